"""The paper's tables beside ours: what `python analyze.py --compare results/paper` adds.

Rows match by algorithm, environment without version, noise as run, rate and step.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from analysis.luck import add_luck, luck_of_paper
from analysis.runs import KEYS, rows_of, script_name, split_version
from noisy_wrappers import BASELINE, Configuration

PAPER_SEEDS = {"SAC": 5, "TD3": 5, "PPO": 10}
PAPER_ENVIRONMENTS = 5
PAPER_CONFIGURATIONS = 90  # 15 noises at 6 rates
PAPER_STEPS = 1_000_000
PAPER_FILES = {
    "best": "best.csv",
    "consistent": "consistent.csv",
    "consistently_worse": "consistently_worse.csv",
    "early_performance": "early_performance*.csv",  # one for each algorithm
}
LUCK = ("luck_median", "luck_95", "p_luck")
FINAL = ("mean", "std", "n")
AVERAGE = ("average_improvement_percent", "std_improvement_percent", "environments")


def read_paper(folder):
    """Read the paper's tables: a dict of name -> frame, with the noise as run and rates as text.

    Raises ValueError where `folder` has no csv files, or other ones.
    """
    if not any(Path(folder).glob("*.csv")):
        raise ValueError(f"no csv files in {folder} (results/paper has the paper's tables)")
    tables = {}
    for name, pattern in PAPER_FILES.items():
        parts = [pd.read_csv(path) for path in sorted(Path(folder).glob(pattern))]
        if not parts:
            continue
        table = pd.concat(parts, ignore_index=True)
        if "noise_as_run" not in table:
            raise ValueError(f"{folder} has no tables of the paper (results/paper has them)")
        table["noise"] = table["noise_as_run"]
        pairs = zip(table["noise"], table["noise_rate"], strict=True)
        table["noise_rate"] = [Configuration.parse(*pair).noise_rate for pair in pairs]
        names = [script_name(algorithm) for algorithm in table["algorithm"]]
        tables[name] = table.assign(exp_name=names, phase="")
    return tables


def compare_tables(paper, lengths, summary, best, consistency, good, bad, early):
    """Yield (name, table) for each table of `paper`, a dict from read_paper.

    `lengths` has the steps of each study, by the values of its columns STUDY: final returns after
    fewer steps than the paper's are shown beside them, without a difference.
    """
    luck = None
    if {"best", "consistent", "consistently_worse"} <= paper.keys():
        paper, luck = with_luck(paper)
    if "best" in paper:
        # The paper's table has baselines too: they are rows of their own here.
        listed = pd.concat([summary[summary["noise"] == ""], best])
        table = compare_table(summary, listed, with_baseline_rows(paper["best"]), *FINAL)
        yield "compare_best", only_equal_steps(table, lengths)
    for name, listed in (("consistent", good), ("consistently_worse", bad)):
        if name in paper:
            table = compare_table(consistency, listed, paper[name], *AVERAGE)
            yield f"compare_{name}", only_equal_steps(table, lengths)
    if luck is not None:
        yield "compare_luck", luck
    if "early_performance" in paper:
        table = compare_table(early, None, paper["early_performance"], *FINAL)
        yield "compare_early_performance", table


def with_luck(paper):
    """Add to the paper's tables what luck alone would show, and return its table of luck, too."""
    best, good, bad = (paper[name] for name in ("best", "consistent", "consistently_worse"))
    best = best.assign(difference=best["noisy_mean"] - best["baseline_mean"])
    lucks = luck_of_paper(best, PAPER_SEEDS, PAPER_CONFIGURATIONS)
    best, good, bad, luck = add_luck(lucks, best, good, bad)
    return paper | {"best": best, "consistent": good, "consistently_worse": bad}, luck


def with_baseline_rows(paper):
    """Turn rows with noise and baseline side by side into rows of noise and rows of baseline."""
    noisy = paper.rename(columns={"noisy_mean": "mean", "noisy_std": "std"})
    baseline = paper.rename(columns={"baseline_mean": "mean", "baseline_std": "std"})
    baseline = baseline.assign(noise=BASELINE.noise, noise_rate=BASELINE.noise_rate)
    baseline = baseline.drop(columns=[name for name in LUCK if name in baseline])
    return pd.concat([noisy, baseline], ignore_index=True)


def only_equal_steps(table, lengths):
    """Take out the differences of studies that ran for other steps than the paper's."""
    others = [key for key, steps in lengths.items() if steps != PAPER_STEPS]
    for key in others:
        table.loc[rows_of(table, key), "difference_se"] = np.nan
    return table


def matching_keys(table, names):
    """Return a tuple for each row: the values of `names` as ours and the paper's rows share them.

    The environment is without its version.
    """
    shared = table[names].copy()
    if "environment" in names:
        shared["environment"] = [split_version(env)[0] for env in table["environment"]]
    if "steps_millions" in names:
        shared["steps_millions"] = table["steps_millions"].astype(float).round(6)
    return list(shared.itertuples(index=False, name=None))


def compare_table(ours, listed, paper, mean, std, number):
    """Set the paper's figures beside ours for every row that `paper` or `listed` has.

    `ours` holds every configuration, `listed` those of our own table, or None: all of them, but
    shown only where the paper has them, too; `mean`, `std` and `number` name its columns. The
    difference is in standard errors: (ours - paper) / sqrt(std^2 / n + paper_std^2 / paper_n).
    """
    keys = [name for name in (*KEYS, "steps_millions") if name in paper]
    names = [name for name in keys if name not in ("exp_name", "phase")]
    ours = ours.assign(key=matching_keys(ours, names))
    paper = paper.assign(key=matching_keys(paper, names))
    shared = ours["key"].isin(paper["key"])
    if listed is None:
        ours["listed"] = shared
    else:  # a key unites studies and versions, only one of which may be listed
        listed_rows = pd.MultiIndex.from_frame(listed[keys])
        ours["listed"] = pd.MultiIndex.from_frame(ours[keys]).isin(listed_rows)
    ours = ours[ours["listed"] | shared]
    paper = paper.add_prefix("paper_").rename(columns={"paper_key": "key"})
    table = ours.merge(paper, on="key", how="outer")
    numbers = [mean, std, number, f"paper_{mean}", f"paper_{std}"]
    table[numbers] = table[numbers].astype(float)  # a table without rows has no types

    in_ours, in_paper = table["listed"].eq(True), table["key"].isin(paper["key"])
    table["listed_by"] = np.select([in_ours & in_paper, in_ours], ["both", "ours"], "paper")
    for name in keys:
        table[name] = table[name].fillna(table[f"paper_{name}"])
    if number == "environments":
        paper_n = PAPER_ENVIRONMENTS
    else:
        paper_n = table["paper_algorithm"].map(PAPER_SEEDS)
    variance = table[std] ** 2 / table[number] + table[f"paper_{std}"] ** 2 / paper_n
    difference = table[mean] - table[f"paper_{mean}"]
    table["difference_se"] = difference / np.sqrt(variance.where(variance > 0))
    columns = [*keys, "listed_by", number, mean, std, f"paper_{mean}", f"paper_{std}"]
    luck = [f"paper_{name}" for name in LUCK if f"paper_{name}" in table]
    return table.sort_values(keys, kind="stable")[[*columns, "difference_se", *luck]]
