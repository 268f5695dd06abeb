"""The runs of `./benchmark.sh choose`: their folders say what they returned, halving what is due.

The run folders are the only state. Whatever was killed, and whichever executor goes on, the same
command computes from the finished runs where each choice stands.
"""

import csv
import fcntl
import itertools
import json
import os
from statistics import fmean
from typing import NamedTuple

from analysis.errors import fail
from analysis.runs import CHOICE_COLUMNS, FIRST_CONFIRMATION_SEED, read_run
from analysis.statistics import detectable_shift, holm
from noisy_wrappers import BASELINE, Configuration, rounded
from sweep import halving
from sweep.grid import NOISES, RATES, PlannedRun, cell, cells, make_run, result

# What a run takes on one core until the finished ones tell: docs/sweeps.md
STEPS_PER_SECOND = {"sac": 150, "td3": 265, "ppo": 5700}  # in small MuJoCo environments
IN_HUMANOID = {"sac": 90, "td3": 130, "ppo": 2900}
START_UP = 10  # seconds, with compilation


class Choice(NamedTuple):
    """The choice of a noise for one algorithm and environment, as far as it has come."""

    name: str  # "PPO on Hopper-v5"
    algorithm: str
    env_id: str
    schedule: list[tuple[int, int]]  # of its search
    confirm: int  # fresh seeds of the confirmation
    state: halving.State
    runs: dict[tuple[Configuration, int], PlannedRun]  # those that have been due so far
    returns: dict[tuple[Configuration, int], float]  # of those that are finished
    core_hours: float  # about what is left


def choices(args):
    """Return the choices of one command, or exit if its numbers make no choice."""
    pairs = list(itertools.product(dict.fromkeys(args.algos), args.envs))
    fewest = halving.fewest_seeds(len(pairs))
    if args.confirm < fewest:
        fail(
            f"--confirm must be at least {fewest}, not {args.confirm}: with fewer seeds no "
            f"difference could be significant (number of verdicts: {len(pairs)})"
        )
    return [follow(args, algorithm, env_id) for algorithm, env_id in pairs]


def follow(args, algorithm, env_id):
    """Return one choice: where the finished runs have brought it."""
    noises = candidates(args, algorithm, env_id)
    budget = 3 * len(noises) if args.budget is None else args.budget
    if budget < len(noises):
        fail(f"--budget must be at least {len(noises)}, a run for each noise, not {budget}")
    schedule = halving.schedule(len(noises), budget)
    last_seed = sum(seeds for _, seeds in schedule)
    if last_seed >= FIRST_CONFIRMATION_SEED:
        fail(f"--budget {budget} is too large: the best noises would run with {last_seed} seeds")
    if not args.noises:
        check_others(args, algorithm, env_id)
    runs, returns = {}, {}
    while True:
        state = halving.advance(noises, budget, args.confirm, returns)
        finished = {}
        for noise, seed in state.due:
            run = make_run(args, algorithm, env_id, noise, seed)
            runs[noise, seed] = run
            if result(run)[0]:
                finished[noise, seed] = read_return(run, seed)
        if not finished:
            break
        returns |= finished
    check_frequencies(runs[key] for key in returns)
    left = halving.number_of_runs(len(noises), budget, args.confirm) - len(returns)
    speeds = IN_HUMANOID if "Humanoid" in env_id else STEPS_PER_SECOND
    seconds = START_UP + args.total_timesteps / speeds[algorithm]
    if returns:
        seconds = fmean(wall_time(runs[key]) for key in returns)
    return Choice(
        name=f"{algorithm.upper()} on {env_id}",
        algorithm=algorithm,
        env_id=env_id,
        schedule=schedule,
        confirm=args.confirm,
        state=state,
        runs=runs,
        returns=returns,
        core_hours=left * seconds / 3600,
    )


