"""From a folder of runs to the paper's tables and figures, with statistics fit for few seeds.

    python analyze.py
    python analyze.py --runs-dir runs --out results --compare results/paper

Open results/report.html first. Tables are written as csv, md and tex, figures as png and pdf.

The unit of replication is the seed: a run's value at a step is the mean over its test episodes, and
every mean, standard deviation (ddof=1) and interval is taken over runs. Only finished runs (those
with a result.json) count; all others are listed. The paper is Khraishi and Okhrati (2023),
https://arxiv.org/abs/2305.02882; IQM and probability of improvement are those of Agarwal et al.
(2021), https://arxiv.org/abs/2108.13264.
"""

import sys
from dataclasses import dataclass
from functools import cache, reduce
from itertools import product
from math import ceil, comb, prod
from pathlib import Path

import numpy as np
import pandas as pd
import tyro
from scipy import stats
from scipy.optimize import brentq

from analyze_compare import compare_tables, read_paper
from analyze_report import figures, text_table, write_figure, write_report, write_table
from analyze_runs import BASELINE, KEYS, make_studies, missing_runs, read_runs

MIN_SEEDS = 3  # with fewer there is no interval
RESAMPLES = 2000
# Seeds -> percent of simulated samples whose 95 % interval holds the true IQM: the worst of normal
# and skewed returns and of returns of which 20 % lie in a low peak; and the worst where 40 % do
# (tests/test_statistics.py::test_coverage, 500 samples each).
COVERAGE = {3: 94, 5: 96, 10: 95, 20: 95}
COVERAGE_OF_MIXTURES = {3: 75, 5: 85, 10: 89, 20: 86}


@dataclass
class Args:
    """Command-line arguments."""

    runs_dir: Path = Path("runs")
    """the folder that holds the run folders"""
    out: Path = Path("results")
    """where the tables, the figures and report.html go"""
    compare: Path | None = None
    """a folder with the paper's tables as csv (results/paper): adds compare_* tables"""


# -------------------------------------------------------------- statistics on (seeds x envs) arrays


def columns(scores):
    """Split a (seeds x envs) array into one array per environment, without the missing runs."""
    return [column[np.isfinite(column)] for column in np.asarray(scores, float).T]


def mean_std(values):
    """Mean, sample standard deviation (ddof=1) and number of the values that are not NaN."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    mean = values.mean() if len(values) else np.nan
    return mean, values.std(ddof=1) if len(values) > 1 else np.nan, len(values)


def improvement_percent(noisy, baseline):
    """100 (noisy - baseline) / |baseline|: positive is better, for negative returns too."""
    scale = np.where(np.equal(baseline, 0), np.nan, np.abs(baseline))
    return 100 * (noisy - baseline) / scale


def iqm(scores):
    """Interquartile mean over the last axis: int(n / 4) values are cut from each end.

    scores (..., n) -> (...). As rliable's aggregate_iqm (Agarwal et al., 2021).
    """
    return stats.trim_mean(scores, 0.25, axis=-1)


def bootstrap_iqm(scores, baseline=None, resamples=RESAMPLES):
    """IQM over seeds and environments with its 95 % interval.

    With a baseline it is the IQM of the scores minus that of the baseline, both in percent of the
    baseline's mean in each environment: zero where the two are alike, skewed or not.

    The interval is iqm +- t_{0.975, df} sqrt(sum of v). There is one v for each sample (the seeds
    of one environment, with noise or without): n / (n - 1) times the variance of the IQM when
    this sample is drawn anew from its own n seeds (Efron and Tibshirani, 1993, chapter 12). df is
    Satterthwaite's (1946), (sum of v)^2 / sum of v^2 / (n - 1), so few seeds of the baseline count.

    scores (seeds x envs), baseline (other seeds x envs) or None -> iqm, low, high.
    """
    rng = np.random.default_rng(0)

    def improvement(x, y):
        means = [cell.mean(axis=-1, keepdims=True) for cell in y]
        pairs = zip(x, means, strict=True)
        return iqm(np.concatenate([improvement_percent(*pair) for pair in pairs], axis=-1))

    def estimate(cells):
        x, y = cells[: len(noisy)], cells[len(noisy) :]
        return improvement(x, y) - improvement(y, y) if y else iqm(np.concatenate(x, axis=-1))

    noisy = columns(scores)
    cells = noisy + ([] if baseline is None else columns(baseline))
    value = estimate(cells)
    n = np.array([len(cell) for cell in cells])
    if n.min() < MIN_SEEDS:
        return value, np.nan, np.nan
    observed = [np.broadcast_to(cell, (resamples, len(cell))) for cell in cells]
    variances = np.empty(len(cells))
    for i, cell in enumerate(cells):
        drawn = cell[rng.integers(n[i], size=(resamples, n[i]))]
        estimates = estimate([*observed[:i], drawn, *observed[i + 1 :]])
        variances[i] = n[i] / (n[i] - 1) * estimates.var(ddof=1)
    variance = variances.sum()
    if variance == 0:  # all seeds alike
        return value, value, value
    df = variance**2 / (variances**2 / (n - 1)).sum()
    half = stats.t.ppf(0.975, df) * np.sqrt(variance)
    return value, value - half, value + half


def wins(x, y):
    """Mann-Whitney's U: the number of pairs with x > y, a tie counting half. x (n), y (m)."""
    return (x[:, None] > y).sum() + 0.5 * (x[:, None] == y).sum()


