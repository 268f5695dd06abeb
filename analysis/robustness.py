"""Robustness for analyze.py: trained policies tested under noise, from robustness.csv of each run.

evaluate.py writes these files. The unit of replication is the seed: a run's value under a test
condition is the mean over its episodes there.

The primary figure is the mean return over all conditions but those of the training itself, compared
with that of the policies trained without noise under the same conditions by the test of all
verdicts, with Holm's correction; docs/statistics.md has the details. All of this may be of the rate
of success instead of the return, in percentage points.
"""

from itertools import zip_longest

import numpy as np
import pandas as pd

from analysis import verdicts
from analysis.comparisons import UNTESTED, are_in
from analysis.episodes import read_episodes, wrapper_names
from analysis.folders import RETURN, SEARCH, SUCCESS, DamageError
from analysis.formatting import listed, p_value, percent, seeds_of
from analysis.runs import KEYS, STUDY, study_name, study_of, where_tested
from analysis.statistics import are_different, compare, holm, mean_std, percent_of
from analysis.tables import table_of
from analysis.words import counted
from noisy_wrappers import BASELINE, WRAPPERS

CLEAN = BASELINE  # a condition of a test is a Configuration, too
RUN_COLUMNS = [*STUDY, "environment", "configuration", "seed", "elsewhere", "condition", "mean"]
COLUMNS = [*KEYS, "test_noise", "test_rate", "tested_on", "n", "mean", "std", "difference"]
COLUMNS += ["change_percent", "score_percent"]
SCORE_COLUMNS = """environment noise noise_rate n n_baseline conditions conditions_tested difference
    difference_low difference_high difference_percent effect_size p p_holm detectable score_percent
    baseline_score_percent clean_change_percent t pooled_std smallest_p"""
SCORE_COLUMNS = [*STUDY, *SCORE_COLUMNS.split()]
MORE = ["percent_low", "percent_high", "n_baseline_most", "primary", "elsewhere", "where"]
MORE += ["lopsided"]  # what sentences need besides


def read_robustness(runs, metric=RETURN):
    """Read robustness.csv of runs that count: one row per run and condition.

    metric: what `mean` is of; of success (in percent), only conditions in which the environment
    tells it, to some run; the others had none there. Return the frame (RUN_COLUMNS) and notes.
    """
    rows, notes = [], []
    for run in runs:
        try:
            tests = read_episodes(run.folder)
        except DamageError as error:
            notes.append(f"{run.folder.name} has no tests of robustness: {error}")
            continue
        row = dict(zip(STUDY, study_of(run), strict=True))
        row |= {"configuration": run.configuration, "seed": run.seed}
        for (condition, elsewhere), episodes in tests.items():
            row |= {"condition": condition, "elsewhere": elsewhere}
            row["environment"] = where_tested(run.environment, elsewhere)
            rows.append(row | {"mean": results_of(episodes, metric)})
    table = pd.DataFrame(rows, columns=RUN_COLUMNS)
    place = [table["environment"], table["condition"]]
    told = table["mean"].map(np.mean).notna().groupby(place).transform("any")
    silent = table[~told].groupby(["environment", "condition"]).ngroups
    if silent:
        notes.append(f"no test of robustness tells success in {counted(silent, 'test condition')}")
    table, more = shortened(table[told])
    return table.fillna({"mean": 0.0}), notes + more


def results_of(episodes, metric):
    """Return the returns of episodes, or their success: 100 or 0, NaN where none tells it."""
    if metric == RETURN:
        return episodes[:, 0]
    success = 100 * episodes[:, 2]
    return success if np.isnan(success).all() else np.nan_to_num(success)


def shortened(table):
    """Return the table with means of the results of episodes, and notes where not all count.

    Episode i begins in the same state in all tests of an environment, so the tests are compared
    over the episodes that all of them have.
    """
    places = [*STUDY, "environment"]
    number = table["mean"].map(len)
    least = number.groupby([table[name] for name in places]).transform("min")
    means = [results[:n].mean() for results, n in zip(table["mean"], least, strict=True)]
    table = table.assign(mean=np.array(means, float), number=number)
    notes = []
    for (*study, environment), group in table.groupby(places):
        few, many = group["number"].min(), group["number"].max()
        if few < many:
            notes.append(
                f"{study_name(*study)} on {environment}: tests have {few} to {many} episodes; the "
                f"first {few} count, which begin alike (evaluate.py --episodes {many} plays the "
                "others)"
            )
        conditions = group["condition"].nunique()
        played = group.groupby(["configuration", "seed"])["condition"].nunique()
        if lacking := (played < conditions).sum():
            notes.append(
                f"{study_name(*study)} on {environment}: {lacking} of {len(played)} tested runs "
                f"lack some of the {conditions} test conditions; a condition counts where all runs "
                "that are compared have it"
            )
    return table, notes


def tested_on(condition, config):
    """Say in words how a test condition is related to the training configuration."""
    if condition == CLEAN:
        return "clean"
    if condition == config:
        return "the same noise"
    if set(wrapper_names(condition)) & set(wrapper_names(config)):
        return "the same wrapper"
    return "new noise"


