"""The runs of `./benchmark.sh choose`: their folders say what they returned, halving what is due.

The run folders are the only state. Whatever was killed, and whichever executor goes on, the same
command computes from the finished runs where each choice stands.
"""

import csv
import itertools
import math
import os
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from analysis.errors import fail, in_words
from analysis.folders import CONFIRMATION, SEARCH, flat_choice, rewritten
from analysis.runs import CHOICE_COLUMNS, SUCCESS, choice_file, read_run
from analysis.statistics import detectable_shift, holm
from analysis.verdicts import POINTS, what_all_runs_do
from noisy_wrappers import BASELINE, Configuration, rounded
from sweep import halving
from sweep.environment import ask_all, remember, remembered, run_seconds, time_left, wall_time
from sweep.grid import PlannedRun, configuration_of, configurations, make_run, result
from sweep.options import from_caller

UNITS = {"return": "", SUCCESS: POINTS}  # of a difference, by the metric
NO_SUCCESS = "it tells no `is_success` or `success`, as --metric success_rate needs"


class Choice(NamedTuple):
    """The choice of a noise for one algorithm and environment, as far as it has come."""

    kind: tuple[str, str]  # algorithm, in capitals, and environment
    noises: int  # that it began with
    batches: list[int]  # how many runs each round of the search has, and the confirmation
    state: halving.State
    runs: dict[tuple[Configuration, int], PlannedRun]  # those that have been due so far
    returns: dict[tuple[Configuration, int], float]  # of the finished ones: returns, or the metric
    spread: float  # standard deviation over seeds of the search's last tests; NaN if unknown
    run_seconds: float | None  # about what a run takes, if anything tells
    problem: str = ""  # why it cannot continue

    @property
    def name(self):
        """The choice in a sentence."""
        return " on ".join(self.kind)


def choices(args):
    """Return the choices of one command, or exit if its numbers make no choice.

    Where runs are listed, environments are made, timed and tried with noises: see untried.
    """
    pairs = list(itertools.product(dict.fromkeys(args.algos), args.envs))
    fewest = halving.fewest_seeds(len(pairs))
    if args.confirm < fewest:
        fail(
            f"--confirm must be at least {fewest}, not {args.confirm}: with fewer seeds no "
            f"difference could be significant (number of verdicts: {len(pairs)})"
        )
    known = {env_id: remembered(args.runs_dir, env_id) for env_id in args.envs}
    listed = args.view in ("list", "dry-run")
    noises = {env_id: untried(args, env_id, known[env_id].tried) for env_id in args.envs if listed}
    noises = {env_id: new for env_id, new in noises.items() if new}
    for env_id, answer in ask_all(args, noises).items():
        known[env_id] = answer._replace(tried=known[env_id].tried | answer.tried)
        if (unfit := unfit_noises(answer.tried)) and not args.noises:
            text = f"{env_id}: left out, because they cannot act there: {unfit}"
            print(text, file=sys.stderr)
    found = [follow(args, *pair, known[pair[1]]) for pair in pairs]
    for env_id in noises if args.view == "list" else ():
        remember(args.runs_dir, env_id, known[env_id])
    problems = [f"{choice.name}: {choice.problem}" for choice in found if choice.problem]
    if len(problems) == len(found):
        is_argument = all(choice.problem == NO_SUCCESS for choice in found)
        fail("\nerror: ".join(problems), code=2 if is_argument else 1)
    for problem in problems:  # the others go on
        print(f"warning: {problem}", file=sys.stderr)
    return [choice for choice in found if not choice.problem]


def untried(args, env_id, tried):
    """Return the noises to try in an environment; tried: as in Environment.

    All of them until the first run of a choice there is finished. From then on a choice keeps its
    noises: only such as were never tried, or were refused and are named all the same.
    """
    noises = candidates(args, args.algos[0], env_id)
    kept = candidates(args, args.algos[0], env_id, () if args.noises else tried)
    walks = (walk(args, algorithm, env_id, kept, len(kept)) for algorithm in args.algos)
    if not any(returns for *_, returns in walks):
        return noises
    return [n for n in noises if n.noise not in tried or (args.noises and tried[n.noise])]


