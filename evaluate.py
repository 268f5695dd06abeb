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
An unfinished run that is named itself plays its latest policy, and nothing of it is stored.

A policy is played by the script that trained it, which config.json names: the file of that name in
the current folder, or else in this one. The script, and the module of an environment or of a noise,
as in my_envs:MyEnv-v0, are imported from your own path, never from a folder of runs. Runs that
cannot be tested, or fail while they play, are listed; the exit status is 1 then, and 2 if none
could begin to play.
"""

import hashlib
import importlib.util
import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.machinery import PathFinder
from pathlib import Path

import numpy as np
import tyro
from gymnasium.wrappers import RenderCollection
from tabulate import tabulate
from tqdm import tqdm

import noisy_wrappers as noisy
from analysis import folders
from analysis.episodes import read_episodes, store_episodes
from analysis.errors import fail, in_words, take_over_terminal, with_place
from analysis.folders import NOT_SETTINGS, DamageError
from analysis.formatting import DASH, rounded
from analysis.matrices import matrices
from analysis.runs import study_name, study_of, usual_config, where_tested
from analysis.statistics import mean_std
from analysis.words import slug

PROJECT = Path(__file__).resolve().parent
STORED = "what was played is stored, but nothing with another --seed"
SCRIPTS = {}  # path -> the module, and the SHA-256 of its text


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
    """another environment to test in, of the same action space and shape of observations, without
    the training's --env-kwargs; by default that of the training"""
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

    def stores(self, player):
        """Tell whether episodes are stored: robustness.csv has no column for seed and step."""
        return self.seed == Args.seed and not self.drawing and player.run.finished


@dataclass(frozen=True, eq=False)
class Player:
    """A run whose policy plays, and where."""

    run: folders.Run
    elsewhere: str = ""  # another environment to play in than that of the training

    @property
    def folder(self):
        """The run's folder."""
        return self.run.folder

    @property
    def environment(self):
        """The environment that the policy plays in."""
        return self.elsewhere or self.run.environment

    @property
    def runs_dir(self):
        """The folder of all runs beside it, in both phases of a choice."""
        folder = self.folder.resolve().parent
        return folder.parent if folders.is_phase(folder) else folder

    def moved_to(self, env_id):
        """Return the player in an environment without the training's --env-kwargs."""
        is_home = env_id == self.run.environment and not self.run.args.get("env_kwargs")
        return self if is_home else replace(self, elsewhere=env_id)

    def name(self, condition):
        """Name a condition for people and files."""
        return "__".join(filter(None, [condition.slug or "clean", slug(self.elsewhere)]))


def find_players(paths):
    """Return the runs that the paths name, each once; a folder stands for its finished runs.

    Also return {run folder: what is damaged in it}, and print how many runs are not finished.
    """
    if not paths:
        fail("name the runs to test, for example: python evaluate.py runs/*Hopper-v5*")
    named = {}  # folder -> whether it was named itself
    for path in map(Path, map(os.path.expanduser, paths)):
        is_run = folders.is_run(path)
        found = [path] if is_run else folders.runs_of(path)
        if not os.path.lexists(path) or (len(paths) == 1 and not found):
            fail(f"{path} is neither a run nor a folder of runs")
        for folder in found:
            named[folder.resolve()] = named.get(folder.resolve(), False) or is_run
    players, damaged, left_out = [], {}, Counter()
    for folder, is_named in named.items():
        phase = folder.parent.name if folders.is_phase(folder.parent) else ""
        try:
            run = None
            if folders.has_begun(folder):
                run = folders.read_run(folder, phase, with_curve=False)
        except DamageError as error:
            damaged[folder] = str(error)
            continue
        if run and (run.finished or (is_named and os.path.exists(folder / "policy.pt"))):
            players.append(Player(run))
        else:
            left_out[" (not tested yet)" if is_named else ""] += 1
    for reason, number in left_out.items():
        print(f"unfinished runs are left out: {number}{reason}")
    return players, damaged