def newcombe_interval(p, n, m):
    """95 % interval of a win rate p of n against m: method 5 of Newcombe (2006).

    Unlike the percentile bootstrap it does not collapse to a point at p = 0 or 1.
    https://doi.org/10.1002/sim.2324
    """
    z, k = stats.norm.ppf(0.975), (n + m) / 2 - 1

    def gap(t):
        variance = t * (1 - t) * (1 + k * (1 - t) / (2 - t) + k * t / (1 + t)) / (n * m)
        return (p - t) ** 2 - z**2 * variance

    inside = np.clip(p, 1e-9, 1 - 1e-9)  # at 0 and 1 the gap is zero without being a limit
    low = brentq(gap, 0, inside) if p > 0 else 0.0
    high = brentq(gap, inside, 1) if p < 1 else 1.0
    return low, high


def probability_of_improvement(x, y):
    """P(x > y) averaged over environments (as rliable), with a 95 % interval.

    The environments' Newcombe intervals are combined by the square-and-add rule (MOVER; Zou and
    Donner, 2008). x (seeds x envs), y (seeds x envs) -> p, low, high.
    """
    x, y = columns(x), columns(y)
    rates = np.array([wins(a, b) / (len(a) * len(b)) for a, b in zip(x, y, strict=True)])
    if min(map(len, x + y)) < MIN_SEEDS:
        return rates.mean(), np.nan, np.nan
    limits = [newcombe_interval(p, len(a), len(b)) for p, a, b in zip(rates, x, y, strict=True)]
    below, above = np.abs(rates[:, None] - limits).T
    p = rates.mean()
    return p, p - np.hypot.reduce(below) / len(x), p + np.hypot.reduce(above) / len(x)


@cache
def mann_whitney_null(n, m):
    """Probabilities of U = 0 ... n m when all orders of n + m values are equally likely."""
    if n == 0 or m == 0:
        return np.ones(1)
    null = np.zeros(n * m + 1)  # the largest value belongs to x (it wins m pairs) or to y
    null[m:] += n / (n + m) * mann_whitney_null(n - 1, m)
    null[: n * (m - 1) + 1] += m / (n + m) * mann_whitney_null(n, m - 1)
    return null


def mann_whitney(x, y):
    """Exact two-sided Mann-Whitney test, stratified by environment: p, and the smallest possible p.

    The statistic is the sum of U over environments; its null distribution is the convolution of
    theirs. x (seeds x envs), y (seeds x envs) -> p, smallest p = 2 / prod over envs of C(n+m, n).
    """
    pairs = list(zip(columns(x), columns(y), strict=True))
    sizes = [(len(a), len(b)) for a, b in pairs]
    u = sum(wins(a, b) for a, b in pairs)
    null = reduce(np.convolve, [mann_whitney_null(n, m) for n, m in sizes])
    below, above = null[: int(np.ceil(u)) + 1].sum(), null[int(np.floor(u)) :].sum()
    smallest = 2 / prod(comb(n + m, n) for n, m in sizes)
    return min(1.0, 2 * min(below, above)), min(1.0, smallest)


