"""Statistics for few seeds: pure functions of final returns; docs/statistics.md explains them.

Samples are arrays (seeds,) of one environment or (seeds x environments); NaN marks a run that does
not exist. IQM and probability of improvement are those of Agarwal et al. (2021),
https://arxiv.org/abs/2108.13264.
"""

from functools import cache, lru_cache, reduce
from itertools import combinations, count
from math import ceil, comb, inf, isnan, nan, prod, sqrt
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import scipy

LEVEL, POWER = 0.05, 0.8
normal_quantile = NormalDist().inv_cdf
# A test at this level finds an effect of so many standard errors with this power.
DETECTABLE = normal_quantile(1 - LEVEL / 2) + normal_quantile(POWER)
# With fewer there is no interval. That of a difference of means would say something else than p in
# 16 % of cases for 4 against 4 seeds (5 seeds: 5 %); of the others docs/statistics.md says why.
SEEDS_FOR_IQM, SEEDS_FOR_PROBABILITY, SEEDS_FOR_INTERVAL = 3, 4, 5
MOST_PARTITIONS = 20_000  # where there are more, a test draws RANDOM_PARTITIONS
RANDOM_PARTITIONS = 99_999


LAST_PART = 0.15  # of a run's steps: its tests there are what it counts with


def final_value(steps, values):
    """Return what a run counts with: the mean of its tests in the last 15 % of its steps.

    The last test always counts. steps (tests,): in ascending order; values (tests,): their returns
    or rates of success.
    """
    last = steps[-1]
    return float(np.mean(values[last - steps < LAST_PART * last]))


def columns(scores):
    """Split a sample into one array per environment, without the missing runs."""
    scores = np.atleast_2d(np.asarray(scores, float).T)
    return [column[np.isfinite(column)] for column in scores]


def exact(value, *samples):
    """Return a difference or a spread of samples, but 0 where it is nothing but rounding errors."""
    return 0.0 if abs(value) <= 1e-12 * abs(np.concatenate(samples)).max() else value


