"""Which noise helps here? A search that is cheap, then one comparison on fresh seeds.

Pure functions of the returns of finished runs, {(configuration, seed): return}. What comes next
is computed from them and from nothing else, so a choice can be interrupted anywhere. choose.py
reads the returns from the run folders and names the runs that are due; benchmark.sh starts them.

The search is sequential halving (Karnin, Koren and Somekh, 2013, "Almost Optimal Exploration in
Multi-Armed Bandits", https://proceedings.mlr.press/v28/karnin13.html). An arm is a noise with its
rate, a pull is a training run with a seed of its own. Runs are dear: a noise is judged by all its
runs so far, those of earlier rounds included.

The best of many looks better than it is on the seeds that chose it. So the winner meets the
baseline on fresh seeds, in one comparison that is fixed beforehand.
"""

import math
from itertools import count
from statistics import fmean
from typing import NamedTuple

import numpy as np

from analysis import statistics, verdicts
from analysis.statistics import LEVEL  # of a verdict, two-sided, over all verdicts of one command
from noisy_wrappers import BASELINE, Configuration, rounded

FIRST_CONFIRMATION_SEED = 1001  # the search uses those below
SCORED = 0.15  # a run's score in the search is the mean of its tests in this last part of its steps


class Round(NamedTuple):
    """A round of the search whose runs are all finished."""

    seeds: int  # each noise has run with the seeds from 1 to this one
    scores: dict[Configuration, float]  # of all its noises
    survivors: list[Configuration]


class State(NamedTuple):
    """How far the choice for one algorithm and environment has come."""

    rounds: list[Round]  # those that are complete
    noises: list[Configuration]  # still in the running, in the order given
    seeds: range  # of the runs that the present round or the confirmation needs
    due: list[tuple[Configuration, int]]  # with their seeds, those that are not finished


# --------------------------------------------------------------------------------------- the search


def schedule(noises, budget):
    """Return the size of every round: [(noises, further seeds for each of them)].

    As in Karnin et al., each of ceil(log2 n) rounds halves the noises. There the rounds share the
    budget equally; here in proportion to the square root of their number of noises, because a good
    noise is lost in the first rounds more often than in the last (tools/simulate_choose.py). The
    budget, in runs, is a target: every noise gets at least one seed in every round.
    """
    numbers = []
    while noises > 1:
        numbers.append(noises)
        noises = math.ceil(noises / 2)
    whole = sum(map(math.sqrt, numbers))
    return [(n, max(1, round(budget / whole / math.sqrt(n)))) for n in numbers]


def advance(noises, budget, confirm, returns):
    """Return how far the choice has come, and which runs are due.

    noises: configurations in the order given, which decides between equal scores.
    returns: {(configuration, seed): return}, the score of a run for the seeds of the search, the
    final test return for those of the confirmation.
    """
    rounds, last_seed = [], 0
    for _, further in schedule(len(noises), budget):
        last_seed += further
        seeds = range(1, last_seed + 1)
        due = missing(noises, seeds, returns)
        if due:
            return State(rounds, noises, seeds, due)
        scores = {noise: fmean(returns[noise, seed] for seed in seeds) for noise in noises}
        ranking = sorted(noises, key=scores.get, reverse=True)  # leaves equals in their order
        best = ranking[: math.ceil(len(noises) / 2)]
        noises = [noise for noise in noises if noise in best]
        rounds.append(Round(last_seed, scores, noises))
    seeds = range(FIRST_CONFIRMATION_SEED, FIRST_CONFIRMATION_SEED + confirm)
    return State(rounds, noises, seeds, missing([*noises, BASELINE], seeds, returns))


def score(steps, returns):
    """Return a run's score in the search: the mean of its tests in the last 15 % of its steps.

    steps (tests,): those of its tests in ascending order, returns (tests,): what they returned. The
    last test always counts.
    """
    steps, returns = np.asarray(steps), np.asarray(returns)
    return float(returns[steps[-1] - steps < SCORED * steps[-1]].mean())


def spread(returns):
    """Return the standard deviation over the seeds of a noise in the search, pooled over noises.

    returns: {(configuration, seed): return}. NaN if no noise has two.
    """
    groups = {}
    for (noise, seed), value in returns.items():
        if seed < FIRST_CONFIRMATION_SEED:
            groups.setdefault(noise, []).append(value)
    std, freedom = statistics.pooled_std(list(groups.values()))
    return float(std) if freedom else math.nan


def missing(noises, seeds, returns):
    """Return the runs that have no return yet, the first seed of every noise first."""
    wanted = [(noise, seed) for seed in seeds for noise in noises]
    return [run for run in wanted if run not in returns]


# ----------------------------------------------------------------------------------- the comparison


def fewest_seeds(comparisons):
    """Return the smallest number of fresh seeds with which every verdict can be significant."""
    return next(n for n in count(4) if 2 / math.comb(2 * n, n) <= LEVEL / comparisons)


def compare(winner, seeds, returns):
    """Compare the winner with the baseline on the fresh seeds, all of which have a return."""
    pair = ([returns[noise, seed] for seed in seeds] for noise in (winner, BASELINE))
    return statistics.compare(*pair)


def helps(comparison, p_corrected):
    """Tell whether the noise was shown to be better than none."""
    return verdicts.significant(p_corrected) and comparison.t > 0


def sentence(name, winner, noises, comparison, p_corrected, comparisons, unit=""):
    """Say in one plain sentence what came out.

    name: the algorithm and the environment. noises: how many were searched. comparisons: for how
    many p is corrected. unit: of the difference.
    """
    evidence = f"{comparison.n} fresh seeds, {verdicts.difference(comparison, unit)}"
    evidence += f", p {verdicts.p_value(comparison.p)}{verdicts.smallest(comparison)}"
    evidence += verdicts.corrected(p_corrected, comparisons, "verdict")
    none = f"none of {noises} noises could be shown to help; the best of them, {winner}"
    said = none if noises > 1 else f"{winner} could not be shown to help"
    if helps(comparison, p_corrected):
        said = f"{winner} beats no noise"
    elif verdicts.significant(p_corrected):
        said = f"{none}," if noises > 1 else f"{winner}"
        said += " is worse than no noise"
    elif comparison.detectable > 0:
        seen = rounded(comparison.detectable, verdicts.spread_of(comparison))
        power = "80 % power before the correction" if comparisons > 1 else "80 % power"
        evidence += f"; with {comparison.n} seeds a difference of {seen}{unit} would have been seen"
        evidence += f" ({power})"
    return f"{name}: {said}: {evidence}.{verdicts.borderline(comparison)}"


def records(algorithm, environment, state, returns, helped):
    """Yield the rows of choice.csv for one finished choice; their columns are CHOICE_COLUMNS."""
    kind = algorithm, environment
    for number, done in enumerate(state.rounds, start=1):
        for noise, score in done.scores.items():
            survives = "yes" if noise in done.survivors else "no"
            yield *kind, "search", number, *noise.columns, done.seeds, score, survives
    for noise, survives in ((BASELINE, ""), (*state.noises, "yes" if helped else "no")):
        score = fmean(returns[noise, seed] for seed in state.seeds)
        yield *kind, "confirmation", "", *noise.columns, len(state.seeds), score, survives
