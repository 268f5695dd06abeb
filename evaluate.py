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
never from a folder of runs. Runs that cannot be tested are listed; the exit status is 1 then, and
2 if there are no others.
"""

import csv
import importlib
import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import threading
import warnings
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.machinery import PathFinder
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import tyro
from gymnasium.wrappers import RecordVideo
from tabulate import tabulate
from tqdm import tqdm

import noisy_wrappers as noisy
from analysis import folders
from analysis.errors import fail, in_words, take_over_terminal, with_place
from analysis.folders import PHASES, DamageError
from analysis.formatting import rounded, slug
from analysis.runs import ROBUSTNESS_COLUMNS, script_name, study_name, usual_settings, where_tested
from analysis.statistics import mean_std

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

    @property
    def drawing(self):
        """How episodes are drawn, a mode of Gymnasium, or None."""
        return "human" if self.render else "rgb_array" if self.video else None

    @property
    def storing(self):
        """Whether episodes are stored: robustness.csv has no column for the seed."""
        return self.seed == Args.seed and not self.drawing


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A finished run: what its config.json says of it."""

    folder: Path
    algorithm: str
    exp_name: str
    environment: str
    configuration: noisy.Configuration
    settings: dict  # the other arguments
    elsewhere: str = ""  # another environment to be tested in

    @property
    def tested_in(self):
        """The environment that the policy plays in."""
        return self.elsewhere or self.environment

    @property
    def study(self):
        """What its study's name is made of: the algorithm, the exp_name, the phase of a choice."""
        phase = self.folder.resolve().parent.name
        return self.algorithm, self.exp_name, phase if phase in PHASES else ""

    @property
    def runs_dir(self):
        """The folder of all runs beside it, in both phases of a choice."""
        folder = self.folder.resolve().parent
        return folder.parent if folder.name in PHASES else folder

    def key(self, condition):
        """Return what names a condition in robustness.csv: see read_stored."""
        return *condition.columns, self.elsewhere


def find_runs(paths):
    """Return the finished runs that the paths name, each once; a folder stands for its runs.

    Also return {run folder: what is damaged in it}, and print how many runs are not finished.
    """
    if not paths:
        fail("name the runs to test, for example: python evaluate.py runs/*Hopper-v5*")
    named = {}
    for path in map(Path, map(os.path.expanduser, paths)):
        found = [path] if folders.is_run(path) else folders.runs_of(path)
        if not os.path.lexists(path) or (len(paths) == 1 and not found):
            fail(f"{path} is neither a run nor a folder of runs")
        for folder in found:
            named.setdefault(folder.resolve(), folder.absolute())
    runs, damaged = [], {}
    for folder in named.values():
        try:
            config = folders.read_config(folder) if folders.has_begun(folder) else None
            if config and folders.read_result(folder, config):
                names = "algorithm", "exp_name", "environment", "configuration", "settings"
                runs.append(FinishedRun(folder, *(config[name] for name in names)))
        except DamageError as error:
            damaged[folder] = str(error)
    unfinished = len(named) - len(runs) - len(damaged)
    if unfinished:
        print(f"unfinished runs are left out: {unfinished}")
    return runs, damaged


def read_conditions(args):
    """Return the configurations to test under: without noise, and every noise at every rate.

    Raises ValueError.
    """
    if not args.noises and args.noise_rates != Args.noise_rates:
        raise ValueError("--noise-rates without --noises: name a noise, or leave the rates out")
    conditions = [noisy.BASELINE]
    for noise, rate in itertools.product(args.noises, args.noise_rates):
        configuration = noisy.Configuration.read(noisy.split_noises(noise), [rate])
        if any(start != end for start, end in configuration.rates):
            raise ValueError(f"--noise-rates {rate}: policies are tested at constant rates")
        conditions.append(configuration)
    return list(dict.fromkeys(conditions))  # each once, in order; a rate of 0 is clean


