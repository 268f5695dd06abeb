"""How far a sweep has come, in six views.

benchmark.sh calls this file from the project's folder:

    python -m sweep list FOLDER PRESET ...     one run per line: folder, state, command
    python -m sweep dry-run FOLDER PRESET ...  the same, after their cost is said on stderr
    python -m sweep status FOLDER PRESET ...   a summary, the failed runs, the slowest running ones
    python -m sweep stopped FOLDER PRESET ...  a summary and the failed runs of a stopped sweep
    python -m sweep report FOLDER PRESET ...   a summary, and what did not finish: exit status 1
    python -m sweep watch FOLDER PRESET ...    the summary, again and again

FOLDER is the one that benchmark.sh was called from: relative paths count from there.

A run is done when its folder holds result.json, and running while a process holds its lock. How it
ended otherwise is read from its log, which benchmark.sh ends with the run's exit status. A run on a
machine whose locks this one cannot see is taken for running while its log is young and has no end.
"""

import argparse
import contextlib
import os
import shutil
import sys
import tempfile
import time
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import NamedTuple

from analysis.errors import take_over_terminal
from analysis.folders import STOPPED, Log, is_locked, read_log
from sweep.environment import cost
from sweep.grid import check_rollouts, command_line, grid, result, runs_in
from sweep.options import check_arguments, parse_args

YOUNG = 120  # seconds: a run writes a line at least every ten, except in a test or in compiling
RUNNING, PROBABLY = "running", "probably running"


class Sweep(NamedTuple):
    """What a view is about."""

    args: argparse.Namespace  # as options.parse_args reads them
    runs: list  # of PlannedRun
    choices: list  # of choose.Choice, for the preset of that name


class Progress(NamedTuple):
    """How far a run has come."""

    state: str  # done, running, probably running, failed or to do
    reason: str  # why it is not done, "" where nothing is known yet
    log: Log


def progress_of(run, over):
    """Return a run's progress; where its sweep is over, no young log means that it is running."""
    log = read_log(run.folder)
    done, damage = result(run)
    if done:
        return Progress("done", "", log)
    if damage:
        return Progress("failed", "damaged", log._replace(last_line=damage))
    if is_locked(run.folder):
        silent = f"silent for {log.age / 60:.0f} min" if YOUNG <= log.age < float("inf") else ""
        return Progress(RUNNING, "still running" if over else silent, log)
    status = log.exit_status
    if status in STOPPED:
        return Progress("to do", "stopped", log)
    if status == 0:  # the run was finished, and its folder has been moved or deleted since
        return Progress("to do", "no result.json", log)
    if status is not None:
        ended = f"signal {status - 128}" if status > 128 else f"exit {status}"
        return Progress("failed", ended, log)
    if log.age < YOUNG and not over:
        return Progress(PROBABLY, "", log)
    return Progress("to do", "lost" if log.age < float("inf") else "", log)


def remaining(run, progress):
    """Return the environment steps that a run has left."""
    return 0 if progress.state == "done" else max(0, run.total_timesteps - progress.log.step)


def summary(runs, progresses):
    """Return one line: how many runs are in which state, how fast it goes, how long it takes."""
    count = dict.fromkeys(("done", RUNNING, PROBABLY, "failed", "to do"), 0)
    speeds = {}
    for run, progress in zip(runs, progresses, strict=True):
        count[progress.state] += 1
        if progress.log.steps_per_second:
            for key in (run.kind, None):
                speeds.setdefault(key, []).append(progress.log.steps_per_second)
    if not count[PROBABLY]:
        del count[PROBABLY]
    speed = {key: len(values) / sum(1 / v for v in values) for key, values in speeds.items()}
    text = f"{len(runs)} runs: " + ", ".join(f"{n} {state}" for state, n in count.items())
    running = [progress for progress in progresses if progress.state in (RUNNING, PROBABLY)]
    if running and speed:
        seconds = 0
        for run, progress in zip(runs, progresses, strict=True):
            seconds += remaining(run, progress) / speed.get(run.kind, speed[None])
        now = sum(progress.log.steps_per_second for progress in running)
        left = timedelta(seconds=round(seconds / len(running)))
        text += f"; about {left} left"
        text += f", {now:,.0f} steps/s" * bool(now)  # a narrow terminal cuts the end off
    return text


def show_slowest(runs, progresses):
    """Print those of the running runs that will take longest."""
    left = []
    for run, progress in zip(runs, progresses, strict=True):
        speed = progress.log.steps_per_second
        if progress.state in (RUNNING, PROBABLY) and speed:
            shown = f"{speed}/s", str(progress.log.step), str(run.folder)
            left.append((remaining(run, progress) / speed, *shown))
    if left:
        print("slowest of those running (time left, steps per second, step):")
        slowest = sorted(left, reverse=True)[:5]
        table([(str(timedelta(seconds=round(seconds))), *shown) for seconds, *shown in slowest])


