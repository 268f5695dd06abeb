"""The runs of a sweep: which there are, the command of each, and how far they have come.

benchmark.sh is the way in; `./benchmark.sh --help` explains the arguments. What it calls:

    python grid.py list PRESET ...     one run per line: folder, "done" or "todo", command
    python grid.py status PRESET ...   a summary, the failed runs, the slowest of those running
    python grid.py stopped PRESET ...  a summary and the failed runs, when the sweep was stopped
    python grid.py report PRESET ...   a summary and what did not finish, then exit status 1
    python grid.py watch PRESET ...    the summary as one line that is rewritten, on a terminal

A run is done when its folder holds result.json. Everything else is read from its log, which
benchmark.sh ends with the run's exit status: it is running while its log has no such end and is
at most two minutes old. That holds on every executor, on machines this one cannot see.
"""

import argparse
import csv
import functools
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from datetime import timedelta
from pathlib import Path
from typing import NamedTuple

import gymnasium

from noisy_wrappers import canonical_noises, run_name

SEEDS = {"sac": range(1, 6), "td3": range(1, 6), "ppo": range(1, 11)}  # the paper's
ENVS = ["HalfCheetah-v5", "Hopper-v5", "Humanoid-v5", "Pusher-v5", "Walker2d-v5"]
RATES = [0.01, 0.05, 0.1, 0.2, 0.5, 1.0]
NOISES = [  # as the paper's authors ran them: dropout keeps 90 %, mixup remembers the mixture
    "RandomDropoutObservation(0.9)",
    "RandomEarlyTermination(1, 100)",
    "RandomEarlyTermination(50)",
    "RandomMixupObservation(0.0, recursive=True)",
    "RandomMixupObservation(0.5, recursive=True)",
    "RandomNormalNoisyObservation(0.001)",
    "RandomNormalNoisyObservation(1.0)",
    "RandomNormalNoisyReward(0.001)",
    "RandomNormalNoisyReward(1.0)",
    "RandomUniformNoisyObservation(-0.001, 0.001)",
    "RandomUniformNoisyReward(-0.001, 0.001)",
    "RandomUniformScaleObservation(0.5, 1.5)",
    "RandomUniformScaleObservation(0.8, 1.2)",
    "RandomUniformScaleReward(0.5, 1.5)",
    "RandomUniformScaleReward(0.8, 1.2)",
]
# The paper shows bars for several beta and names none of them: these are ours.
ABLATION = [(f"RandomUniformScaleReward({2 - b:.1f}, {b})", 0.05) for b in (1.1, 1.2, 1.5, 1.8, 2)]
ABLATION += [
    (f"RandomUniformNoisyObservation(-{b}, {b})", 1.0) for b in (0.0001, 0.001, 0.01, 0.1, 1.0)
]
PRESETS = {  # the grid options that a preset sets; its noises are in preset_pairs
    "demo": {
        "algos": ["ppo"],
        "envs": ["Hopper-v5"],
        "seeds": [[1]],
        "total_timesteps": 100_000,
        "runs_dir": "runs/demo",  # never into a sweep's folders: these runs are shorter
    },
    "baseline": {},
    "best": {},
    "paper": {},
    "ablation": {"algos": ["ppo"]},
    "custom": {},
}
OURS = ["env-id", "seed", "noise", "noise-rate", "total-timesteps", "runs-dir", "exp-name"]
STOPPED = (129, 130, 138, 143)  # exit statuses of a run that was told to stop, by signal
END = re.compile(r"# .* exit=(\d+)")
PROGRESS = re.compile(r"step=(\d+)/\d+ sps=(\d+)")


class Run(NamedTuple):
    """One line of the grid."""

    folder: Path
    kind: tuple[str, str]  # algorithm, environment: runs of one kind are equally fast
    total_timesteps: int
    command: list[str]


