"""How far a sweep has come, in the views that benchmark.sh asks for.

    python -m sweep VIEW FOLDER PRESET ...

VIEW is one of VIEWS. FOLDER is the one that benchmark.sh was called from: relative paths count from
there.

A run is done when its folder holds result.json, and running while a process holds its lock. How it
ended otherwise is read from its log, which benchmark.sh ends with the run's exit status. A run on a
machine whose locks this one cannot see is taken for running while its log is young and has no end.
"""

import contextlib
import os
import shlex
import shutil
import sys
import time
from collections import Counter
from statistics import harmonic_mean
from typing import NamedTuple

from analysis.errors import take_over_terminal
from analysis.folders import SUCCESS
from analysis.logs import STOPPED, Log, is_locked, read_log
from analysis.words import counted, duration
from sweep.environment import cost
from sweep.found import look, refuse_others, remarks, runs_in
from sweep.grid import PlannedRun, command_line, grid
from sweep.options import from_caller, parse_args

PATIENCE = 60  # seconds until another machine's results are seen, or taken for lost
YOUNG = 120  # seconds: a run writes a line at least every ten, except in a test or in compiling
RUNNING, PROBABLY = "running", "probably running"
STATES = ("done", RUNNING, PROBABLY, "failed", "to do")


class Progress(NamedTuple):
    """How far a run has come."""

    run: PlannedRun
    log: Log
    state: str  # one of STATES
    reason: str = ""  # why it is not done, "" where nothing is known yet


def progress_of(run, found, over):
    """Return the progress of a run in whose folder something was found.

    over: its sweep is; then no young log means that it is running.
    """
    log = read_log(run.folder)
    if found.finished:
        return Progress(run, log, "done")
    if found.damage:
        return Progress(run, log._replace(last_line=found.damage), "failed", "damaged")
    if found.differences:
        said = f"it has {' and '.join(found.differences)}"
        return Progress(run, log._replace(last_line=said, step=0), "to do", "other arguments")
    is_young = abs(log.age) < YOUNG  # a log that is dated in the future is not
    if is_locked(run.folder):
        is_silent = YOUNG <= log.age < float("inf")
        reason = f"running, silent for {duration(log.age)}" if is_silent else ""
        return Progress(run, log, RUNNING, "still running" if over else reason)
    status = log.exit_status
    if status in STOPPED:
        return Progress(run, log, "to do", "stopped")
    if status == 0:  # the run was finished, and its folder has been moved or deleted since
        return Progress(run, log._replace(step=0), "to do", "no result.json")
    if status is not None:
        # beyond the last signal it is a program's own, such as the 255 of sys.exit(-1)
        ended = f"signal {status - 128}" if 128 < status <= 192 else f"exit {status}"
        return Progress(run, log, "failed", ended)
    if is_young and not over:
        return Progress(run, log, PROBABLY)
    return Progress(run, log, "to do", "lost" if log.age < float("inf") else "")


def summary(progresses):
    """Return one line: how many runs are in which state, how fast it goes, how long it takes."""
    count = Counter(progress.state for progress in progresses)
    states = [f"{count[state]:,} {state}" for state in STATES if state != PROBABLY or count[state]]
    text = f"{counted(len(progresses), 'run')}: {', '.join(states)}"
    unfinished = [p for p in progresses if p.state != "done"]
    left = {p.run.folder: max(0, p.run.total_timesteps - p.log.step) for p in unfinished}
    steps = sum(p.run.total_timesteps for p in progresses)
    if any(left.values()):
        text += f"; {steps - sum(left.values()):,} of {steps:,} steps"
    speeds = {}  # of each kind of runs, and of all
    for p in progresses:
        if p.log.steps_per_second:
            for kind in (p.run.kind, None):
                speeds.setdefault(kind, []).append(p.log.steps_per_second)
    on_their_way = [p for p in progresses if p.state in (RUNNING, PROBABLY)]
    if on_their_way and speeds:
        mean = {kind: harmonic_mean(values) for kind, values in speeds.items()}
        seconds = sum(left[p.run.folder] / mean.get(p.run.kind, mean[None]) for p in unfinished)
        now = sum(p.log.steps_per_second for p in on_their_way)
        text += f"; about {duration(seconds / len(on_their_way))} left"
        text += f", {now:,.0f} steps/s" if now else ""
    return text


