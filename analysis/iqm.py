"""Interquartile mean and probability of improvement, with intervals for few seeds.

Both are those of Agarwal et al. (2021), https://arxiv.org/abs/2108.13264. Samples are arrays
(seeds x environments); NaN marks a run that does not exist.
"""

from math import inf, nan

import numpy as np
import scipy

from analysis.permutation import columns
from analysis.power import LEVEL
from analysis.statistics import PERCENT_OF_SPAN, normal_quantile, satterthwaite

SEEDS_FOR_IQM, SEEDS_FOR_PROBABILITY = 3, 4  # with fewer there is no interval: docs/statistics.md


def iqm(scores):
    """Interquartile mean over the last axis: int(n / 4) values are cut from each end.

    scores (..., n) -> (...), NaN where a score is. As rliable's aggregate_iqm (Agarwal et al.,
    2021), which is scipy's trim_mean: sorting is ten times as fast.
    """
    ordered = np.sort(scores, axis=-1)  # NaN comes last
    n = ordered.shape[-1]
    cut = int(n / 4)
    means = ordered[..., cut : n - cut].mean(axis=-1)
    return np.where(np.isnan(ordered[..., -1]), np.nan, means)[()]


def bootstrap_iqm(scores, baseline=None, resamples=2000):
    """IQM over seeds and environments with its 95 % interval.

    With a baseline it is the IQM of the scores minus that of the baseline, both in percent of the
    baseline's IQM in each environment, and NaN where the interval of one of these includes zero or
    it is small beside what the returns span. Of positive returns it is never below -100.

    The interval is iqm +- t_{0.975, df} sqrt(sum of v). There is one v for each sample (the seeds
    of one environment, with noise or without): n / (n - 1) times the variance of the IQM when
    this sample is drawn anew from its own n seeds (Efron and Tibshirani, 1993, chapter 12). df is
    Satterthwaite's (1946), so few seeds of the baseline count.

    scores (seeds x envs), baseline (other seeds x envs) or None -> iqm, low, high.
    """
    noisy, alone = columns(scores), [] if baseline is None else columns(baseline)
    for x, y in zip(noisy, alone, strict=False):
        middle, low, high = bootstrap_iqm(y)
        span = np.ptp(np.concatenate([x, y]))
        if low <= 0 <= high or abs(middle) < PERCENT_OF_SPAN * span:
            return nan, nan, nan

    def improvement(x, y):
        pairs = [(a, np.asarray(iqm(b))[..., None]) for a, b in zip(x, y, strict=True)]
        return iqm(np.concatenate([100 * (a - middle) / abs(middle) for a, middle in pairs], -1))

    def estimate(samples):
        x, y = samples[: len(noisy)], samples[len(noisy) :]
        return improvement(x, y) - improvement(y, y) if y else iqm(np.concatenate(x, axis=-1))

    samples = noisy + alone
    least = -100.0 if alone and min(map(np.min, samples)) > 0 else -inf
    value = max(estimate(samples), least)
    n = np.array([len(sample) for sample in samples])
    if n.min() < SEEDS_FOR_IQM:
        return value, nan, nan
    # a baseline that is drawn anew may be 0: then there is no interval of the change in percent
    rng = np.random.default_rng(0)
    observed = [np.broadcast_to(sample, (resamples, len(sample))) for sample in samples]
    variances = np.empty(len(samples))
    for i, sample in enumerate(samples):
        drawn = sample[rng.integers(n[i], size=(resamples, n[i]))]
        with np.errstate(divide="ignore", invalid="ignore"):
            estimates = estimate([*observed[:i], drawn, *observed[i + 1 :]])
        variances[i] = n[i] / (n[i] - 1) * estimates.var(ddof=1)
    _, half = satterthwaite(variances, n)
    half = half if half > 0 else nan  # values that are all alike are no proof that all would be
    return value, max(value - half, least), value + half


def win_rate(x, y):
    """P(x > y) of samples x (n) and y (m), a tie counting half: Mann-Whitney's U / (n m)."""
    return ((x[:, None] > y) + 0.5 * (x[:, None] == y)).mean()


def newcombe_interval(p, n, m):
    """95 % interval of a win rate p of n against m: method 5 of Newcombe (2006).

    Unlike the percentile bootstrap it does not collapse to a point at p = 0 or 1.
    https://doi.org/10.1002/sim.2324
    """
    z, k = normal_quantile(1 - LEVEL / 2), (n + m) / 2 - 1

    def gap(t):
        variance = t * (1 - t) * (1 + k * (1 - t) / (2 - t) + k * t / (1 + t)) / (n * m)
        return (p - t) ** 2 - z**2 * variance

    inside = np.clip(p, 1e-9, 1 - 1e-9)  # at 0 and 1 the gap is zero without being a limit
    low = scipy.optimize.brentq(gap, 0, inside) if p > 0 else 0.0
    high = scipy.optimize.brentq(gap, inside, 1) if p < 1 else 1.0
    return low, high


def probability_of_improvement(x, y):
    """P(x > y) averaged over environments (as rliable), with a 95 % interval.

    The environments' Newcombe intervals are combined by the square-and-add rule (MOVER; Zou and
    Donner, 2008). x (seeds x envs), y (seeds x envs) -> p, low, high.
    """
    x, y = columns(x), columns(y)
    rates = np.array(list(map(win_rate, x, y)))
    if min(map(len, x + y)) < SEEDS_FOR_PROBABILITY:
        return rates.mean(), nan, nan
    limits = [newcombe_interval(p, len(a), len(b)) for p, a, b in zip(rates, x, y, strict=True)]
    below, above = np.abs(rates[:, None] - limits).T
    p = rates.mean()
    return p, p - np.hypot.reduce(below) / len(x), p + np.hypot.reduce(above) / len(x)