def mean_std(values):
    """Mean, sample standard deviation (ddof=1) and number of the values that are not NaN."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    mean = values.mean() if len(values) else nan
    return mean, exact(values.std(ddof=1), values) if len(values) > 1 else nan, len(values)


def pooled_std(samples):
    """Return the standard deviation within samples (n_i), and its degrees of freedom."""
    df = sum(len(sample) - 1 for sample in samples if len(sample))
    squares = sum(((sample - np.mean(sample)) ** 2).sum() for sample in samples if len(sample))
    return np.sqrt(squares / max(1, df)), df


def percent_of(difference, baseline):
    """100 difference / |mean of the baseline|, or NaN where a percentage would mean nothing.

    That is where the mean is not clearly unequal to zero: its 95 % interval (Student's t) includes
    zero, or, with fewer than three seeds, the returns have not all one sign. baseline (seeds,).
    """
    baseline = baseline[np.isfinite(baseline)]
    if len(baseline) < 3:
        clear = len(baseline) > 0 and (np.all(baseline > 0) or np.all(baseline < 0))
    else:
        _, _, low, high = contrast([baseline], [1])
        clear = not low <= 0 <= high
    return 100 * difference / abs(baseline.mean()) if clear else nan


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
    baseline's IQM in each environment, and NaN where the interval of one of these includes zero.

    The interval is iqm +- t_{0.975, df} sqrt(sum of v). There is one v for each sample (the seeds
    of one environment, with noise or without): n / (n - 1) times the variance of the IQM when
    this sample is drawn anew from its own n seeds (Efron and Tibshirani, 1993, chapter 12). df is
    Satterthwaite's (1946), so few seeds of the baseline count.

    scores (seeds x envs), baseline (other seeds x envs) or None -> iqm, low, high.
    """
    noisy, alone = columns(scores), [] if baseline is None else columns(baseline)
    if any(low <= 0 <= high for _, low, high in map(bootstrap_iqm, alone)):
        return nan, nan, nan

    def improvement(x, y):
        pairs = [(a, np.asarray(iqm(b))[..., None]) for a, b in zip(x, y, strict=True)]
        return iqm(np.concatenate([100 * (a - middle) / abs(middle) for a, middle in pairs], -1))

    def estimate(samples):
        x, y = samples[: len(noisy)], samples[len(noisy) :]
        return improvement(x, y) - improvement(y, y) if y else iqm(np.concatenate(x, axis=-1))

    samples = noisy + alone
    value = estimate(samples)
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
    return value, value - half, value + half


def win_rate(x, y):
    """P(x > y) of samples x (n) and y (m), a tie counting half: Mann-Whitney's U / (n m)."""
    return ((x[:, None] > y) + 0.5 * (x[:, None] == y)).mean()


def newcombe_interval(p, n, m):
    """95 % interval of a win rate p of n against m: method 5 of Newcombe (2006).

    Unlike the percentile bootstrap it does not collapse to a point at p = 0 or 1.
    https://doi.org/10.1002/sim.2324
    """
    z, k = normal_quantile(0.975), (n + m) / 2 - 1

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


@lru_cache(maxsize=4)  # one may take 50 MB
def partitions(n, m):
    """Return ways to divide n + m values, the actual one first; 1: first sample, 0: second.

    All of them, or, where there are more than MOST_PARTITIONS, RANDOM_PARTITIONS after the actual
    one, from seed 0.
    """
    if comb(n + m, n) <= MOST_PARTITIONS:
        chosen = list(combinations(range(n + m), n))
        divisions = np.zeros((len(chosen), n + m))
        np.put_along_axis(divisions, np.array(chosen), 1, axis=1)
        return divisions
    return random_partitions(n, m, RANDOM_PARTITIONS, np.random.default_rng(0))


def random_partitions(n, m, number, rng):
    """Return the actual division of n + m values and a number of random ones; see partitions."""
    divisions = np.zeros((1 + number, n + m))
    divisions[:, :n] = 1
    divisions[1:] = rng.permuted(divisions[1:], axis=1)
    return divisions


def welch_t(values, chosen):
    """Welch's t of many comparisons, each under many partitions of its values.

    t is 0 where the means are equal, and infinite where they differ and only the spread is 0.

    values (n + m, ...), chosen (partitions, n + m) -> (partitions, ...).
    """
    n = chosen[0].sum()
    m = len(values) - n
    mean, scale = values.mean(axis=0), values.std(axis=0)
    values = (values - mean) / np.where(scale > 1e-12 * abs(mean), scale, inf)
    sums, squares = chosen @ values, chosen @ values**2
    others = (values**2).sum(axis=0) - squares
    difference = sums * (1 / n + 1 / m)  # because the sum of all values is 0
    variance = (squares - sums**2 / n) / (n - 1) / n + (others - sums**2 / m) / (m - 1) / m
    error = np.sqrt(np.maximum(variance, 0))
    difference[abs(difference) < 1e-9] = 0  # rounding errors, in standard deviations of all values
    error[error < 1e-6] = 0
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(difference / error, nan=0, posinf=inf, neginf=-inf)


def permutation_t(x, y):
    """Two-sided permutation test with Welch's t, over environments with the mean of its scores.

    Exact where the two distributions are equal, and for many seeds valid where only the means are
    (Janssen, 1997, https://doi.org/10.1016/S0167-7152(97)00043-6; Chung and Romano, 2013,
    https://doi.org/10.1214/13-AOS1090). The runs of each environment are divided on their own.

    x, y: samples of the same environments -> t or the mean score, p, the smallest p that is
    possible with so many seeds; all but the last NaN where there are fewer than two on a side.
    """
    pairs = list(zip(columns(x), columns(y), strict=True))
    sizes = [(len(a), len(b)) for a, b in pairs]
    if min(map(min, sizes)) < 2:
        return nan, nan, 1.0
    ways = prod(comb(n + m, n) for n, m in sizes)
    ts = [welch_t(np.concatenate([a, b]), partitions(len(a), len(b))) for a, b in pairs]
    if len(ts) > 1:
        ts = list(map(normal_scores, ts))
    if len(ts) == 1 or ways <= MOST_PARTITIONS:
        null = reduce(lambda a, b: np.add.outer(a, b).ravel(), ts)
    else:
        rng = np.random.default_rng(0)
        null = sum(np.append(t[0], drawn(t, rng)) for t in ts)
    above, below = tails(null)
    smallest = 2 / min(ways, 1 + RANDOM_PARTITIONS)
    return null[0] / len(pairs), min(1.0, 2 * min(above, below)), min(1.0, smallest)


def normal_scores(t):
    """Return the normal quantile of the rank of each t (partitions,) in one environment.

    So every environment counts alike. t itself is huge, or infinite, where runs hardly differ.
    """
    ranks = scipy.stats.rankdata(np.round(t, 9))  # equal up to rounding is equal
    return scipy.special.ndtri((ranks - 0.5) / len(t))


def drawn(t, rng):
    """Draw RANDOM_PARTITIONS of one environment's scores, in another order than in the others."""
    if len(t) > RANDOM_PARTITIONS:  # they are random, after the actual one
        return rng.permutation(t[1:])
    return rng.choice(t, RANDOM_PARTITIONS)


def tails(null):
    """Return the shares of t (partitions, ...) that are at least, and at most, the first one."""
    # equal up to rounding is equal
    margin = 1e-9 * np.where(np.isfinite(null[0]), 1 + abs(null[0]), 0)
    return (null >= null[0] - margin).mean(axis=0), (null <= null[0] + margin).mean(axis=0)


class Comparison(NamedTuple):
    """Runs with noise against runs without: all that a verdict says. NaN where there is nothing."""

    environments: int
    n: int  # seeds with noise, in the environment that has fewest
    n_baseline: int
    n_baseline_most: int
    difference: float  # of the means, in units of the return; in one environment
    difference_low: float  # its 95 % interval
    difference_high: float
    difference_percent: float  # of |mean without noise|; over environments the mean
    effect_size: float  # the difference in pooled_std; over environments the median
    pooled_std: float  # sqrt((variance with noise + variance without) / 2)
    t: float  # Welch's; over environments the mean of normal_scores
    p: float
    smallest_p: float  # that is possible with these numbers of seeds
    detectable: float  # difference that these seeds find with 80 % power, before a correction
    seeds_needed: float  # on each side, to find the observed difference with 80 % power


def compare(x, y, level=LEVEL):
    """Compare the means of two samples x and y of the same environments.

    level: one minus the coverage of the interval.
    """
    xs, ys = columns(x), columns(y)
    pairs = list(zip(xs, ys, strict=True))
    differences = np.array([exact(a.mean() - b.mean(), a, b) for a, b in pairs])
    stds = np.array([sqrt((mean_std(a)[1] ** 2 + mean_std(b)[1] ** 2) / 2) for a, b in pairs])
    percents = list(map(percent_of, differences, ys))
    with np.errstate(divide="ignore", invalid="ignore"):
        effects = np.where(differences == 0, 0 * stds, differences / stds)
        effect = np.median(effects)  # of inf and -inf there is none
    difference = low = high = std = detectable = needed = nan
    n, m = min(map(len, xs)), min(map(len, ys))
    if len(pairs) == 1:
        difference, error, low, high = contrast([xs[0], ys[0]], [1, -1], level)
        if min(n, m) < SEEDS_FOR_INTERVAL:
            low = high = nan
        std, needed = stds[0], seeds_needed(round(abs(effect), 3))
        detectable = detectable_shift(n, m) * error / sqrt(1 / n + 1 / m)
    t, p, smallest_p = permutation_t(x, y)
    sizes = len(pairs), n, m, max(map(len, ys))
    found = difference, low, high, np.mean(percents), effect, std
    return Comparison(*sizes, *found, t, p, smallest_p, detectable, needed)


def steps_to_reach(curves, steps, target):
    """First step with a mean over seeds of at least `target`, or NaN. curves (steps x seeds)."""
    curves = curves[:, np.isfinite(curves).all(axis=0)]
    means = curves.mean(axis=1)
    # The last mean of the baseline is its own target, but rounding depends on the order of a sum.
    reached = np.flatnonzero((means >= target) | np.isclose(means, target, rtol=1e-9, atol=0))
    return steps[reached[0]] if len(reached) else np.nan


def contrast(samples, weights, level=LEVEL):
    """Weighted sum of the means of independent samples, with its standard error and interval.

    Student's t with Satterthwaite's degrees of freedom: each sample has a variance of its own.
    samples: arrays (n_i), weights: numbers -> estimate, standard error, low, high; NaN where a
    sample has fewer than two values.
    """
    estimate = sum(w * np.mean(sample) for w, sample in zip(weights, samples, strict=True))
    estimate = exact(estimate, *samples)
    sizes = np.array([len(sample) for sample in samples])
    if sizes.min() < 2:
        return estimate, nan, nan, nan
    variances = np.array([mean_std(sample)[1] ** 2 for sample in samples])
    error, half = satterthwaite(np.square(weights) * variances / sizes, sizes, level)
    return estimate, error, estimate - half, estimate + half


def satterthwaite(variances, sizes, level=LEVEL):
    """Return the standard error of a sum of independent means, and half of its interval.

    variances (k, ...): of the k means; sizes (k, ...): how many values each is the mean of.
    """
    total = np.sum(variances, axis=0)
    squares = np.sum(np.square(variances) / (sizes - 1), axis=0)
    freedom = np.divide(total**2, squares, out=np.ones_like(total), where=squares > 0)
    return np.sqrt(total), np.sqrt(total) * scipy.special.stdtrit(freedom, 1 - level / 2)


def holm(p):
    """Correct p-values (n,) for n tests with Holm's step-down method."""
    order, adjusted = np.argsort(p), np.empty(len(p))
    adjusted[order] = np.maximum.accumulate(np.sort(p) * np.arange(len(p), 0, -1))
    return np.minimum(1, adjusted)


# -------------------------------------------------------------------------------------------- power


@cache
def detectable_shift(n, m, level=LEVEL):
    """Return the shift that n against m seeds find with 80 % power, or NaN if there is none.

    In standard deviations, for normal returns of equal spread, by the noncentral t distribution;
    simulated where the test has so few partitions that its p is a coarse number.
    """
    smallest_p = 2 / comb(n + m, n) if n + m < 1000 else 0.0
    if min(n, m) < 2 or smallest_p > level:
        return nan
    if 5 * smallest_p > level:
        return simulated_shift(n, m, level)
    df = n + m - 2
    critical = scipy.special.stdtrit(df, 1 - level / 2)
    return scipy.special.nctdtrinc(df, 1 - POWER, critical) * sqrt(1 / n + 1 / m)


def simulated_shift(n, m, level):
    """Return detectable_shift by bisection, in 200 to 4,000 simulated comparisons."""
    chosen = partitions(n, m)
    number = int(np.clip(1_000_000 / len(chosen), 200, 4000))
    noise = np.random.default_rng(0).standard_normal((n + m, number))
    low, high = 0.0, 16.0
    while high - low > 0.005:
        shift = (low + high) / 2
        above, _ = tails(welch_t(noise + shift * chosen[0][:, None], chosen))
        power = np.mean(2 * above <= level + 1e-12)
        low, high = (low, shift) if power >= POWER else (shift, high)
    return high


@cache
def seeds_needed(shift):
    """Return how many seeds each side needs to find a shift (in sd) with 80 % power; maybe inf."""
    if isnan(shift):
        return nan
    if shift == 0:
        return inf
    least = ceil(2 * (DETECTABLE / shift) ** 2)  # of infinitely many degrees of freedom
    return next(n for n in count(max(4, least)) if detectable_shift(n, n) <= shift)