def table(title, progresses, args):
    """Print the runs under a title, if there are any: the reason, the log, its last line."""
    rows = [(p.reason, from_caller(args, p.log.path), p.log.last_line) for p in progresses]
    if rows:
        print(title)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  " + "  ".join(map(str.ljust, row, widths)).rstrip())


# ------------------------------------------------- the views, which may return an exit status


def show_list(args, runs, choices):
    """Print the runs to do for benchmark.sh: folder and command; on stderr how many there are.

    A dry run also says what they will take. A choice says it of each of its batches, see begin.
    """
    all_found, notes = refuse_others(runs, from_caller(args, args.runs_dir))
    done, todo = [], []
    for run, found in zip(runs, all_found, strict=True):
        if found.damage:
            print(f"warning: {found.damage}", file=sys.stderr)
        else:
            (done if found.finished else todo).append(run)
    if todo or args.view == "dry-run":  # otherwise the report follows, which has them, too
        for line in notes:
            print(f"note: {line}", file=sys.stderr)
    for run in todo:
        folder = f"{run.folder.parent}/{run.folder.name}"  # with a slash, for --runs-dir . too
        print(folder, command_line(run), sep="\t")
    if choices:
        if args.view == "dry-run":
            announce(args, choices)
        return
    line = f"{counted(len(runs), 'run')}{with_baselines(runs)}, {len(todo):,} to do"
    if args.view == "dry-run" and todo:
        line += "; " + cost(args, done, todo)
    print(line, file=sys.stderr)


def announce(args, choices):
    """Say on stderr what a choice's next batch is, and what all of it will take."""
    from sweep import telling

    for line in telling.before_a_batch(choices, args):
        print(line, file=sys.stderr)


def begin(args, runs, choices):
    """Announce a choice's next batch of runs just before they start; keep what it fixes."""
    from sweep import choose

    choose.begin(args, choices)
    announce(args, choices)


def watch(args, runs, choices):
    """Show the summary until benchmark.sh ends: on a terminal one line that is rewritten.

    Elsewhere lines follow each other, seldom enough for the log of a sweep that takes days.
    """
    # benchmark.sh may be killed before this line: then another process is the parent already
    parent = int(os.environ.get("WATCHED", os.getppid()))
    terminal = sys.stderr.isatty()
    pause = 10 if terminal or args.preset == "demo" else 600  # seconds
    shown = -pause if terminal else time.monotonic()  # a terminal shows the first line at once
    while os.getppid() == parent:
        if time.monotonic() - shown >= pause:
            shown = time.monotonic()
            progresses = [progress_of(run, look(run), over=False) for run in runs]
            # one that has no lock yet is starting: this sweep has begun it
            line = summary(
                [p._replace(state=p.state.removeprefix("probably ")) for p in progresses]
            )
            if terminal:
                width = shutil.get_terminal_size().columns - 1
                line = f"\r{line[:width].ljust(width)}"
            print(line, end="" if terminal else "\n", file=sys.stderr, flush=True)
        time.sleep(1)


def show_status(args, runs, choices):
    """Print how far a sweep is; the exit status is 1 where a run's files are damaged."""
    found = list(map(look, runs))
    progresses = show_progress(args, runs, found, over=False)
    hindrances, notes = remarks(found, from_caller(args, args.runs_dir))
    for line in [*hindrances, *notes]:
        print(f"note: {line}")
    silent = [p for p in progresses if p.state == RUNNING and p.reason]
    table("running, but silent:", silent, args)
    if choices:
        from sweep import telling

        print(*telling.standing(choices, args), sep="\n")
    return int(any(p.reason == "damaged" for p in progresses))


def show_stopped(args, runs, choices):
    """Print where a sweep stands that was stopped."""
    show_progress(args, runs, map(look, runs), over=True)


