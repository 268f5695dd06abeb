"""Robustness for analyze.py: trained policies tested under noise, from robustness.csv of each run.

evaluate.py writes these files. The unit of replication is the seed: a run's value under a test
condition is the mean over its episodes there.

The primary figure is the score on noise that was not in training: 100 (R - C) / |C|, where R is a
run's mean return under a condition and C the mean clean return of the policies trained without
noise in that environment, averaged equally over the conditions. A condition counts if it is not
clean, none of its wrappers was in training, and none is reward noise or early termination, which
change no policy's behaviour in a test. It is compared with the score of the policies trained
without noise under the same conditions, by the exact test of the mean win rate over
environments, with Holm's correction over the training configurations of an algorithm.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from analysis.formatting import P_VALUE, SHARE, WHOLE, Table
from analysis.runs import KEYS, ROBUSTNESS_COLUMNS, STUDY, study_name
from analysis.statistics import (
    DETECTABLE,
    LEVEL,
    contrast,
    holm,
    improvement_percent,
    mann_whitney,
    mean_std,
    probability_of_improvement,
)
from analysis.verdicts import counted, p_value
from noisy_wrappers import BASELINE, Configuration

FILES = ("robustness.csv", "robustness.csv.gz")
CONDITION = ["test_noise", "test_rate"]
CLEAN = BASELINE  # a condition of a test is a Configuration, too
RUN_COLUMNS = [*KEYS, "configuration", "seed", *CONDITION, "condition", "mean", "cvar"]
COLUMNS = [*KEYS, *CONDITION, "tested_on", "n", "mean", "std", "change_percent", "cvar"]
SCORE_COLUMNS = [*STUDY, "scope", "environment", "noise", "noise_rate", "n", "n_baseline"]
SCORE_COLUMNS += ["conditions", "score", "baseline_score"]
SCORE_COLUMNS += ["difference", "difference_low", "difference_high"]
SCORE_COLUMNS += ["win_rate", "p", "p_holm"]
SCORE_COLUMNS += ["smallest_p", "detectable"]
SCORE_COLUMNS += ["clean_change_percent", "cvar_score", "baseline_cvar_score"]
SCORE_COLUMNS += ["worst_score", "baseline_worst_score", "worst_condition"]
FORMATS = dict.fromkeys(("n", "n_baseline", "conditions"), WHOLE)
FORMATS |= dict.fromkeys(("p", "p_holm", "smallest_p"), P_VALUE) | {"win_rate": SHARE}

CAPTIONS = {
    "robustness_score": """Primary figure of robustness: the score on noise that was not in
training, of policies trained with noise and without.""",
    "robustness": """Return under every test condition: mean \u00b1 standard deviation over n seeds,
and change against the policies trained without noise.""",
}
HOW = {
    "robustness_score": """Score: 100 (R - C) / |C|, averaged equally over the test conditions that
are not clean and have no wrapper of the training (and neither reward noise nor early termination),
where R is the mean return of a run under a condition and C the mean clean return of the policies
trained without noise. Baseline score: the same of the policies trained without noise, under the
same conditions. [ ]: 95 % interval (Welch, Satterthwaite). Win rate: how often a policy has a
higher score than one trained without noise, averaged over environments. p: its exact two-sided
test, in one environment Mann and Whitney's; it decides where the interval says otherwise. Holm:
corrected for the training configurations of an algorithm; smallest p: what these numbers of seeds
could reach at most; detectable: the difference that they find with 80 % power, for normal scores.
Rows of one environment are secondary where there is one of all. Clean change: how much better or
worse the policies are without any noise, so that a better policy is not taken for a more robust
one. Worst: the lowest score under one condition. CVaR: the score of the worst tenth of the episodes
of each seed.""",
    "robustness": """Change: against the policies trained without noise under the same condition.
Tested on: clean; the same noise as in training; the same wrapper with other parameters or another
rate; new noise. CVaR: mean of the worst tenth of a seed's episodes, then over seeds.""",
}
CAPTIONS, HOW = (
    {name: " ".join(text.split()) for name, text in texts.items()} for texts in (CAPTIONS, HOW)
)


def read_robustness(runs_dir, runs):
    """Read robustness.csv (or .csv.gz) of every finished run: one row per run and condition.

    Return the frame (RUN_COLUMNS) and notes on the files that could not be read.
    """
    rows, notes = [], []
    for run in runs[runs["status"] == "finished"].itertuples():
        paths = [Path(runs_dir) / run.run / name for name in FILES]
        paths = [path for path in paths if path.exists()]
        if not paths:
            continue
        try:
            episodes = read_episodes(paths[0])
        except (OSError, ValueError, EOFError) as error:
            notes.append(f"{run.run}: {paths[0].name} is left out: {' '.join(str(error).split())}")
            continue
        keys = [getattr(run, name) for name in (*KEYS, "configuration", "seed")]
        for condition, returns in episodes.items():
            spelled = condition.noise, condition.noise_rate
            rows.append((*keys, *spelled, condition, returns.mean(), cvar(returns)))
    return pd.DataFrame(rows, columns=RUN_COLUMNS), notes