@contextmanager
def load(run, render_mode=None):
    """Yield a run's clean environment, closed at the end, and its policy, NumPy to NumPy.

    Raises ValueError if a run cannot be tested, besides what its environment raises.
    """
    script = importlib.import_module(script_name(run.algorithm))

    def make_env(env_id, **kwargs):
        """Make a clean environment as the script does."""
        try:
            env = gym.make(env_id, disable_env_checker=True, max_episode_steps=steps, **kwargs)
            return noisy.make_flat(env, script.STEP_LIMIT)
        except noisy.refusals(env_id) as error:
            raise ValueError(noisy.reason(error)) from error

    for environment in (run.environment, run.tested_in):
        noisy.canonical_env_id(environment)  # imports its module
    steps = run.settings.get("max_episode_steps")
    drawn = {"render_mode": render_mode} if render_mode else {}  # not every class takes it
    noisy.seed_globals(Args.seed)  # as every episode does: the constructor may draw, too
    with make_env(run.tested_in, **drawn) as env:
        if run.elsewhere:
            with make_env(run.environment) as trained_in:
                check_spaces(run, trained_in, env)
        try:
            policy = script.load_policy(run.folder, env)
        except Exception as error:  # a damaged file may raise anything
            text = f"policy.pt is not a policy for {run.tested_in}: {in_words(error)}"
            raise ValueError(text) from None
        yield env, policy


def check_spaces(run, trained_in, env):
    """Raise ValueError unless both environments have the same spaces."""
    for name in ("observation_space", "action_space"):
        here, there = getattr(trained_in, name), getattr(env, name)
        if here != there:
            raise ValueError(
                f"--env-id {run.elsewhere}: its {name} is {there}, that of {run.environment} is "
                f"{here}; a policy needs the same"
            )


def refuse_foreign_module(run, name):
    """Raise ValueError if an environment or a noise would be imported from a folder of runs.

    Whoever made a folder of runs that somebody downloads chose its modules and their names, too.
    """
    module, colon, _ = name.partition("(")[0].rpartition(":")
    first, *rest = module.strip().split(".")
    spec = PathFinder.find_spec(first, noisy.module_path()) if colon else None  # executes nothing
    here, project, folder = Path.cwd(), Path(__file__).resolve().parent, run.folder.resolve()
    for found in (spec.submodule_search_locations or [spec.origin]) if spec else ():
        entry, top = Path(found).parent.resolve(), Path(found).resolve()
        place = Path(top, *rest).resolve()
        # the project's folder may hold the runs, and packages that are on the module path
        is_own = entry.is_relative_to(run.runs_dir) and (entry != here or entry == project)
        forbidden = folder if is_own else run.runs_dir
        if place.is_relative_to(forbidden) or folder.is_relative_to(top):
            raise ValueError(
                f"{name} would be imported from {place}, in a folder of runs; "
                "if you trust that module, move it to where your own ones are"
            )


def check_runs(runs, conditions, bad, storing):
    """Return {run: what is stored of it} of the runs that can be tested.

    Add the others to `bad`, {run folder: why}.

    The policy must fit its environment, and every noise must be able to act on it.
    """
    stored, told = {}, {}
    for run in runs:
        try:
            refuse_foreign_module(run, run.environment)
            with load(run) as (env, _), warnings.catch_warnings(record=True) as notes:
                for condition in conditions:
                    condition.wrap(env)
            told |= dict.fromkeys(str(note.message) for note in notes)
            stored[run] = read_stored(run) if storing else {}
        except Exception as error:  # any but a ValueError is of the user's environment
            bad[run.folder] = with_place(error, ValueError)
    for note in told:
        print(note, file=sys.stderr)
    return stored


def tell(bad):
    """Print each reason why runs cannot be tested, with the first of them; bad: see check_runs."""
    folders_of = {}
    for folder, text in bad.items():
        folders_of.setdefault(text, []).append(folder)
    for text, (first, *others) in folders_of.items():
        more = f" and {len(others)} more" if others else ""
        print(f"error: {first}{more}: {text}", file=sys.stderr)


def play(run, condition, args):
    """Play episodes, and store them; or draw one. Return what play_episodes does."""
    with load(run, args.drawing) as (env, policy):
        with warnings.catch_warnings(action="ignore"):  # check_runs has told them
            noisy_env = condition.wrap(env)
        if args.video:
            place = f"__{slug(run.elsewhere)}" if run.elsewhere else ""
            name = f"{run.folder.name}__{condition.slug or 'clean'}{place}.mp4"
            return record(noisy_env, policy, args.seed, args.video / name)
        results = play_episodes(noisy_env, policy, 1 if args.render else args.episodes, args.seed)
    if args.storing:
        store(run, run.key(condition), results)
    return results


