"""Which noise helps here? A search that is cheap, then one comparison on fresh seeds.

Pure functions of the returns of finished runs, {(configuration, seed): return}. What comes next
is computed from them and from nothing else, so a choice can be interrupted anywhere. choose.py
reads the returns from the run folders and names the runs that are due; benchmark.sh starts them.

The search is sequential halving (Karnin, Koren and Somekh, 2013, "Almost Optimal Exploration in
Multi-Armed Bandits", https://proceedings.mlr.press/v28/karnin13.html). An arm is a configuration,
that is noises with their rates; a pull is a training run with a seed of its own. Runs are dear: a
configuration is judged by all its runs so far, those of earlier rounds included.

The best of many looks better than it is on the seeds that chose it. So the winner meets the
baseline on fresh seeds, in one comparison that is fixed beforehand, with the looks of looks.py.
"""

import math
from statistics import fmean
from typing import NamedTuple

from analysis import statistics
from noisy_wrappers import BASELINE, Configuration
from sweep.looks import nominal_levels, stops

FIRST_CONFIRMATION_SEED = 1001  # the search uses those below


class Round(NamedTuple):
    """A round of the search whose runs are all finished."""

    seeds: int  # each candidate has run with the seeds from 1 to this one
    scores: dict[Configuration, float]  # of all its candidates
    survivors: list[Configuration]


class State(NamedTuple):
    """How far the choice for one algorithm and environment has come."""

    rounds: list[Round]  # those that are complete
    candidates: list[Configuration]  # still in the running, in the order given
    seeds: range  # of the runs that the present round or look needs, earlier ones included
    due: list[tuple[Configuration, int]]  # with their seeds, those that are not finished
    look: int = 0  # of the confirmation, from 1; 0 during the search


# --------------------------------------------------------------------------------------- the search


def sizes_of_rounds(number, budget):
    """Return the size of every round: [(candidates, further seeds for each of them)].

    As in Karnin et al., each of ceil(log2 n) rounds halves the candidates. There the rounds share
    the budget equally; here in proportion to the square root of their number of candidates, because
    a good one is lost in the first rounds more often than in the last. The budget, in runs, is a
    target: every candidate gets at least one seed in every round.
    """
    numbers = []
    while number > 1:
        numbers.append(number)
        number = math.ceil(number / 2)
    whole = sum(map(math.sqrt, numbers))
    return [(n, max(1, round(budget / whole / math.sqrt(n)))) for n in numbers]


def advance(candidates, budget, plan, returns):
    """Return how far the choice has come, and which runs are due.

    candidates: configurations, in the order given, which decides between equal scores.
    plan: a Plan, the seeds of each look of the confirmation and its level.
    returns: {(configuration, seed): return}.
    """
    rounds, last_seed = [], 0
    for _, further in sizes_of_rounds(len(candidates), budget):
        last_seed += further
        seeds = range(1, last_seed + 1)
        due = missing(candidates, seeds, returns)
        if due:
            return State(rounds, candidates, seeds, due)
        scores = {one: fmean(returns[one, seed] for seed in seeds) for one in candidates}
        ranking = sorted(candidates, key=scores.get, reverse=True)  # leaves equals in their order
        best = ranking[: math.ceil(len(candidates) / 2)]
        candidates = [candidate for candidate in candidates if candidate in best]
        rounds.append(Round(last_seed, scores, candidates))
    for look, number in enumerate(plan.looks, start=1):
        seeds = fresh_seeds(number)
        due = missing([*candidates, BASELINE], seeds, returns)
        if due or look == len(plan.looks) or stops(*pair(*candidates, seeds, returns), look, plan):
            return State(rounds, candidates, seeds, due, look)
    raise AssertionError("a confirmation has at least one look")


def fresh_seeds(number):
    """Return the seeds of a confirmation, which no search uses."""
    return range(FIRST_CONFIRMATION_SEED, FIRST_CONFIRMATION_SEED + number)


def missing(candidates, seeds, returns):
    """Return the runs that have no return yet, the first seed of every candidate first."""
    wanted = [(candidate, seed) for seed in seeds for candidate in candidates]
    return [run for run in wanted if run not in returns]


# ----------------------------------------------------------------------------------- the comparison


def pair(winner, seeds, returns):
    """Return the returns of the winner and of the baseline on the fresh seeds."""
    noisy = tuple(returns[winner, seed] for seed in seeds)
    baseline = tuple(returns[BASELINE, seed] for seed in seeds)
    return noisy, baseline


class Verdict(NamedTuple):
    """What a confirmation found when it ended."""

    comparison: statistics.Comparison  # with the repeated confidence interval
    seeds: int  # of the planned ones, when it stopped
    planned: int
    needed: float  # the p that this look needed

    @property
    def significant(self):
        """Whether there is a difference, in spite of rounding errors."""
        return round(self.comparison.p, 12) <= self.needed

    @property
    def helps(self):
        """Whether the noise was shown to be better than none."""
        return self.significant and self.comparison.t > 0


def judge(state, plan, returns, episodes=None):
    """Return the Verdict of a choice whose runs are all finished.

    episodes: of a test, where returns are rates of success in percent.
    """
    needed = nominal_levels(plan)[state.look - 1]
    samples = pair(*state.candidates, state.seeds, returns)
    comparison = statistics.compare(*samples, level=needed, episodes=episodes)
    return Verdict(comparison, len(state.seeds), plan.looks[-1], needed)


def records(kind, state, returns, verdict):
    """Yield the rows of choice.csv for one finished choice; their columns are CHOICE_COLUMNS.

    kind: algorithm, environment, exp_name, where it was tested.
    """
    for number, done in enumerate(state.rounds, start=1):
        for candidate, score in done.scores.items():
            survives = "yes" if candidate in done.survivors else "no"
            yield *kind, "search", number, *candidate.columns, done.seeds, score, survives
    said = "yes" if verdict.helps else "worse" if verdict.significant else "no"
    for candidate, survives in ((BASELINE, ""), (*state.candidates, said)):
        score = fmean(returns[candidate, seed] for seed in state.seeds)
        yield *kind, "confirmation", "", *candidate.columns, len(state.seeds), score, survives
