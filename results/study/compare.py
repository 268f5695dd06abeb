"""Returns with noise against returns without: means, intervals, tests and verdicts."""

import numpy as np
import pandas as pd
from scipy import stats

from analysis.comparisons import compare_all, results
from analysis.runs import read_runs
from analysis.statistics import at_least_minus_100, fieller, holm
from analysis.studies import make_studies
from results.study import returns

LEVEL = 0.05
SHUFFLES = 100_000


def mann_whitney_p(x, y):
    """Return the two-sided p of the exact Mann-Whitney test."""
    return stats.mannwhitneyu(x, y, method="exact").pvalue


def permutation_p(x, y):
    """Return the two-sided p of Welch's t when runs are shuffled; exact for few of them."""
    options = {"vectorized": True, "n_resamples": SHUFFLES, "rng": 0}
    return stats.permutation_test((x, y), welch_t, **options).pvalue


def joint_p(pairs):
    """Return the two-sided p of the mean of Welch's t over environments.

    pairs: (x, y) of each environment, within which the runs are shuffled.
    """
    rng, shuffled = np.random.default_rng(0), 0
    for x, y in pairs:
        runs = rng.permuted(np.tile(np.concatenate([x, y]), (SHUFFLES, 1)), axis=1)
        shuffled = shuffled + welch_t(runs[:, : len(x)], runs[:, len(x) :])
    observed = sum(welch_t(np.asarray(x), np.asarray(y)) for x, y in pairs)
    as_far = (abs(shuffled) >= abs(observed) - 1e-9).sum()
    return (1 + as_far) / (1 + SHUFFLES)


def welch_t(x, y, axis=-1):
    """Return Welch's t of the samples along an axis of x and y."""
    squared = sum(z.var(axis, ddof=1) / z.shape[axis] for z in (x, y))
    return (x.mean(axis) - y.mean(axis)) / np.sqrt(squared)


def compare(x, y, p):
    """Compare runs with noise (x) with runs without (y).

    p(x, y) is the test, mann_whitney_p or permutation_p. The interval of the difference is Welch's,
    at 95 %; the columns that end in _percent are relative to the mean without noise, with Fieller's
    interval.
    """
    difference = x.mean() - y.mean()
    low, high = stats.ttest_ind(x, y, equal_var=False).confidence_interval(0.95)
    row = {"n": len(x), "mean": x.mean(), "sd": x.std(ddof=1)}
    row |= {"n_without": len(y), "mean_without": y.mean(), "sd_without": y.std(ddof=1)}
    row |= {"difference": difference, "low": low, "high": high}
    row["difference_percent"] = 100 * difference / abs(y.mean())
    row["low_percent"], row["high_percent"] = fieller(x, y)
    return row | {"p": p(x, y)}


def average_change(pairs):
    """Return the change in percent of the mean return, averaged over environments.

    pairs: (x, y) of each environment -> change, low, high, p. The environments' intervals are
    Fieller's, combined by the square-and-add rule (Zou and Donner, 2008); the test was declared
    before the runs: Welch's and Satterthwaite's, which takes the means without noise as known.
    """
    parts = []  # variance of a mean, and its degrees of freedom
    changes, limits = [], []
    for x, y in pairs:
        percent = 100 / abs(y.mean())
        scale = percent / len(pairs)
        changes.append(percent * (x.mean() - y.mean()))
        limits.append(fieller(x, y))
        parts += [(scale**2 * z.var(ddof=1) / len(z), len(z) - 1) for z in (x, y)]
    variance = sum(v for v, _ in parts)
    df = variance**2 / sum(v**2 / n for v, n in parts)
    change = np.mean(changes)
    p = 2 * stats.t.sf(abs(change) / np.sqrt(variance), df)
    below, above = np.hypot.reduce(np.array(limits) - np.array(changes)[:, None]) / len(pairs)
    low = at_least_minus_100(change - below, np.concatenate([z for pair in pairs for z in pair]))
    return change, low, change + above, p


def comparisons(runs):
    """Compare each noise in a frame of read_returns with no noise: a row a comparison.

    p is of the permuted Welch t; `holm` corrects it for these rows. A noise in several environments
    gets one row more, "together", with the average change and the test of all at once.
    """
    rows, together = [], {}
    keys = ["algorithm", "environment", "steps"]
    for key, group in runs.groupby(keys):
        sides = group.groupby("seed")["seed"].transform("size")
        group = group[sides == sides.max()]  # the whole seeds
        if group["seed"].nunique() < 2:  # one has no deviation
            continue
        without = group.loc[group["noise"] == "", "test"].to_numpy()
        for (noise, rate), same in group[group["noise"] != ""].groupby(["noise", "rate"]):
            row = dict(zip(keys, key, strict=True)) | {"noise": noise, "rate": rate}
            pair = same["test"].to_numpy(), without
            rows.append(row | compare(*pair, permutation_p))
            together.setdefault((key[0], key[2], noise, rate), []).append(pair)
    table = pd.DataFrame(rows)
    table["holm"] = holm(table["p"])
    table["verdict"] = list(map(in_words, table["difference"], table["holm"]))
    for (algorithm, steps, noise, rate), pairs in together.items():
        if len(pairs) > 1:
            change, low, high, _ = average_change(pairs)
            p = joint_p(pairs)
            row = {"algorithm": algorithm, "environment": "together", "steps": steps}
            row |= {"noise": noise, "rate": rate, "difference_percent": change}
            row |= {"low_percent": low, "high_percent": high, "p": p}
            table.loc[len(table)] = row | {"verdict": in_words(change, p)}
    return table