def record(env, policy, seed, path):
    """Play an episode into a video; return what play_episodes does."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".") as temporary:
        folder = Path(temporary, "video")  # a new one: RecordVideo warns of one that exists
        video = RecordVideo(env, str(folder))  # of the first episode
        try:
            results = play_episodes(video, policy, 1, seed)
        finally:
            if video.recording:
                video.stop_recording()
        (folder / "rl-video-episode-0.mp4").replace(path)
    return results


def play_episodes(env, policy, number, seed):
    """Play episodes; return [(true return, length, success), ...].

    Success is 1 or 0, or NaN where the environment does not tell it.
    """
    results = []
    with noisy.kept_generators(env):
        for episode in range(number):
            noisy.seed_globals(seed + episode)
            observation, _ = env.reset(seed=seed + episode)
            terminated = truncated = False
            while not (terminated or truncated):
                observation, _, terminated, truncated, info = env.step(policy(observation))
            record = info["episode"]  # the return is a sum of numbers or of arrays
            results.append((np.asarray(record["r"]).item(), int(record["l"]), noisy.outcome(info)))
    return results


def attempt(task, args):
    """Return what `play` returns of a task, (run, condition), or in words why it cannot."""
    try:
        return play(*task, args)
    except Exception as error:  # of the environment, or of any library that draws
        return with_place(error, (noisy.NotFiniteError, noisy.SpaceError))


def play_all(tasks, args):
    """Yield all tasks, (run, condition), in their order, with what `attempt` returns of each."""
    with tqdm(tasks, unit="condition", disable=None) as bar:
        everything = attempt, tasks, itertools.repeat(args)
        if args.jobs == 1 or args.render:
            yield from zip(bar, map(*everything), strict=True)
            return
        context = multiprocessing.get_context("spawn")  # PyTorch does not survive a fork
        with ProcessPoolExecutor(args.jobs, context, end_with_program) as pool:
            yield from zip(bar, pool.map(*everything), strict=True)


def end_with_program():
    """Let this process of --jobs finish what it plays at Ctrl-C, and end when the program ends.

    Without this it would go on alone, and then wait for work forever. What it played is stored.
    """

    def wait():
        multiprocessing.parent_process().join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=wait, daemon=True).start()


def read_stored(run):
    """Read robustness.csv: {(noise, noise rate, environment): what play_episodes returns}.

    The environment is empty for that of the training. Raises DamageError.
    """
    path = run.folder / "robustness.csv"
    stored = {}
    try:
        text = path.read_text("utf-8") if path.exists() else ""
        for row in csv.DictReader(text.splitlines()):
            success = float(row.get("success") or "nan")
            result = float(row["episodic_return"]), int(row["episodic_length"]), success
            key = row["noise"], row["noise_rate"], row.get("environment") or ""
            stored.setdefault(key, []).append(result)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, csv.Error) as error:
        text = f"robustness.csv: {in_words(error)}; delete that file to play everything again"
        raise DamageError(text) from None
    return stored


def store(run, key, results):
    """Add a condition to robustness.csv, beside what other processes have stored meanwhile."""
    path = run.folder / "robustness.csv"
    try:
        with folders.rewritten(path) as file:
            stored = read_stored(run)
            stored[key] = max(stored.get(key, []), results, key=len)
            rows = [
                (*condition, i, *result, environment or None)
                for (*condition, environment), played in stored.items()
                for i, result in enumerate(played)
            ]
            table = pd.DataFrame(rows, columns=[*ROBUSTNESS_COLUMNS, "success", "environment"])
            table = table.astype({"success": "Int64"}).dropna(axis="columns", how="all")
            table.to_csv(file, index=False)
    except (OSError, DamageError) as error:
        fail(f"cannot write {path}: {error}", code=1)


def names_of(runs):
    """Name each run's study as analyze.py does, and in which arguments the run differs from it."""
    studies = {}
    for run in runs:
        studies.setdefault(run.study, []).append(run.settings)
    usual = {key: usual_settings(settings) for key, settings in studies.items()}
    for run in runs:
        key = run.study
        differing = folders.difference(run.settings, usual[key])
        own = [f"{name}={run.settings[name]}" for name in differing]
        yield ", ".join([study_name(*key), *own])


