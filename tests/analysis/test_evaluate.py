"""evaluate.py as a user meets it: stored returns, the table, videos, bad input."""

import csv
import gzip
import importlib
import json
import math
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from unittest import mock

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
import torch

import evaluate
import ppo_continuous_noisy as ppo
import td3_continuous_noisy as td3
from analysis.episodes import read_episodes, store_episodes
from analysis.folders import DamageError, Run
from analysis.formatting import rounded
from evaluate import Args, main
from noisy_wrappers import BASELINE, Configuration

ROOT = Path(__file__).parents[2]
OBSERVATION, ACTION = "RandomNormalNoisyObservation(0.1)", "RandomNormalNoisyAction(0.5)"
SEED = 2_000_000  # of the first episode, unless --seed says otherwise
CLEAN = BASELINE, ""  # a condition, and no other environment
ENDING = "RandomEarlyTermination(6)"
BOTH = f"{ENDING} + RandomUniformScaleReward(-3.0, 5.0)"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder of small finished runs on InvertedPendulum: two of PPO and one of TD3."""
    runs_dir = tmp_path_factory.mktemp("trained")
    common = {"env_id": "InvertedPendulum-v5", "compile": False, "runs_dir": str(runs_dir)}
    off_policy = {"total_timesteps": 80, "learning_starts": 79, "batch_size": 8, "buffer_size": 100}
    on_policy = {"total_timesteps": 256, "num_steps": 128, "num_minibatches": 4}
    for seed in (1, 2):
        ppo.train(ppo.Args(seed=seed, **on_policy, **common))
    td3.train(td3.Args(**off_policy, **common, learning_rate=0.0))  # so that episodes differ
    return runs_dir


@pytest.fixture
def runs(trained, tmp_path):
    """A copy of the trained runs, to write into."""
    return Path(shutil.copytree(trained, tmp_path / "runs"))


def stored(run):
    """The rows of a run's robustness.csv."""
    with open(run / "robustness.csv", newline="") as file:
        return list(csv.DictReader(file))


def one(runs, algorithm):
    """The first run of an algorithm."""
    return sorted(runs.glob(f"*{algorithm.lower()}_continuous_noisy*"))[0]


@pytest.fixture
def run_dir(runs):
    """The first run of PPO in that copy."""
    return one(runs, "PPO")