def unfit_noises(tried):
    """Return the noises that cannot act in an environment, those with one reason together."""
    noises_of = {}
    for noise, reason in tried.items():
        if reason:
            reason = reason.removeprefix(noise.partition("(")[0]).strip()  # of several, often
            noises_of.setdefault(reason, []).append(noise)
    return "; ".join(f"{', '.join(noises)} ({reason})" for reason, noises in noises_of.items())


def follow(args, algorithm, env_id, environment):
    """Return one choice: where the finished runs have brought it."""
    noises = candidates(args, algorithm, env_id, environment.tried)
    budget = 3 * len(noises) if args.budget is None else args.budget
    if budget < len(noises):
        fail(f"--budget must be at least {len(noises)}, a run for each noise, not {budget}")
    schedule = halving.schedule(len(noises), budget)
    last_seed = sum(seeds for _, seeds in schedule)
    if last_seed >= halving.FIRST_CONFIRMATION_SEED:
        fail(f"--budget {budget} is too large: the best noises would run with {last_seed} seeds")
    fresh = range(halving.FIRST_CONFIRMATION_SEED, halving.FIRST_CONFIRMATION_SEED + args.confirm)
    for seed in fresh:  # which other choices in this folder may have run: with the same options?
        result(make_run(args, algorithm, env_id, BASELINE, seed, CONFIRMATION))
    state, runs, tests, returns = walk(args, algorithm, env_id, noises, budget)
    folders = {steps: runs[key].folder for key, (steps, _, _) in tests.items()}
    if len(folders) > 1:  # then their scores do not compare
        one, other, *_ = folders.values()
        fail(
            f"{one} and {other} were not tested at the same steps: choose another --runs-dir, or "
            "move the runs of one kind away"
        )
    spread = halving.spread({run: values[-1] for run, (_, values, _) in tests.items()})
    seconds = wall_time(map(runs.get, returns))
    if seconds is None and environment.timed_steps:
        seconds = run_seconds(next(iter(runs.values())), environment)
    kind = algorithm.upper(), env_id
    results, problem = set().union(*(values for _, values, _ in tests.values())), ""
    over = state.rounds or not state.due  # the first batch
    if over and args.metric == SUCCESS and not any(told for _, _, told in tests.values()):
        problem = NO_SUCCESS
    elif over and len(results) == 1:
        problem = (
            f"{what_all_runs_do(*results, args.metric)} in {args.total_timesteps:,} steps (runs: "
            f"{len(returns)}), so further runs would say nothing about noise; change "
            "--total-timesteps, or leave this out"
        )
    batches = [number * seeds for number, seeds in schedule] + [2 * args.confirm]
    return Choice(kind, len(noises), batches, state, runs, returns, spread, seconds, problem)


def walk(args, algorithm, env_id, noises, budget):
    """Go from batch to batch as long as runs are finished.

    Returns the state; the runs that were due; the steps and the results of the tests of those that
    are finished, and whether they tell the metric; and their scores. All but the state are
    {(configuration, seed): ...}. A run that tells no success, where others do, had none.
    """
    runs, tests, returns = {}, {}, {}
    while True:
        state = halving.advance(noises, budget, args.confirm, returns)
        if runs.keys() >= set(state.due):  # they have not finished
            return state, runs, tests, returns
        for noise, seed in state.due:
            phase = SEARCH if seed < halving.FIRST_CONFIRMATION_SEED else CONFIRMATION
            run, row = read(make_run(args, algorithm, env_id, noise, seed, phase))
            runs[noise, seed] = run
            if row:
                values = row["success_rates" if args.metric == SUCCESS else "returns"]
                told = values is not None
                values = values if told else np.zeros(len(row["steps"]))
                tests[noise, seed] = tuple(row["steps"]), values, told
                score = halving.score(row["steps"], values) if phase == SEARCH else values[-1]
                returns[noise, seed] = score


