"""What `./benchmark.sh choose` says: its plan, where it stands, its verdicts."""

import csv
from pathlib import Path

from analysis.choice import CHOICE_COLUMNS, KEYS, choice_file
from analysis.errors import fail, in_words
from analysis.folders import SUCCESS, rewritten
from analysis.formatting import p_value, rounded, two_digits
from analysis.power import detectable_shift
from analysis.statistics import LEVEL
from analysis.verdicts import POINTS, borderline, difference_in_words, excluded, smallest
from analysis.words import counted
from noisy_wrappers import BASELINE
from sweep import halving
from sweep.environment import processor_time
from sweep.found import look
from sweep.looks import nominal_levels
from sweep.options import from_caller

UNITS = {"return": "", SUCCESS: POINTS}  # of a difference, by the metric

# ---------------------------------------------------------------------------------- before a batch


def before_a_batch(found, args):
    """Return lines that say, before a batch starts, what is due and what all of it will take.

    Before any run, they also say what gain can be confirmed.
    """
    if not any(choice.state.due for choice in found):
        return []
    lines = [*map(describe, found), total(found)]
    if not any(choice.returns for choice in found):
        lines += dict.fromkeys(detectable_gain(choice.plan) for choice in found)
    return [*lines, f"runs, logs and the verdict are stored in {from_caller(args, args.runs_dir)}"]


def total(found):
    """Say how many runs all choices take, and what is left of them."""
    search = sum(sum(choice.batches[: -len(choice.plan.looks)]) for choice in found)
    confirm = sum(2 * choice.plan.looks[-1] for choice in found)
    finished = sum(len(choice.returns) for choice in found)
    runs = counted(search + confirm, "run")
    if any(len(choice.plan.looks) > 1 for choice in found):
        text = f"at most {runs}, {search:,} to search and up to {confirm:,} to confirm"
    else:
        text = f"{runs} in all, {search:,} to search and {confirm:,} to confirm"
    text += f"; {finished:,} done"
    if any(choice.run_seconds is None for choice in found):
        return text
    seconds = 0
    for choice in found:
        if choice.state.due:
            begun = len(choice.state.rounds) + max(1, choice.state.look)
            left = len(choice.state.due) + sum(choice.batches[begun:])
            seconds += left * choice.run_seconds
    return f"{text}, {processor_time(seconds)}"


def detectable_gain(plan):
    """Say what gain a confirmation can show."""
    seeds = plan.looks[-1]
    gain = detectable_shift(seeds, seeds, nominal_levels(plan)[-1])
    text = f"{seeds} fresh seeds confirm a true gain of {gain:.1f} standard deviations over seeds"
    verdicts = shared_level(plan)
    shared = f", where {verdicts} verdicts share the level" if verdicts else ""
    return f"{text} with 80 % power{shared}"


def shared_level(plan):
    """Return how many verdicts share the level of 0.05, 0 if it is one verdict's own."""
    share = round(LEVEL / plan.level)
    return share if share > 1 else 0


def describe(choice):
    """Say where a choice stands."""
    state = choice.state
    rounds = len(choice.batches) - len(choice.plan.looks)
    if not state.due:
        return f"{choice.name}: all runs are done"
    seeds = f"seeds {state.seeds[0]} to {state.seeds[-1]}" if len(state.seeds) > 1 else "seed 1"
    due = f"{seeds}; runs to do: {len(state.due)}"
    if not state.look:
        left = f"{len(state.candidates)} of {counted(choice.number, 'configuration')}"
        return f"{choice.name}, round {len(state.rounds) + 1} of {rounds}: {left}, {due}"
    [winner] = state.candidates
    looks = len(choice.plan.looks)
    which = f", look {state.look} of {looks}" if looks > 1 else ""
    return f"{choice.name}, confirmation{which}: {winner} against no noise, {due}"


def standing(found, args):
    """Yield lines that say where each choice stands, what is in the running, and what is left.

    When all choices are finished, these are the verdicts.
    """
    if not any(choice.state.due for choice in found):
        for choice in found:
            yield sentence(choice, judge(choice, args), UNITS[args.metric])
        return
    for choice in found:
        yield describe(choice)
        if choice.state.due and choice.state.rounds:
            yield f"  mean {args.metric} after round {len(choice.state.rounds)}:"
            scores = choice.state.rounds[-1].scores
            for noise in sorted(choice.state.candidates, key=scores.get, reverse=True):
                yield f"  {rounded(scores[noise]):>10}  {noise}"
    yield total(found)


