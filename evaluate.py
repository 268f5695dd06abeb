"""Test trained policies again: clean and under noise, in a window, or as a video.

    python evaluate.py runs/*Hopper-v5* --noise "RandomNormalNoisyAction(0.2)" --noise-rate 0.5 1
    python evaluate.py runs/baseline_s1__Hopper-v5__sac_continuous_noisy --render
    python evaluate.py runs --video videos

Every policy plays without noise and under every noise at every rate. Episode i begins with
reset(seed = --seed + i), which also seeds the noise: all policies and conditions share their
initial states. Returns are the environment's own, before noise on the reward. They are stored in
robustness.csv in the run's folder, and what is stored there is not played again. That file has no
column for the seed: with any --seed but the default, everything is played and nothing is stored.
"""

import csv
import fcntl
import importlib
import itertools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import traceback
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import tyro
from gymnasium.wrappers import RecordVideo
from tabulate import tabulate
from tqdm import tqdm

from analysis.errors import fail
from analysis.runs import (
    ROBUSTNESS_COLUMNS,
    differing_settings,
    is_run,
    read_config,
    study_name,
)
from noisy_wrappers import (
    BASELINE,
    Configuration,
    NotFiniteError,
    canonical_env_id,
    make_noisy,
    noise_slug,
    rounded,
    seed_globals,
    seeded_globals,
    split_noises,
)

DISPLAY = "import glfw; assert glfw.init() and glfw.get_primary_monitor()"


@dataclass
class Args:
    """Command-line arguments."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """folders of finished runs, or folders that hold such folders"""
    noise: tuple[str, ...] = ()
    """noises to test under; "A(..)+B(..)" combines two"""
    noise_rate: tuple[float | str, ...] = ()
    """noise rates; every noise is tested at every rate"""
    episodes: int = 100
    """test episodes per policy and condition"""
    seed: int = 2_000_000
    """seed of the first episode; with any other, everything is played and nothing is stored"""
    jobs: int = 1
    """number of parallel processes"""
    render: bool = False
    """show one episode of each condition in a window and store nothing"""
    video: Path | None = None
    """write a video of one episode of each condition into this folder and store nothing else"""


class FinishedRun(NamedTuple):
    """A finished run, as analysis.runs.read_config reads and names it."""

    folder: Path
    algorithm: str
    environment: str
    noise: str
    noise_rate: str
    arguments: str  # the others, as JSON


def reason(error):
    """Return an exception's text as one line."""
    return " ".join(str(error).split()) or type(error).__name__


def find_runs(paths):
    """Return the runs that the paths name, each once; a folder stands for its finished runs."""
    if not paths:
        fail("name the runs to test, for example: python evaluate.py runs/*Hopper-v5*")
    folders = []
    for path in paths:
        children = sorted(filter(is_run, path.iterdir())) if path.is_dir() else []
        if children:
            finished = [child for child in children if (child / "result.json").exists()]
            if len(finished) < len(children):
                print(f"{path}: unfinished runs are left out ({len(children) - len(finished)})")
            folders += finished
        elif is_run(path):
            folders.append(path)
        elif path.name not in ("logs", "choice.csv") and not (path / "report.html").exists():
            # What is skipped is written by benchmark.sh and by analyze.py.
            fail(f"{path} is neither a run nor a folder of runs")
    if not folders:
        fail(f"there is no finished run in {', '.join(map(str, paths))}")
    return [read_finished(folder) for folder in dict.fromkeys(map(Path.absolute, folders))]