class Progress(NamedTuple):
    """How far a run has come."""

    state: str  # done, running, failed or to do
    step: int
    sps: float
    reason: str  # why it is not done, "" where nothing is known yet
    last_line: str
    log: Path


def parse_args(argv):
    """Return the grid's arguments; `extra` are the scripts' own, after "--"."""
    split = argv.index("--") if "--" in argv else len(argv)
    parser = argparse.ArgumentParser(prog="benchmark.sh", add_help=False, allow_abbrev=False)
    parser.error = fail
    parser.add_argument("view", choices=["list", "status", "stopped", "report", "watch"])
    parser.add_argument("preset")
    parser.add_argument("--algos", nargs="+", type=str.lower, default=list(SEEDS))
    parser.add_argument("--envs", nargs="+", default=ENVS)
    parser.add_argument("--noises", nargs="+", default=[])
    parser.add_argument("--noise-rates", nargs="+", type=float, default=[])
    parser.add_argument("--seeds", nargs="+", type=seeds)
    parser.add_argument("--total-timesteps", type=int, default=1_000_000)
    parser.add_argument("--runs-dir", default="runs")
    preset = argv[1] if len(argv) > 1 else ""
    if preset and preset not in PRESETS:
        fail(f"unknown preset {preset!r}; choose one of {', '.join(PRESETS)}")
    parser.set_defaults(**PRESETS.get(preset, {}))
    args = parser.parse_args(argv[:split])
    args.extra = argv[split + 1 :]
    return args


def seeds(text):
    """Read a seed, "3", or a range of seeds, "1-5"."""
    match = re.fullmatch(r"(\d+)(?:-(\d+))?", text)
    values = match and range(int(match[1]), int(match[2] or match[1]) + 1)
    if not values:
        raise argparse.ArgumentTypeError(f"{text!r} is no seed, as 3, and no range, as 1-5")
    return values


def check(args):
    """Exit with one line about the first argument that no run could be started with."""
    if unknown := [algorithm for algorithm in args.algos if algorithm not in SEEDS]:
        fail(f"unknown algorithm {unknown[0]!r}; choose from {', '.join(SEEDS)}")
    if args.total_timesteps <= 0:
        fail(f"--total-timesteps must be greater than 0, not {args.total_timesteps}")
    for env_id in (e for e in args.envs if ":" not in e):  # "module:id" registers on import
        try:
            gymnasium.spec(env_id)
        except gymnasium.error.Error as error:
            fail(f"--envs {env_id}: {error}")
    if args.preset == "custom" and bool(args.noises) != bool(args.noise_rates):
        fail("custom needs --noises and --noise-rates, or neither of them for the baselines only")
    if {"-h", "--help"} & set(args.extra):
        fail("--help after the -- would start nothing: ask the script itself")
    for word in (word for word in args.extra if word.startswith("--")):
        name = word.partition("=")[0].removeprefix("--").replace("_", "-")
        if name in OURS:
            fail(f"--{name} is part of the grid: it has an option of its own, before the --")
        if name == "overwrite":
            fail("--overwrite would start interrupted runs afresh: delete their folders instead")
    if not re.fullmatch(r"[^-\t\n][^\t\n]*", args.runs_dir):
        fail("--runs-dir must be a path without tabs and newlines that begins with no dash")


def preset_pairs(preset, algorithm, env_id):
    """Return a preset's (noise, rate) pairs for one algorithm and environment."""
    if preset == "demo":
        return [("RandomNormalNoisyReward(1.0)", 1.0)]  # the paper's best for PPO on Hopper
    if preset == "paper":
        return list(itertools.product(NOISES, RATES))
    if preset == "ablation":
        return ABLATION
    if preset == "best":
        pair = best_pairs().get((algorithm, env_id.rpartition("-v")[0]))
        return [pair] if pair else fail(f"the paper has no best noise for {algorithm} on {env_id}")
    return []