def files(folder):
    """All files below a folder with their content and time of writing."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}


def command(*options):
    """The command line of a process."""
    return [sys.executable, str(ROOT / "evaluate.py"), *map(str, options)]


# What is played


@pytest.mark.parametrize("algorithm", ["TD3", "PPO"])
def test_clean_returns_are_those_of_the_last_evaluation(runs, algorithm):
    run_dir = one(runs, algorithm)
    [finished], _ = evaluate.find_players([run_dir])
    torch.set_float32_matmul_precision("high")  # whatever it is in this process
    played = evaluate.play(finished, BASELINE, Args((run_dir,), episodes=10, seed=1_000_000))
    with open(run_dir / "eval.csv", newline="") as file:
        last = list(csv.DictReader(file))[-10:]
    rows = [(float(row["episodic_return"]), int(row["episodic_length"])) for row in last]
    assert [(value, length) for value, length, _ in played] == rows
    assert len(set(rows)) > 1
    precision = finished.run.config["matmul_precision"]  # returns of longer episodes depend on it
    assert torch.get_float32_matmul_precision() == precision


def test_noisy_returns_are_those_of_a_loop_of_ones_own(run_dir):
    """Episode i and its noise begin with the seed SEED + i; noise on the reward is not counted."""
    main(Args((run_dir,), noises=(OBSERVATION, BOTH), noise_rates=(0.5,), episodes=6))
    bare = gym.make("InvertedPendulum-v5")
    policy, expected = ppo.load_policy(run_dir, bare), []
    for noise, acting in (("", []), (OBSERVATION, [OBSERVATION]), (BOTH, [ENDING])):
        env = Configuration.read(acting, [0.5] * len(acting)).wrap(bare)
        for i in range(6):
            observation, _ = env.reset(seed=SEED + i)
            total, length, done = 0.0, 0, False
            while not done:
                observation, reward, terminated, truncated, _ = env.step(policy(observation))
                total, length, done = total + reward, length + 1, terminated or truncated
            expected.append((noise, str(i), str(total), str(length)))
    assert {length for *_, length in expected[12:]} > {"6"}  # not all of them end early
    columns = "noise", "episode", "episodic_return", "episodic_length"
    assert [tuple(row[name] for name in columns) for row in stored(run_dir)] == expected


def test_the_time_limit_of_training_holds(run_dir):
    edit_args(run_dir, max_episode_steps=3)
    main(Args((run_dir,), episodes=3))
    assert [row["episodic_length"] for row in stored(run_dir)] == ["3"] * 3


# What is stored


def test_only_what_is_not_stored_is_played(runs, monkeypatch, capsys):
    args = Args((runs,), noises=(OBSERVATION,), noise_rates=(0.5, 1.0), episodes=2)
    main(args)
    table, before, first = capsys.readouterr().out, files(runs), stored(one(runs, "PPO"))
    with monkeypatch.context() as patch:
        patch.setattr(evaluate, "play", None)
        main(args)
        assert capsys.readouterr().out == table
        spelled = (" RandomNormalNoisyObservation(.1)",)
        main(Args((runs,), spelled, (1, 0.5, 0.50, 0.0), episodes=1))
    assert files(runs) == before
    mean = float(stored(one(runs, "TD3"))[0]["episodic_return"])  # of the first episode
    assert f" {rounded(mean)} " in capsys.readouterr().out
    main(Args((one(runs, "PPO"),), (OBSERVATION, ACTION), (0.5,), episodes=3))
    again = stored(one(runs, "PPO"))
    counts = Counter((row["noise"], row["noise_rate"]) for row in again)
    more = {("", "0.0"): 3, (OBSERVATION, "0.5"): 3, (ACTION, "0.5"): 3}
    assert counts == more | {(OBSERVATION, "1.0"): 2}
    assert [row for row in again if row["episode"] != "2" and row["noise"] != ACTION] == first


def test_another_seed_plays_everything_and_stores_nothing(runs, run_dir, capsys):
    main(Args((run_dir,), episodes=3))
    before = files(runs)
    args = Args((run_dir,), (OBSERVATION,), episodes=3, seed=7)
    capsys.readouterr()
    main(args)
    said, *table = capsys.readouterr().out.splitlines()
    assert "nothing is stored" in said and files(runs) == before
    [finished], _ = evaluate.find_players([run_dir])
    conditions = BASELINE, Configuration.read([OBSERVATION], [1.0])
    played = [evaluate.play(finished, condition, args) for condition in conditions]
    assert table[-1].split()[-2:] == [rounded(results[:, 0].mean()) for results in played]


@pytest.mark.slow
def test_a_killed_program_leaves_no_process_behind(runs):
    """Its processes end by themselves, also one that was just started and still imports."""
    options = ["--noises", OBSERVATION, ACTION, "--episodes", 20_000, "--jobs", 2]
    process = subprocess.Popen(command(one(runs, "PPO"), *options), start_new_session=True)

    def processes():
        listed = ["ps", "-ww", "-o", "args=", "-s", str(process.pid)]
        return subprocess.run(listed, capture_output=True, text=True).stdout.count("spawn_main")

    while processes() < 2:
        assert process.poll() is None
        time.sleep(0.1)
    process.kill()
    process.wait(timeout=100)
    deadline = time.time() + 60
    while processes() and time.time() < deadline:
        time.sleep(0.1)
    assert processes() == 0


def store(folder, noise):
    for i in range(1, 21):
        store_episodes(folder, (Configuration.parse(noise, i / 20), ""), [(1.0, 1, math.nan)])


def test_two_processes_on_one_run_lose_nothing(tmp_path):
    with multiprocessing.get_context("fork").Pool(2) as pool:
        pool.starmap(store, [(tmp_path, OBSERVATION), (tmp_path, ACTION)])
    assert len(read_episodes(tmp_path)) == 40
    assert [path.name for path in tmp_path.glob(".robustness*")] == [".robustness.lock"]


def test_the_longer_of_two_results_is_kept_also_of_a_compressed_file(tmp_path):
    short, long = [(1.0, 1, 1.0)], [(1.0, 1, 1.0), (2.0, 2, 0.0)]
    path = tmp_path / "robustness.csv"
    for results in (short, long, short):
        store_episodes(tmp_path, CLEAN, results)
        Path(f"{path}.gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    assert read_episodes(tmp_path)[CLEAN].tolist() == [list(result) for result in long]


DAMAGE = {
    "are lost": lambda text: text.replace(",0.0,0,1.0,1,1\n", ""),
    "not finite": lambda text: text.replace("2.0", "inf"),
    "unexpected header": lambda text: text.replace("episode,", "number,"),
    "or no episodes": lambda text: text.partition("\n")[0],
    "unknown noise 'RandomX'": lambda text: text + "RandomX(1),0.5,0,1.0,1,1\n",
}


@pytest.mark.parametrize("said", DAMAGE)
def test_damaged_episodes_are_told(said, tmp_path):
    """Or others would count as episodes that begin in the same states."""
    store_episodes(tmp_path, CLEAN, [(1.0, 1, 1.0), (2.0, 2, 0.0)])
    path = tmp_path / "robustness.csv"
    path.write_text(DAMAGE[said](path.read_text()))
    with pytest.raises(DamageError, match=rf"^robustness.csv: .*{said}"):
        read_episodes(tmp_path)


def test_a_full_disk_leaves_the_previous_file(runs, run_dir, monkeypatch, capsys):
    main(Args((run_dir,), episodes=1))
    before = files(runs)
    full = mock.Mock(side_effect=OSError(28, "No space left on device"))
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SystemExit, match="1"):
        main(Args((run_dir,), episodes=2))
    assert "No space left on device" in capsys.readouterr().err and files(runs) == before


def test_a_script_that_is_not_there_or_has_changed_is_told(run_dir, capsys):
    sha256 = json.loads((run_dir / "config.json").read_text())["script_sha256"]
    for others in (64 * "0", f"{64 * '0'}, {sha256}"):  # which resumed it
        edit_config(run_dir, script_sha256=others)
        assert main(Args((run_dir,), episodes=1)) == 0
        assert "ppo_continuous_noisy.py has changed" in capsys.readouterr().err
    edit_config(run_dir, script="wide_continuous_noisy.py")
    assert main(Args((run_dir,), episodes=1)) == 2
    assert "its script wide_continuous_noisy.py is neither" in capsys.readouterr().err


def test_an_unfinished_run_plays_only_if_it_is_named_and_stores_nothing(runs, run_dir, capsys):
    (run_dir / "result.json").unlink()
    header, _ = (run_dir / "eval.csv").read_text().split("\n", 1)
    (run_dir / "eval.csv").write_text(header + "\n")  # it has been resumed from before its tests
    before = files(run_dir)
    assert main(Args((run_dir,), episodes=2)) == 0
    assert "its policy of step 256 is tested" in capsys.readouterr().out
    assert files(run_dir) == before
    runs = runs.rename(runs.parent / "two__words")  # which is no run's name here
    (runs / "report.html").touch()  # analyze.py --out may be the same folder
    main(Args((runs, one(runs, "TD3")), episodes=1))
    assert "unfinished runs are left out: 1\n" in capsys.readouterr().out
    assert sum((run_dir / "robustness.csv").exists() for run_dir in runs.glob("*Inv*")) == 2


# The table


def test_the_table_of_known_returns(capsys):
    conditions = [BASELINE, Configuration.parse("A(1) + B(2)", "0.1 + 0.1")]
    seen = {}
    for noise, rate, clean, noisy in [
        ("", "0.00", [10, 30], [1, 2]),  # means 20 and 1.5
        ("A(1)", "0.50", [5, 5], [7, 8]),
        ("", "0.00", [40, 20], [4, 3]),  # means 30 and 3.5
        ("", "0.00", [10, 90], [-5, 0]),  # means 50 and -2.5
    ]:
        folder, configuration = Path(str(len(seen))), Configuration.parse(noise, rate)
        names = "PPO", "ppo_continuous_noisy.py", "E", "ppo_continuous_noisy", configuration
        run = Run(folder, "", {"args": {}}, *names, BASELINE, len(seen), 1, "0.4", result={})
        # A third episode is stored and not asked for; the second number is the length.
        seen[evaluate.Player(run)] = {
            (condition, ""): np.array([(value, 1, math.nan) for value in (*values, 1000)])
            for condition, values in zip(conditions, (clean, noisy), strict=True)
        }
    evaluate.print_table(list(seen), conditions, seen, episodes=2)
    lines = [re.split(r" {2,}", line.strip()) for line in capsys.readouterr().out.splitlines()]
    # sd of (20, 30, 50): sqrt((13.33^2 + 3.33^2 + 16.67^2) / 2); of (1.5, 3.5, -2.5) about 0.833
    assert lines[1] == ["Mean return, tested with A(1) + B(2)"]
    assert lines[2][-2:] == ["clean", "at 0.1 + 0.1"]
    assert lines[4:] == [
        ["E", "PPO", "no noise", "0.00", "3", "33 ± 15", "0.8 ± 3.1"],
        ["E", "PPO", "A(1)", "0.50", "1", "5.000", "7.500"],
    ]


def test_what_is_never_pooled_is_a_row_of_its_own(tmp_path):
    """Releases and other settings; and a policy of step 10 is not one of the end."""
    torch.save({"step": 10}, tmp_path / "policy.pt")
    names = "PPO", "ppo_continuous_noisy.py", "E", "ppo_continuous_noisy", BASELINE, BASELINE, 1, 99

    def named(*runs):
        players = []
        for gamma, release, result in runs:
            config = {"args": {"gamma": gamma}, "versions": {"noisy_wrappers": release}}
            run = Run(tmp_path, "", config, *names, release, result=result)
            players.append(evaluate.Player(run))
        return list(evaluate.names_of(players))

    usual = 0.99, "0.4", {}
    assert named(usual, (0.9, "0.4", {}), usual) == ["PPO", "PPO, gamma=0.9", "PPO"]
    released, old, early = named(usual, (0.99, "0.3", {}), (0.99, "0.4", None))
    assert (released, old) == ("PPO, release 0.4", "PPO, release 0.3")
    assert early == "PPO, release 0.4, step 10, not finished"


def test_phases_of_a_choice_are_rows_of_their_own(runs, capsys):
    for phase in ("search", "confirmation"):
        shutil.copytree(one(runs, "PPO"), runs / "choice" / phase / "run")
    main(Args((runs / "choice",), episodes=1))
    printed = re.split(r" {2,}|\n", capsys.readouterr().out)
    assert {"PPO [search]", "PPO [confirmation]"} <= set(printed)


def test_masses_by_delays_are_a_matrix(run_dir, capsys):
    names = ["RandomDynamics(0.7, 0.7)", "RandomDynamics(1.3, 1.3)"]
    pairs = [f"{mass} + RandomActionDelay({delay})" for mass in names for delay in (1, 2)]
    main(Args((run_dir,), (*pairs, names[0]), episodes=1))
    table = capsys.readouterr().out
    assert "tested with RandomDynamics(0" not in table
    lines = [re.split(r" {2,}", line) for line in table.splitlines()]
    returns = {row["noise"]: rounded(float(row["episodic_return"])) for row in stored(run_dir)}
    cells = [returns[pair] for pair in pairs]
    assert lines[-3] == ["none", returns[""], "–", "–"]
    assert lines[-2] == ["x = 0.7", returns[names[0]], *cells[:2]]
    assert lines[-1] == ["x = 1.3", "–", *cells[2:]]


# Videos


@pytest.mark.slow
def test_videos(runs, run_dir, tmp_path, monkeypatch):
    """Without a display."""
    for name in ("DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    before = files(runs)
    line = command(run_dir, "--noises", ACTION, "--video", tmp_path / "a" / "b", "--episodes", 9)
    result = subprocess.run(line, capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (0, "")
    assert files(runs) == before
    main(Args((run_dir,), (ACTION,), (1.0,), episodes=1))
    names = ["clean", "p1.0_NormalNoisyAction_0.5"]
    for name, row in zip(names, stored(run_dir), strict=True):
        video = imageio.imread(tmp_path / "a" / "b" / f"{run_dir.name}__{name}.mp4")
        assert len(video) == int(row["episodic_length"]) + 1  # the reset's, and one per step
        assert video.shape[1:] == (480, 480, 3)
        assert video[0].std() > 10 and np.abs(video[0].astype(int) - video[-1]).max() > 50
    assert f"return {rounded(float(row['episodic_return']))}, " in result.stdout


OWN = """
import os, sys
import gymnasium as gym

