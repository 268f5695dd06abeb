"""Test trained policies again: clean and under noise, in a window, or as a video.

    python evaluate.py runs/*Hopper-v5* --noises "RandomNormalNoisyAction(0.2)" --noise-rates 0.5 1
    python evaluate.py runs/*Hopper-v5* --noises "RandomDynamics(0.7, 0.7)" "RandomActionDelay(2)"
    python evaluate.py runs/*my_envs* --env-id my_envs:MyHeavyEnv-v0
    python evaluate.py runs/baseline_s1__Hopper-v5__sac_continuous_noisy --render
    python evaluate.py runs --video videos

Every policy plays without noise and under every noise at every rate. Episode i begins with
reset(seed = --seed + i), which also seeds the noise: all policies and conditions share their
initial states. Returns are the environment's own, before noise on the reward. They are stored in
robustness.csv in the run's folder, and what is stored there is not played again. That file has no
column for the seed: with any --seed but the default, everything is played and nothing is stored.

The module of an environment or of a noise, as in my_envs:MyEnv-v0, is imported from your own path,
never from a folder of runs. Runs that cannot be tested are listed; the exit status is 1 then.
"""

import csv
import fcntl
import importlib
import itertools
import math
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from importlib.machinery import PathFinder
from pathlib import Path

import numpy as np
import tyro
from gymnasium.wrappers import RecordVideo
from tabulate import tabulate
from tqdm import tqdm