def show_report(args, runs, choices):
    """Print what came out of a sweep; the exit status is 1 unless all runs are done."""
    found = list(map(look, runs))
    progresses = show_progress(args, runs, found, over=True, everything=True)
    _, notes = remarks(found, from_caller(args, args.runs_dir))
    for line in notes:  # a script may have been edited meanwhile
        print(f"note: {line}")
    refused = {p.run.script.file: p.log.last_line for p in progresses if p.reason == "exit 2"}
    for script, reason in refused.items():
        print(f"{script} refused arguments, so no other seeds of these were started: {reason}")
    if choices:
        from sweep import telling

        telling.report(choices, args)
    if any(p.state == "done" for p in progresses):
        place = shlex.quote(from_caller(args, args.runs_dir))
        program = shlex.quote(from_caller(args, "analyze.py"))
        print(f"See the curves with: tensorboard --logdir {place}")
        metric = " --metric success_rate" if choices and args.metric == SUCCESS else ""
        print(f"Make tables and figures with: python {program} --runs-dir {place}{metric}")
    return int(any(p.state != "done" for p in progresses))


def show_progress(args, runs, found, over, everything=False):
    """Print the summary and the failed runs; return the progress of all.

    everything: also print what else is known to have ended, or not to.
    """
    progresses = [progress_of(run, one, over) for run, one in zip(runs, found, strict=True)]
    print(f"{from_caller(args, args.runs_dir)}: {summary(progresses)}")
    named = [p for p in progresses if p.state == "failed" or (everything and p.reason)]
    table("not finished:" if everything else "failed:", named, args)
    return progresses


def with_baselines(runs):
    """Say how many runs have no noise, unless none has any."""
    clean = sum("--noise" not in run.command for run in runs)
    return "" if clean == len(runs) else f" ({clean:,} of them without noise)"


VIEWS = {
    "list": show_list,
    "dry-run": show_list,
    "status": show_status,
    "begin": begin,
    "stopped": show_stopped,
    "report": show_report,
    "watch": watch,
}


def main(view, caller, argv):
    """Print one view of the grid; returns the exit status."""
    with contextlib.redirect_stdout(sys.stderr):  # what a user's module prints is no run
        args = parse_args(view, caller, argv)
        runs, choices = planned(args)
        if os.environ.get("SWEEP_WAITED") and view in ("list", "report") and are_seen(runs):
            runs, choices = planned(args)
    runs.sort(key=lambda run: run.seed)  # the first seed of everything first
    return VIEWS[view](args, runs, choices) or 0


def planned(args):
    """Return the runs of a grid, and, if they are those of choices, these."""
    if not args.names_grid:
        return runs_in(args.runs_dir, args.caller), []
    if args.preset != "choose":
        return grid(args), []
    from sweep import choose  # and with it pandas: no other preset should wait for that

    choices = choose.choices(args)
    return [run for choice in choices for run in choice.runs.values()], choices


def are_seen(runs):
    """Wait until the results can be seen of runs that have just ended well on other machines.

    A network's file system may show them seconds after the log says exit=0. Returns whether there
    were any to wait for.
    """
    deadline, late = time.monotonic() + PATIENCE, list(filter(is_late, runs))
    waited = bool(late)
    while late and time.monotonic() < deadline:
        time.sleep(1)
        for folder in {folder for run in late for folder in (run.folder.parent, run.folder)}:
            with contextlib.suppress(OSError):
                os.listdir(folder)  # makes the file system look again
        late = list(filter(is_late, late))
    return waited


def is_late(run):
    """Tell whether a run has ended well, and its result is not to be seen."""
    return not os.path.exists(run.folder / "result.json") and read_log(run.folder).exit_status == 0


if __name__ == "__main__":
    if sys.argv[1] in ("list", "dry-run"):
        sys.stdout = open(os.dup(1), "w")  # noqa: SIM115
        os.dup2(2, 1)  # what native code of a user's module prints is no run, either
    else:
        take_over_terminal()
    try:
        sys.exit(main(sys.argv[1], sys.argv[2], sys.argv[3:]))
    except KeyboardInterrupt:
        sys.exit(130)
