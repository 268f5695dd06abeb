"""When a confirmation may stop before its last seed: O'Brien and Fleming's bounds, and futility.

Who looks at a p-value again and again while runs come in, and stops at the first one below 0.05,
claims a useless noise to help in one of seven cases. Here the looks and their levels are fixed
beforehand. The levels are those of Lan and DeMets (1983, "Discrete Sequential Boundaries for
Clinical Trials", https://doi.org/10.1093/biomet/70.3.659), whose error spending is that of O'Brien
and Fleming (1979): very little at the first looks, nearly all of it at the last.

Futility: a confirmation also ends where a gain that all its seeds would show in 9 of 10 cases would
now be shown in fewer than 3. That is not binding: the level holds whoever goes on.
"""

from functools import cache
from math import sqrt
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import scipy

from analysis.permutation import permutation_t

MOST_LOOKS, SEEDS_OF_A_LOOK = 5, 5  # by default
POWER = 0.9  # of the whole confirmation, for the gain by which futility is judged
HOPE = 0.3  # chance of still showing it, below which the confirmation ends
normal_quantile = NormalDist().inv_cdf
POINTS, WIDTH = 2001, 10.0  # of the grid of the integration, in standard deviations


class Plan(NamedTuple):
    """What is fixed before the first run of a confirmation."""

    looks: tuple[int, ...]  # after how many seeds a side
    level: float  # two-sided, of all looks together


def looks_after(seeds, number=None):
    """Return after how many seeds a confirmation is looked at, by default after each five.

    >>> looks_after(25), looks_after(25, 1), looks_after(12), looks_after(50, 3)
    ((5, 10, 15, 20, 25), (25,), (6, 12), (17, 34, 50))
    """
    number = min(MOST_LOOKS, max(1, seeds // SEEDS_OF_A_LOOK)) if number is None else number
    return tuple(-(-seeds * look // number) for look in range(1, number + 1))


def nominal_levels(plan):
    """Return the two-sided p that each look needs; see bounds."""
    return tuple(2 * float(scipy.special.ndtr(-bound)) for bound in bounds(*plan))


@cache
def bounds(looks, level):
    """Return the bounds of |z| at each look, by which the errors of all looks add up to `level`.

    The density of the sum of all increments, for those that have not been stopped, is carried from
    look to look on a grid (Armitage, McPherson and Rowe, 1969).
    """
    times = [number / looks[-1] for number in looks]
    spent = [2 * (1 - scipy.special.ndtr(normal_quantile(1 - level / 4) / sqrt(t))) for t in times]
    found, grid, density, before, already = [], None, None, 0.0, 0.0
    for time, error in zip(times, spent, strict=True):
        step = sqrt(time - before)
        known = error - already, time, step, grid, density
        bound = scipy.optimize.brentq(excess, 0, 40, known, xtol=1e-10)
        limit = min(bound, WIDTH) * sqrt(time)
        new = np.linspace(-limit, limit, POINTS)
        if grid is None:
            density = np.exp(-(new**2) / 2 / time) / sqrt(2 * np.pi * time)
        else:
            kernel = np.exp(-((new[:, None] - grid) ** 2) / 2 / step**2) / sqrt(2 * np.pi) / step
            density = scipy.integrate.trapezoid(kernel * density, grid, axis=1)
        found.append(float(bound))
        grid, before, already = new, time, error
    return tuple(found)


def excess(bound, error, time, step, grid, density):
    """Return the chance to pass an upper bound at a look, and not before, less `error`."""
    if grid is None:
        return scipy.special.ndtr(-bound) - error
    tail = scipy.special.ndtr((grid - bound * sqrt(time)) / step)
    return scipy.integrate.trapezoid(density * tail, grid) - error


@cache
def futility_limits(looks, level):
    """Return the z below which each look ends the confirmation; the last one ends it anyway."""
    last = bounds(looks, level)[-1]
    drift = normal_quantile(1 - level / 2) + normal_quantile(POWER)
    limits = []
    for number in looks[:-1]:
        time = number / looks[-1]
        left = 1 - time  # of the information: what is to come adds drift * left on average
        limits.append((last - drift * left + normal_quantile(HOPE) * sqrt(left)) / sqrt(time))
    return tuple(limits)


def stops(noisy, baseline, look, plan):
    """Tell whether a look that is not the last ends the confirmation.

    noisy, baseline (seeds,): the returns so far.
    """
    t, p, _ = permutation_t(noisy, baseline)
    return round(p, 12) <= nominal_levels(plan)[look - 1] or t < futility_limits(*plan)[look - 1]