def leave_one_seed_out(finals):
    """Value of the best configuration without the luck of choosing it on its own seeds.

    The configuration that is best on all other seeds is measured on the seed s that was left out:
    mean over s of finals[argmax_c mean_{t != s} finals[c, t], s].

    finals (configs x seeds) -> float.
    """
    held_out = []
    for seed in range(finals.shape[1]):
        others = np.delete(finals, seed, axis=1)
        able = np.isfinite(finals[:, seed]) & np.isfinite(others).any(axis=1)
        if able.any():
            held_out.append(finals[able, seed][np.nanmean(others[able], axis=1).argmax()])
    return np.mean(held_out) if held_out else np.nan


def steps_to_reach(curves, steps, target):
    """First step with a mean over seeds of at least `target`, or NaN. curves (steps x seeds)."""
    curves = curves[:, np.isfinite(curves).all(axis=0)]
    means = curves.mean(axis=1)
    # The last mean of the baseline is its own target, but rounding depends on the order of a sum.
    reached = np.flatnonzero((means >= target) | np.isclose(means, target, rtol=1e-9))
    return steps[reached[0]] if len(reached) else np.nan


# ------------------------------------------------------------------------------------------- tables

COLUMNS = {
    "summary": """algorithm environment noise noise_rate n mean std n_baseline baseline_mean
        baseline_std improvement_percent std_change_percent steps_to_baseline""",
    "best": """algorithm environment noise noise_rate baseline_mean baseline_std noisy_mean
        noisy_std improvement_percent leave_one_seed_out_percent n n_baseline chosen_from
        leave_one_seed_out_mean""",
    "consistency": """algorithm noise noise_rate percent_of_environments
        average_improvement_percent std_improvement_percent environments n fails_at_every_rate""",
    "early_performance": "algorithm environment noise steps_millions noise_rate mean std n",
    "statistics": """algorithm environment noise noise_rate environments n n_baseline
        iqm iqm_low iqm_high improvement_iqm_percent improvement_low improvement_high
        probability_of_improvement probability_low probability_high excludes_no_improvement
        p p_adjusted smallest_p smallest_p_adjusted""",
}


def frame(name, rows):
    """Make a table of a list of dicts, with the columns of its kind even when it is empty."""
    return pd.DataFrame(list(rows), columns=COLUMNS[name].split())


def summary_rows(study):
    """Yield the final mean and std of every configuration, against the baseline of its env."""
    for (e, env), config in product(enumerate(study.environments), study.returns):
        mean, std, n = mean_std(study.final(config)[:, e])
        if n == 0:
            continue
        base_mean, base_std, base_n = mean_std(study.final(BASELINE)[:, e])
        row = dict(zip(KEYS, (study.algorithm, env, *config), strict=True))
        row |= {"n": n, "mean": mean, "std": std}
        row |= {"n_baseline": base_n, "baseline_mean": base_mean, "baseline_std": base_std}
        if config != BASELINE:
            row["improvement_percent"] = improvement_percent(mean, base_mean)
            row["std_change_percent"] = improvement_percent(std, base_std)
        curves = study.returns[config][..., e]
        yield row | {"steps_to_baseline": steps_to_reach(curves, study.steps, base_mean)}


def best_rows(study, summary):
    """Yield the best noise per environment, with the leave-one-seed-out value of choosing it."""
    noisy = summary[summary["improvement_percent"].notna()]
    for env, group in noisy[noisy["algorithm"] == study.algorithm].groupby("environment"):
        best = group.loc[group["mean"].idxmax()]
        e = study.environments.index(env)
        finals = np.stack([study.final(c)[:, e] for c in study.returns if c != BASELINE])
        held_out = leave_one_seed_out(finals)
        yield best.to_dict() | {
            "noisy_mean": best["mean"],
            "noisy_std": best["std"],
            "chosen_from": len(group),
            "leave_one_seed_out_mean": held_out,
            "leave_one_seed_out_percent": improvement_percent(held_out, best["baseline_mean"]),
        }


def consistency_rows(summary):
    """Yield per noise and rate the share of envs that are matched or better, and by how much."""
    keys = ["algorithm", "noise", "noise_rate"]
    for key, group in summary[summary["improvement_percent"].notna()].groupby(keys):
        mean, std, count = mean_std(group["improvement_percent"])
        yield dict(zip(keys, key, strict=True)) | {
            "percent_of_environments": 100 * (group["improvement_percent"] >= 0).mean(),
            "average_improvement_percent": mean,
            "std_improvement_percent": std,
            "environments": count,
            "n": group["n"].min(),
        }