from analysis.errors import fail, in_words, take_over_terminal, with_place
from analysis.folders import (
    PHASES,
    DamageError,
    difference,
    has_begun,
    is_run,
    read_config,
    read_result,
    runs_of,
)
from analysis.formatting import slug
from analysis.runs import (
    ROBUSTNESS_COLUMNS,
    script_name,
    study_name,
    usual_settings,
    where_tested,
)
from noisy_wrappers import (
    BASELINE,
    Configuration,
    NotFiniteError,
    SpaceError,
    canonical_env_id,
    module_path,
    outcome,
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
    noises: tuple[str, ...] = ()
    """noises to test under; "A(..)+B(..)" combines two"""
    noise_rates: tuple[float | str, ...] = (1.0,)
    """noise rates; every noise is tested at every rate"""
    env_id: str | None = None
    """another environment to test in, with the same spaces; by default that of the training"""
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


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A finished run, as analysis.folders.read_config reads it."""

    folder: Path
    algorithm: str
    exp_name: str
    environment: str
    configuration: Configuration
    settings: dict  # the other arguments
    elsewhere: str = ""  # another environment to be tested in

    @property
    def tested_in(self):
        """The environment that the policy plays in."""
        return self.elsewhere or self.environment


class UnusableError(Exception):
    """A run cannot be tested; the text says why."""


def find_runs(paths):
    """Return the finished runs that the paths name, each once; a folder stands for its runs.

    Also return {run folder: what is damaged in it}, and print how many runs are not finished.
    """
    if not paths:
        fail("name the runs to test, for example: python evaluate.py runs/*Hopper-v5*")
    folders = {}
    for path in map(Path.expanduser, paths):
        found = [path] if is_run(path) else runs_of(path)
        if not os.path.lexists(path) or (len(paths) == 1 and not found):
            fail(f"{path} is neither a run nor a folder of runs")
        folders |= dict.fromkeys(map(Path.absolute, found))
    runs, damaged = [], {}
    for folder in folders:
        try:
            config = read_config(folder) if has_begun(folder) else None
            if config and read_result(folder, config):
                names = [field.name for field in fields(FinishedRun)][1:-1]
                runs.append(FinishedRun(folder, *(config[name] for name in names)))
        except DamageError as error:
            damaged[folder] = str(error)
    unfinished = len(folders) - len(runs) - len(damaged)
    if unfinished:
        print(f"unfinished runs are left out: {unfinished}")
    return runs, damaged


def read_conditions(args):
    """Return the configurations to test under: without noise, and every noise at every rate."""
    conditions = {BASELINE: None}  # a dictionary keeps each once, in order; a rate of 0 is clean
    for noise, rate in itertools.product(args.noises, args.noise_rates):
        try:
            configuration = Configuration.read(split_noises(noise), [rate])
        except ValueError as error:
            fail(error)
        if any(start != end for start, end in configuration.rates):
            fail(f"--noise-rates {rate}: policies are tested at constant rates")
        conditions[configuration] = None
    return list(conditions)


@contextmanager
def load(run, render_mode=None):
    """Yield a run's clean environment, closed at the end, and its policy, NumPy to NumPy.

    Raises UnusableError.
    """
    script = importlib.import_module(script_name(run.algorithm))
    for environment in dict.fromkeys([run.environment, run.tested_in]):
        refuse_foreign_module(run, environment)
        try:
            canonical_env_id(environment)  # imports its module
        except ValueError as error:
            raise UnusableError(error) from None
    steps = run.settings.get("max_episode_steps")
    drawn = {"render_mode": render_mode} if render_mode else {}  # not every class takes it
    seed_globals(Args.seed)  # as every episode does: the constructor may draw, too
    with script.make_env(run.tested_in, max_episode_steps=steps, **drawn) as env:
        if run.elsewhere:
            with script.make_env(run.environment, max_episode_steps=steps) as trained_in:
                check_spaces(run, trained_in, env)
        try:
            policy = script.load_policy(run.folder, env)
        except Exception as error:  # a damaged file may raise anything
            reason = f"policy.pt is not a policy for {run.tested_in}: {in_words(error)}"
            raise UnusableError(reason) from None
        yield env, policy


def check_spaces(run, trained_in, env):
    """Raise UnusableError unless both environments have the same spaces."""
    for name in ("observation_space", "action_space"):
        here, there = getattr(trained_in, name), getattr(env, name)
        if here != there:
            raise UnusableError(
                f"--env-id {run.elsewhere}: its {name} is {there}, that of {run.environment} is "
                f"{here}; a policy needs the same"
            )


def folders_of_runs(run):
    """Return a run's own folder, and the one of all runs beside it."""
    folder = run.folder.resolve()
    runs_dir = folder.parent
    return folder, runs_dir.parent if runs_dir.name in PHASES else runs_dir


def refuse_foreign_module(run, name):
    """Raise UnusableError if an environment or a noise would be imported from a folder of runs.

    Whoever made a folder of runs that somebody downloads chose its modules and their names, too.
    """
    module, colon, _ = name.partition("(")[0].rpartition(":")
    first, *rest = module.strip().split(".")
    here, project = Path.cwd(), Path(__file__).resolve().parent
    spec = PathFinder.find_spec(first, module_path()) if colon else None  # executes nothing
    folder, runs_dir = folders_of_runs(run)
    for found in (spec.submodule_search_locations or [spec.origin]) if spec else ():
        entry = Path(found).parent.resolve()
        top = Path(found).resolve()
        place = Path(top, *rest).resolve()
        # the project's folder may hold the runs, and packages that are on the module path
        is_own = entry.is_relative_to(runs_dir) and (entry != here or entry == project)
        beside = place.is_relative_to(runs_dir) and not is_own
        if beside or place.is_relative_to(folder) or folder.is_relative_to(top):
            raise UnusableError(
                f"{name} would be imported from {place}, in a folder of runs; "
                "if you trust that module, move it to where your own ones are"
            )


def check_runs(runs, conditions, bad, storing):
    """Return {run: what is stored of it} of the runs that can be tested.

    Add the others to `bad`, {run folder: why}.

    The policy must fit its environment, and every noise must be able to act on it.
    """
    stored = {}
    for run in runs:
        try:
            with load(run) as (env, _):
                for condition in conditions:
                    condition.wrap(env)
            stored[run] = read_stored(run) if storing else {}
        except (UnusableError, ValueError) as error:
            bad[run.folder] = str(error)
        except Exception as error:  # of the user's environment
            bad[run.folder] = with_place(error)
    return stored


def tell(bad):
    """Print each reason why runs cannot be tested, with the first of them; bad: see check_runs."""
    folders = {}
    for folder, reason in bad.items():
        folders.setdefault(reason, []).append(folder)
    for reason, (first, *others) in folders.items():
        more = f" and {len(others)} more" if others else ""
        print(f"error: {first}{more}: {reason}", file=sys.stderr)


def play(run, condition, args):
    """Play episodes; return what play_episodes does."""
    with load(run) as (env, policy):
        return play_episodes(condition.wrap(env), policy, args.episodes, args.seed)


def draw(run, condition, args):
    """Play an episode in a window or into a video: its result, or in words why it cannot."""
    try:
        if args.video:
            return record(run, condition, args)
        with load(run, "human") as (env, policy):
            [result] = play_episodes(condition.wrap(env), policy, 1, args.seed)
            return result
    except Exception as error:  # of any library that draws, or of the environment
        return with_place(error)


def record(run, condition, args):
    """Play one episode into a video; return its result."""
    place = f"__{slug(run.elsewhere)}" if run.elsewhere else ""
    name = f"{run.folder.name}__{condition.slug or 'clean'}{place}.mp4"
    with tempfile.TemporaryDirectory(dir=args.video, prefix=".") as temporary:
        folder = Path(temporary, "video")  # a new one: RecordVideo warns of one that exists
        with load(run, "rgb_array") as (env, policy):
            video = RecordVideo(
                condition.wrap(env), str(folder), episode_trigger=lambda episode: True
            )
            try:
                [result] = play_episodes(video, policy, 1, args.seed)
            finally:
                if video.recording:
                    video.stop_recording()
        (folder / "rl-video-episode-0.mp4").replace(args.video / name)
    return result


def play_episodes(env, policy, number, seed):
    """Play episodes; return [(true return, length), ...].

    Where the environment tells success, 1 or 0 follows.
    """
    results = []
    for episode in range(number):
        with seeded_globals(seed + episode):
            observation, _ = env.reset(seed=seed + episode)
            terminated = truncated = False
            while not (terminated or truncated):
                observation, _, terminated, truncated, info = env.step(policy(observation))
        record = info["episode"]  # the return is a sum of numbers or of arrays
        success = outcome(info)
        told = () if math.isnan(success) else (int(success),)
        results.append((np.asarray(record["r"]).item(), int(record["l"]), *told))
    return results


def play_all(play, tasks, args):
    """Yield the results of play(run, condition, args) for all tasks, in their order."""
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
    """Read robustness.csv: {(noise, noise rate, environment): what play_episodes returns}.

    The environment is empty for that of the training. Raises UnusableError.
    """
    path = run.folder / "robustness.csv"
    stored = {}
    try:
        text = path.read_text("utf-8") if path.exists() else ""
        for row in csv.DictReader(text.splitlines()):
            told = (int(row["success"]),) if row.get("success") else ()
            result = (float(row["episodic_return"]), int(row["episodic_length"]), *told)
            key = row["noise"], row["noise_rate"], row.get("environment") or ""
            stored.setdefault(key, []).append(result)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, csv.Error) as error:
        text = f"robustness.csv: {in_words(error)}; delete that file to play everything again"
        raise UnusableError(text) from None
    return stored