def table(rows):
    """Print rows as columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  " + "  ".join(map(str.ljust, row, widths)).rstrip())


# ------------------------------------------------------------------------- the views: exit statuses


def show_list(sweep, with_cost=False):
    """Print the runs for benchmark.sh: folder, state and command; on stderr how many there are.

    with_cost: also what they will take. A choice says it of each of its batches.
    """
    states = []
    for run in sweep.runs:
        done, damage = result(run)
        states.append("done" if done else "damaged" if damage else "todo")
        if damage:
            print(f"warning: {damage}", file=sys.stderr)
    if "todo" in states:
        check_rollouts(sweep.runs)
    for run, state in zip(sweep.runs, states, strict=True):
        folder = f"{run.folder.parent}/{run.folder.name}"  # with a slash, for --runs-dir . too
        print(folder, state, command_line(run), sep="\t")
    plan = [f"{len(sweep.runs)} runs, {states.count('todo')} to do"]
    if sweep.choices:
        from sweep import choose

        plan = choose.plan(sweep.choices, sweep.args)
    elif with_cost and "todo" in states:
        todo = [run for run, state in zip(sweep.runs, states, strict=True) if state == "todo"]
        done = [run for run, state in zip(sweep.runs, states, strict=True) if state == "done"]
        plan[0] += "; " + cost(sweep.args, done, todo)
    for line in plan:
        print(line, file=sys.stderr)
    return 0


def watch(sweep):
    """Show the summary until benchmark.sh ends: on a terminal one line that is rewritten.

    Elsewhere lines follow each other, seldom enough for the log of a sweep that takes days.
    """
    # benchmark.sh may be killed before this line: then another process is the parent already
    parent = int(os.environ.get("WATCHED", os.getppid()))
    terminal = sys.stderr.isatty()
    pause = 10 if terminal or sweep.args.preset == "demo" else 600  # seconds
    shown = -pause if terminal else time.monotonic()
    while os.getppid() == parent:
        if time.monotonic() - shown >= pause:
            shown = time.monotonic()
            line = summary(sweep.runs, [progress_of(run, over=False) for run in sweep.runs])
            if terminal:
                width = shutil.get_terminal_size().columns - 1
                line = f"\r{line[:width].ljust(width)}"
            print(line, end="" if terminal else "\n", file=sys.stderr, flush=True)
        time.sleep(1)
    return 0


def show_status(sweep):
    """Print how far a sweep is; the exit status is 1 where a run's files are damaged."""
    progresses = show_progress(sweep, "failed", over=False)
    silent = [p for p in progresses if p.state == RUNNING and p.reason]
    if silent:
        print("running, but silent:")
        table([(f"{p.state}, {p.reason}", str(p.log.path), p.log.last_line) for p in silent])
    show_slowest(sweep.runs, progresses)
    if sweep.choices:
        from sweep import choose

        print(*choose.standing(sweep.choices, sweep.args), sep="\n")
    return int(any(p.reason == "damaged" for p in progresses))


def show_stopped(sweep):
    """Print where a sweep stands that was stopped."""
    show_progress(sweep, "failed", over=True)
    return 0


def show_report(sweep):
    """Print what came out of a sweep; the exit status is 1 unless all runs are done."""
    progresses = show_progress(sweep, "not finished", over=True)
    unfinished = any(p.state != "done" for p in progresses)
    if unfinished:
        check_disk(sweep.runs[0].folder.parent / "logs")
    if sweep.choices:
        from sweep import choose

        choose.report(sweep.choices, Path(sweep.args.runs_dir, "choice.csv"))
    if any(p.state == "done" for p in progresses):
        print(f"See the curves with: tensorboard --logdir {sweep.args.runs_dir}")
        print(f"Make tables and figures with: python analyze.py --runs-dir {sweep.args.runs_dir}")
    return int(unfinished)


def show_progress(sweep, title, over):
    """Print the summary and the runs that are not on their way; return the progress of all."""
    progresses = [progress_of(run, over) for run in sweep.runs]
    print(f"{sweep.args.runs_dir}: {summary(sweep.runs, progresses)}")
    everything = title == "not finished"
    named = [p for p in progresses if p.state == "failed" or (everything and p.reason)]
    if named:
        print(f"{title}:")
        table([(p.reason, str(p.log.path), p.log.last_line) for p in named])
    return progresses


def check_disk(folder):
    """Say so if nothing can be written into a folder: then not even the logs can tell."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(100_000))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        print(f"error: cannot write to {folder}: {error.strerror}", file=sys.stderr)


VIEWS = {
    "list": show_list,
    "dry-run": partial(show_list, with_cost=True),
    "status": show_status,
    "stopped": show_stopped,
    "report": show_report,
    "watch": watch,
}


def main(view, caller, argv):
    """Print one view of the grid; returns the exit status."""
    args = parse_args(view, caller, argv)
    choices = []
    if view == "status" and args.preset in (None, "custom") and args.given <= {"--runs-dir"}:
        runs = runs_in(args.runs_dir)
    else:
        with contextlib.redirect_stdout(sys.stderr):  # what a user's module prints is no run
            check_arguments(args)
        if args.preset == "choose":
            from sweep import choose  # and with it pandas: no other preset should wait for that

            ask = view in ("list", "dry-run")
            choices = choose.choices(args, ask, keep=view == "list")
            runs = choose.planned_runs(choices)
        else:
            runs = grid(args)
    return VIEWS[view](Sweep(args, runs, choices))


if __name__ == "__main__":
    names = {"encoding": sys.getfilesystemencoding(), "errors": sys.getfilesystemencodeerrors()}
    if sys.argv[1] in ("list", "dry-run"):  # folders as they are: bash starts their runs
        sys.stdout.reconfigure(**names)
    else:
        take_over_terminal()
    try:
        sys.exit(main(sys.argv[1], sys.argv[2], sys.argv[3:]))
    except KeyboardInterrupt:
        sys.exit(130)