def read_finished(folder):
    """Read what a finished run's config.json says."""
    if not (folder / "result.json").exists():
        fail(f"{folder} is not finished: run the command that started it again")
    try:
        config = read_config(folder)
        return FinishedRun(folder, *(config[name] for name in FinishedRun._fields[1:]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        fail(f"cannot read {folder / 'config.json'}: {type(error).__name__}: {reason(error)}")


def read_conditions(args):
    """Return the clean condition and every noise at every rate, each once.

    That is {(noise, noise rate) as in robustness.csv: (noises, noise rates)}.
    """
    if bool(args.noise) != bool(args.noise_rate):
        fail("--noise and --noise-rate go together: every noise is tested at every rate")
    conditions = {BASELINE.columns: BASELINE.texts}
    for noise, rate in itertools.product(args.noise, args.noise_rate):
        try:
            configuration = Configuration.read(split_noises(noise), [rate])
        except ValueError as error:
            fail(error)
        if any(start != end for start, end in configuration.rates):
            fail(f"--noise-rate {rate}: policies are tested at constant rates")
        conditions.setdefault(configuration.columns, configuration.texts)  # a rate of 0 is clean
    return conditions


@contextmanager
def load(run, render_mode=None):
    """Yield a run's clean environment, closed at the end, and its policy, NumPy to NumPy."""
    name = f"{run.algorithm}_continuous_noisy".lower()
    try:
        script = importlib.import_module(name)
    except ImportError as error:
        fail(f"{run.folder}: cannot import {name}: {error}")
    try:
        canonical_env_id(run.environment)  # imports its module
    except ValueError as error:
        fail(error)
    steps = json.loads(run.arguments).get("max_episode_steps")
    drawn = {"render_mode": render_mode} if render_mode else {}  # not every class takes it
    seed_globals(Args.seed)  # as every episode does: the constructor may draw, too
    with script.make_env(run.environment, max_episode_steps=steps, **drawn) as env:
        try:
            policy = script.load_policy(run.folder, env)
        except Exception as error:  # a damaged file may raise anything
            where = run.folder / "policy.pt"
            fail(f"{where} is not a policy for {run.environment}: {reason(error)}")
        yield env, policy


def check_environment(run, conditions):
    """Exit unless the policy fits its environment and every noise can act on it."""
    with load(run) as (env, _):
        for noises, rates in conditions.values():
            try:
                make_noisy(env, noises, rates)
            except ValueError as error:
                fail(f"{run.folder}: {error}")


def play(run, noises, rates, args):
    """Play episodes; return their true returns and lengths, [(return, length), ...]."""
    with load(run) as (env, policy):
        return play_episodes(make_noisy(env, noises, rates), policy, args.episodes, args.seed)


def draw(run, noises, rates, args):
    """Play an episode in a window or into a video: (return, length), or in words why it cannot."""
    try:
        if args.video:
            return record(run, noises, rates, args)
        with load(run, "human") as (env, policy):
            [result] = play_episodes(make_noisy(env, noises, rates), policy, 1, args.seed)
            return result
    except Exception as error:  # of any library that draws, or of the environment
        place = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {reason(error)} ({place.filename}, line {place.lineno})"


def record(run, noises, rates, args):
    """Play one episode into a video; return (return, length)."""
    name = f"{run.folder.name}__{noise_slug(noises, rates) or 'clean'}.mp4"
    with tempfile.TemporaryDirectory(dir=args.video, prefix=".") as temporary:
        folder = Path(temporary, "video")  # a new one: RecordVideo warns of one that exists
        with load(run, "rgb_array") as (env, policy):
            env = make_noisy(env, noises, rates)
            video = RecordVideo(env, str(folder), episode_trigger=lambda episode: True)
            try:
                [result] = play_episodes(video, policy, 1, args.seed)
            finally:
                if video.recording:
                    video.stop_recording()
        (folder / "rl-video-episode-0.mp4").replace(args.video / name)
    return result


def play_episodes(env, policy, number, seed):
    """Play episodes; return [(true return, length), ...]."""
    results = []
    for episode in range(number):
        with seeded_globals(seed + episode):
            observation, _ = env.reset(seed=seed + episode)
            terminated = truncated = False
            while not (terminated or truncated):
                observation, _, terminated, truncated, info = env.step(policy(observation))
        record = info["episode"]  # the return is a sum of numbers or of arrays
        results.append((np.asarray(record["r"]).item(), int(record["l"])))
    return results


def play_all(play, tasks, args):
    """Yield the results of play(run, noises, rates, args) for all tasks, in their order."""
    with tqdm(tasks, unit="condition", disable=None) as bar:
        if args.jobs == 1 or args.render:
            for task in bar:
                yield play(*task, args)
            return
        context = multiprocessing.get_context("spawn")  # PyTorch does not survive a fork
        ignore = (signal.SIGINT, signal.SIG_IGN)  # at Ctrl-C they finish what they play
        with ProcessPoolExecutor(args.jobs, context, signal.signal, ignore) as pool:
            futures = [pool.submit(play, *task, args) for task in tasks]
            try:
                for _, future in zip(bar, futures, strict=True):
                    yield future.result()
            finally:
                pool.shutdown(cancel_futures=True)


def read_stored(run):
    """Read robustness.csv: {(noise, noise rate): [(return, length), ...]}."""
    path = run.folder / "robustness.csv"
    stored = {}
    try:
        for row in csv.DictReader(path.read_text().splitlines() if path.exists() else []):
            result = float(row["episodic_return"]), int(row["episodic_length"])
            stored.setdefault((row["noise"], row["noise_rate"]), []).append(result)
    except (OSError, ValueError, KeyError, TypeError) as error:
        text = f"{type(error).__name__}: {reason(error)}"
        fail(f"cannot read {path} ({text}); delete it to play everything again")
    return stored


def store(run, key, results):
    """Add a condition to robustness.csv, beside what other processes have stored meanwhile."""
    try:
        with open(run.folder / ".robustness.lock", "a") as lock:
            fcntl.lockf(lock, fcntl.LOCK_EX)  # until it is closed
            stored = read_stored(run)
            if len(stored.get(key, [])) < len(results):
                write_stored(run, stored | {key: results})
    except OSError as error:
        fail(f"cannot write {run.folder / 'robustness.csv'}: {error}", code=1)


def write_stored(run, stored):
    """Write robustness.csv, whole or not at all."""
    # not *.tmp, which the training command deletes when it is called again
    temporary = run.folder / f".robustness.{os.getpid()}"
    try:
        with open(temporary, "w") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(ROBUSTNESS_COLUMNS)
            for key, results in stored.items():
                writer.writerows([*key, i, *result] for i, result in enumerate(results))
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(run.folder / "robustness.csv")
    finally:
        temporary.unlink(missing_ok=True)


def algorithms(runs):
    """Name the runs' algorithms as analyze.py does: where settings differ, the name says which."""
    table = pd.DataFrame(runs).assign(status="finished", name="")
    for algorithm, group in table.groupby("algorithm"):
        names = [study_name(algorithm, settings) for settings in differing_settings(group)]
        table.loc[group.index, "name"] = names
    return table["name"]


def print_table(runs, conditions, stored, episodes):
    """Print mean and sample standard deviation over seeds: one table for each noise of the test."""
    trained = {}
    for run, algorithm in zip(runs, algorithms(runs), strict=True):
        config = (run.environment, algorithm, run.noise or "no noise", run.noise_rate)
        trained.setdefault(config, []).append(stored[run])
    noises = dict.fromkeys(noise for noise, _ in conditions if noise)
    for tested_with in noises or [""]:
        columns = [key for key in conditions if key[0] in ("", tested_with)]
        headers = ["environment", "algorithm", "trained with", "at rate", "seeds"]
        headers += [f"at {rate}" if noise else "clean" for noise, rate in columns]
        rows = [
            [*config, len(seeds), *(mean_return(seeds, key, episodes) for key in columns)]
            for config, seeds in trained.items()
        ]
        if tested_with:
            print(f"\nMean return, tested with {tested_with}")
        print(tabulate(rows, headers, disable_numparse=True))


def mean_return(seeds, key, episodes):
    """Spell the mean return under a condition, and its standard deviation if there are seeds."""
    means = [np.mean(seed[key][:episodes], axis=0)[0] for seed in seeds]
    if len(means) == 1:
        return rounded(means[0])
    spread = np.std(means, ddof=1)
    return f"{rounded(np.mean(means), spread)} ± {rounded(spread, spread)}"


def works(code):
    """Tell whether Python can run some code, in a process of its own, for it may crash."""
    return not subprocess.run([sys.executable, "-c", code], capture_output=True).returncode


def draw_without_display():
    """Let MuJoCo draw without a display, with the first library that works.

    dm_control reads MUJOCO_GL when it is imported, so this comes before any environment.
    """
    if os.environ.get("MUJOCO_GL") or works(DISPLAY):
        return
    for library in ("egl", "osmesa"):
        os.environ["MUJOCO_GL"] = library
        if works(f"from mujoco.{library} import GLContext; GLContext(64, 64).make_current()"):
            return
    fail(
        "--video needs a display, or a library to draw without one: on Debian or Ubuntu, "
        "apt install libegl1 libgl1, or libosmesa6"
    )


def make_folder(folder):
    """Make the folder of the videos."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        fail(f"--video: cannot write to {folder}: {error}")


def show(runs, conditions, args):
    """Play one episode of each condition in a window or into a video; store nothing else."""
    tasks = [(run, *condition) for run in runs for condition in conditions.values()]
    failures = []
    for (run, *condition), result in zip(tasks, play_all(draw, tasks, args), strict=True):
        name = f"{run.folder.name}, {noise_slug(*condition) or 'clean'}"
        if isinstance(result, str):
            failures.append(f"{name}: {result}")
            continue
        episodic_return, length = result
        print(f"{name}: return {rounded(episodic_return)}, {length} steps")
    for failure in failures:
        print(f"error: cannot draw {failure}", file=sys.stderr)
    if failures:
        raise SystemExit(1)


def main(args):
    """Check everything, play what is not stored, print the table."""
    for name, least in (("episodes", 1), ("jobs", 1), ("seed", 0)):
        if getattr(args, name) < least:
            fail(f"--{name} must be at least {least}, not {getattr(args, name)}")
    if args.render and args.video:
        fail("--render and --video exclude each other")
    if args.render and not works(DISPLAY):
        fail("--render needs a display; --video FOLDER makes videos without one")
    os.environ["OMP_NUM_THREADS"] = "1"  # before the scripts import PyTorch; processes inherit it
    sys.path.append(os.getcwd())  # my_module:MyEnv-v0 may lie in the folder this is called from
    conditions = read_conditions(args)
    runs = find_runs(args.runs)
    storing = args.seed == Args.seed
    stored = {run: read_stored(run) if storing else {} for run in runs}
    if args.video:
        if len({run.folder.name for run in runs}) < len(runs):
            fail("--video: two of these runs have the same name, and so would their videos")
        draw_without_display()
    for run in runs:
        check_environment(run, conditions)
    if args.video:
        make_folder(args.video)
    if args.video or args.render:
        show(runs, conditions, args)
        return
    if not storing:
        print(f"--seed {args.seed} is not the default: everything is played, nothing is stored")
    todo = []
    for run, key in itertools.product(runs, conditions):
        if len(stored[run].get(key, [])) < args.episodes:
            todo.append((run, key))
    tasks = [(run, *conditions[key]) for run, key in todo]
    for (run, key), results in zip(todo, play_all(play, tasks, args), strict=True):
        stored[run][key] = results
        if storing:
            store(run, key, results)
    print_table(runs, conditions, stored, args.episodes)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except KeyboardInterrupt:
        fail("stopped; what was played is stored, but nothing with another --seed", code=130)
    except NotFiniteError as error:  # from the environment
        fail(error, code=1)