def check_others(args, algorithm, env_id):
    """Exit if the folder holds a search among all of the paper's noises.

    They were the default once. With today's list a search would mix with theirs.
    """
    ours = cells(args, algorithm, env_id)
    for noise, rate in itertools.product(NOISES, args.noise_rates or RATES):
        found = cell([(noise, rate)])
        if found in ours:
            continue
        if result(make_run(args, algorithm, env_id, found, seed=1))[0]:
            fail(
                f"{args.runs_dir} holds a choice among other noises, one of them "
                f"{found}: continue it (--noises paper tries all 90), "
                "or choose another --runs-dir"
            )


def runs_of(found):
    """Return the runs of all choices together, the first seed of everything first."""
    runs = []
    for choice in found:
        runs += [(seed, run) for (_, seed), run in choice.runs.items()]
    return [run for _, run in sorted(runs, key=lambda pair: pair[0])]


def candidates(args, algorithm, env_id):
    """Return the noises to choose from, each once."""
    noises = dict.fromkeys(cells(args, algorithm, env_id))
    noises.pop(BASELINE, None)  # at rate 0 a noise is none
    for pairs in args.exclude:
        if any(rate is None for _, rate in pairs):
            fail('--exclude needs a rate with each noise, as in "NOISE@0.1"')
        excluded = cell(pairs)
        if excluded not in noises:
            fail(f"--exclude: {excluded} is not among the noises")
        del noises[excluded]
    if not noises:
        fail("there is no noise to choose from")
    return list(noises)


def read_return(run, seed):
    """Return what a finished run counts for.

    That is halving.score in the search, and its last test in the confirmation.
    """
    row = read_run(run.folder)
    if row["status"] != "finished":
        fail(f"{run.folder} cannot be used ({row['reason']}); delete it to run it again")
    if seed >= FIRST_CONFIRMATION_SEED:
        return row["returns"][-1]
    return halving.score(row["steps"], row["returns"])


def check_frequencies(runs):
    """Exit if finished runs were not all tested equally often: their scores do not compare."""
    found = {}
    for run in runs:
        made_with = json.loads((run.folder / "config.json").read_text())["args"]
        found.setdefault(made_with.get("eval_frequency"), run.folder)
    if len(found) > 1:
        (every, one), (other, another), *_ = found.items()
        fail(
            f"{one} was tested every {every} steps and {another} every {other}: choose another "
            f"--runs-dir, or delete the runs of one kind"
        )


def wall_time(run):
    """Return how many seconds a finished run has taken."""
    return json.loads((run.folder / "result.json").read_text())["wall_time_seconds"]


# ---------------------------------------------------------------------------------------- in words


def plan(found):
    """Return lines that say, before a batch starts, what is due and what all of it will take.

    Before the first batch, also what gain can be confirmed.
    """
    if not any(choice.state.due for choice in found):
        return []
    begun = any(choice.returns for choice in found)
    return [*map(describe, found), total(found), *([] if begun else [reach(found)])]


def total(found):
    """Say how many runs all choices take, and what is left of them."""
    search = sum(noises * seeds for choice in found for noises, seeds in choice.schedule)
    confirm = sum(2 * choice.confirm for choice in found)
    finished = sum(len(choice.returns) for choice in found)
    hours = sum(choice.core_hours for choice in found)
    hours = f"{hours:.1f}" if hours >= 0.1 else f"{hours:.2g}"
    return (
        f"{search + confirm} runs in all, {search} to search and {confirm} to confirm; "
        f"{finished} are done, about {hours} core-hours are left"
    )


def reach(found):
    """Say what gain the confirmations of all choices can show."""
    seeds = found[0].confirm
    gain = detectable_shift(seeds, seeds, halving.LEVEL / len(found))
    together = f", corrected for {len(found)} verdicts" if len(found) > 1 else ""
    return (
        f"{seeds} fresh seeds confirm a true gain of {gain:.1f} standard deviations over seeds "
        f"with 80 % power{together}"
    )