def by_run(runs, config):
    """Arrange the mean returns of a configuration as a frame (seeds x conditions)."""
    mine = runs[runs["configuration"] == config]
    return mine.pivot(index="seed", columns="condition", values="mean")


def row_keys(runs, config):
    """Return the columns KEYS of the results of one configuration in one environment."""
    names = [*STUDY, "environment"]
    return runs.iloc[0][names].to_dict() | {"noise": config.noise, "noise_rate": config.noise_rate}


def condition_rows(runs):
    """Yield one row per training configuration and test condition, in each environment."""
    for _, group in runs.groupby([*STUDY, "environment"]):
        baseline = by_run(group, BASELINE)
        for (config, condition), tests in group.groupby(["configuration", "condition"]):
            mean, std, n = mean_std(tests["mean"])
            row = row_keys(tests, config)
            row |= {"test_noise": condition.noise, "test_rate": condition.noise_rate}
            row |= {"tested_on": tested_on(condition, config), "n": n, "mean": mean, "std": std}
            if config != BASELINE and condition in baseline:
                row["difference"] = mean - baseline[condition].mean()
                values = baseline[condition]
                row["change_percent"] = percent_of(row["difference"], values, tests["mean"])
            if CLEAN in baseline:
                clean = baseline[CLEAN]
                row["score_percent"] = percent_of(mean - clean.mean(), clean, tests["mean"])
            yield row


def score_rows(runs, metric=RETURN):
    """Yield the score of every configuration with noise: over all environments, then in each.

    `primary` are those over all environments that have two seeds of both kinds, of which not all
    have the same result, or in the only one.
    Tests in another environment are apart: they leave those at home as they are.
    """
    for _, group in runs.groupby(STUDY):
        tested = group.loc[group["elsewhere"] == "", "environment"].nunique()
        configs = sorted({*group["configuration"]} - {BASELINE})
        noises = [config.noise for config in configs]
        for config in configs:
            has_rates = noises.count(config.noise) > 1
            scores = [
                environment_score(same, config, metric, has_rates)
                for _, same in group.groupby("environment")
            ]
            scores = [score for score in scores if score]
            at_home = [score for score in scores if not score["elsewhere"]]
            counting = [
                score
                for score in at_home
                if min(score["n"], score["n_baseline"]) >= 2
                and are_different(np.concatenate([score["x"], score["y"]]))
            ]
            counting = counting or at_home
            if len(counting) > 1:
                of = f"{len(counting)} of {tested}" if len(counting) < tested else "all"
                where = f"{of} environments together"
                yield average_score(counting, metric) | {"primary": True, "where": where}
            for score in scores:
                is_only = len(counting) == 1 and score is counting[0]
                yield score | {"primary": bool(score["elsewhere"]) or is_only}


def environment_score(runs, config, metric=RETURN, has_rates=False):
    """Score a configuration against the baseline in one environment, or return None.

    runs: those of one study and environment. has_rates: the noise has other rates, too, so with
    lopsided numbers of seeds there is no p. The result is a row of SCORE_COLUMNS with `x` (seeds)
    and `y` (baseline seeds), the mean returns over the conditions. What is in percent is relative
    to the clean return of the baseline, NaN where that has no percentages.
    """
    x, y = by_run(runs, config), by_run(runs, BASELINE)
    if CLEAN not in x or CLEAN not in y:
        return None
    complete = pd.concat([x, y]).notna().all()
    shared = complete.index[complete]
    conditions = [name for name in shared if name != config and not is_clean(name)]
    if not conditions:
        return None
    clean, clean_x = y[CLEAN], x[CLEAN]
    x, y = (side[conditions].mean(axis=1).to_numpy() for side in (x, y))
    everything = np.concatenate([x, y, clean_x])

    def in_percent(difference):
        return percent_of(difference, clean, everything)

    row = row_keys(runs, config) | {"elsewhere": runs["elsewhere"].iloc[0]}
    episodes = int(runs["number"].min()) if metric == SUCCESS else None
    row |= compare(x, y, episodes=episodes)._asdict() | {"episodes": episodes}
    most = verdicts.MOST_RATIO_OF_RATES if has_rates else verdicts.MOST_RATIO
    row["lopsided"] = verdicts.is_lopsided(len(x), len(y), most)
    row |= {
        "difference_percent": in_percent(x.mean() - y.mean()),
        "percent_low": np.nan,  # of the clean return, so it has no interval
        "percent_high": np.nan,
        "score_percent": in_percent(x.mean() - clean.mean()),
        "baseline_score_percent": in_percent(y.mean() - clean.mean()),
        "clean_change_percent": in_percent(clean_x.mean() - clean.mean()),
    }
    tested = set(runs["condition"]) - {CLEAN}
    return row | {
        "x": x,
        "y": y,
        "conditions": len(conditions),
        "conditions_tested": len(tested),
    }


def is_clean(condition):
    """Tell whether a test is the clean one: noise on rewards leaves returns as they are."""
    kinds = {getattr(WRAPPERS.get(name), "kind", "own") for name in wrapper_names(condition)}
    return kinds <= {"reward"}


