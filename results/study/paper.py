"""The paper's tables beside those of a folder of runs: python -m results.study.paper RUNS OUT.

Rows match by algorithm, environment without version, noise as run, rate and step.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from analysis.comparisons import compare_all, results
from analysis.folders import SEARCH, script_name
from analysis.luck import add_luck, draw_differences
from analysis.runs import KEYS, STUDY, read_runs
from analysis.studies import make_studies
from analysis.tables import COLUMNS, consistency_rows, early_rows
from noisy_wrappers import BASELINE, Configuration
from results.study.returns import RESULTS

VERSION = r"(?P<name>.*?)(?:-v(?P<version>\d{1,9}))?$"  # of an environment's id, if it has one

PAPER_SEEDS = {"SAC": 5, "TD3": 5, "PPO": 10}
PAPER_ENVIRONMENTS = 5
PAPER_CONFIGURATIONS = 90  # 15 noises at 6 rates
PAPER_STEPS = 1_000_000
# The names of its files; of the last, there is one for each algorithm
PAPER_TABLES = ("best", "consistent", "consistently_worse", "early_performance*")
LUCK = ["luck_median", "luck_95", "p_luck"]
FINAL = ("mean", "std", "n")
AVERAGE = ("average_improvement_percent", "std_improvement_percent", "environments")


def read_paper(folder):
    """Read the paper's tables: a dict of name -> frame, with the noise as run and rates as text.

    Raises ValueError where `folder` does not have them.
    """
    tables = {}
    for name in PAPER_TABLES:
        parts = [pd.read_csv(path) for path in sorted(Path(folder).glob(f"{name}.csv"))]
        if not parts or "noise_as_run" not in parts[0]:
            raise ValueError(f"{folder} has no tables of the paper (results/paper has them)")
        table = pd.concat(parts, ignore_index=True)
        table["noise"] = table["noise_as_run"]
        pairs = zip(table["noise"], table["noise_rate"], strict=True)
        table["noise_rate"] = [Configuration.parse(*pair).noise_rate for pair in pairs]
        names = [script_name(algorithm) for algorithm in table["algorithm"]]
        tables[name.rstrip("*")] = table.assign(exp_name=names, phase="", tested="")
    return tables


def beside(paper, lengths, alone, consistency, early):
    """Yield (name, table) for each table of `paper`, a dict from read_paper.

    `lengths` has the steps of each study, by the values of its columns STUDY: final returns after
    fewer steps than the paper's are shown beside them, without a difference.
    """
    # The paper's table has noise and baseline side by side: they are rows of their own here.
    noisy = add_luck_of_paper(paper["best"])
    baseline = noisy.rename(columns={"baseline_mean": "mean", "baseline_std": "std"})
    baseline = baseline.assign(noise=BASELINE.noise, noise_rate=BASELINE.noise_rate)
    noisy = noisy.rename(columns={"noisy_mean": "mean", "noisy_std": "std"})
    best = pd.concat([noisy, baseline.drop(columns=LUCK)], ignore_index=True)
    for name, theirs in (paper | {"best": best}).items():
        ours = {"best": alone, "early_performance": early}.get(name, consistency)
        table = side_by_side(ours, theirs)
        if name != "early_performance":  # whose rows are of the same step
            others = pd.MultiIndex.from_frame(table[STUDY]).map(lengths) != PAPER_STEPS
            table.loc[others, "difference_se"] = np.nan
        yield name, table


def add_luck_of_paper(best, seeds=PAPER_SEEDS):
    """Add to the paper's table of best noises what luck alone would show: its sweep, drawn again.

    The standard deviation is the baseline's. That of the best noise is known, too, but belongs to a
    winner, which had luck with its seeds.

    seeds: algorithm -> seeds of each of the PAPER_CONFIGURATIONS in every environment.
    """
    lucks = {}
    for key, rows in best.groupby(STUDY):
        rng, n = np.random.default_rng(0), seeds[key[0]]
        for row in rows.itertuples():
            n_noisy = PAPER_CONFIGURATIONS * [n]
            draws = draw_differences(row.baseline_std, n - 1, n, n_noisy, rng)
            lucks[*key, row.environment] = draws.max(axis=0)
    return add_luck(best.assign(difference=best["noisy_mean"] - best["baseline_mean"]), lucks)


def side_by_side(ours, paper):
    """Set our figures beside every row of the paper's table that has them, once for each study.

    `ours` holds every configuration. The difference is in standard errors: (ours - paper) /
    sqrt(std^2 / n + paper_std^2 / paper_n).
    """
    mean, std, number = FINAL if "mean" in paper else AVERAGE
    keys = [name for name in (*KEYS, "steps_millions") if name in paper]
    numbers = [name for name in (mean, std, number, "steps_millions") if name in ours]
    ours = ours.astype(dict.fromkeys(numbers, float))  # a table without rows has no types
    shared = [name for name in keys if name not in ("exp_name", "phase", "tested", "environment")]
    if "environment" in keys:
        shared.append("place")
        ours, paper = (
            table.assign(place=table["environment"].str.extract(VERSION)["name"])
            for table in (ours, paper)
        )
    paper = paper.rename(columns={name: f"paper_{name}" for name in paper if name not in shared})
    table = paper.merge(ours, on=shared, how="left")
    for name in set(keys) - set(shared):
        table[name] = table[name].fillna(table[f"paper_{name}"])
    paper_n = table["algorithm"].map(PAPER_SEEDS) if number == "n" else PAPER_ENVIRONMENTS
    variance = table[std] ** 2 / table[number] + table[f"paper_{std}"] ** 2 / paper_n
    difference = table[mean] - table[f"paper_{mean}"]
    table["difference_se"] = difference / np.sqrt(variance.where(variance > 0))
    columns = [*keys, number, mean, std, f"paper_{mean}", f"paper_{std}"]
    columns += ["difference_se", *(f"paper_{name}" for name in LUCK if f"paper_{name}" in table)]
    return table.sort_values(keys, kind="stable")[columns]


def tables_of(runs_dir):
    """Return {name: the paper's table beside that of the runs in a folder}."""
    studies, _ = make_studies(read_runs(runs_dir))
    compared = compare_all(studies)
    alone = results(studies, compared)
    alone = alone[alone["phase"] != SEARCH]
    rows = consistency_rows(alone, compared.rates_together)
    consistency = pd.DataFrame(rows, columns=COLUMNS["consistency"])
    rows = [row for study in studies for row in early_rows(study)]
    early = pd.DataFrame(rows, columns=COLUMNS["early_performance"])
    lengths = {study.key: study.steps[-1] for study in studies}
    return dict(beside(read_paper(RESULTS / "paper"), lengths, alone, consistency, early))


if __name__ == "__main__":
    runs_dir, out = map(Path, sys.argv[1:])
    out.mkdir(parents=True, exist_ok=True)
    for name, table in tables_of(runs_dir).items():
        table.to_csv(out / f"compare_{name}.csv", index=False, float_format="%.10g")