@functools.cache
def best_pairs():
    """Return the paper's best noise and rate for each algorithm and environment."""
    with open(Path(__file__).parent / "results" / "paper" / "best.csv", newline="") as file:
        return {
            (row["algorithm"].lower(), row["environment"].rpartition("-v")[0]): (
                row["noise_as_run"],
                float(row["noise_rate"]),
            )
            for row in csv.DictReader(file)
        }


@functools.cache
def canonical(noise, rate):
    """Return the canonical noises and rates of one cell, whose noises may be joined by "+"."""
    try:
        return canonical_noises(re.split(r"(?<=\))\s*\+\s*", noise), [rate])
    except ValueError as error:
        fail(error)


def cells(args, algorithm, env_id):
    """Yield the noises and rates to run, the baseline first."""
    yield [], []
    pairs = preset_pairs(args.preset, algorithm, env_id)
    if args.noises or args.noise_rates:
        noises = args.noises or dict.fromkeys(noise for noise, _ in pairs)
        rates = args.noise_rates or dict.fromkeys(rate for _, rate in pairs)
        pairs = itertools.product(noises, rates)
    for noise, rate in pairs:
        yield canonical(noise, rate)


def grid(args):
    """Return the runs, each once, the first seed of everything first."""
    python, runs = os.environ.get("PYTHON", "python"), {}
    of = {a: sorted(set(itertools.chain(*(args.seeds or [SEEDS[a]])))) for a in args.algos}
    for seed in sorted(set().union(*of.values())):
        algorithms = [algorithm for algorithm in of if seed in of[algorithm]]
        for algorithm, env_id in itertools.product(algorithms, dict.fromkeys(args.envs)):
            script = f"{algorithm}_continuous_noisy"
            for noises, rates in cells(args, algorithm, env_id):
                name = run_name(env_id, script, noises, rates, seed)
                if name in runs:
                    continue
                noise = ["--noise", *noises, "--noise-rate", *map(str, rates)] if noises else []
                command = [python, f"{script}.py", "--env-id", env_id, "--seed", str(seed), *noise]
                command += ["--total-timesteps", str(args.total_timesteps)]
                command += ["--runs-dir", args.runs_dir, *args.extra]
                folder = Path(args.runs_dir) / name
                runs[name] = Run(folder, (algorithm, env_id), args.total_timesteps, command)
    return list(runs.values()) or fail("the grid is empty")


def check_extra(runs):
    """Let each script read one command: a typing error is not worth 9,100 failed runs."""
    read = "import tyro; from {} import Args; tyro.cli(Args)"
    for command in {run.command[1]: run.command for run in runs}.values():
        python, script, *args = command
        code = read.format(script.removesuffix(".py"))
        if subprocess.run([python, "-c", code, *args], stdout=subprocess.DEVNULL).returncode:
            fail(f"{script} does not accept the arguments after --, or cannot be imported")