def step_of(player):
    """Return the step that a run's policy.pt is of, or "?" of runs of version 0.3.

    The last test in eval.csv may be an earlier one, where a run was resumed and stopped again.
    """
    script, _ = import_script(player)
    return script.read_state(player.folder / "policy.pt").get("step", "?")


def read_conditions(args):
    """Return the configurations to test under: without noise, and every noise at every rate.

    Raises ValueError.
    """
    conditions = [noisy.BASELINE]
    for noise, rate in itertools.product(args.noises, args.noise_rates):
        configuration = noisy.Configuration.read(noisy.split_noises(noise), [rate])
        conditions.append(configuration.for_tests())
    return list(dict.fromkeys(conditions))  # each once, in order; a rate of 0 is clean


def import_script(player):
    """Return the script that trained a policy, as a module, and whether its text is another now.

    Raises ValueError if it is not there.
    """
    name = player.run.script
    for folder in dict.fromkeys([Path.cwd(), PROJECT]):
        path = folder / name
        is_a_run = folder.resolve().is_relative_to(player.runs_dir) and folder != PROJECT
        if path.is_file() and path.name == name and not is_a_run:
            if path not in SCRIPTS:
                spec = importlib.util.spec_from_file_location(path.stem, path)
                script = importlib.util.module_from_spec(spec)
                sys.modules[path.stem] = script
                spec.loader.exec_module(script)
                SCRIPTS[path] = script, hashlib.sha256(path.read_bytes()).hexdigest()
            script, sha256 = SCRIPTS[path]
            return script, player.run.is_of_another_text(sha256)
    raise ValueError(f"its script {name} is neither in the current folder nor in {PROJECT}")


@contextmanager
def load(player, render_mode=None):
    """Yield a run's clean environment, closed at the end, and its policy, NumPy to NumPy.

    Raises ValueError if a run cannot be tested, besides what its environment raises.
    """
    if not os.path.exists(player.folder / "policy.pt"):
        raise ValueError("there is no policy.pt")
    script, _ = import_script(player)
    run = player.run
    steps = {"max_episode_steps": run.args.get("max_episode_steps")}
    kwargs = noisy.parse_env_kwargs(run.args.get("env_kwargs", []))
    drawn = {"render_mode": render_mode} if render_mode else {}  # not every class takes it
    for environment in (run.environment, player.environment):
        noisy.canonical_env_id(environment)  # imports its module
    noisy.seed_globals(Args.seed)  # as every episode does: the constructor may draw, too
    own = {} if player.elsewhere else kwargs
    with script.make_env(player.environment, **steps, **own, **drawn) as env:
        if run.release != "0.3":
            check_spaces(player, noisy.Spaces(run.config), env)
        elif player.elsewhere:
            raise ValueError("a run of 0.3 does not tell its spaces: it is tested at home alone")
        use_kernels_of(run)
        try:
            policy = script.load_policy(player.folder, env if run.release == "0.3" else None)
        except Exception as error:  # a damaged file may raise anything
            text = f"policy.pt is damaged, or not a policy for {player.environment}"
            text = f"{text}: {in_words(error)[:200]}"
            raise ValueError(text) from None
        yield env, policy


def use_kernels_of(run):
    """Multiply matrices as the run did, so that its actions are the same to the last digit.

    But not where "medium" would round here to bfloat16: see train() in the scripts.
    """
    import torch  # here, because it takes a second, and bad input should not wait for it

    processor = torch.cpu.get_capabilities()
    would_round = processor.get("amx_tile") or processor.get("bf16")
    is_medium = run.config.get("matmul_precision") == "medium" and not would_round
    torch.set_float32_matmul_precision("medium" if is_medium else "highest")


def check_spaces(player, trained_in, env):
    """Raise ValueError unless a policy fits an environment; noise may have widened observations."""
    spaces = [
        ("observation space", trained_in.observation_space, env.observation_space),
        ("action space", trained_in.action_space, env.action_space),
    ]
    for name, trained, here in spaces:
        if trained.shape != here.shape or (name == "action space" and trained != here):
            raise ValueError(
                f"policy.pt is not a policy for {player.environment}: its {name} is {here}, that "
                f"of the training was {trained}"
            )


