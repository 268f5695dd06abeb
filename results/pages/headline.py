"""The paper's headline: SAC on HalfCheetah reaches the baseline's final return in half the steps.

With RandomUniformScaleReward(0.5, 1.5) at p = 0.01, the paper's figure and its table of early
performance. Our runs are in data/long/; readme.py shows what is here.
"""

import numpy as np
import pandas as pd
from common import DATA, plain
from scipy import optimize, stats

from analysis.runs import read_runs
from analysis.statistics import LEVEL, MIN_SEEDS, POWER, steps_to_reach

NOISE, RATE = "RandomUniformScaleReward(0.5, 1.5)", "0.01"
TOTAL = 1_000_000


def read_curves(folder=DATA / "long"):
    """Return (steps, without noise, with noise), curves (steps x seeds) of the whole seeds.

    A seed is whole when both runs are there. None without any.
    """
    runs = plain(read_runs(folder)).query(
        "status == 'finished' and algorithm == 'SAC' and environment == 'HalfCheetah'"
        " and total == @TOTAL"
    )
    found = {
        noise: group.set_index("seed")["returns"]
        for (noise, rate), group in runs.groupby(["noise", "noise_rate"])
        if (noise, rate) in (("", "0.00"), (NOISE, RATE))
    }
    seeds = sorted(set.intersection(*(set(found.get(n, pd.Series()).index) for n in ("", NOISE))))
    if not seeds:
        return None
    curves = [np.stack([found[noise][seed] for seed in seeds], axis=1) for noise in ("", NOISE)]
    return runs["steps"].iloc[0], *curves


def smallest_shown(x, y):
    """Return the difference of means that a two-sided t-test finds with 80 % power at 5 %.

    x (n) and y (m) give the common standard deviation.
    """
    n, m = len(x), len(y)
    df = n + m - 2
    pooled = np.sqrt(((n - 1) * np.var(x, ddof=1) + (m - 1) * np.var(y, ddof=1)) / df)
    critical = stats.t.ppf(1 - LEVEL / 2, df)

    def missing_power(shift):  # the other tail is negligible
        return stats.nct.sf(critical, df, shift) - POWER

    return optimize.brentq(missing_power, 0, 10) * pooled * np.sqrt(1 / n + 1 / m)


def numbers(curves):
    """Compute steps and final returns from the result of read_curves.

    The target is the baseline's final mean. "without" and "noisy" have the steps after which the
    mean curve ("mean") and each run ("runs") reach it. A run that never reaches it counts with all
    of its steps, so the mean of "runs" is a lower limit then. "p" is None without three seeds.
    """
    undecided = {"p": None, "verdict": "not tested"}
    if curves is None:
        return undecided | {"n": 0}
    steps, without, noisy = curves
    target = without[-1].mean()
    reached = {}
    for name, returns in (("without", without), ("noisy", noisy)):
        mean = steps_to_reach(returns, steps, target)
        first = [steps_to_reach(run[:, None], steps, target) for run in returns.T]
        reached[name] = {
            "final": spell_returns(returns[-1]),
            "mean": mean,
            "in_words": "never" if np.isnan(mean) else f"at {mean:,.0f} steps",
            "runs": np.where(np.isnan(first), steps[-1], first).tolist(),
        }
    found = {"n": without.shape[1], "target": target} | reached
    if found["n"] < MIN_SEEDS:
        return found | undecided
    x, y = reached["noisy"]["runs"], reached["without"]["runs"]
    final = stats.ttest_ind(noisy[-1], without[-1], equal_var=False)
    low, high = final.confidence_interval(0.95)
    p_steps = stats.ttest_ind(x, y, equal_var=False).pvalue
    return found | {
        "difference": noisy[-1].mean() - target,
        "low": low,
        "high": high,
        "p": final.pvalue,
        "shown": smallest_shown(noisy[-1], without[-1]),
        "p_steps": p_steps,
        "steps_shown": smallest_shown(x, y),
        "verdict": verdict(reached["noisy"]["mean"], np.mean(x) < np.mean(y), p_steps),
    }


def spell_returns(values):
    """Write returns as mean ± sample standard deviation, or a single one as it is."""
    spread = f" ± {values.std(ddof=1):,.0f}" if len(values) > 1 else ""
    return f"{values.mean():,.0f}{spread}"


def verdict(steps_with_noise, is_faster, p):
    """Return the verdict: the mean curve is there before half of the steps, and not by chance."""
    if not steps_with_noise < TOTAL / 2:
        return "undecided"
    return "confirmed" if is_faster and p <= LEVEL else "undecided"