# ------------------------------------------------------------------------------------- the verdicts


def report(found, args):
    """Print the verdicts, and write choice.csv; or, where runs are left, what to do about them."""
    if any(choice.state.due for choice in found):
        print(*map(obstacle, found), sep="\n")
        return
    rows = []
    for choice in found:
        verdict = judge(choice, args)
        print(sentence(choice, verdict, UNITS[args.metric]), flush=True)
        run = look(next(iter(choice.runs.values()))).run
        kind = *choice.kind, run.exp_name, run.tested
        rows += halving.records(kind, choice.state, choice.returns, verdict)
    write_choice(Path(args.runs_dir, choice_file(args.metric)), rows)


def judge(choice, args):
    """Return the Verdict of a finished choice; a rate of success is one of so many episodes."""
    episodes = next(iter(choice.runs.values())).number("eval_episodes", 10)
    episodes = episodes if args.metric == SUCCESS else None
    return halving.judge(choice.state, choice.plan, choice.returns, episodes)


def sentence(choice, verdict, unit=""):
    """Say in one plain sentence what a choice has found; unit: of the difference."""
    [winner] = choice.state.candidates
    comparison, share = verdict.comparison, shared_level(choice.plan)
    seeds = f"{verdict.seeds} fresh seeds"
    if verdict.seeds < verdict.planned:
        seeds = f"stopped after {verdict.seeds} of {verdict.planned} planned fresh seeds"
    evidence = f"{seeds}, {difference_in_words(comparison, unit)}, p {p_value(comparison.p)}"
    evidence += smallest(comparison)
    if round(verdict.needed, 6) < LEVEL:
        evidence += f", needed: {two_digits(verdict.needed)}"
        evidence += f" (level shared by {share} verdicts)" if share else ""
    said = f"{winner} could not be shown to help"
    if choice.number > 1:
        said = f"none of {choice.number} configurations could be shown to help; "
        said += f"the best of them, {winner}"
    if verdict.helps:
        said = f"{winner} beats no noise"
    elif verdict.significant:
        said = f"{said}, is worse" if choice.number > 1 else f"{winner} is worse"
        said += " than no noise"
    else:
        evidence += excluded(comparison, unit)
    return f"{choice.name}: {said}: {evidence}.{borderline(comparison, verdict.needed)}"


def obstacle(choice):
    """Say that a choice cannot continue, and what to do."""
    if not choice.state.due:
        return f"{describe(choice)}; the verdict comes with the others"
    failed = [run for run in choice.state.due if not choice.runs[run].damage]
    text = f"{describe(choice)}."
    if failed:
        text += " These did not finish; run the same command again to retry them."
    if failed and not choice.returns:  # then it is not the noise
        return text + f"\n  If none ever finishes, leave {choice.name} out: see --algos and --envs"
    noises = dict.fromkeys(noise for noise, _ in failed)
    if BASELINE in noises:  # then it is not the noise, either
        return text
    for noise in noises:
        excluded = "+".join(f"{name}@{rate}" for name, rate in zip(*noise.texts, strict=True))
        text += f'\n  If it fails every time, leave it out: --exclude "{excluded}"'
    return text


def write_choice(path, new):
    """Write choice.csv; it keeps what other commands have chosen.

    new: rows of halving.records.
    """

    def key(row):
        return tuple(row[: len(KEYS)])

    rows, chosen_now = [CHOICE_COLUMNS], set(map(key, new))
    try:
        with rewritten(path) as file:  # other commands may end at the same time
            if path.exists():
                with open(path, newline="", encoding="utf-8") as old:
                    rows = [row for row in csv.reader(old) if key(row) not in chosen_now]
            if rows[:1] != [CHOICE_COLUMNS]:
                raise ValueError(f"its columns are not {','.join(CHOICE_COLUMNS)}")
            csv.writer(file, lineterminator="\n").writerows(rows + new)
    except (OSError, ValueError) as error:
        fail(f"cannot write {path} ({in_words(error)})")