def read(run):
    """Return a run, with what is damaged in it, and its data, None if it has not finished."""
    runs_dir, phase = run.folder.parents[1], run.folder.parent
    if not phase.exists() and os.path.exists(runs_dir / run.folder.name):
        fail(f"{flat_choice(runs_dir)} (or choose another --runs-dir, if it is another sweep)")
    finished, damage = result(run)
    if finished:
        row = read_run(run.folder)
        if row["status"] == "finished":
            return run, row
        damage = f"{run.folder}/{row['reason']}; move its folder away to run it again"
    return run._replace(damage=damage), None


def candidates(args, algorithm, env_id, tried=()):
    """Return the noises to choose from, each once, but for those that cannot act there.

    tried: as in Environment. Exits if the user has named one that cannot act.
    """
    noises = dict.fromkeys(configurations(args, algorithm, env_id))
    noises.pop(BASELINE, None)  # at rate 0 a noise is none
    if any(rate is None for pairs in args.exclude for _, rate in pairs):
        fail('--exclude needs a rate with each noise, as in "NOISE@0.1"')
    for excluded in set(map(configuration_of, args.exclude)):
        if excluded not in noises:
            fail(f"--exclude: {excluded} is not among the noises")
        del noises[excluded]
    reasons = {noise.noise: tried[noise.noise] for noise in noises if noise.noise in tried}
    if args.noises and any(reasons.values()):
        fail(f"--noises: these cannot act in {env_id}: {unfit_noises(reasons)}")
    noises = [noise for noise in noises if not reasons.get(noise.noise)]
    if not noises:
        fail("there is no noise to choose from")
    return noises


# ---------------------------------------------------------------------------------------- in words


def plan(found, args):
    """Return lines that say, before a batch starts, what it is for and what all of it will take.

    They also say what gain can be confirmed; before any run only in standard deviations.
    """
    if not any(choice.state.due for choice in found):
        return []
    lines = []
    if not any(choice.returns for choice in found):
        fresh = f"{args.confirm} fresh seeds of each will decide"
        for choice in found:
            which = f"the best of {choice.noises} noises" if choice.noises > 1 else "the noise"
            lines.append(f"{choice.name}: is {which} better than no noise? {fresh}")
    lines += [*map(describe, found), total(found, args)]
    lines += filter(None, (detectable_gain(choice, args, len(found)) for choice in found))
    place = from_caller(args, args.runs_dir)
    return [*dict.fromkeys(lines), f"runs, logs and the verdict are stored in {place}"]


def total(found, args):
    """Say how many runs all choices take, and what is left of them."""
    search = sum(sum(choice.batches[:-1]) for choice in found)
    confirm = 2 * args.confirm * len(found)
    finished = sum(len(choice.returns) for choice in found)
    text = (
        f"{search + confirm} runs in all, {search} to search and {confirm} to confirm; "
        f"{finished} are done"
    )
    if any(choice.run_seconds is None for choice in found):
        return text
    left = []  # of each choice, the batches that are left: the seconds of their runs
    for choice in found:
        runs = [len(choice.state.due), *choice.batches[len(choice.state.rounds) + 1 :]]
        left.append([number * [choice.run_seconds] for number in runs])
    batches = [sum(batch, []) for batch in itertools.zip_longest(*left, fillvalue=[])]
    return f"{text}, {time_left(batches, args.jobs, args.elsewhere and not finished)}"


def detectable_gain(choice, args, verdicts):
    """Say what gain the confirmation can show, or nothing once runs are done without a spread."""
    gain = detectable_shift(args.confirm, args.confirm, halving.LEVEL / verdicts)
    seeds = f"{args.confirm} fresh seeds confirm a true gain of"
    power = "with 80 % power" + (f", corrected for {verdicts} verdicts" if verdicts > 1 else "")
    if not choice.returns:
        return f"{seeds} {gain:.1f} standard deviations over seeds {power}"
    if not choice.spread > 0:
        return ""
    shift = rounded(gain * choice.spread, gain * choice.spread) + UNITS[args.metric]
    deviations = f"{gain:.1f} standard deviations of the last tests in the search"
    return f"{choice.name}: {seeds} about {shift} ({deviations}) {power}"


