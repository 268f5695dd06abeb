"""The paper's headline: SAC on HalfCheetah reaches the baseline's final return in half the steps.

With RandomUniformScaleReward(0.5, 1.5) at p = 0.01, the paper's figure and its table of early
performance. Our runs are in data/long/; readme.py shows what they say.
"""

import numpy as np
from common import DATA, plain
from scipy import optimize, stats

from analysis.runs import read_runs
from analysis.statistics import LEVEL, POWER, steps_to_reach

NOISE, RATE = "RandomUniformScaleReward(0.5, 1.5)", "0.01"


def read_curves(folder=DATA / "long"):
    """Return (steps, without noise, with noise), the last two as curves (steps x seeds)."""
    runs = plain(read_runs(folder)).query("algorithm == 'SAC' and environment == 'HalfCheetah'")
    curves = [
        np.stack(list(runs.loc[runs["noise"] == noise, "returns"]), axis=1) for noise in ("", NOISE)
    ]
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
    of its steps, so the mean of "runs" is a lower limit then.
    """
    steps, without, noisy = curves
    target = without[-1].mean()
    reached = {}
    for name, returns in (("without", without), ("noisy", noisy)):
        mean = steps_to_reach(returns, steps, target)
        first = [steps_to_reach(run[:, None], steps, target) for run in returns.T]
        reached[name] = {
            "final": f"{returns[-1].mean():,.0f} ± {returns[-1].std(ddof=1):,.0f}",
            "mean": mean,
            "in_words": "never" if np.isnan(mean) else f"at {mean:,.0f} steps",
            "runs": np.where(np.isnan(first), steps[-1], first).tolist(),
        }
    x, y = reached["noisy"]["runs"], reached["without"]["runs"]
    # from mean and deviation: of equal values, as of runs that all never get there, scipy warns
    described = [value for z in (x, y) for value in (np.mean(z), np.std(z, ddof=1), len(z))]
    final = stats.ttest_ind(noisy[-1], without[-1], equal_var=False)
    low, high = final.confidence_interval(0.95)
    return reached | {
        "n": noisy.shape[1],
        "total": steps[-1],
        "target": target,
        "difference": noisy[-1].mean() - target,
        "low": low,
        "high": high,
        "p": final.pvalue,
        "shown": smallest_shown(noisy[-1], without[-1]),
        "p_steps": stats.ttest_ind_from_stats(*described, equal_var=False).pvalue,
    }
