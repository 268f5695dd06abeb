"""Statistics for few seeds: pure functions on (seeds x environments) arrays of final returns.

NaN marks a run that does not exist. IQM and probability of improvement are those of Agarwal et al.
(2021), https://arxiv.org/abs/2108.13264.
"""

from functools import cache, reduce
from math import ceil, comb, inf, isnan, lcm, nan, pi, prod, sqrt
from statistics import NormalDist

import numpy as np
import scipy  # scipy.stats, which takes most of a second, is imported when it is first used

LEVEL, POWER = 0.05, 0.8
normal_quantile = NormalDist().inv_cdf
# A test at this level finds an effect of so many standard errors with this power.
DETECTABLE = normal_quantile(1 - LEVEL / 2) + normal_quantile(POWER)
MIN_SEEDS = 3  # with fewer there is no interval
RESAMPLES = 2000
PERMUTATIONS = 100_000  # where a null distribution has more than MOST_VALUES
MOST_VALUES = 20_000
# Seeds -> percent of simulated samples whose 95 % interval holds the true IQM: the worst of normal
# and skewed returns and of returns of which 20 % lie in a low peak; and the worst where 40 % do
# (tests/test_statistics.py::test_coverage, 500 samples each).
COVERAGE = {3: 94, 5: 96, 10: 95, 20: 95}
COVERAGE_OF_MIXTURES = {3: 75, 5: 85, 10: 89, 20: 86}


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

    scores (..., n) -> (...), NaN where a score is. As rliable's aggregate_iqm (Agarwal et al.,
    2021), which is scipy's trim_mean: sorting is ten times as fast.
    """
    ordered = np.sort(scores, axis=-1)  # NaN comes last
    n = ordered.shape[-1]
    cut = int(n / 4)
    means = ordered[..., cut : n - cut].mean(axis=-1)
    return np.where(np.isnan(ordered[..., -1]), np.nan, means)[()]


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
    half = scipy.stats.t.ppf(0.975, df) * np.sqrt(variance)
    return value, value - half, value + half


def wins(x, y):
    """Mann-Whitney's U: the number of pairs with x > y, a tie counting half. x (n), y (m)."""
    return (x[:, None] > y).sum() + 0.5 * (x[:, None] == y).sum()


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


