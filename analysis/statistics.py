"""Statistics for few seeds: pure functions of final returns; docs/statistics.md explains them.

Samples are arrays (seeds,) of one environment or (seeds x environments); NaN marks a run that does
not exist.
"""

from math import inf, isnan, nan, sqrt
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import scipy

from analysis.permutation import columns, permutation_t
from analysis.power import LEVEL, detectable_shift

normal_quantile = NormalDist().inv_cdf
# With fewer there is no interval. That of a difference of means would say something else than p in
# 16 % of cases for 4 against 4 seeds (5 seeds: 5 %).
SEEDS_FOR_INTERVAL = 5
LAST_PART = 0.15  # of a run's steps: its tests there are what it counts with
# A percentage needs a baseline's mean of at least this part of what all returns span
PERCENT_OF_SPAN = 0.1


def final_value(steps, values):
    """Return what a run counts with: the mean of its tests in the last 15 % of its steps.

    The last test always counts. steps (tests,): in ascending order; values (tests,): their returns
    or rates of success.
    """
    last = steps[-1]
    return float(np.mean(values[last - steps < LAST_PART * last]))


def exact(value, *samples):
    """Return a difference or a spread of samples, but 0 where it is nothing but rounding errors."""
    return 0.0 if abs(value) <= 1e-12 * abs(np.concatenate(samples)).max() else value


def are_different(values):
    """Tell whether values, without those that are not finite, differ by more than rounding."""
    values = values[np.isfinite(values)]
    return len(values) > 1 and exact(np.ptp(values), values) > 0