def split_consistency(consistency):
    """Return the rows with at least 80 % of the environments, best first, and those with 0 %.

    One environment says nothing about consistency.
    """
    consistency = consistency[consistency["environments"] > 1]
    share = consistency["percent_of_environments"]
    by = ["algorithm", "percent_of_environments", "average_improvement_percent"]
    good = consistency[share >= 80].drop(columns="fails_at_every_rate")
    good = good.sort_values(by, ascending=[True, False, False], kind="stable")
    highest = share.groupby([consistency["algorithm"], consistency["noise"]]).transform("max")
    bad = consistency.assign(fails_at_every_rate=np.where(highest == 0, "yes", "no"))[share == 0]
    return good, bad


def early_rows(study):
    """Yield mean and std at every 0.2 M steps, or at every fifth of a run below 1 M steps."""
    total = study.steps[-1]
    stride = 200_000 if total >= 1_000_000 else total / 5
    wanted = np.arange(1, round(total / stride) + 1) * stride
    places = np.unique(np.searchsorted(study.steps, wanted, side="right") - 1)
    noises = sorted({noise for noise, _ in study.returns if noise})
    for (e, env), noise in product(enumerate(study.environments), noises):
        configs = [config for config in study.returns if config[0] in ("", noise)]
        if not any(np.isfinite(study.final(c)[:, e]).any() for c in configs if c[0]):
            continue  # not tried here: the baseline alone would be no comparison
        for i, config in product(places[places >= 0], configs):
            mean, std, n = mean_std(study.returns[config][i, :, e])
            row = dict(zip(KEYS, (study.algorithm, env, noise, config[1]), strict=True))
            row |= {"steps_millions": study.steps[i] / 1e6, "mean": mean, "std": std, "n": n}
            if n:
                yield row


def statistics_rows(study):
    """Yield IQM, improvement, probability of improvement and test, per env and over several."""
    envs = np.array(study.environments)
    pusher = np.array([env.startswith("Pusher") for env in envs])
    scopes = [(env, envs == env) for env in envs]
    if len(envs) > 1:
        scopes.append(("all", np.full(len(envs), True)))
    if pusher.any() and (~pusher).sum() > 1:
        scopes.append(("all but Pusher", ~pusher))
    for (scope, chosen), config in product(scopes, study.returns):
        x, y = study.final(config)[:, chosen], study.final(BASELINE)[:, chosen]
        here = np.isfinite(x).any(axis=0)
        both = here & np.isfinite(y).any(axis=0)
        row = dict(zip(KEYS, (study.algorithm, scope, *config), strict=True))
        if scope.startswith("all"):
            if config == BASELINE or both.sum() < 2:
                continue
        elif not here.any():
            continue
        else:  # returns of different environments have no common scale
            row["n"] = np.isfinite(x).sum()
            row |= zip(("iqm", "iqm_low", "iqm_high"), bootstrap_iqm(x), strict=True)
        yield row | (against_baseline(x[:, both], y[:, both]) if config != BASELINE else {})


def against_baseline(x, y):
    """Return the part of a row of statistics that compares x with y, both (seeds x envs)."""
    if x.shape[1] == 0:
        return {}
    row = {"environments": x.shape[1]}
    row |= {"n": np.isfinite(x).sum(axis=0).min(), "n_baseline": np.isfinite(y).sum(axis=0).min()}
    names = ("improvement_iqm_percent", "improvement_low", "improvement_high")
    row |= zip(names, bootstrap_iqm(x, y), strict=True)
    p, low, high = probability_of_improvement(x, y)
    names = ("probability_of_improvement", "probability_low", "probability_high")
    row |= zip(names, (p, low, high), strict=True)
    if np.isfinite(low):
        verdict = "yes, better" if low > 0.5 else "yes, worse" if high < 0.5 else "no"
        row["excludes_no_improvement"] = verdict
    return row | dict(zip(("p", "smallest_p"), mann_whitney(x, y), strict=True))


