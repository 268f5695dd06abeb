"""The permutation test with Welch's t: pure functions; docs/statistics.md explains it.

Samples are arrays (seeds,) of one environment or (seeds x environments); NaN marks a run that does
not exist.
"""

from functools import lru_cache
from itertools import combinations
from math import comb, inf, nan, prod

import numpy as np
import scipy

MOST_PARTITIONS = 20_000  # where there are more, a test draws RANDOM_PARTITIONS
RANDOM_PARTITIONS = 99_999
BLOCK = 10_000  # partitions that are multiplied at once, for the sake of memory


def columns(scores):
    """Split a sample into one array per environment, without the missing runs."""
    scores = np.atleast_2d(np.asarray(scores, float).T)
    return [column[np.isfinite(column)] for column in scores]


@lru_cache(maxsize=16)  # one may take 10 MB
def partitions(n, m):
    """Return ways to divide n + m values, the actual one first; 1: first sample, 0: second.

    All of them, or, where there are more than MOST_PARTITIONS, RANDOM_PARTITIONS after the actual
    one, from seed 0. Of whole numbers of one byte, because there are many.
    """
    if comb(n + m, n) <= MOST_PARTITIONS:
        chosen = list(combinations(range(n + m), n))
        divisions = np.zeros((len(chosen), n + m), np.uint8)
        np.put_along_axis(divisions, np.array(chosen), 1, axis=1)
        return divisions
    return random_partitions(n, m, RANDOM_PARTITIONS, np.random.default_rng(0))


def random_partitions(n, m, number, rng):
    """Return the actual division of n + m values and a number of random ones; see partitions."""
    divisions = np.zeros((1 + number, n + m), np.uint8)
    divisions[:, :n] = 1
    divisions[1:] = rng.permuted(divisions[1:], axis=1)
    return divisions


def welch_t(values, chosen):
    """Welch's t of many comparisons, each under many partitions of its values.

    t is 0 where the means are equal, and infinite where they differ and only the spread is 0.

    values (n + m, ...), chosen (partitions, n + m) -> (partitions, ...).
    """
    n = int(chosen[0].sum())
    m = len(values) - n
    mean, scale = values.mean(axis=0), values.std(axis=0)
    values = (values - mean) / np.where(scale > 1e-12 * abs(mean), scale, inf)
    blocks = [chosen[i : i + BLOCK].astype(float) for i in range(0, len(chosen), BLOCK)]
    sums = np.concatenate([block @ values for block in blocks])
    squares = np.concatenate([block @ values**2 for block in blocks])
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
        null = ts[0]
        for others in ts[1:]:  # every division there with every one here
            null = (null[:, None] + others).ravel()
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