def describe(choice):
    """Say where a choice stands."""
    state = choice.state
    number, rounds = len(state.rounds) + 1, len(choice.schedule)
    if not state.due:
        return f"{choice.name}: all runs are done"
    seeds = f"seeds {state.seeds[0]} to {state.seeds[-1]}" if len(state.seeds) > 1 else "seed 1"
    due = f"{seeds}; runs to do: {len(state.due)}"
    if number <= rounds:
        noises = f"{len(state.noises)} of {choice.schedule[0][0]} noises"
        return f"{choice.name}, round {number} of {rounds}: {noises}, {due}"
    [winner] = state.noises
    return f"{choice.name}, confirmation: {winner} against no noise, {due}"


def standing(found):
    """Yield lines that say where each choice stands, which noises survive, and what is left.

    When all choices are finished, these are the verdicts.
    """
    if not any(choice.state.due for choice in found):
        yield from verdicts(found, judged(found))
        return
    for choice in found:
        yield describe(choice)
        if choice.state.due and choice.state.rounds:
            yield f"  mean return after round {len(choice.state.rounds)}:"
            scores = choice.state.rounds[-1].scores
            for noise in sorted(choice.state.noises, key=scores.get, reverse=True):
                yield f"  {rounded(scores[noise]):>10}  {noise}"
    yield total(found)


def conclusion(found):
    """Yield the verdicts, one line for each choice.

    While runs of a choice are left, there is none: then say what to do about them.
    """
    if any(choice.state.due for choice in found):
        for choice in found:
            yield obstacle(choice) if choice.state.due else describe(choice)
    else:
        yield from verdicts(found, judged(found))


def rows(found):
    """Return the rows of choice.csv; there are none while runs of a choice are left."""
    if any(choice.state.due for choice in found):
        return []
    result = []
    for choice, (comparison, p) in zip(found, judged(found), strict=True):
        names = choice.algorithm.upper(), choice.env_id
        helped = halving.helps(comparison, p)
        result += halving.rows(*names, choice.state, choice.returns, helped)
    return result


def judged(found):
    """Return each finished choice's comparison, and its p corrected for all of them."""
    comparisons = []
    for choice in found:
        [winner] = choice.state.noises
        comparisons.append(halving.compare(winner, choice.state.seeds, choice.returns))
    corrected = holm([comparison.p for comparison in comparisons])
    return list(zip(comparisons, corrected, strict=True))


def verdicts(found, judgements):
    """Yield what came out, one line for each choice."""
    for choice, (comparison, p) in zip(found, judgements, strict=True):
        noises = choice.schedule[0][0] if choice.schedule else 1
        [winner] = choice.state.noises
        yield halving.sentence(choice.name, winner, noises, comparison, p, len(found))


def obstacle(choice):
    """Say that a choice cannot continue, and what to do."""
    text = f"{describe(choice)}. These did not finish; run the same command again to retry them."
    for configuration, _ in choice.state.due:
        pairs = zip(*configuration.texts, strict=True)
        excluded = "+".join(f"{noise}@{rate}" for noise, rate in pairs)
        advice = f'\n  If it fails every time, leave it out: --exclude "{excluded}"'
        if excluded and advice not in text:
            text += advice
    return text


def write_choice(path, rows):
    """Write choice.csv whole or not at all; it keeps what other commands have chosen."""
    try:
        with open(path.with_name(".choice.lock"), "w") as lock:
            fcntl.lockf(lock, fcntl.LOCK_EX)  # until it is closed: commands may end side by side
            replace_choice(path, rows)
    except (OSError, KeyError, ValueError) as error:
        fail(f"cannot write {path} ({type(error).__name__}: {error})")


def replace_choice(path, rows):
    """Replace the lines of what was chosen now, and keep the others."""
    ours = {(row["algorithm"], row["environment"]) for row in rows}
    if path.exists():
        with open(path, newline="") as file:
            old = list(csv.DictReader(file))
        rows = [r for r in old if (r["algorithm"], r["environment"]) not in ours] + rows
    temporary = path.with_suffix(".tmp")
    with open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, CHOICE_COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    os.replace(temporary, path)