class Own(gym.ActionWrapper):
    def action(self, action):
        {code}
        return action

gym.register("{name}-v0", lambda **given: Own(gym.make("InvertedPendulum-v5", **given)))
"""


def use_own_environment(run_dir, folder, name, code):
    """Write a module with a user's environment, and let a run be one of it."""
    (folder / f"{name}.py").write_text(OWN.format(name=name, code=code))
    edit_args(run_dir, env_id=f"{name}:{name}-v0")


def test_a_window_shows_one_episode_of_each_condition(runs, monkeypatch, capsys):
    """The window itself is replaced."""
    modes, make_env = [], gym.make

    def make(env_id, render_mode=None, **kwargs):
        modes.append(render_mode)
        return make_env(env_id, **kwargs)

    monkeypatch.setattr(evaluate, "has_display", lambda: True)
    monkeypatch.setattr(gym, "make", make)
    before = files(runs)
    main(Args((one(runs, "PPO"),), (ACTION,), (1.0,), render=True, jobs=2))
    assert modes == [None, "human", "human"]  # the first is the check
    assert files(runs) == before and capsys.readouterr().out.count("\n") == 2


# Bad input


def edit_config(run_dir, **values):
    config = json.loads((run_dir / "config.json").read_text())
    (run_dir / "config.json").write_text(json.dumps(config | values))