@cache
def win_rate_null(sizes):
    """Probabilities of the mean win rate over environments when all orders are equally likely.

    sizes: (n, m) of each environment -> probabilities of 0 ... `unit`, unit: a mean win rate is one
    of these numbers divided by `unit`. Win rates are U / (n m); the least common multiple of all
    n m makes them whole. (None, unit) if there are more than MOST_VALUES.
    """
    scale = lcm(*(n * m for n, m in sizes))
    unit = scale * len(sizes)
    if unit > MOST_VALUES:
        return None, unit
    stretched = []
    for n, m in sizes:
        null = np.zeros(scale + 1)
        null[:: scale // (n * m)] = mann_whitney_null(n, m)
        stretched.append(null)
    return reduce(np.convolve, stretched), unit


@cache
def permuted_win_rates(sizes):
    """Draw the mean win rate of PERMUTATIONS random orders, with a fixed seed.

    sizes: (n, m) of each environment -> (PERMUTATIONS,).
    """
    rng = np.random.default_rng(0)
    rates = [
        rng.choice(n * m + 1, PERMUTATIONS, p=mann_whitney_null(n, m)) / (n * m) for n, m in sizes
    ]
    return np.mean(rates, axis=0)


def mann_whitney(x, y):
    """Exact two-sided test of the mean win rate over environments: p, and the smallest possible p.

    Every environment counts alike, whatever its number of seeds, and the direction is that of
    probability_of_improvement, which is the same statistic. In one environment this is Mann and
    Whitney's test. Where there are too many possible values p is from PERMUTATIONS random orders.

    x (seeds x envs), y (seeds x envs) -> p, smallest p.
    """
    pairs = list(zip(columns(x), columns(y), strict=True))
    sizes = tuple((len(a), len(b)) for a, b in pairs)
    smallest = 2 / prod(comb(n + m, n) for n, m in sizes)
    rate = np.mean([wins(a, b) / (len(a) * len(b)) for a, b in pairs])
    null, unit = win_rate_null(sizes)
    if null is None:
        drawn = permuted_win_rates(sizes)
        below = (1 + (drawn <= rate + 1e-12).sum()) / (1 + PERMUTATIONS)
        above = (1 + (drawn >= rate - 1e-12).sum()) / (1 + PERMUTATIONS)
        smallest = max(smallest, 2 / (1 + PERMUTATIONS))
    else:
        place = round(float(rate) * unit, 6)
        possible = np.flatnonzero(null)  # between two of them, where runs are tied: the milder one
        below = null[: possible[np.searchsorted(possible, place)] + 1].sum()
        above = null[possible[np.searchsorted(possible, place, side="right") - 1] :].sum()
    return min(1.0, 2 * min(below, above)), min(1.0, smallest)


def leave_one_seed_out(finals):
    """Value of choosing the best configuration, without the luck of choosing on the same seeds.

    It values the procedure, not the configuration that is best on all seeds: another one may be
    chosen each time. It is descriptive: the terms share seeds, so it has no honest interval. The
    configuration that is best on all other seeds is measured on the seed s that was left out:
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


def contrast(cells, weights):
    """Weighted sum of the means of independent samples, with its standard error and 95 % interval.

    Student's t with Satterthwaite's degrees of freedom: each sample has a variance of its own.
    cells: arrays (n_i), weights: numbers -> estimate, standard error, low, high; without an
    interval where a sample has fewer than MIN_SEEDS.
    """
    estimate = sum(weight * np.mean(cell) for cell, weight in zip(cells, weights, strict=True))
    sizes = np.array([len(cell) for cell in cells])
    if sizes.min() < MIN_SEEDS:
        return estimate, np.nan, np.nan, np.nan
    variances = np.array([np.var(cell, ddof=1) for cell in cells])
    if not variances.any():
        return estimate, 0.0, estimate, estimate
    error, half = satterthwaite(np.square(weights) * variances / sizes, sizes)
    return estimate, error, estimate - half, estimate + half


def satterthwaite(variances, sizes):
    """Return the standard error of a sum of independent means, and half of its 95 % interval.

    variances (k, ...): of the k means; sizes (k, ...): how many values each is the mean of.
    """
    total = np.sum(variances, axis=0)
    freedom = total**2 / np.sum(np.square(variances) / (sizes - 1), axis=0)
    return np.sqrt(total), np.sqrt(total) * scipy.stats.t.ppf(0.975, freedom)


def holm(p):
    """Correct p-values (n,) for n tests with Holm's step-down method."""
    order, adjusted = np.argsort(p), np.empty(len(p))
    adjusted[order] = np.maximum.accumulate(np.sort(p) * np.arange(len(p), 0, -1))
    return np.minimum(1, adjusted)


# -------------------------------------------------------------------------------------------- power


def normal_shift(n, m, level=LEVEL):
    """Return the shift that n against m seeds find with 80 % power, for many seeds.

    In standard deviations, for normal returns. Noether (1987),
    https://doi.org/10.1080/01621459.1987.10478478.
    """
    errors = normal_quantile(1 - level / 2) + normal_quantile(POWER)
    return errors * sqrt((1 / n + 1 / m) * pi / 3)


# simulated_shift(n, n, 0.05) for n = 4, 5, ... 30, because each takes up to half a second
SHIFTS = (
    2.880862450382901,
    2.312949896173857,
    1.9279458212032476,
    1.771853031134289,
    1.5534433245274863,
    1.504862163115294,
    1.3978390998062058,
    1.3037013547958693,
    1.2516792232735203,
    1.1971269819745425,
    1.1287642871586079,
    1.110028389468349,
    1.0643220362675698,
    1.0210327153193397,
    0.9975291599418932,
    0.9616221484366039,
    0.9371047049525144,
    0.9098650224369204,
    0.8890197044192255,
    0.8673265723381766,
    0.8522793466267378,
    0.8290939050900458,
    0.8154541471750474,
    0.8020434089788901,
    0.7835182554211101,
    0.7690933946536513,
    0.7548621930126792,
)


@cache
def detectable_shift(n, m, level=LEVEL):
    """Return the shift that n against m seeds find with 80 % power, or NaN if there is none.

    In standard deviations, for normal returns and the exact two-sided Mann-Whitney test at this
    level. For few seeds it is simulated.
    """
    if n * m > 900:
        return normal_shift(n, m, level)
    if n == m >= 4 and level == LEVEL:
        return SHIFTS[n - 4]
    return simulated_shift(n, m, level)


def simulated_shift(n, m, level):
    """Return detectable_shift: when x is shifted by s, it wins the pairs with y - x < s."""
    tail = 2 * np.cumsum(mann_whitney_null(n, m))
    losses = np.flatnonzero(tail <= level + 1e-12)  # so many lost pairs are still significant
    if len(losses) == 0:
        return nan
    rng = np.random.default_rng(0)
    last_needed = n * m - losses[-1] - 1  # the largest gap that must be closed
    largest = []
    # 400,000 draws for few seeds, down to 40,000: an error of about 0.1 to 0.4 %
    for _ in range(min(100, max(10, 5000 // (n * m)))):
        x, y = rng.normal(size=(4000, n, 1)), rng.normal(size=(4000, 1, m))
        for rows in range(0, 4000, 200):  # blocks that fit into a processor's cache
            gaps = (y[rows : rows + 200] - x[rows : rows + 200]).reshape(200, n * m)
            largest.append(np.partition(gaps, last_needed, axis=1)[:, last_needed])
    return float(np.quantile(np.concatenate(largest), POWER))


@cache
def seeds_needed(shift):
    """Return how many seeds each side needs to find a shift (in sd) with 80 % power; maybe inf."""
    if shift == 0:
        return inf
    n = max(4, ceil((normal_shift(1, 1) / shift) ** 2))
    while n < 30 and not detectable_shift(n, n) <= shift:
        n += 1
    return n


def spread_percent(x, y):
    """Pooled standard deviation of x (n) and y (m) in percent of |mean of y|; NaN without any."""
    (_, x_std, n), (y_mean, y_std, m) = mean_std(x), mean_std(y)
    if n < 2 or m < 2 or y_mean == 0:
        return nan
    pooled = sqrt(((n - 1) * x_std**2 + (m - 1) * y_std**2) / (n + m - 2))
    return 100 * pooled / abs(y_mean) or nan


def detectable_percent(x, y):
    """Improvement in percent that final returns x (n) and y (m) find with 80 % power, or NaN.

    For normal returns with the pooled standard deviation of x and y.
    """
    spread = spread_percent(x, y)
    return nan if isnan(spread) else detectable_shift(mean_std(x)[2], mean_std(y)[2]) * spread


def seeds_for(x, y, percent):
    """Seeds that each side needs to find an improvement of `percent` with 80 % power, or NaN.

    For normal returns with the pooled standard deviation of x (n) and y (m); maybe infinite.
    """
    spread = spread_percent(x, y)
    return nan if isnan(spread) else seeds_needed(round(abs(percent) / spread, 3))