def print_table(runs, conditions, stored, episodes):
    """Print mean and sample standard deviation over seeds: one table for each noise of the test."""
    trained = {}
    for run, name in zip(runs, names_of(runs), strict=True):
        noise = run.configuration.noise or "no noise"
        where = where_tested(run.environment, run.elsewhere)
        row = where, name, noise, run.configuration.noise_rate
        trained.setdefault(row, []).append(run)
    noises = dict.fromkeys(condition.noise for condition in conditions if condition.noise)
    for noise in noises or [""]:
        columns = [condition for condition in conditions if condition.noise in ("", noise)]
        headers = ["environment", "algorithm", "trained with", "at rate", "seeds"]
        headers += [f"at {column.columns[1]}" if column.noise else "clean" for column in columns]
        rows = []
        for row, seeds in trained.items():
            played = [[stored[run][run.key(column)] for run in seeds] for column in columns]
            rows.append([*row, len(seeds), *(mean_return(results, episodes) for results in played)])
        if noise:
            print(f"\nMean return, tested with {noise}")
        print(tabulate(rows, headers, disable_numparse=True))


def mean_return(played, episodes):
    """Return the text of a cell: the mean return, its standard deviation, the rate of success.

    played: what play_episodes returns, for each run.
    """
    results = np.array([results[:episodes] for results in played])
    mean, spread, n = mean_std(results[..., 0].mean(axis=1))
    text = rounded(mean, spread)
    if n > 1:
        text += f" ± {rounded(spread, spread)}"
    success = results[..., 2]
    return text if np.isnan(success).all() else f"{text}, {100 * (success > 0).mean():.0f} % solved"


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


def main(args):
    """Check everything, play what is not stored, print the table; return the exit status."""
    if args.render and args.video:
        fail("--render and --video exclude each other")
    if args.render and not works(DISPLAY):
        fail("--render needs a display; --video FOLDER makes videos without one")
    os.environ["OMP_NUM_THREADS"] = "1"  # before the scripts import PyTorch; processes inherit it
    try:
        noisy.check_numbers(vars(args))
        runs, bad = find_runs(args.runs)
        named = [name for text in args.noises for name in noisy.split_noises(text)]
        for run, name in itertools.product(runs, [*named, args.env_id or ""]):
            refuse_foreign_module(run, name)
        conditions = read_conditions(args)
    except ValueError as error:
        fail(error)
    here = Path.cwd()  # for what the module of my_envs:MyEnv-v0 imports
    if not any(here.is_relative_to(run.runs_dir) for run in runs):
        sys.path.append(str(here))
    if args.video:
        args.video = Path(os.path.expanduser(args.video))
        if len({run.folder.name for run in runs}) < len(runs):
            fail("--video: two of these runs have the same name, and so would their videos")
        draw_without_display()
    if args.env_id:
        try:
            env_id = noisy.canonical_env_id(args.env_id)
        except ValueError as error:
            fail(f"--env-id: {error}")
        runs = [replace(run, elsewhere=env_id * (env_id != run.environment)) for run in runs]
    stored = check_runs(runs, conditions, bad, args.storing)
    runs = list(stored)
    tell(bad)
    if not runs:
        return 2 if bad else fail(f"there is no finished run in {', '.join(map(str, args.runs))}")
    if args.video:
        try:
            args.video.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=args.video).close()
        except OSError as error:
            fail(f"--video: cannot write to {args.video}: {error}")
    if not (args.storing or args.drawing):
        print(f"--seed {args.seed} is not the default: everything is played, nothing is stored")
    tasks = [
        (run, condition)
        for run, condition in itertools.product(runs, conditions)
        if args.drawing or len(stored[run].get(run.key(condition), [])) < args.episodes
    ]
    failed = {}
    for (run, condition), results in play_all(tasks, args):
        name = condition.slug or "clean"
        stored[run][run.key(condition)] = results
        if isinstance(results, str):
            failed[run.folder] = f"{name}: {results}"
            if args.drawing:
                text = f"cannot draw {run.folder.name}, {failed[run.folder]}"
                print(f"error: {text}", file=sys.stderr)
        elif args.drawing:
            [(drawn, steps, _)] = results
            print(f"{run.folder.name}, {name}: return {rounded(drawn)}, {steps} steps")
    if not args.drawing:
        tell(failed)
        if runs := [run for run in runs if run.folder not in failed]:
            print_table(runs, conditions, stored, args.episodes)
    return bool(bad or failed)


if __name__ == "__main__":
    take_over_terminal()
    # at once: an ordinary exit would wait for what the processes of --jobs play
    signal.signal(signal.SIGTERM, lambda number, frame: os._exit(128 + number))
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except KeyboardInterrupt:
        fail("stopped; what was played is stored, but nothing with another --seed", code=130)