def edit_args(run_dir, **values):
    args = json.loads((run_dir / "config.json").read_text())["args"]
    edit_config(run_dir, args=args | values)


BAD_RUNS = {
    "policy.pt is damaged": lambda folder: (folder / "policy.pt").write_bytes(b"x"),
    "robustness.csv: ": lambda folder: (folder / "robustness.csv").write_text("a,b\n1,2\n"),
    "not today .*broken.py, line 2": lambda folder: edit_args(folder, env_id="broken:Mine-v0"),
    "SystemExit: no .*exits.py, line 1": lambda folder: edit_args(folder, env_id="exits:Mine-v0"),
}


@pytest.mark.parametrize("message", BAD_RUNS)
def test_a_bad_run_hides_no_other(message, runs, run_dir, capsys, monkeypatch, tmp_path):
    (tmp_path / "broken.py").write_text("def f():\n    raise RuntimeError('not today')\nf()\n")
    (tmp_path / "exits.py").write_text("raise SystemExit('no licence')")
    monkeypatch.chdir(tmp_path)
    BAD_RUNS[message](run_dir)
    assert main(Args((one(runs, "TD3"), run_dir), episodes=1)) == 1
    out, err = capsys.readouterr()
    assert err.count("\n") == 1 and re.match(f"error: {run_dir}: .*{message}", err), err
    assert (", line " in err) == (", line " in message)  # only a user's own error has a place
    assert len(stored(one(runs, "TD3"))) == 1 and "TD3" in out and "PPO" not in out