def is_done(run):
    """Tell whether a run is finished; exit if its folder holds a run of another length."""
    path = run.folder / "result.json"
    if not path.exists():
        return False
    try:
        steps = json.loads(path.read_text())["total_timesteps"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        fail(f"cannot read {path} ({type(error).__name__}: {error}); delete the run's folder")
    if steps != run.total_timesteps:
        fail(f"{run.folder} holds a finished run of {steps} steps; choose another --runs-dir")
    return True


def look(run, now, fresh):
    """Return a run's progress, from its folder and a log that is `fresh` for so many seconds."""
    log, age, lines = run.folder.parent / "logs" / f"{run.folder.name}.log", float("inf"), []
    done = is_done(run)
    if log.exists():
        with open(log, "rb") as file:
            stat = os.fstat(file.fileno())
            age = now - stat.st_mtime
            file.seek(max(0, stat.st_size - 8192))
            lines = file.read().decode(errors="replace").splitlines()
    end = END.fullmatch(lines[-1]) if lines else None
    found = [match for match in map(PROGRESS.match, lines) if match]
    step, sps = map(int, found[-1].groups()) if found else (0, 0)
    told = [line for line in lines if not line.startswith("# ") and re.search(r"\w", line)]
    if done:
        state, reason = "done", ""
    elif end:
        status = int(end[1])
        state, reason = ("to do", "stopped") if status in STOPPED else ("failed", f"exit {status}")
        reason = f"signal {status - 128}" if state == "failed" and status > 128 else reason
    else:
        state, reason = ("running", "") if age < fresh else ("to do", "lost" if lines else "")
    return Progress(state, step, sps, reason, told[-1].strip() if told else "", log)


def remaining(run, progress):
    """Return the environment steps that a run has left."""
    return 0 if progress.state == "done" else max(0, run.total_timesteps - progress.step)


def summary(runs, progresses):
    """Return one line: how many runs are in which state, how fast it goes, how long it takes."""
    count = {state: 0 for state in ("done", "running", "failed", "to do")}
    speeds = {}
    for run, progress in zip(runs, progresses, strict=True):
        count[progress.state] += 1
        if progress.sps:  # from the most particular to the most general
            for key in (run.kind, run.kind[0], None):
                speeds.setdefault(key, []).append(progress.sps)
    speed = {key: len(values) / sum(1 / v for v in values) for key, values in speeds.items()}
    text = f"{len(runs)} runs: " + ", ".join(f"{n} {state}" for state, n in count.items())
    if count["running"] and speed:
        seconds = sum(
            remaining(run, p) / (speed.get(run.kind) or speed.get(run.kind[0]) or speed[None])
            for run, p in zip(runs, progresses, strict=True)
        )
        now = sum(p.sps for p in progresses if p.state == "running")
        left = timedelta(seconds=round(seconds / count["running"]))
        text += f"; {now:,.0f} steps/s now, about {left} left"
    return text


def table(rows):
    """Print rows as columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  " + "  ".join(map(str.ljust, row, widths)).rstrip())


def main(argv):
    """Print one view of the grid; returns the exit status."""
    args = parse_args(argv)
    check(args)
    runs = grid(args)
    if args.view == "list":
        done = [is_done(run) for run in runs]
        if args.extra and not all(done):
            check_extra(runs)
        for run, over in zip(runs, done, strict=True):
            folder = f"{run.folder.parent}/{run.folder.name}"  # with a slash, for --runs-dir . too
            print(folder, "done" if over else "todo", shlex.join(run.command), sep="\t")
        return 0
    parent = os.getppid()
    while args.view == "watch":
        width, now = shutil.get_terminal_size().columns - 1, time.time()
        line = summary(runs, [look(run, now, fresh=120) for run in runs])
        print(f"\r{line[:width].ljust(width)}", end="", file=sys.stderr, flush=True)
        time.sleep(10)
        if os.getppid() != parent:  # benchmark.sh was killed
            return 0

    fresh = 120 if args.view == "status" else 0  # nothing runs any more, however fresh its log is
    progresses = [look(run, time.time(), fresh) for run in runs]
    print(f"{args.runs_dir}: {summary(runs, progresses)}")
    over = args.view == "report"
    named = [p for p in progresses if p.state == "failed" or (over and p.reason)]
    if named:
        print("not finished:" if over else "failed:")
        table([(p.reason, str(p.log), p.last_line) for p in named])
    left = [
        (remaining(run, p) / p.sps, run, p)
        for run, p in zip(runs, progresses, strict=True)
        if p.state == "running" and p.sps
    ]
    if left:
        print("slowest of those running (time left, steps per second, step):")
        left = sorted(left, key=lambda item: item[0], reverse=True)[:5]
        table(
            [
                (str(timedelta(seconds=round(seconds))), f"{p.sps}/s", f"{p.step}", str(run.folder))
                for seconds, run, p in left
            ]
        )
    return int(over and any(p.state != "done" for p in progresses))


def fail(message):
    """Exit with one line."""
    print(f"error: {' '.join(str(message).split())}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
