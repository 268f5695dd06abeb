"""Comparisons with all runs in results/data: they were asked after the runs.

Batches of runs for different questions share configurations. A run that two of them have counts
once. The test is that of the first page, Mann-Whitney's.
"""

import pandas as pd

from analysis.folders import read_run
from results.study.compare import average_change, compare, holm, mann_whitney_p
from results.study.returns import (
    DATA,
    ENVIRONMENTS,
    RESULTS,
    curve_of,
    each_run_once,
    read_returns,
    select,
)

BATCHES = ("runs", "paper_tests", "robustness", "ablation", "choice", "schedules")
FRESH = [  # of sets A and E
    ("Hopper", "RandomNormalNoisyReward(1.0)", "1.0", "ppo_hopper"),
    ("Walker2d", "RandomUniformScaleReward(0.8, 1.2)", "0.05", "ppo_walker2d"),
]
PAPER_FINAL = 9515  # of SAC on HalfCheetah without noise, in the paper's early_performance table
SCALE = "RandomUniformScaleReward(0.5, 1.5)"
EARLY_STEPS = 200_000


def best_noises():
    """Compare PPO's best noise of the paper in each environment with no noise, all runs."""
    runs = each_run_once(read_returns(*BATCHES))
    best = pd.read_csv(RESULTS / "paper/best.csv").query("algorithm == 'PPO'")
    rows = []
    for paper in best.sort_values("environment").itertuples():
        environment = paper.environment.split("-")[0]
        case = {"environment": environment, "noise": paper.noise, "rate": str(paper.noise_rate)}
        samples = (select(runs, "PPO", environment, *c) for c in (tuple(case.values())[1:], ()))
        row = case | {"paper_percent": paper.improvement_percent}
        rows.append(row | compare(*samples, mann_whitney_p))
    return pd.DataFrame(rows).assign(holm=holm([row["p"] for row in rows]))


def with_fresh():
    """Compare PPO's best noise with no noise where a set has fresh seeds: they and all earlier."""
    rows = []
    for environment, noise, rate, folder in FRESH:
        runs = each_run_once(read_returns(*BATCHES, folder))
        case = {"environment": environment, "noise": noise, "rate": rate}
        samples = (select(runs, "PPO", *c) for c in (case.values(), [environment]))
        rows.append(case | compare(*samples, mann_whitney_p))
    return pd.DataFrame(rows)


def sac_early():
    """Compare SAC on HalfCheetah after 200,000 steps with no noise, with the long runs' tests."""
    runs = pd.concat([read_returns("runs"), read_returns("long", step=EARLY_STEPS)])
    rows = []
    for rate in ("0.01", "0.05"):
        samples = (select(runs, "SAC", "HalfCheetah", *c) for c in ((SCALE, rate), ()))
        rows.append({"noise": SCALE, "rate": rate, **compare(*samples, mann_whitney_p)})
    return pd.DataFrame(rows)


def sac_headline():
    """Return when SAC on HalfCheetah reaches two returns, and where it ends: a row a run.

    The returns are the paper's last mean without noise, and ours. A run is there at its first test
    that returns as much.
    """
    curves = {}
    for path in sorted((DATA / "long").glob("*HalfCheetah*sac*")):
        run = read_run(path)
        noise = f"{SCALE}, p = 0.01" if run.configuration.noise else "no noise"
        curves[noise, run.seed] = curve_of(run)
    table = pd.DataFrame(curves)
    for noise in dict.fromkeys(noise for noise, _ in curves):
        table[noise, "mean"] = table[noise].mean(axis=1)
    ours = table["no noise", "mean"].iloc[-1]
    rows = [
        {
            "noise": noise,
            "seed": seed,
            f"steps to {PAPER_FINAL}": first(curve, PAPER_FINAL),
            "steps to our last mean": first(curve, ours),
            "last return": round(curve.iloc[-1]),
        }
        for (noise, seed), curve in table.sort_index(axis=1).items()
    ]
    return pd.DataFrame(rows)


def first(curve, value):
    """Return the first step at which a curve is at a value, or an empty text."""
    there = curve.index[curve >= value]
    return there[0] if len(there) else ""


def consistent_rows():
    """Return the rows of the paper's table of consistent noises that PPO was run with.

    `improved` of the five environments are better than without noise; the average change has an
    interval and Welch's p.
    """
    runs = read_returns("ablation")
    paper = pd.read_csv(RESULTS / "paper/consistent.csv").query("algorithm == 'PPO'")
    rows = []
    for row in paper.itertuples():
        rate = f"{row.noise_rate}"
        pairs = [
            [select(runs, "PPO", environment, *c) for c in ((row.noise, rate), ())]
            for environment in ENVIRONMENTS
        ]
        if len(pairs[0][0]):
            change, low, high, p = average_change(pairs)
            improved = sum(x.mean() >= y.mean() for x, y in pairs)
            found = {"noise": row.noise, "rate": rate, "n": len(pairs[0][0]), "improved": improved}
            found |= {"average_percent": change, "low_percent": low, "high_percent": high}
            rows.append(found | {"p": p, "paper_percent": row.average_improvement_percent})
    return pd.DataFrame(rows)