def refuse_foreign_module(player, name):
    """Raise ValueError if an environment or a noise would be imported from a folder of runs.

    Whoever made a folder of runs that somebody downloads chose its modules and their names, too.
    """
    module, colon, _ = name.partition("(")[0].rpartition(":")
    first, *rest = module.strip().split(".")
    path = [os.getcwd(), *sys.path]  # as noisy_wrappers.py imports them
    spec = PathFinder.find_spec(first, path) if colon else None  # executes nothing
    for found in (spec.submodule_search_locations or [spec.origin]) if spec else ():
        top = Path(found).resolve()
        place = Path(top, *rest).resolve()
        if place.is_relative_to(player.runs_dir) or player.folder.resolve().is_relative_to(top):
            raise ValueError(
                f"{name} would be imported from {place}, in a folder of runs; "
                "if you trust that module, move it to where your own ones are"
            )


def check_players(players, conditions, bad, args):
    """Return {player: its stored episodes} of those that can play; add the others to `bad`.

    The policy must fit its environment, and every noise must be able to act on it.
    bad: {run folder: why}.
    """
    stored, changed = {}, set()
    for player in players:
        try:
            refuse_foreign_module(player, player.run.environment)
            if import_script(player)[1]:
                changed.add(player.run.script)
            with load(player) as (env, _):
                modes = env.metadata.get("render_modes", [])
                if args.drawing and args.drawing not in modes:
                    raise ValueError(f"{args.drawing} is not among its render_modes, {modes}")
                for condition in conditions:
                    condition.wrap(env)
            found = read_episodes(player.folder) if args.stores(player) else {}
            due = [one for one in conditions if lacks(found, player, one, args)]
            if due and args.stores(player) and not os.access(player.folder, os.W_OK):
                raise ValueError("cannot be written to; with another --seed nothing is stored")
            if not player.run.finished:
                step = step_of(player)
                print(f"{player.folder.name} is not finished: its policy of step {step} is tested")
            stored[player] = found
        except (Exception, SystemExit) as error:  # but for a ValueError, of the user's environment
            bad[player.folder] = with_place(error, ValueError)
    for script in sorted(changed):
        text = f"{script} has changed since some of these runs were trained"
        print(f"{text}: what plays may differ from what was trained", file=sys.stderr)
    return stored


def lacks(stored, player, condition, args):
    """Tell whether episodes of a condition are still to be played; stored: of read_episodes."""
    return len(stored.get((condition, player.elsewhere), [])) < args.episodes


def tell(bad):
    """Print each reason why runs cannot play, with the first of them; bad: see check_players."""
    folders_of = {}
    for folder, text in bad.items():
        folders_of.setdefault(text, []).append(folder)
    for text, (first, *others) in folders_of.items():
        more = f" and {len(others)} more" if others else ""
        print(f"error: {first}{more}: {text}", file=sys.stderr)


def play(player, condition, args):
    """Play episodes, or draw one. Return them as read_episodes does."""
    with load(player, args.drawing) as (env, policy):
        env = condition.wrap(env)
        if args.video:
            name = slug(f"{player.folder.name}__{player.name(condition)}")
            return record(env, policy, args.seed, args.video / f"{name}.mp4")
        return noisy.play(env, policy, 1 if args.render else args.episodes, args.seed)