def adjust(statistics):
    """Add Benjamini-Hochberg's p per (algorithm, environment), and the smallest one in reach."""
    tested = statistics[statistics["p"].notna()]
    for _, family in tested.groupby(["algorithm", "environment"]):
        adjusted = stats.false_discovery_control(family["p"].astype(float))
        statistics.loc[family.index, "p_adjusted"] = adjusted
        alone = np.minimum(1, family["smallest_p"].astype(float) * len(family))
        statistics.loc[family.index, "smallest_p_adjusted"] = alone
    return statistics


def family_notes(statistics):
    """Say what the number of seeds can show at all after the Benjamini-Hochberg adjustment."""
    notes = []
    tested = statistics[statistics["p"].notna()]
    for algorithm, rows in tested.groupby("algorithm"):
        limits = rows.groupby("environment", sort=False)["smallest_p"].agg(["size", "min"])
        for (size, smallest), same in limits.reset_index().groupby(["size", "min"], sort=False):
            needed = ceil(round(size * smallest / 0.05, 9))
            if needed <= 1:
                reach = "a single configuration can reach 0.05"
            elif needed <= size:
                reach = f"below 0.05 only if {needed} or more configurations reach it together"
            else:
                reach = "no configuration can reach 0.05"
            notes.append(
                f"{algorithm}, {', '.join(same['environment'])}: comparisons: {size}; the smallest "
                f"p that this number of seeds can give is {smallest:.2g}, adjusted "
                f"{min(1, size * smallest):.2g} for one configuration alone: {reach}."
            )
    return notes


# --------------------------------------------------------------------------------------------- main

CAPTIONS = {
    "best": """Best noise for each algorithm and environment against the baseline without noise:
final test return, mean \u00b1 sample standard deviation over n seeds. The best of many is chosen
on the seeds that it is reported on, which flatters it; the leave-one-seed-out columns choose on
all seeds but one and measure on that one.""",
    "consistent": """Noise that matches or betters the baseline in at least 80 % of two or more
environments: improvement over |baseline|, mean \u00b1 standard deviation over environments; n is
the smallest number of seeds in any environment.""",
    "consistently_worse": """Noise that is worse than the baseline in each of two or more
environments (0 %); columns as in the table of consistent noise. Worse at every rate that was
tried:""",
    "early_performance": """Test return during training, by noise rate (0.00 is the baseline):
mean \u00b1 sample standard deviation over (n) seeds.""",
    "summary": """Final test return of every configuration: mean \u00b1 sample standard deviation
over n seeds, improvement over |baseline|, and change of the standard deviation. Steps to
baseline: the first evaluation at which the mean over seeds reaches the baseline's final mean.""",
    "statistics": f"""IQM: interquartile mean of the final returns over n seeds. Improvement: IQM
of (return - baseline mean) / |baseline mean| over seeds and environments, minus that of the
baseline's own returns. [ ]: 95 % intervals from a stratified bootstrap over seeds (Student's t
times the bootstrap standard error; the baseline is resampled too). In simulated samples of one
environment they held the true IQM in at least
{", ".join(f"{c} % (n = {n})" for n, c in COVERAGE.items())} of the cases where returns were
normal, skewed or 20 % of them in a low peak, but in
{", ".join(f"{c} % (n = {n})" for n, c in COVERAGE_OF_MIXTURES.items())} where 40 % were in a low
and narrow peak, as PPO's on HalfCheetah may be. P(improvement):
probability that a noisy run beats a baseline run, averaged over environments, with Newcombe's
interval; the next column says whether that interval, alone among all in the table, excludes one
half. No interval for n < {MIN_SEEDS}. p: exact two-sided Mann-Whitney test, stratified by
environment. It is the primary test: where an interval says otherwise, p decides. In a full grid
the rows of all environments together are primary: in one environment five seeds cannot reach 0.05
after the adjustment. p adjusted: Benjamini-Hochberg over one family, all configurations of an
algorithm in one environment, or in all of them together. Smallest p adjusted: what one
configuration alone could reach at most with its number of seeds.""",
    "missing": """Runs that are in no table and no figure. Missing are the seeds that other runs of
the algorithm have, and baselines.""",
    "compare": """The paper's table (environments v2, 1,000,000 steps) beside ours, with the
difference in standard errors where the steps are the same; listed by: whose table has the row.
Ours:""",
}
CAPTIONS = {name: " ".join(text.split()) for name, text in CAPTIONS.items()}


