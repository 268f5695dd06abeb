"""How far a sweep has come, in six views.

benchmark.sh calls this file from the project's folder:

    python -m sweep list FOLDER PRESET ...     one run per line: folder, state, command
    python -m sweep dry-run FOLDER PRESET ...  the same, after their cost is said on stderr
    python -m sweep status FOLDER PRESET ...   a summary, the failed runs, the slowest running ones
    python -m sweep stopped FOLDER PRESET ...  a summary and the failed runs of a stopped sweep
    python -m sweep report FOLDER PRESET ...   a summary, and what did not finish: exit status 1
    python -m sweep watch FOLDER PRESET ...    the summary on one line that is rewritten

FOLDER is the one that benchmark.sh was called from: relative paths count from there.

A run is done when its folder holds result.json. Everything else is read from its log, which
benchmark.sh ends with the run's exit status: a run counts as running while its log has no such end
and is at most two minutes old. That holds on every executor, and on machines that this one cannot
see.
"""

import contextlib
import os
import re
import shutil
import sys
import time
from datetime import timedelta
from pathlib import Path
from typing import NamedTuple

from sweep.environment import cost
from sweep.grid import check_extra, check_rollouts, command_line, grid, result, runs_in
from sweep.options import check_arguments, parse_args

STOPPED = (129, 130, 138, 143)  # exit statuses of a run that was told to stop, by signal
END = re.compile(r"# .* exit=(\d+)")  # the last line of run_one in executors.sh
PROGRESS = re.compile(r"step=(\d+)/\d+ sps=(\d+)")  # the line of _show_progress in the scripts


class Log(NamedTuple):
    """What the end of a run's log says."""

    path: Path
    age: float  # seconds since the last line, infinite where there is no log
    step: int
    steps_per_second: int
    exit_status: int | None  # None while the run is not over, or where there is no log
    last_line: str


class Progress(NamedTuple):
    """How far a run has come."""

    state: str  # done, running, failed or to do
    reason: str  # why it is not done, "" where nothing is known yet
    log: Log


def read_log(run, now):
    """Read the end of a run's log."""
    path = run.folder.parent / "logs" / f"{run.folder.name}.log"
    if not path.exists():
        return Log(path, float("inf"), 0, 0, None, "")
    with open(path, "rb") as file:
        status = os.fstat(file.fileno())
        file.seek(max(0, status.st_size - 8192))
        lines = file.read().decode(errors="replace").splitlines()
    step, steps_per_second, exit_status, last_line = 0, 0, None, ""
    for line in lines:
        end, progress = END.fullmatch(line), PROGRESS.match(line)
        exit_status = int(end[1]) if end else None
        if progress:
            step, steps_per_second = int(progress[1]), int(progress[2])
        # "(" begins the notes that the scripts leave below a traceback
        if not line.startswith(("# ", "(")) and re.search(r"\w", line):
            last_line = line.strip()
    return Log(path, now - status.st_mtime, step, steps_per_second, exit_status, last_line)


def judge(run, log, fresh):
    """Return a run's progress: without an end it runs if its log is `fresh`, in seconds."""
    done, damage = result(run)
    if done:
        return Progress("done", "", log)
    if damage:
        return Progress("failed", "damaged", log._replace(last_line=damage))
    if log.exit_status in STOPPED:
        return Progress("to do", "stopped", log)
    if log.exit_status is not None and log.exit_status > 128:
        return Progress("failed", f"signal {log.exit_status - 128}", log)
    if log.exit_status is not None:
        return Progress("failed", f"exit {log.exit_status}", log)
    if log.age < fresh:
        return Progress("running", "", log)
    return Progress("to do", "lost" if log.age < float("inf") else "", log)


def look(runs, fresh):
    """Return the progress of every run."""
    now = time.time()
    return [judge(run, read_log(run, now), fresh) for run in runs]


def remaining(run, progress):
    """Return the environment steps that a run has left."""
    return 0 if progress.state == "done" else max(0, run.total_timesteps - progress.log.step)