# A downloaded folder of runs, with its own modules: where they lie in it, and the id in config.json
FOREIGN = {
    "in the run": ("runs/dl/{run}/evil.py", "runs.dl.{run}.evil:Mine-v0", "."),
    "a package": ("runs/dl/__init__.py", "runs.dl:Mine-v0", "."),
    "called from the run": ("runs/dl/{run}/evil.py", "evil:Mine-v0", "runs/dl/{run}"),
    "through a link": ("runs/dl/evil.py", "link.evil:Mine-v0", "."),
    "not even a late import": ("runs/dl/my_physics.py", "InvertedPendulum-v5", "runs/dl"),
}


@pytest.mark.parametrize("place", FOREIGN)
def test_no_module_is_imported_from_a_folder_of_runs(place, trained, tmp_path, monkeypatch, capsys):
    """As `python evaluate.py runs/dl` would, were it in this process's module path."""
    file, env_id, cwd = (text.replace("{run}", "run") for text in FOREIGN[place])
    shutil.copytree(one(trained, "PPO"), tmp_path / "runs/dl/run")
    (tmp_path / file).write_text("raise SystemExit('imported')")
    (tmp_path / "link").symlink_to("runs/dl")
    edit_args(tmp_path / "runs/dl/run", env_id=env_id)
    monkeypatch.chdir(tmp_path / cwd)
    monkeypatch.setattr(sys, "path", sys.path[:])
    if place == "not even a late import":
        main(Args((tmp_path / "runs/dl",), episodes=1))
        with pytest.raises(ImportError):
            importlib.import_module("my_physics")
        return
    assert main(Args((tmp_path / "runs/dl",), episodes=1)) == 2
    assert "in a folder of runs; if you trust that module, move it" in capsys.readouterr().err


