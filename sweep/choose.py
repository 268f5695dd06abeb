"""The runs of `./benchmark.sh choose`: their folders say what they returned, halving what is due.

The run folders are the only state, and choice.json, which keeps what was fixed beforehand. Whatever
was killed, and whichever executor goes on, the same command computes from the finished runs where
each choice stands.
"""

import itertools
import math
import sys
from typing import NamedTuple

import numpy as np

from analysis.errors import fail
from analysis.folders import CONFIRMATION, SEARCH, SUCCESS
from analysis.statistics import LEVEL, final_value
from analysis.verdicts import what_all_runs_do
from analysis.words import counted
from noisy_wrappers import BASELINE, Configuration, parse_noise
from sweep import halving
from sweep.environment import MANY, ask_all, mean_seconds, remember, remembered, run_seconds
from sweep.found import look, remarks
from sweep.grid import PlannedRun, configuration_of, configurations, make_run
from sweep.looks import Plan, looks_after, nominal_levels
from sweep.memory import choice_key, keep_plans, plan_of
from sweep.options import from_caller


class Choice(NamedTuple):
    """The choice of a noise for one algorithm and environment, as far as it has come."""

    kind: tuple[str, str]  # algorithm, in capitals, and environment
    number: int  # of configurations that it began with
    plan: Plan  # of its confirmation
    batches: list[int]  # how many runs each round of the search has, and each look
    state: halving.State
    runs: dict[tuple[Configuration, int], PlannedRun]  # those that have been due so far
    returns: dict[tuple[Configuration, int], float]  # of the finished ones: returns, or the metric
    run_seconds: float | None  # about what a run takes, if anything tells
    problem: str = ""  # why it cannot continue

    @property
    def name(self):
        """The choice in a sentence."""
        return " on ".join(self.kind)


def choices(args):
    """Return the choices of one command, or exit if its numbers make no choice.

    Where runs are listed, environments are made, timed and tried with noises.
    """
    pairs = list(itertools.product(args.algos, args.envs))
    plans = {pair: plan_for(args, *pair, len(pairs)) for pair in pairs}
    known = {env_id: remembered(args, env_id) for env_id in args.envs}
    asked = {}
    if args.view in ("list", "dry-run"):
        refuse_other_baselines(args, plans)
        asked = ask_about_untried(args, known)
        known |= asked
    found = [follow(args, *pair, known[pair[1]], plan) for pair, plan in plans.items()]
    if args.view == "list":
        for env_id, environment in asked.items():
            remember(args, env_id, environment)
    problems = [f"{choice.name}: {choice.problem}" for choice in found if choice.problem]
    if len(problems) == len(found):
        fail("\nerror: ".join(problems), code=1)
    if args.view not in ("begin", "watch"):  # which follow a list
        for problem in problems:  # the others go on
            print(f"warning: {problem}", file=sys.stderr)
    return [choice for choice in found if not choice.problem]


def begin(args, found):
    """Keep what the runs that start now fix: the command, and the plans of confirmations."""
    plans = {}
    for choice in found:
        algorithm, env_id = choice.kind
        if choice.state.look:
            plans[choice_key(args, algorithm.lower(), env_id)] = choice.plan
    keep_plans(args, plans)