def make_tables(studies, paper=None):
    """Compute every table: a dict of name -> (frame, caption), in the order of the report.

    `paper` has the paper's tables (read_paper), to be set beside ours.
    """
    summary = frame("summary", (row for study in studies for row in summary_rows(study)))
    best = frame("best", (row for study in studies for row in best_rows(study, summary)))
    consistency = frame("consistency", consistency_rows(summary))
    good, bad = split_consistency(consistency)
    early = frame("early_performance", (row for study in studies for row in early_rows(study)))
    statistics = frame("statistics", (row for study in studies for row in statistics_rows(study)))
    statistics = adjust(statistics)
    failing = bad[bad["fails_at_every_rate"] == "yes"][["algorithm", "noise"]].drop_duplicates()
    failing = "; ".join(f"{noise} ({algorithm})" for algorithm, noise in failing.values) or "none"
    limits = "\n".join(family_notes(statistics))
    tables = {
        "best": (best, CAPTIONS["best"]),
        "consistent": (good, CAPTIONS["consistent"]),
        "consistently_worse": (bad, f"{CAPTIONS['consistently_worse']} {failing}."),
        "statistics": (statistics, f"{CAPTIONS['statistics']}\n{limits}"),
        "early_performance": (early, CAPTIONS["early_performance"]),
    }
    for base in sorted({study.base for study in studies}):
        same = [study.algorithm for study in studies if study.base == base]
        table = summary[summary["algorithm"].isin(same)]
        tables[f"summary_{base}"] = (table, CAPTIONS["summary"])
    if paper:
        lengths = {study.algorithm: study.steps[-1] for study in studies}
        caption = ", ".join(f"{algorithm} {steps:,} steps" for algorithm, steps in lengths.items())
        listed = summary, best, consistency, good, bad, early
        for name, table in compare_tables(paper, lengths, *listed):
            tables[name] = (table, f"{CAPTIONS['compare']} {caption}.")
    return tables


def fail(message):
    """End with one line on stderr and status 2, as the training scripts do for bad input."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


def main(args):
    """Read the runs, write tables, figures and report, and print the main table."""
    if not args.runs_dir.is_dir():
        fail(f"no folder {args.runs_dir}")
    try:
        paper = read_paper(args.compare) if args.compare else None
    except ValueError as error:
        fail(error)
    runs = read_runs(args.runs_dir)
    studies, notes = make_studies(runs)
    missing = pd.concat([runs[runs["status"] != "finished"], missing_runs(runs)])
    missing = missing[["status", *KEYS, "seed", "run", "reason"]]
    counts = missing["status"].value_counts(sort=False)
    problems = ", ".join(f"{n} {status}" for status, n in counts.items())
    problems = f"Runs that do not count: {len(missing)} ({problems})." if problems else ""
    if not studies:
        print(text_table("missing", missing))
        fail(f"no finished run in {args.runs_dir}")
    tables = make_tables(studies, paper)
    tables["missing"] = (missing, CAPTIONS["missing"])
    overview = [f"Finished runs: {(runs['status'] == 'finished').sum()}."]
    overview += [
        f"{study.algorithm}: {study.steps[-1]:,} steps, seeds: {len(study.seeds)}, environments: "
        f"{len(study.environments)}, noise configurations: {len(study.returns) - 1}."
        for study in studies
    ]
    overview = " ".join(overview)
    drawn = []
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        for name, (table, caption) in tables.items():
            write_table(args.out, name, table, caption)
        for name, figure, caption in figures(studies, tables):
            write_figure(args.out, name, figure)
            drawn.append((name, caption))
        write_report(args.out, tables, drawn, overview, problems, notes)
    except OSError as error:
        fail(f"--out: {error}")
    old = sorted(path.name for path in args.out.glob("*.csv") if path.stem not in tables)
    if old:
        notes.append(f"{args.out} also holds an earlier analysis, not renewed: {', '.join(old)}")
    print(f"{overview}\n\n{text_table('best', tables['best'][0])}\n\n{tables['best'][1]}\n")
    for note in family_notes(tables["statistics"][0]) + notes:
        print(f"note: {note}")
    if problems:
        print(f"\nWARNING: {problems}\n{text_table('missing', missing.head(20))}")
        print(f"All of them: {args.out / 'missing.csv'}")
    print(f"\nOpen {args.out / 'report.html'}")


if __name__ == "__main__":
    main(tyro.cli(Args))