def store(run, key, results):
    """Add a condition to robustness.csv, beside what other processes have stored meanwhile."""
    try:
        with open(run.folder / ".robustness.lock", "a", encoding="utf-8") as lock:
            fcntl.lockf(lock, fcntl.LOCK_EX)  # until it is closed
            stored = read_stored(run)
            if len(stored.get(key, [])) < len(results):
                write_stored(run, stored | {key: results})
    except (OSError, UnusableError) as error:
        fail(f"cannot write {run.folder / 'robustness.csv'}: {error}", code=1)


def write_stored(run, stored):
    """Write robustness.csv, whole or not at all."""
    # not *.tmp, which the training command deletes when it is called again
    temporary = run.folder / f".robustness.{os.getpid()}"
    try:
        with open(temporary, "w", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            told = any(len(result) > 2 for results in stored.values() for result in results)
            elsewhere = any(environment for _, _, environment in stored)
            columns = [*ROBUSTNESS_COLUMNS, *["success"] * told, *["environment"] * elsewhere]
            writer.writerow(columns)
            for (*condition, environment), results in stored.items():
                for i, result in enumerate(results):
                    row = [*condition, i, *result, *[""] * (told and len(result) == 2)]
                    writer.writerow([*row, *[environment] * elsewhere])
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(run.folder / "robustness.csv")
    finally:
        temporary.unlink(missing_ok=True)


def names_of(runs):
    """Name each run's study as analyze.py does, and in which arguments the run differs from it."""
    studies = {}
    for run in runs:
        studies.setdefault((run.algorithm, run.exp_name), []).append(run.settings)
    usual = {key: usual_settings(settings) for key, settings in studies.items()}
    for run in runs:
        key = run.algorithm, run.exp_name
        own = [f"{name}={run.settings[name]}" for name in difference(run.settings, usual[key])]
        yield ", ".join([study_name(*key), *own])


def print_table(runs, conditions, stored, episodes):
    """Print mean and sample standard deviation over seeds: one table for each noise of the test."""
    keys, trained = [condition.columns for condition in conditions], {}
    for run, name in zip(runs, names_of(runs), strict=True):
        noise = run.configuration.noise or "no noise"
        where = where_tested(run.environment, run.elsewhere)
        config = (where, name, noise, run.configuration.noise_rate)
        at_hand = {key[:2]: value for key, value in stored[run].items() if key[2] == run.elsewhere}
        trained.setdefault(config, []).append(at_hand)
    noises = dict.fromkeys(noise for noise, _ in keys if noise)
    for tested_with in noises or [""]:
        columns = [key for key in keys if key[0] in ("", tested_with)]
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
    """Return the text of a cell: the mean return, its standard deviation, the rate of success."""
    played = [seed[key][:episodes] for seed in seeds]
    means = [np.mean([result[0] for result in results]) for results in played]
    solved = ""
    if any(len(result) > 2 for results in played for result in results):
        rates = [np.mean([result[2:] == (1,) for result in results]) for results in played]
        solved = f", {100 * np.mean(rates):.0f} % solved"
    if len(means) == 1:
        return rounded(means[0]) + solved
    spread = np.std(means, ddof=1)
    return f"{rounded(np.mean(means), spread)} ± {rounded(spread, spread)}{solved}"


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


def show(runs, conditions, args):
    """Play an episode of each condition in a window or into a video; return whether one failed."""
    tasks = list(itertools.product(runs, conditions))
    failures = []
    for (run, condition), result in zip(tasks, play_all(draw, tasks, args), strict=True):
        name = f"{run.folder.name}, {condition.slug or 'clean'}"
        if isinstance(result, str):
            failures.append(f"{name}: {result}")
            continue
        episodic_return, length, *_ = result
        print(f"{name}: return {rounded(episodic_return)}, {length} steps")
    for failure in failures:
        print(f"error: cannot draw {failure}", file=sys.stderr)
    return bool(failures)


def main(args):
    """Check everything, play what is not stored, print the table; return the exit status."""
    for name, least in (("episodes", 1), ("jobs", 1), ("seed", 0)):
        if getattr(args, name) < least:
            fail(f"--{name} must be at least {least}, not {getattr(args, name)}")
    if args.render and args.video:
        fail("--render and --video exclude each other")
    if args.render and not works(DISPLAY):
        fail("--render needs a display; --video FOLDER makes videos without one")
    os.environ["OMP_NUM_THREADS"] = "1"  # before the scripts import PyTorch; processes inherit it
    runs, bad = find_runs(args.runs)
    named = [name for text in args.noises for name in split_noises(text)]
    try:
        for run, name in itertools.product(runs, [*named, args.env_id or ""]):
            refuse_foreign_module(run, name)
    except UnusableError as error:
        fail(error)
    conditions = read_conditions(args)
    here = Path.cwd()  # for what the module of my_envs:MyEnv-v0 imports
    if not any(here.is_relative_to(runs_dir) for run in runs for runs_dir in folders_of_runs(run)):
        sys.path.append(str(here))
    storing = args.seed == Args.seed
    if args.video:
        args.video = args.video.expanduser()
        if len({run.folder.name for run in runs}) < len(runs):
            fail("--video: two of these runs have the same name, and so would their videos")
        draw_without_display()
    if args.env_id:
        try:
            env_id = canonical_env_id(args.env_id)
        except ValueError as error:
            fail(f"--env-id: {error}")
        runs = [replace(run, elsewhere=env_id * (env_id != run.environment)) for run in runs]
    stored = check_runs(runs, conditions, bad, storing)
    runs = list(stored)
    tell(bad)
    if not runs and bad:
        return 2
    if not runs:
        fail(f"there is no finished run in {', '.join(map(str, args.runs))}")
    if args.video:
        try:
            args.video.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=args.video).close()
        except OSError as error:
            fail(f"--video: cannot write to {args.video}: {error}")
    if args.video or args.render:
        return show(runs, conditions, args) or bool(bad)
    if not storing:
        print(f"--seed {args.seed} is not the default: everything is played, nothing is stored")
    tasks = [
        (run, condition)
        for run, condition in itertools.product(runs, conditions)
        if len(stored[run].get((*condition.columns, run.elsewhere), [])) < args.episodes
    ]
    for (run, condition), results in zip(tasks, play_all(play, tasks, args), strict=True):
        key = *condition.columns, run.elsewhere
        stored[run][key] = results
        if storing:
            store(run, key, results)
    print_table(runs, conditions, stored, args.episodes)
    return bool(bad)


if __name__ == "__main__":
    take_over_terminal()
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except KeyboardInterrupt:
        fail("stopped; what was played is stored, but nothing with another --seed", code=130)
    except (NotFiniteError, SpaceError) as error:  # from the environment
        fail(error, code=1)