def mean_std(values):
    """Mean, sample standard deviation (ddof=1) and number of the values that are not NaN."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    mean = values.mean() if len(values) else nan
    return mean, exact(values.std(ddof=1), values) if len(values) > 1 else nan, len(values)


def pooled_std(samples, episodes=None):
    """Return the standard deviation within samples (n_i), and its degrees of freedom.

    episodes: where the values are rates of success in percent, of so many episodes each: it is at
    least that of chance, see variance_of_mean.
    """
    samples = [sample for sample in samples if len(sample)]
    df = sum(len(sample) - 1 for sample in samples)
    if df == 0:
        return 0.0, 0
    squares = sum(((sample - np.mean(sample)) ** 2).sum() for sample in samples)
    std = exact(sqrt(squares / df), *samples)
    if episodes:
        values = np.concatenate(samples)
        least = least_variance(values.mean(), episodes * len(values))  # of the mean of all
        std = max(std, sqrt(len(values) * least))
    return std, df


# ------------------------------------------------------------------------------------- percentages


def percent_of(difference, baseline, others=()):
    """100 difference / |mean of the baseline|, or NaN where a percentage would mean nothing.

    It means something where the baseline's mean is clearly not zero and large beside what the
    returns span: its 95 % interval (Student's t) excludes zero (with fewer than three seeds, the
    returns have one sign), and it is at least a tenth of the span of all returns.

    baseline (seeds,); others: all further returns that are compared with it.
    """
    baseline = baseline[np.isfinite(baseline)]
    everything = np.append(baseline, others)
    everything = everything[np.isfinite(everything)]
    if len(baseline) == 0:
        return nan
    size = abs(baseline.mean())
    if len(baseline) < 3:
        clear = np.all(baseline > 0) or np.all(baseline < 0)
    else:
        _, _, low, high = contrast([baseline], [1])
        clear = not low <= 0 <= high
    large = size >= PERCENT_OF_SPAN * np.ptp(everything)
    return at_least_minus_100(100 * difference / size, everything) if clear and large else nan


def at_least_minus_100(percent, returns):
    """Return a change in percent, but not below -100 where all returns are positive."""
    return max(percent, -100.0) if np.all(returns > 0) else percent


def fieller(x, y, level=LEVEL):
    """Return the interval of 100 (mean x - mean y) / |mean y|, in percent: Fieller's.

    Both means are uncertain. The interval has the ratios r for which Student's t of mean x -
    r mean y does not reject 0, with Satterthwaite's degrees of freedom at the observed ratio. It is
    NaN where that set is unbounded, because mean y is not clearly unequal to zero, or nearly so:
    percent_of tells no change beyond 1,000 % either.

    x (seeds,), y (other seeds,), two or more on each side; level: of the interval.
    Fieller (1954), https://doi.org/10.1111/j.2517-6161.1954.tb00159.x
    """
    means = np.array([np.mean(x), np.mean(y)])
    variances = np.array([variance_of_mean(sample) for sample in (x, y)])
    if means[1] == 0:
        return nan, nan
    ratio = means[0] / means[1]
    sizes = np.array([len(x), len(y)])
    freedom = degrees_of_freedom(np.array([1, ratio**2]) * variances, sizes)
    of_x, of_y = means**2 - scipy.special.stdtrit(freedom, 1 - level / 2) ** 2 * variances
    if of_y <= 0:
        return nan, nan
    product = means.prod()
    root = sqrt(max(0.0, product**2 - of_x * of_y))
    changes = 100 * (np.array([product - root, product + root]) / of_y - 1) * np.sign(means[1])
    if max(abs(changes)) > 100 / PERCENT_OF_SPAN:
        return nan, nan
    low, high = (at_least_minus_100(change, np.append(x, y)) for change in sorted(changes))
    return float(low), float(high)


# ------------------------------------------------------------------------------------- comparisons


class Comparison(NamedTuple):
    """Runs with noise against runs without: all that a verdict says. NaN where there is nothing."""

    environments: int
    n: int  # seeds with noise, in the environment that has fewest
    n_baseline: int
    n_baseline_most: int
    difference: float  # of the means, in units of the return; in one environment
    difference_low: float  # its interval
    difference_high: float
    difference_percent: float  # of |mean without noise|; over environments the mean
    percent_low: float  # its interval; in one environment
    percent_high: float
    effect_size: float  # the difference in pooled_std; over environments the median
    pooled_std: float  # sqrt((variance with noise + variance without) / 2)
    t: float  # Welch's; over environments the mean of normal_scores
    p: float
    smallest_p: float  # that is possible with these numbers of seeds
    detectable: float  # difference that these seeds find with 80 % power, before a correction


def compare(x, y, level=LEVEL, episodes=None):
    """Compare the means of two samples x and y of the same environments.

    level: of the intervals, which hold the truth with 1 - level; at a look of a sequence of looks,
    its nominal level. p does not depend on it. episodes: see contrast; then no percentages.
    """
    xs, ys = columns(x), columns(y)
    pairs = list(zip(xs, ys, strict=True))
    differences = np.array([exact(a.mean() - b.mean(), a, b) for a, b in pairs])
    variances = [[len(s) * variance_of_mean(s, episodes) for s in pair] for pair in pairs]
    stds = np.sqrt(np.mean(variances, axis=1))
    percents = [percent_of(d, b, a) for d, (a, b) in zip(differences, pairs, strict=True)]
    if episodes:
        percents = [nan]
    with np.errstate(divide="ignore", invalid="ignore"):
        effects = np.where(differences == 0, 0 * stds, differences / stds)
        effect = np.median(effects)  # of inf and -inf there is none
    difference = low = high = percent_low = percent_high = std = detectable = nan
    n, m = min(map(len, xs)), min(map(len, ys))
    if len(pairs) == 1:
        difference, error, low, high = contrast([xs[0], ys[0]], [1, -1], level, episodes)
        if min(n, m) < SEEDS_FOR_INTERVAL:
            low = high = nan
        elif not isnan(percents[0]):
            percent_low, percent_high = fieller(xs[0], ys[0], level)
            if (percent_low > 0 or percent_high < 0) != (low > 0 or high < 0):
                percent_low = percent_high = nan  # two intervals that disagree would say nothing
        std = stds[0]
        detectable = detectable_shift(n, m) * error / sqrt(1 / n + 1 / m)
    t, p, smallest_p = permutation_t(x, y)
    sizes = len(pairs), n, m, max(map(len, ys))
    found = difference, low, high, np.mean(percents), percent_low, percent_high
    return Comparison(*sizes, *found, effect, std, t, p, smallest_p, detectable)


def contrast(samples, weights, level=LEVEL, episodes=None):
    """Weighted sum of the means of independent samples, with its standard error and interval.

    Student's t with Satterthwaite's degrees of freedom: each sample has a variance of its own.
    episodes: where the values are rates of success in percent, of so many episodes each: see
    variance_of_mean. The interval of a difference of rates ends at 100 percentage points.

    samples: arrays (n_i), weights: numbers -> estimate, standard error, low, high; NaN where a
    sample has fewer than two values.
    """
    estimate = sum(w * np.mean(sample) for w, sample in zip(weights, samples, strict=True))
    estimate = exact(estimate, *samples)
    sizes = np.array([len(sample) for sample in samples])
    if sizes.min() < 2:
        return estimate, nan, nan, nan
    variances = [variance_of_mean(sample, episodes) for sample in samples]
    error, half = satterthwaite(np.square(weights) * variances, sizes, level)
    most = 100.0 if episodes else inf
    return estimate, error, max(estimate - half, -most), min(estimate + half, most)


def variance_of_mean(sample, episodes=None):
    """Return the variance of a sample's mean, as its n values tell it.

    Seeds that all succeed, or all fail, do not vary, and are still no proof that all seeds would.
    So where `episodes` says that the values are rates of success in percent, of so many episodes
    each, it is at least that of the rate of all episodes together with one success and one failure
    more (Agresti and Caffo, 2000, https://doi.org/10.1080/00031305.2000.10474560).
    """
    variance = mean_std(sample)[1] ** 2 / len(sample)
    if not episodes:
        return variance
    return max(variance, least_variance(np.mean(sample), episodes * len(sample)))


def least_variance(mean, number):
    """Return the least variance of a mean rate of success, in percent, of a number of episodes."""
    rate = (number * mean / 100 + 1) / (number + 2)
    return 100**2 * rate * (1 - rate) / (number + 2)


def degrees_of_freedom(variances, sizes):
    """Return Satterthwaite's degrees of freedom of a sum of independent means.

    variances (k, ...): of the k means; sizes (k, ...): how many values each is the mean of.
    """
    total = np.sum(variances, axis=0)
    squares = np.sum(np.square(variances) / (sizes - 1), axis=0)
    return np.divide(total**2, squares, out=np.ones_like(total), where=squares > 0)


def satterthwaite(variances, sizes, level=LEVEL):
    """Return the standard error of a sum of independent means, and half of its interval.

    variances, sizes: see degrees_of_freedom.
    """
    error = np.sqrt(np.sum(variances, axis=0))
    freedom = degrees_of_freedom(variances, sizes)
    return error, error * scipy.special.stdtrit(freedom, 1 - level / 2)


def steps_to_reach(curves, steps, target):
    """First step with a mean over seeds of at least `target`, or NaN. curves (steps x seeds).

    A run that ended before a step is in no mean there.
    """
    tested = np.isfinite(curves)
    means = np.where(tested, curves, 0).sum(axis=1) / np.maximum(1, tested.sum(axis=1))
    reached = np.flatnonzero(tested.any(axis=1) & (means >= target))
    return steps[reached[0]] if len(reached) else np.nan


def holm(p):
    """Correct p-values (n,) for n tests with Holm's step-down method."""
    order, adjusted = np.argsort(p), np.empty(len(p))
    adjusted[order] = np.maximum.accumulate(np.sort(p) * np.arange(len(p), 0, -1))
    return np.minimum(1, adjusted)