def test_no_script_is_run_from_a_folder_of_runs(trained, tmp_path, monkeypatch, capsys):
    """Neither the one beside the runs, nor one that config.json names there."""
    run_dir = shutil.copytree(one(trained, "PPO"), tmp_path / "runs/dl/run")
    script = json.loads((run_dir / "config.json").read_text())["script"]
    for name in (script, "evil.py"):
        (tmp_path / "runs/dl" / name).write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path / "runs/dl")
    assert main(Args((run_dir,), episodes=1)) == 0
    monkeypatch.chdir(tmp_path)
    edit_config(run_dir, script="runs/dl/evil.py")
    assert main(Args((run_dir,), episodes=1)) == 2
    assert "its script runs/dl/evil.py is neither in the current" in capsys.readouterr().err


@pytest.mark.parametrize("options", [{"noises": ("evil:Sticky(0.1)",)}, {"env_id": "evil:Mine-v0"}])
def test_no_noise_is_imported_from_a_folder_of_runs(options, runs, run_dir, monkeypatch, capsys):
    """Nor another environment; a noise in config.json is not imported at all."""
    (runs / "evil.py").write_text("raise SystemExit('imported')")
    edit_args(run_dir, noise=["evil:Sticky(0.1)"], noise_rate=[0.5])
    monkeypatch.chdir(runs)
    monkeypatch.setattr(sys, "path", sys.path[:])
    refused(Args((run_dir,), **options), "in a folder of runs; if you trust", run_dir, capsys)
    assert main(Args((run_dir,), episodes=1)) == 0