def in_words(effect, p):
    """Return what noise does by the rule of plans.md: "helps", "harms" or "undecided"."""
    if p > LEVEL:
        return "undecided"
    return "helps" if effect > 0 else "harms"


# Of a set with looks: after so many seeds a side, the nominal level of p, and what |t| must reach
LOOKS = {
    10: (0.0000011, 0.0),
    20: (0.00079, 0.3),
    30: (0.0074, 0.75),
    40: (0.0220, 1.3),
    50: (0.0423, np.inf),
}


def in_looks(runs):
    """Compare the runs of a set, in the order of their seeds, at each look and after the last seed.

    The look that decides, or sees too little hope, is the last row: what comes after it does not
    count.
    """
    sides = runs.groupby("seed")["seed"].transform("size")
    seeds = runs.loc[sides == 2, "seed"].sort_values().unique()  # with noise and without
    rows = []
    for n in sorted({*LOOKS, len(seeds)}):
        if n > len(seeds):
            break
        row = comparisons(runs[runs["seed"].isin(seeds[:n])]).iloc[0].drop("holm")
        x, y = row["sd"], row["sd_without"]
        row["t"] = row["difference"] / np.sqrt((x**2 + y**2) / n)
        row["level"], least_t = LOOKS.get(n, (np.nan, 0.0))
        if row["p"] <= row["level"]:
            row["verdict"] = "helps" if row["difference"] > 0 else "harms"
        else:
            row["verdict"] = "undecided" if abs(row["t"]) < least_t else "under way"
        rows.append(row)
        if row["verdict"] != "under way":
            break
    return pd.DataFrame(rows)


# Sets that compare environments together: so many, with so many seeds with noise and without
TOGETHER = {"td3_fresh": (3, 8, 8), "ppo_relative": (4, 6, 9)}
NAMES = {"std": "sd", "baseline_mean": "mean_without", "baseline_std": "sd_without"}
NAMES |= {"percent_low": "low_percent", "percent_high": "high_percent"}
NAMES |= {"n_baseline": "n_without", "noise_rate": "rate"}


def by_the_tool(folder, environments, seeds, seeds_without):
    """Compare the runs of a set as analyze.py does, environments together.

    The rows "together", one for each noise, have the verdicts, corrected for each other, when all
    environments have all seeds. A set without a noise in two environments has no table yet.
    """
    studies, _ = make_studies(read_runs(returns.DATA / folder))
    compared = compare_all(studies)
    together = compared.noises_together.assign(environment="together")
    alone = results(studies, compared).query("noise != ''").drop(columns="verdict")
    if together.empty:
        return together
    together["holm"] = holm(together["p"])
    sizes = together[["environments", "n", "n_baseline"]]
    if (sizes == [environments, seeds, seeds_without]).all(axis=None):
        together["verdict"] = list(map(in_words, together["t"], together["holm"]))
    else:
        together["verdict"] = "under way"
    columns = ["environment", "noise", "rate", "n", "mean", "sd", "n_without", "mean_without"]
    columns += ["sd_without", "difference", "difference_percent", "low_percent", "high_percent"]
    columns += ["effect_size", "p", "holm", "verdict"]
    table = pd.concat([alone, together]).rename(columns=NAMES)
    table["environment"] = table["environment"].str.split("-").str[0]
    return table[columns].reset_index(drop=True)


def judge_claim(tests, claimed=1, of=all):
    """Judge a claim by its tests: a list of (effect, corrected p), one for each case.

    A case with p <= 0.05 confirms or contradicts by its sign; claimed, 1 or -1, is that of the
    claim. The claim that `all` cases have the effect is confirmed if all do, and contradicted if
    any does the opposite; the claim that `any` has it, the other way round.
    """
    if not tests:
        return "not tested"
    signs = [np.sign(effect) * claimed if p <= LEVEL else 0 for effect, p in tests]
    if of(sign == 1 for sign in signs):
        return "confirmed"
    opposite = any if of is all else all
    return "contradicted" if opposite(sign == -1 for sign in signs) else "undecided"