def record(env, policy, seed, path):
    """Play an episode into a video; return it as `play` does."""
    from moviepy import ImageSequenceClip  # imports much

    frames = RenderCollection(env)
    episodes = noisy.play(frames, policy, 1, seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    clip = ImageSequenceClip(frames.render(), fps=env.metadata.get("render_fps", 30))
    clip.write_videofile(str(path), logger=None)
    return episodes


def attempt(task, args):
    """Play a task, (player, condition), and store it; return the episodes, or why it failed."""
    player, condition = task
    try:
        episodes = play(player, condition, args)
    except (Exception, SystemExit) as error:  # of the environment, or of any library that draws
        return with_place(error, (noisy.NotFiniteError, noisy.SpaceError))
    if args.stores(player):
        try:
            store_episodes(player.folder, (condition, player.elsewhere), episodes)
        except (OSError, DamageError) as error:
            fail(f"cannot write to {player.folder}: {error}", code=1)
    return episodes


def play_all(tasks, args):
    """Yield all tasks, (player, condition), in order, with what `attempt` returns of each."""
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


def names_of(players):
    """Name each run's study as analyze.py does, and in what the run differs from most of it."""
    studies = {}
    for player in players:
        studies.setdefault(study_of(player.run), []).append(player.run.config)
    usual = {key: usual_config(configs) for key, configs in studies.items()}
    releases = {key: {noisy.release(config) for config in studies[key]} for key in studies}
    for player in players:
        key = study_of(player.run)
        differing = noisy.different_arguments(player.run.config, usual[key], NOT_SETTINGS)
        own = [f"{name}={value}" for name, (value, _) in sorted(differing.items())]
        if len(releases[key]) > 1:
            own.append(f"release {player.run.release}")
        if not player.run.finished:
            own.append(f"step {step_of(player)}, not finished")
        yield ", ".join([study_name(*key), *own])


def print_table(players, conditions, stored, episodes):
    """Print mean and sample standard deviation over seeds: one table for each noise of the test.

    Two noises that were combined with several numbers of each are matrices instead. Of runs with
    the same arguments and seed the first one counts, as in analyze.py.
    """
    trained = {}
    for player, name in zip(players, names_of(players), strict=True):
        run = player.run
        where = where_tested(run.environment, player.elsewhere)
        noise = run.configuration.noise or "no noise"
        row = where, name, noise, run.configuration.noise_rate
        seeds = trained.setdefault(row, {})
        first = seeds.setdefault(run.seed, player)
        if first is not player:
            print(f"duplicate: {player.folder} is left out, because {first.folder} counts")

    def cell(seeds, condition):
        played = [stored[one][condition, one.elsewhere] for one in seeds.values()]
        return mean_return(played, episodes)

    found = matrices(conditions)
    arranged = {one for matrix in found for one in matrix.cells.values()} - {noisy.BASELINE}
    alone = [condition for condition in conditions if condition not in arranged]
    noises = dict.fromkeys(condition.noise for condition in alone if condition.noise)
    for noise in noises or [""]:
        columns = [condition for condition in alone if condition.noise in ("", noise)]
        headers = ["environment", "algorithm", "trained with", "at rate", "seeds"]
        headers += [f"at {column.columns[1]}" if column.noise else "clean" for column in columns]
        rows = [
            [*row, len(seeds), *(cell(seeds, column) for column in columns)]
            for row, seeds in trained.items()
        ]
        if noise:
            print(f"\nMean return, tested with {noise}")
        print(tabulate(rows, headers, disable_numparse=True))
    for matrix, ((where, name, noise, rate), seeds) in itertools.product(found, trained.items()):
        print(f"\nMean return, tested with {matrix.name}")
        print(f"{name} on {where}, trained with {noise} at rate {rate}, seeds: {len(seeds)}")
        cells = matrix.frame({one: cell(seeds, one) for one in matrix.cells.values()}).fillna(DASH)
        print(tabulate(cells, cells.columns, disable_numparse=True))


def mean_return(played, episodes):
    """Return the text of a cell: the mean return, its standard deviation, the rate of success.

    played: the episodes of each run, as read_episodes has them.
    """
    results = np.array([results[:episodes] for results in played])
    mean, spread, n = mean_std(results[..., 0].mean(axis=1))
    text = rounded(mean, spread)
    if n > 1:
        text += f" ± {rounded(spread, spread)}"
    success = results[..., 2]
    return text if np.isnan(success).all() else f"{text}, {100 * (success > 0).mean():.0f} % solved"


def has_display():
    """Tell whether there is a screen, in a process of its own, which may crash."""
    line = [sys.executable, "-c", "import glfw; assert glfw.init() and glfw.get_primary_monitor()"]
    return not subprocess.run(line, capture_output=True).returncode


def check_writable(folder):
    """End with an error if no file can be written into a folder, or where it would be made."""
    there = next(path for path in (folder, *folder.parents) if os.path.exists(path))
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        fail(f"--video: cannot write to {folder}: {error.strerror}")


def check_args(args):
    """End with an error where the options make no sense."""
    if args.render and args.video:
        fail("--render and --video exclude each other")
    if args.render and not has_display():
        fail("--render needs a display; --video FOLDER makes videos without one")
    for name, least in {"episodes": 1, "jobs": 1, "seed": 0}.items():
        if getattr(args, name) < least:
            fail(f"--{name} must be at least {least}, not {getattr(args, name)}")
    if args.noise_rates != Args.noise_rates and not args.noises:
        fail("--noise-rates without --noises: name a noise, or leave the rates out")


def players_of(args):
    """Return the players, {run folder: why it cannot play}, and the conditions; see main.

    Modules may be imported from the current folder then, unless it is one of runs.
    """
    players, bad = find_players(args.runs)
    noises = [name for text in args.noises for name in noisy.split_noises(text)]
    for player, name in itertools.product(players, [*noises, args.env_id or ""]):
        refuse_foreign_module(player, name)
    conditions = read_conditions(args)
    here = Path.cwd()  # for what the module of my_envs:MyEnv-v0 imports
    if not any(here.is_relative_to(player.runs_dir) for player in players):
        sys.path.append(str(here))
    if args.env_id is not None:
        env_id = noisy.canonical_env_id(args.env_id)
        players = [player.moved_to(env_id) for player in players]
    return players, bad, conditions


def main(args):
    """Check everything, play what is not stored, print the table; return the exit status."""
    check_args(args)
    os.environ["OMP_NUM_THREADS"] = "1"  # before the scripts import PyTorch; processes inherit it
    if args.video:
        args.video = Path(os.path.expanduser(args.video))
        check_writable(args.video)
        if not has_display():  # before any environment: dm_control reads it when it is imported
            os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        players, bad, conditions = players_of(args)
    except ValueError as error:
        fail(error)
    if args.video and len({player.folder.name for player in players}) < len(players):
        fail("--video: two of these runs have the same name, and so would their videos")
    stored = check_players(players, conditions, bad, args)
    tell(bad)
    if not stored:
        return 2 if bad else fail(f"there is nothing to test in {', '.join(map(str, args.runs))}")
    if args.seed != Args.seed and not args.drawing:
        print(f"--seed {args.seed} is not the default: everything is played, nothing is stored")
    tasks = [
        (player, condition)
        for player, condition in itertools.product(stored, conditions)
        if lacks(stored[player], player, condition, args)
    ]
    failed = {}
    for (player, condition), result in play_all(tasks, args):
        name = player.name(condition)
        stored[player][condition, player.elsewhere] = result
        if isinstance(result, str):
            failed[player.folder] = f"{name}: {result}"
        elif args.drawing:
            [(drawn, steps, _)] = result
            print(f"{player.folder.name}, {name}: return {rounded(drawn)}, {steps:.0f} steps")
    tell(failed)
    players = [player for player in stored if player.folder not in failed]
    if players and not args.drawing:
        print_table(players, conditions, stored, args.episodes)
    return bool(bad or failed)


if __name__ == "__main__":
    take_over_terminal()
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except KeyboardInterrupt:
        fail(f"stopped; {STORED}", code=130)
    except BrokenExecutor:
        why = "a process ended abruptly (out of memory, or a crash of an environment?)"
        fail(f"{why}; {STORED}: run the same command again, with fewer --jobs", code=1)