def average_score(scores, metric=RETURN):
    """Return the row of all environments; they count equally, whatever their number of seeds."""
    table = pd.DataFrame(scores)
    x, y = (np.array([*zip_longest(*table[name], fillvalue=np.nan)]) for name in ("x", "y"))
    episodes = min(table["episodes"]) if metric == SUCCESS else None
    row = scores[0] | compare(x, y, episodes=episodes)._asdict()
    row |= {"environment": "", **table[["conditions", "conditions_tested"]].sum()}
    row["lopsided"] = table["lopsided"].any()
    return row | table.filter(like="percent").mean(skipna=False).to_dict()


def analyse_robustness(runs, metric=RETURN):
    """Return the tables of read_robustness's frame, by name, and the sentences on its scores."""
    if runs.empty:
        return {}, []
    table = pd.DataFrame(condition_rows(runs), columns=COLUMNS)
    scores = pd.DataFrame(score_rows(runs, metric), columns=[*SCORE_COLUMNS, *MORE])
    scores.loc[scores["lopsided"].astype(bool), UNTESTED] = np.nan
    primary = scores[scores["primary"].astype(bool)]
    for _, family in primary[primary["p"].notna()].groupby([*STUDY, "elsewhere"]):
        scores.loc[family.index, "p_holm"] = holm(family["p"].to_numpy(float))
    note, score_note = "", "Percentages and scores: of the clean return without noise."
    if metric == SUCCESS:  # never percent of a rate
        note = "Rates are in percent of the episodes, differences in percentage points."
        score_note = note
        for frame in (scores, table):
            frame[frame.filter(regex="_percent$").columns] = np.nan
    sentences = list(robustness_sentences(scores.loc[primary.index], metric))
    sentences += not_compared(table, scores)
    more = {"section": "robustness", "only_csv": ("t", "pooled_std", "smallest_p")}
    tables, is_alone = {}, scores["environment"] != ""
    for name, rows in (("robustness_together", ~is_alone), ("robustness_score", is_alone)):
        part = scores.loc[rows, SCORE_COLUMNS]
        if name == "robustness_together":
            part = part.drop(columns="environment")
        tables[name] = table_of(name, part, note=score_note, **more)
    tables["robustness"] = table_of("robustness", table, note=note, only_csv=("score_percent",))
    return tables, sentences


def not_compared(table, scores):
    """Yield a sentence where policies trained with noise were tested under noise and have no score.

    table: the results under all conditions.
    """
    of_noise = (table["noise"] != "") & (table["test_noise"] != "")
    of_noise &= table["phase"] != SEARCH  # which has no baseline
    tested = table[of_noise][KEYS].drop_duplicates()
    for key, rows in tested[~are_in(tested, scores)].groupby(STUDY):
        where = listed(sorted(set(rows["environment"])))
        yield (
            f"{study_name(*key)} on {where}: {counted(len(rows), 'training configuration')} not "
            "compared under noise, because no policy trained without noise was tested under the "
            "same conditions; python evaluate.py, with the folder of all these runs and the "
            "options of the other tests, plays what is missing (noise on rewards and the noise of "
            "the training itself do not count)."
        )


def robustness_sentences(scores, metric):
    """Yield one plain sentence for each training configuration: does it return more under noise?"""
    unit = verdicts.POINTS if metric == SUCCESS else ""
    ways = {1: "returns more", -1: "returns less", 0: verdicts.UNCLEAR}
    if metric == SUCCESS:
        ways |= {1: "succeeds more often", -1: "succeeds less often"}
    for row in scores.itertuples():
        where = row.environment or row.where
        study = study_name(*(getattr(row, name) for name in STUDY))
        start = f"{study} on {where}, trained with {row.noise} at rate {row.noise_rate}"
        over = f"over {row.conditions} of {counted(row.conditions_tested, 'test condition')}"
        shown, limit = f"{ways[0]} under noise", ""
        evidence = verdicts.difference_in_words(row, unit, " of the clean return without noise")
        if min(row.n, row.n_baseline) < 2:
            shown = "too few seeds for a test of robustness"
        elif row.lopsided:
            seeds = seeds_of(row.n, row.n_baseline, row.n_baseline_most)
            shown = f"no verdict with {seeds} seeds, which would be wrong too often,"
        else:
            corrected = p_value(row.p_holm).removeprefix("= ")
            evidence += f", p {p_value(row.p)}{verdicts.smallest(row)}, Holm {corrected}"
            limit = verdicts.excluded(row, unit) + verdicts.cannot_show(row)
        if verdicts.significant(row.p_holm):
            way = verdicts.direction(row.t, row.effect_size, row.difference_percent)
            shown = f"{ways[way]} under noise"
            limit = verdicts.undirected(row)
        if pd.notna(row.clean_change_percent):
            evidence += f"; clean return {percent(row.clean_change_percent)}"
        yield f"{start}: {shown} {over} ({evidence}){limit}.{verdicts.borderline(row)}"