def read_episodes(path):
    """Read one file: a dict of Configuration -> returns of its episodes. Raises ValueError."""
    text = {"noise": str, "noise_rate": str}
    table = pd.read_csv(path, dtype=text, keep_default_na=False)
    if list(table.columns) != ROBUSTNESS_COLUMNS:
        raise ValueError("unexpected header")
    returns = pd.to_numeric(table["episodic_return"])
    if not np.isfinite(returns).all() or not len(returns):
        raise ValueError("no episodes, or a return that is not finite")
    groups = returns.groupby([table["noise"], table["noise_rate"]], sort=False)
    return {Configuration.parse(*key): group.to_numpy(float) for key, group in groups}


def cvar(returns):
    """Mean of the worst tenth of the returns (n), rounded up to whole episodes."""
    return np.sort(returns)[: -(-len(returns) // 10)].mean()


def is_unseen(condition, config):
    """Tell whether a test condition counts in the score of a training configuration."""
    ends = "RandomEarlyTermination" in condition.wrappers
    changes_behaviour = "reward" not in condition.kinds and not ends
    new = set(condition.wrappers).isdisjoint(config.wrappers)
    return not condition.is_baseline and changes_behaviour and new


def is_seen(condition, config):
    """Tell whether a test condition consists of wrappers that were in training."""
    return not condition.is_baseline and set(condition.wrappers) <= set(config.wrappers)


def tested_on(condition, config):
    """Say in words how a test condition is related to the training configuration."""
    if condition == CLEAN:
        return "clean"
    if condition == config:
        return "the same noise"
    if set(condition.wrappers) & set(config.wrappers):
        return "the same wrapper"
    return "new noise"


def by_run(runs, config, value):
    """Arrange the runs of a configuration as a frame (seeds x conditions) of `value`."""
    mine = runs[runs["configuration"] == config]
    return mine.pivot(index="seed", columns="condition", values=value)


def condition_rows(runs):
    """Yield one row per training configuration and test condition, in each environment."""
    for key, group in runs.groupby([*STUDY, "environment"]):
        baseline = by_run(group, BASELINE, "mean").mean()
        for config in sorted(set(group["configuration"])):
            means, cvars = by_run(group, config, "mean"), by_run(group, config, "cvar")
            for condition in sorted(means.columns):
                mean, std, n = mean_std(means[condition])
                row = dict(zip(KEYS, (*key, config.noise, config.noise_rate), strict=True))
                row |= {"test_noise": condition.noise, "test_rate": condition.noise_rate}
                row |= {"tested_on": tested_on(condition, config), "n": n, "mean": mean, "std": std}
                row["cvar"] = cvars[condition].mean()
                if config != BASELINE and condition in baseline:
                    row["change_percent"] = improvement_percent(mean, baseline[condition])
                yield row


def environment_scores(runs, config, counts):
    """Score a configuration and the baseline in one environment, or return None.

    runs: those of one study and environment. counts(condition, config) tells which conditions
    count. The result is a dict with arrays: `x` (seeds) and `y` (baseline seeds) are scores,
    `x_cvar` and `y_cvar` the same of the worst tenth of the episodes, `clean` (seeds) is the change
    of the clean return in percent; `x_conditions` and `y_conditions` are Series with the mean score
    under each condition.
    """
    x, y = by_run(runs, config, "mean"), by_run(runs, BASELINE, "mean")
    if x.empty or y.empty or CLEAN not in x or CLEAN not in y:
        return None
    shared = x.columns.intersection(y.columns)
    whole = [c for c in shared if x[c].notna().all() and y[c].notna().all()]
    conditions = [condition for condition in whole if counts(condition, config)]
    clean = y[CLEAN].mean()
    if not conditions or clean == 0:
        return None

    def score(values):
        return improvement_percent(values[conditions], clean)

    x_cvar = by_run(runs, config, "cvar")
    y_cvar = by_run(runs, BASELINE, "cvar")
    return {
        "x": score(x).mean(axis=1).to_numpy(),
        "y": score(y).mean(axis=1).to_numpy(),
        "x_cvar": score(x_cvar).mean(axis=1).to_numpy(),
        "y_cvar": score(y_cvar).mean(axis=1).to_numpy(),
        "clean": improvement_percent(x[CLEAN].dropna().to_numpy(), clean),
        "x_conditions": score(x).mean(),
        "y_conditions": score(y).mean(),
    }


def score_rows(runs, counts=is_unseen):
    """Yield the score of every configuration with noise: over all environments, then in each.

    counts(condition, config) tells whether a test condition counts for a training configuration.
    """
    for study, group in runs.groupby(STUDY):
        for config in sorted(set(group["configuration"])):
            if config == BASELINE:
                continue
            scores = {}
            for environment, same in group.groupby("environment"):
                found = environment_scores(same, config, counts)
                if found:
                    scores[environment] = found
            if len(scores) > 1:
                yield score_row(study, "all", "", config, scores)
            for environment, found in scores.items():
                yield score_row(study, "environment", environment, config, {environment: found})


def score_row(study, scope, environment, config, scores):
    """Return one row of scores; environments count equally, whatever their number of seeds."""
    found = list(scores.values())
    cells = [part["x"] for part in found] + [part["y"] for part in found]
    weights = [1 / len(found)] * len(found) + [-1 / len(found)] * len(found)
    difference, error, low, high = contrast(cells, weights)
    x, y = (stacked(part[name] for part in found) for name in ("x", "y"))
    p, smallest_p = mann_whitney(x, y)
    win_rate, _, _ = probability_of_improvement(x, y)
    worst = {
        (name, condition): value
        for name, part in scores.items()
        for condition, value in part["x_conditions"].items()
    }
    worst_place, worst_condition = min(worst, key=worst.get)
    where = f" on {worst_place}" if scope == "all" else ""

    def average(name):
        return np.mean([np.mean(part[name]) for part in found])

    return {
        **dict(zip(STUDY, study, strict=True)),
        "scope": scope,
        "environment": environment,
        "noise": config.noise,
        "noise_rate": config.noise_rate,
        "n": min(len(part["x"]) for part in found),
        "n_baseline": min(len(part["y"]) for part in found),
        "conditions": min(len(part["x_conditions"]) for part in found),
        "score": average("x"),
        "baseline_score": average("y"),
        "difference": difference,
        "difference_low": low,
        "difference_high": high,
        "win_rate": win_rate,
        "p": p,
        "smallest_p": smallest_p,
        "detectable": DETECTABLE * error,
        "clean_change_percent": average("clean"),
        "worst_score": min(worst.values()),
        "baseline_worst_score": min(part["y_conditions"].min() for part in found),
        "worst_condition": f"{worst_condition.noise} at {worst_condition.noise_rate}{where}",
        "cvar_score": average("x_cvar"),
        "baseline_cvar_score": average("y_cvar"),
    }


def stacked(samples):
    """Put samples of different sizes side by side: (most seeds x samples), padded with NaN."""
    samples = list(samples)
    table = np.full((max(map(len, samples)), len(samples)), np.nan)
    for column, sample in zip(table.T, samples, strict=True):
        column[: len(sample)] = sample
    return table


def primary(scores):
    """Return which rows of scores are primary: of all environments, or of the only one."""
    together = (scores["scope"] == "all").astype(bool)
    keys = [*STUDY, "noise", "noise_rate"]
    return together | ~together.groupby([scores[name] for name in keys]).transform("any")


def robustness_tables(runs):
    """Compute the tables of robustness from read_robustness's frame: name -> Table."""
    if runs.empty:
        return {}
    table = pd.DataFrame(condition_rows(runs), columns=COLUMNS)
    scores = pd.DataFrame(score_rows(runs), columns=SCORE_COLUMNS)
    for _, family in scores[primary(scores)].groupby(STUDY):
        scores.loc[family.index, "p_holm"] = holm(family["p"].to_numpy(float))
    tables = {"robustness_score": scores, "robustness": table}
    only_csv = {"robustness_score": ("smallest_p",)}
    return {
        name: Table(
            name, frame, CAPTIONS[name], "robustness", FORMATS, HOW[name], only_csv.get(name, ())
        )
        for name, frame in tables.items()
    }


def robustness_sentences(scores):
    """Yield one plain sentence for each training configuration: is it more robust?"""
    for row in scores[primary(scores)].itertuples():
        where = row.environment or "all environments together"
        study = study_name(row.algorithm, row.settings, row.phase)
        verdict = "no clear difference in robustness to new noise"
        if row.p <= LEVEL:
            more = "more" if row.win_rate > 0.5 else "less"
            verdict = f"{'' if row.p_holm <= LEVEL else 'perhaps '}{more} robust to new noise"
        limit = ""
        if row.smallest_p > LEVEL:
            limit = f"; {counted(row.n, 'seed')} against {row.n_baseline} cannot show any"
        elif row.p > LEVEL and row.detectable > 0:
            limit = f"; a difference of {row.detectable:.0f} would have been seen (80 % power)"
        corrected = p_value(row.p_holm).removeprefix("= ")
        yield (
            f"{study} on {where}, trained with {row.noise} at rate {row.noise_rate}: "
            f"{verdict} (score {row.score:.0f} against {row.baseline_score:.0f} without noise in "
            f"training, p {p_value(row.p)}, Holm {corrected}; clean return "
            f"{row.clean_change_percent:+.0f} %){limit}."
        )