def describe(choice):
    """Say where a choice stands."""
    state = choice.state
    number, rounds = len(state.rounds) + 1, len(choice.batches) - 1
    if not state.due:
        return f"{choice.name}: all runs are done"
    seeds = f"seeds {state.seeds[0]} to {state.seeds[-1]}" if len(state.seeds) > 1 else "seed 1"
    due = f"{seeds}; runs to do: {len(state.due)}"
    if number <= rounds:
        noises = f"{len(state.noises)} of {choice.noises} noises"
        return f"{choice.name}, round {number} of {rounds}: {noises}, {due}"
    [winner] = state.noises
    return f"{choice.name}, confirmation: {winner} against no noise, {due}"


def standing(found, args):
    """Yield lines that say where each choice stands, which noises survive, and what is left.

    When all choices are finished, these are the verdicts.
    """
    if not any(choice.state.due for choice in found):
        yield from (sentence for _, sentence in verdicts(found, args))
        return
    for choice in found:
        yield describe(choice)
        if choice.state.due and choice.state.rounds:
            yield f"  mean {args.metric} after round {len(choice.state.rounds)}:"
            scores = choice.state.rounds[-1].scores
            for noise in sorted(choice.state.noises, key=scores.get, reverse=True):
                yield f"  {rounded(scores[noise]):>10}  {noise}"
    yield total(found, args)


def report(found, args):
    """Print the verdicts, and write choice.csv; or, where runs are left, what to do about them."""
    if any(choice.state.due for choice in found):
        print(*(obstacle(choice, len(found)) for choice in found), sep="\n")
        return
    judged, rows = verdicts(found, args), []
    print(*(sentence for _, sentence in judged), sep="\n", flush=True)
    for choice, (helped, _) in zip(found, judged, strict=True):
        rows += halving.records(*choice.kind, choice.state, choice.returns, helped)
    write_choice(Path(args.runs_dir, choice_file(args.metric)), rows)


def verdicts(found, args):
    """Return of finished choices whether the noise helps, and the verdict in a sentence."""
    comparisons = [
        halving.compare(*choice.state.noises, choice.state.seeds, choice.returns)
        for choice in found
    ]
    corrected = holm([comparison.p for comparison in comparisons])
    judged = []
    for choice, comparison, p in zip(found, comparisons, corrected, strict=True):
        if args.metric == SUCCESS:
            comparison = comparison._replace(difference_percent=math.nan)  # never percent of a rate
        what = choice.name, *choice.state.noises, choice.noises, comparison, p, len(found)
        judged.append((halving.helps(comparison, p), halving.sentence(*what, UNITS[args.metric])))
    return judged


def obstacle(choice, choices):
    """Say that a choice of so many cannot continue, and what to do."""
    if not choice.state.due:
        return f"{describe(choice)}; the verdict comes with the others, for which p is corrected"
    failed = [run for run in choice.state.due if not choice.runs[run].damage]
    text = f"{describe(choice)}."
    if failed:
        text += " These did not finish; run the same command again to retry them."
    if failed and not choice.returns:  # then it is not the noise
        return text + f"\n  If none ever finishes, leave {choice.name} out: see --algos and --envs"
    for noise in dict.fromkeys(noise for noise, _ in failed if noise != BASELINE):
        excluded = "+".join(f"{name}@{rate}" for name, rate in zip(*noise.texts, strict=True))
        text += f'\n  If it fails every time, leave it out: --exclude "{excluded}"'
        text += " (of all choices of the command, finished ones too)" if choices > 1 else ""
    return text


def write_choice(path, new):
    """Write choice.csv; it keeps what other commands have chosen.

    new: rows of halving.records.
    """
    rows, chosen_now = [CHOICE_COLUMNS], {row[:2] for row in new}
    try:
        with rewritten(path) as file:  # other commands may end at the same time
            if path.exists():
                with open(path, newline="", encoding="utf-8") as old:
                    rows = [row for row in csv.reader(old) if tuple(row[:2]) not in chosen_now]
            if rows[:1] != [CHOICE_COLUMNS]:
                raise ValueError(f"its columns are not {','.join(CHOICE_COLUMNS)}")
            csv.writer(file, lineterminator="\n").writerows(rows + new)
    except (OSError, ValueError) as error:
        fail(f"cannot write {path} ({in_words(error)})")