def plan_for(args, algorithm, env_id, verdicts):
    """Return the looks and the level of a confirmation: as they were fixed when it began.

    Before that, the looks are those of the options, and each of the command's verdicts has an equal
    share of the level.
    """
    kept = plan_of(args, algorithm, env_id)
    if args.looks is not None and not 1 <= args.looks <= max(1, args.confirm // 2):
        fail(f"--looks must be from 1 to half of --confirm, not {args.looks}")
    asked = Plan(looks_after(args.confirm, args.looks), LEVEL / verdicts)
    if kept:
        if args.given & {"--confirm", "--looks"} and kept.looks != asked.looks:
            fail(
                f"{algorithm.upper()} on {env_id}: its confirmation has begun, with "
                f"{kept.looks[-1]} seeds and {counted(len(kept.looks), 'look')}, and keeps them: "
                "leave out --confirm and --looks, or use another --runs-dir"
            )
        return kept
    start = max(4, args.looks or 0)  # with fewer seeds two looks would be one
    fewest = next(n for n in itertools.count(start) if is_enough(n, args.looks, asked.level))
    if args.confirm < fewest:
        fail(
            f"--confirm must be at least {fewest}, not {args.confirm}: with fewer seeds no "
            f"difference could be significant (number of verdicts: {verdicts})"
        )
    return asked


def is_enough(seeds, looks, level):
    """Tell whether a difference can be significant at the last look of so many seeds."""
    plan = Plan(looks_after(seeds, looks), level)
    return 2 / math.comb(2 * seeds, seeds) <= nominal_levels(plan)[-1]


def refuse_other_baselines(args, plans):
    """Exit if the fresh seeds have run without noise, in this folder, with other arguments."""
    runs = [
        make_run(args, *pair, BASELINE, seed, CONFIRMATION)
        for pair, plan in plans.items()
        for seed in halving.fresh_seeds(plan.looks[-1])
    ]
    hindrances, _ = remarks(map(look, runs), from_caller(args, args.runs_dir))
    if hindrances:
        fail("\nerror: ".join(hindrances))


# --------------------------------------------------------------------------- which noises can act


def ask_about_untried(args, known):
    """Ask the environments in which noises were never tried; return what is known of these now.

    known: {env_id: Environment}, what earlier commands found.
    """
    untried = {}
    for env_id in args.envs:
        whole = candidates(args, args.algos[0], env_id)
        new = [noise for noise in whole if noise.noise not in known[env_id].tried]
        if new:
            untried[env_id] = new
    answers = ask_all(args, untried)
    for env_id, answer in answers.items():
        if not args.noises:
            for noise, reason in reasons_against(args, answer).items():
                print(f"{env_id}: left out: {noise} ({reason})", file=sys.stderr)
        answers[env_id] = answer._replace(tried=known[env_id].tried | answer.tried)
    return answers


def reasons_against(args, environment):
    """Return why noises are left out in an environment: {noise: reason}.

    Where rewards take few values, noise on them would drown what they tell: of the default noises,
    those on rewards are left out.
    """
    reasons = {noise: reason for noise, reason in environment.tried.items() if reason}
    if args.default_noises and environment.rewards < MANY:
        few = f"rewards take only {counted(environment.rewards, 'value')} there"
        reasons |= {noise: few for noise in environment.tried if is_on_rewards(noise)}
    return reasons


def is_on_rewards(noise):
    """Tell whether one of the noises of an entry perturbs rewards."""
    return any(parse_noise(part).wrapper.kind == "reward" for part in noise.split(" + "))


def candidates(args, algorithm, env_id, environment=None):
    """Return the configurations to choose from, each once, but for those that cannot act there.

    environment: what is known of it. Exits if the user has named a noise that cannot act.
    """
    found = dict.fromkeys(configurations(args, algorithm, env_id))
    found.pop(BASELINE, None)  # at rate 0 a noise is none
    if any(rate is None for pairs in args.exclude for _, rate in pairs):
        fail('--exclude needs a rate with each noise, as in "NOISE@0.1"')
    for excluded in set(map(configuration_of, args.exclude)):
        if excluded not in found:
            fail(f"--exclude: {excluded} is not among the noises")
        del found[excluded]
    against = reasons_against(args, environment) if environment else {}
    left_out = {noise.noise: against[noise.noise] for noise in found if noise.noise in against}
    if args.noises and left_out:
        reasons = "; ".join(f"{noise} ({reason})" for noise, reason in left_out.items())
        fail(f"--noises: these cannot act in {env_id}: {reasons}")
    found = [noise for noise in found if noise.noise not in left_out]
    if not found:
        fail("there is no noise to choose from")
    return found


# --------------------------------------------------------------------------------- how far they are


def follow(args, algorithm, env_id, environment, plan):
    """Return one choice: where the finished runs have brought it."""
    tried = candidates(args, algorithm, env_id, environment)
    budget = 3 * len(tried) if args.budget is None else args.budget
    if budget < len(tried):
        fail(f"--budget must be at least {len(tried)}, a run for each configuration, not {budget}")
    sizes = halving.sizes_of_rounds(len(tried), budget)
    last_seed = sum(seeds for _, seeds in sizes)
    if last_seed >= halving.FIRST_CONFIRMATION_SEED:
        fail(f"--budget {budget} is too large: the best would run with {last_seed} seeds")
    state, runs, returns, tests = walk(args, algorithm, env_id, tried, budget, plan)
    seconds = mean_seconds(map(runs.get, returns))
    if seconds is None and environment.step_seconds:
        seconds = run_seconds(next(iter(runs.values())), environment)
    looks = [0, *plan.looks]
    batches = [number * seeds for number, seeds in sizes]
    batches += [2 * (after - before) for before, after in itertools.pairwise(looks)]
    kind = algorithm.upper(), env_id
    first_batch_is_over = state.rounds or state.look > 1 or not state.due
    problem = why_tests_say_nothing(args, tests) if first_batch_is_over else ""
    return Choice(kind, len(tried), plan, batches, state, runs, returns, seconds, problem)


def why_tests_say_nothing(args, tests):
    """Return why further runs would say nothing about noise, or "".

    tests: the results of each run's tests, None where they tell no success.
    """
    results = set()
    for values in tests.values():
        results.update([0.0] if values is None else values)
    if args.metric == SUCCESS and all(values is None for values in tests.values()):
        return "it tells no `is_success` or `success`, as --metric success_rate needs"
    if len(results) > 1:
        return ""
    [value] = results
    return (
        f"{what_all_runs_do(value, args.metric)} in {args.total_timesteps:,} steps "
        f"(runs: {len(tests)}), so further runs would say nothing about noise; change "
        "--total-timesteps, or leave this out"
    )


def walk(args, algorithm, env_id, tried, budget, plan):
    """Go from batch to batch as long as runs are finished.

    Returns the state; the runs that were due; what the finished ones returned, or their metric; and
    the results of their tests, None where they tell no success: all but the state
    {(configuration, seed): ...}. A run that tells no success, where others do, had none.
    """
    runs, returns, tests = {}, {}, {}
    while True:
        state = halving.advance(tried, budget, plan, returns)
        if runs.keys() >= set(state.due):  # they have not finished
            return state, runs, returns, tests
        for noise, seed in state.due:
            phase = SEARCH if seed < halving.FIRST_CONFIRMATION_SEED else CONFIRMATION
            planned = make_run(args, algorithm, env_id, noise, seed, phase)
            found = look(planned, with_curve=True)
            runs[noise, seed] = planned._replace(damage=found.damage)
            if found.finished:
                curve = found.run.curve
                tests[noise, seed] = values = curve.of(args.metric)
                values = np.zeros(len(curve.steps)) if values is None else values
                returns[noise, seed] = final_value(curve.steps, values)