def test_a_module_of_ones_own_is_imported(trained, tmp_path, monkeypatch):
    run_dir = tmp_path / "runs/run"
    shutil.copytree(one(trained, "PPO"), run_dir)
    use_own_environment(run_dir, tmp_path, "own", "pass")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    assert main(Args((run_dir,), episodes=1)) == 0
    assert len(stored(run_dir)) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noises": ("Nothing(1)",), "noise_rates": (1.0,)}, "unknown name"),
        ({"noises": (ACTION,), "noise_rates": ("1:0",)}, "constant rates"),
        ({"noise_rates": (0.5,)}, "--noise-rates without --noises"),
        ({"env_id": "Nowhere-v0"}, "there is no environment"),
        ({"noises": (f"{OBSERVATION[:-4]}(1, 2))",), "noise_rates": (1.0,)}, "has 2 numbers"),
        ({"episodes": 0}, "--episodes must be at least 1, not 0"),
        ({"seed": -1}, "--seed"),
        ({"render": True, "video": Path("v")}, "exclude each other"),
        ({"render": True}, "--render needs a display"),
        ({"runs": ()}, "name the runs"),
        ({"runs": (ROOT / "docs",)}, "is neither a run nor a folder of runs"),
        ({"video": Path("/proc/x/y")}, "--video: cannot write to /proc"),
    ],
)
def test_bad_arguments(runs, capsys, options, message, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    refused(Args(**({"runs": (runs,)} | options)), message, runs, capsys)


def test_runs_that_cannot_be_written_to_are_not_played(runs, run_dir, capsys, monkeypatch):
    monkeypatch.setattr(evaluate.os, "access", lambda path, mode: False)
    refused(Args((run_dir,)), "cannot be written to; with another --seed", runs, capsys)
    store_episodes(run_dir, CLEAN, np.zeros((3, 3)))
    assert main(Args((run_dir,), episodes=3)) == 0  # of what is stored there is a table


def test_what_fails_is_told_and_the_rest_is_kept(runs, tmp_path, monkeypatch, capsys):
    """An environment that exits, too, and fails under a noise alone."""
    first, second = sorted(runs.glob("*ppo_continuous_noisy*"))
    use_own_environment(first, tmp_path, "failing", "abs(action[0]) < 3 or sys.exit('too strong')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    noises = "RandomNormalNoisyAction(1e9)", OBSERVATION
    assert main(Args((first, second), noises, episodes=2)) == 1
    out, err = capsys.readouterr()
    told = rf"error: {re.escape(str(first))}: p1.0_Normal.*: SystemExit: too strong \(.*failing.py"
    assert re.match(told, err) and err.count("\n") == 1 and "failing" not in out
    assert [len(stored(run_dir)) for run_dir in (first, second)] == [4, 6]


@pytest.mark.slow
def test_a_process_that_is_killed_is_told_in_one_line(runs, tmp_path):
    first, second = sorted(runs.glob("*ppo_continuous_noisy*"))
    use_own_environment(first, tmp_path, "killed", "os.kill(os.getpid(), 9)")
    line = command(first, second, "--episodes", 1, "--jobs", 2)
    result = subprocess.run(line, capture_output=True, text=True, cwd=tmp_path)
    assert (result.returncode, result.stdout) == (1, "")
    # Lines of glfw may stand beside it: a helper of its import minds that its process is ended
    line = "^error: a process ended abruptly .* with fewer --jobs$"
    assert re.search(line, result.stderr, re.MULTILINE) and "evaluate.py" not in result.stderr


def test_a_copied_run_is_no_seed(runs, run_dir, capsys):
    shutil.copytree(run_dir, runs / "copy")
    main(Args((run_dir, runs / "copy"), episodes=1))
    told, *table = capsys.readouterr().out.splitlines()
    assert told == f"duplicate: {runs / 'copy'} is left out, because {run_dir} counts"
    assert re.split(r" {2,}", table[-1])[4] == "1"


def test_another_environment(runs, capsys):
    """Its tests stand beside those at home, and are not played again."""
    run_dir, home = one(runs, "PPO"), "InvertedPendulum-v5"
    main(Args((run_dir,), (OBSERVATION,), episodes=2))
    gym.register("Heavy-v0", gym.spec(home).entry_point, max_episode_steps=7)
    for _ in range(2):
        main(Args((run_dir,), (OBSERVATION,), env_id="Heavy-v0", episodes=2))
    assert f"{home}, tested in Heavy-v0" in capsys.readouterr().out.splitlines()[-1]
    rows = stored(run_dir)
    assert [row["environment"] for row in rows] == 4 * [""] + 4 * ["Heavy-v0"]
    assert all(int(row["episodic_length"]) <= 7 for row in rows[4:])
    # the own one, too, has not the training's arguments then
    edit_args(run_dir, env_kwargs=["reset_noise_scale:0.0"])
    main(Args((run_dir,), env_id=home, episodes=1))
    assert stored(run_dir)[-1]["environment"] == home
    scaled = lambda **options: gym.wrappers.RescaleAction(gym.make(home, **options), -1, 1)  # noqa: E731
    gym.register("Scaled-v0", scaled)
    capsys.readouterr()
    for env_id, what in (("Pendulum-v1", "observation"), ("Scaled-v0", "action")):
        refused(Args((run_dir,), env_id=env_id), f"its {what} space is Box", runs, capsys)


def refused(args, message, runs, capsys):
    """Exit status 2, an error, nothing played or written."""
    before = files(runs)
    try:
        code = main(args)
    except SystemExit as exit:
        code = exit.code
    out, err = capsys.readouterr()
    assert (code, out) == (2, "") and files(runs) == before
    assert re.match(f"error: .*{message}", err)