def summary(runs, progresses):
    """Return one line: how many runs are in which state, how fast it goes, how long it takes."""
    count = {"done": 0, "running": 0, "failed": 0, "to do": 0}
    speeds = {}
    for run, progress in zip(runs, progresses, strict=True):
        count[progress.state] += 1
        if progress.log.steps_per_second:  # from the most particular to the most general
            for key in (run.kind, run.kind[0], None):
                speeds.setdefault(key, []).append(progress.log.steps_per_second)
    speed = {key: len(values) / sum(1 / v for v in values) for key, values in speeds.items()}
    text = f"{len(runs)} runs: " + ", ".join(f"{n} {state}" for state, n in count.items())
    if count["running"] and speed:
        seconds = 0
        for run, progress in zip(runs, progresses, strict=True):
            expected = speed.get(run.kind) or speed.get(run.kind[0]) or speed[None]
            seconds += remaining(run, progress) / expected
        now = sum(p.log.steps_per_second for p in progresses if p.state == "running")
        left = timedelta(seconds=round(seconds / count["running"]))
        text += f"; about {left} left, {now:,.0f} steps/s"  # a narrow terminal cuts the end off
    return text


# ---------------------------------------------------------------------------------------- the views


def show_list(args, runs):
    """Print the runs for benchmark.sh: folder, state and command; returns those in each state."""
    states = []
    of = {"done": [], "damaged": [], "todo": []}
    for run in runs:
        done, damage = result(run)
        if done:
            states.append("done")
        elif damage:
            states.append("damaged")
            print(f"warning: {damage}", file=sys.stderr)
        else:
            states.append("todo")
    if "todo" in states:
        check_rollouts(runs)
        if args.extra:
            check_extra(runs)
    for run, state in zip(runs, states, strict=True):
        folder = f"{run.folder.parent}/{run.folder.name}"  # with a slash, for --runs-dir . too
        print(folder, state, command_line(run), sep="\t")
        of[state].append(run)
    return of


def watch(runs):
    """Rewrite the summary every ten seconds, until benchmark.sh ends."""
    parent = os.getppid()
    while os.getppid() == parent:
        width = shutil.get_terminal_size().columns - 1
        line = summary(runs, look(runs, fresh=120))
        print(f"\r{line[:width].ljust(width)}", end="", file=sys.stderr, flush=True)
        time.sleep(10)


def show_slowest(runs, progresses):
    """Print those of the running runs that will take longest."""
    left = []
    for run, progress in zip(runs, progresses, strict=True):
        if progress.state == "running" and progress.log.steps_per_second:
            seconds = remaining(run, progress) / progress.log.steps_per_second
            left.append((seconds, run, progress.log))
    if not left:
        return
    left.sort(key=lambda item: item[0], reverse=True)
    print("slowest of those running (time left, steps per second, step):")
    rows = []
    for seconds, run, log in left[:5]:
        time_left = str(timedelta(seconds=round(seconds)))
        rows.append((time_left, f"{log.steps_per_second}/s", str(log.step), str(run.folder)))
    table(rows)


def table(rows):
    """Print rows as columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  " + "  ".join(map(str.ljust, row, widths)).rstrip())


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
            runs = choose.runs_of(choices)
        else:
            runs = grid(args)
    if view in ("list", "dry-run"):
        of = show_list(args, runs)
        plan = [f"{len(runs)} runs, {len(of['todo'])} to do"]
        if choices:
            plan = choose.plan(choices, args)
        elif view == "dry-run" and of["todo"]:
            plan[0] += "; " + cost(args, of["done"], of["todo"])
        for line in plan:
            print(line, file=sys.stderr)
        return 0
    if view == "watch":
        watch(runs)
        return 0
    # Where the sweep is over, nothing runs any more, however fresh a log is
    progresses = look(runs, fresh=120 if view == "status" else 0)
    over = view == "report"
    print(f"{args.runs_dir}: {summary(runs, progresses)}")
    named = [p for p in progresses if p.state == "failed" or (over and p.reason)]
    if named:
        print("not finished:" if over else "failed:")
        table([(p.reason, str(p.log.path), p.log.last_line) for p in named])
    show_slowest(runs, progresses)
    if choices and over:
        rows = choose.rows(choices)
        if rows:
            choose.write_choice(Path(args.runs_dir, "choice.csv"), rows)
        print(*choose.conclusion(choices), sep="\n")
    elif choices:
        print(*choose.standing(choices, args), sep="\n")
    if over and any(p.state == "done" for p in progresses):
        print(f"See the curves with: tensorboard --logdir {args.runs_dir}")
        print(f"Make tables and figures with: python analyze.py --runs-dir {args.runs_dir}")
    return int(over and any(p.state != "done" for p in progresses))


if __name__ == "__main__":
    if sys.argv[1:] in ([], ["-h"], ["--help"]):
        print(__doc__)
        sys.exit()
    try:
        sys.exit(main(sys.argv[1], sys.argv[2], sys.argv[3:]))
    except KeyboardInterrupt:
        sys.exit(130)
