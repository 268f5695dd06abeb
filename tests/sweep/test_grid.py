"""The grid of a sweep, asked in this process: its runs, what counts as finished, bad input."""

import argparse
import csv
import functools
import itertools
import os
import re
import shlex
import subprocess
import sys
import time
from collections import Counter
from importlib import import_module
from pathlib import Path

import pytest
import stub_run
import tyro
from views import ROOT, finish, folders, locked, log_of, view

import noisy_wrappers
from analysis import logs, verdicts
from sweep import scripts
from sweep.grid import MOST_BASELINES

ALGORITHMS = {"sac": 5, "td3": 5, "ppo": 10}  # seeds
SCALE = "RandomUniformScaleReward(0.5, 1.5)"
A = "RandomNormalNoisyReward(1)"
KEYS = "RandomDropoutObservation(0.5,keys=('a','b'))"
JOINED = "RandomDropoutObservation(0.5,keys=('a-b',))"
BOX = (
    "╭─ Parsing error ─╮\n│ Argument --a: bad │\n│ ───── │\n│ For help, see │\n╰─────╯\n"  # of tyro
)
ENDING = "_continuous_noisy"
C = "choose --algos ppo --envs Hopper-v5"
GRID = ["--algos", "sac", "--envs", "Pendulum-v1", "--seeds", "1"]


@functools.cache
def dry_run(*args):
    """Return the grid's lines, each with its text and its options."""
    result = view("list", *args)
    assert result.code == 0, result.err
    lines = [line.split("\t") for line in result.out.splitlines()]
    assert result.err.startswith(f"{len(lines):,} run")
    parser, found = stub_run.parser(), []
    for folder, text in lines:
        given = argparse.Namespace(text=text, folder=folder)
        found.append(parser.parse_known_args(shlex.split(text)[1:], given)[0])
    return found


# THE RUNS


def test_paper_grid():
    lines = dry_run("paper")
    tables = (ROOT / "results" / "paper").glob("*.csv")
    rows = [row for path in tables for row in csv.DictReader(path.open())]
    noises = {row["noise_as_run"] for row in rows if "noise_as_run" in row}
    rates = ["0.01", "0.05", "0.1", "0.2", "0.5", "1.0"]
    expected = {
        (f"{algorithm}{ENDING}.py", f"{env}-v5", seed, noise)
        for algorithm, seeds in ALGORITHMS.items()
        for env in ("HalfCheetah", "Hopper", "Humanoid", "Pusher", "Walker2d")
        for seed in range(1, seeds + 1)
        for noise in [(), *itertools.product(noises, rates)]
    }
    found = {(x.script, x.env_id, x.seed, (*x.noise, *x.noise_rate)) for x in lines}
    assert found == expected and len(noises) == 15
    assert len(lines) == len({line.folder for line in lines}) == 9100
    assert {line.total_timesteps for line in lines} == {1_000_000}
    assert [line.seed for line in lines] == sorted(line.seed for line in lines)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_scripts_accept_every_line(algorithm):
    script = import_module(f"{algorithm}_continuous_noisy")
    lines = dry_run("paper", "--algos", algorithm, "--seeds", "1")
    assert len(lines) == 455
    lines = lines[::11]  # all noises, all rates, all environments
    assert len({tuple(line.noise) for line in lines}) == 16  # with the baseline
    for line in lines:
        args = tyro.cli(script.Args, args=shlex.split(line.text)[2:])
        assert list(args.noise) == line.noise
        assert [args.env_id, args.seed] == [line.env_id, 1]
        assert list(map(str, args.noise_rate)) == line.noise_rate


def test_other_presets():
    best = {(x.script[:3], x.env_id, *x.noise, *x.noise_rate) for x in dry_run("best")}
    with open(ROOT / "results" / "paper" / "best.csv") as file:
        for row in csv.DictReader(file):
            cell = (row["algorithm"].lower(), row["environment"].replace("-v2", "-v5"))
            best -= {cell, (*cell, row["noise_as_run"], str(float(row["noise_rate"])))}
    assert not best
    assert len(dry_run("best")) == 2 * len(dry_run("baseline")) == 200
    ablation = dry_run("ablation")
    assert len(ablation) == 5 * 10 * (1 + 5 + 5)
    for line in ablation:
        if line.noise:
            name, low, high = re.fullmatch(r"(\w+)\((.+), (.+)\)", *line.noise).groups()
            scale = name == "RandomUniformScaleReward"
            assert float(low) == pytest.approx(2 - float(high) if scale else -float(high))
            assert line.noise_rate == (["0.05"] if scale else ["1.0"])
    demo = {(x.script[:3], x.env_id, x.runs_dir, x.total_timesteps) for x in dry_run("demo")}
    assert demo == {("ppo", "InvertedPendulum-v5", "runs/demo", 20_480)}
    assert {x.noise[0] for x in dry_run("demo") if x.noise} == {"RandomNormalNoisyObservation(1.0)"}


def test_folders_that_need_care(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    home = view("list", "demo", "--runs-dir=~/my runs").out
    assert f"--runs-dir '{tmp_path}/my runs'" in home
    assert view("list", "demo", "--runs-dir", ".").out.startswith("./baseline_s1__")
    inside = view("list", "demo", caller=ROOT / "docs").out
    assert " --runs-dir docs/runs/demo " in inside


def test_spellings_and_rate_zero_are_one_run():
    noises = ["RandomUniformScaleReward(.5, 1.5)", "RandomUniformScaleReward(0.50, high=1.5)"]
    grid = ["--algos=SAC", "--envs", "Hopper-v5", "Hopper-v5", "--seeds", "3", "3", "--seeds", "4"]
    lines = dry_run("custom", *grid, "--noises", *noises, "--noise-rates", "0.10", "0", ".1")
    expected = [(seed, noise) for seed in (3, 4) for noise in ([], [SCALE])]
    assert [(line.seed, line.noise) for line in lines] == expected


def test_rates_of_ones_own():
    cells = ["--noises", f"{A}@0.1+RandomEarlyTermination(50)@1:0", "RandomDropoutObservation(0.9)"]
    cells += ["--noise-rates", "0.5", "1.0:0", "--baseline-seeds", "1"]
    lines = dry_run("custom", *GRID, *cells)
    both = ["RandomEarlyTermination(50)", "RandomNormalNoisyReward(1.0)"]
    drop = ["RandomDropoutObservation(0.9)"]
    assert [(line.noise, line.noise_rate) for line in lines] == [
        ([], []),
        (both, ["1.0:0.0", "0.1"]),
        (drop, ["0.5"]),
        (drop, ["1.0:0.0"]),
    ]
    assert {x.total_timesteps for x in dry_run("demo", "--total-timesteps", "2.5e3")} == {2500}


# FINISHED RUNS


def test_states_and_what_is_left(tmp_path, monkeypatch):
    """Running is what holds the lock, which is only asked for: to take it would end the run."""
    monkeypatch.delattr(logs.fcntl, "lockf")
    grid = ["baseline", "--algos", "sac", "--envs", "Hopper-v5", "--seeds", "1-9"]
    grid += ["--total-timesteps", "1000", "--runs-dir", tmp_path]
    done, running, silent, elsewhere, future, failed, stopped, lost, deleted = folders(*grid)
    (tmp_path / "logs").mkdir()
    finish(done)
    for folder, age, text in (  # age: of the log, in minutes
        (done, 1, "step=1000/1000 sps=200 eval_return=1.0\n# now host: exit=0\n"),
        (running, 1, "step=100/1000 sps=100\nstep=200/1000 sps=100 eta=0:00:08\n"),
        (silent, 14, "step=500/1000 sps=100\ncompiling\n"),
        (elsewhere, 1, "step=200/1000 sps=10 eta=0:01:20\n"),
        (future, -999, "step=500/1000 sps=100\n"),  # another machine's clock is wrong
        (failed, 1, f"step=600/1000 sps=100\n{BOX}# now host: exit=1\n"),
        (stopped, 1, "step=500/1000 sps=100\n# now host: exit=143\n"),
        (lost, 5, "step=500/1000 sps=100\n"),
        (deleted, 1, "step=1000/1000 sps=100\n# now host: exit=0\n"),
    ):
        log_of(folder).write_text(f"# now host: python sac_continuous_noisy.py\n{text}")
        os.utime(log_of(folder), (time.time() - 60 * age,) * 2)
    with locked(running), locked(silent):
        status, report = view("status", *grid), view("report", *grid).out
    # 800 + 500 + 800 + 500 + 400 + 500 + 500 + 1000 steps are left. At 200, 10 and seven times 100
    # steps per second the mean time of a step is 0.175 / 9 seconds; three run at a time: 32.4 s.
    state = "9 runs: 1 done, 2 running, 1 probably running, 1 failed, 4 to do; "
    state += "4,000 of 9,000 steps; about 32 s left, 210 steps/s"
    assert status.code == 0 and state in status.out
    assert re.search(rf"exit 1 +{log_of(failed)} +Argument --a: bad\n", status.out)
    assert re.search(rf"silent for 14 min +{log_of(silent)} +compiling", status.out)
    assert "2 running, 1 failed, 5 to do" in report and report.count("still running") == 2
    assert not (lost / ".lock").exists()


@pytest.fixture
def one(tmp_path):
    """A grid of one run, and its folder."""
    grid = ["baseline", *GRID, "--total-timesteps", "1000", "--runs-dir", tmp_path]
    [folder] = folders(*grid)
    return grid, folder


@pytest.mark.parametrize(
    ("made", "words", "said"),
    [
        ({"steps": 20}, "", "--total-timesteps 20, not 1000"),
        ({"env_id": "Pendulum/v1"}, "", "--env-id Pendulum/v1, not Pendulum-v1"),  # one folder
        ({"gamma": 0.99}, "--gamma 0.5", "--gamma 0.99, not 0.5"),
        ({"learning_starts": 10}, "", "--learning-starts 10, not 5000"),  # an option of today's
        ({}, "--tau 0.1", "--tau 0.005, not 0.1"),  # an option that the run did not have
        ({"max_episode_steps": 50}, "--max-episode-steps None", "--max-episode-steps 50, not None"),
    ],
)
def test_a_run_with_other_arguments_is_not_done(made, words, said, one):
    """It is counted before anything starts, and shown; a result is not needed for that."""
    grid, folder = one
    finish(folder, **{"env_id": "Pendulum-v1", "exp_name": "sac_continuous_noisy"} | made)
    words = ["--", *words.split()] if words else []
    for _ in range(2):
        refused = view("list", *grid, *words)
        assert (refused.code, refused.out, refused.err.count("\n")) == (2, "", 1), refused.err
        assert f"1 run was made in {folder.parent} with other arguments: {said}" in refused.err
        assert folder.name in refused.err and "another --exp-name" in refused.err
        status = view("status", *grid, *words)
        assert status.code == 0 and "0 done, 0 running, 0 failed, 1 to do" in status.out
        assert said in status.out
        (folder / "result.json").unlink(missing_ok=True)
    named = view("list", *grid, "--", *words[1:], "--exp-name", "other")
    assert named.code == 0 and "/baseline_s1__Pendulum-v1__other\t" in named.out


def test_a_run_with_the_same_arguments_is_done(one):
    grid, folder = one
    made = {"env_id": "Pendulum-v1", "exp_name": "sac_continuous_noisy", "gamma": 0.99, "gone": 1}
    finish(folder, **made, torch_threads=8, compile=False, learning_starts=5000, hidden=[64, 64])
    for words in ("", "--gamma .990", "--learning_starts=5_000 --no-compile --torch-threads 2"):
        shown = view("report", *grid, "--", *words.split())
        assert shown.code == 0 and "1 run: 1 done" in shown.out, shown.out + shown.err


def test_runs_of_another_text_of_the_script_are_counted(one):
    grid, folder = one
    text = scripts.find("sac", ROOT).sha256
    for sha256, said in ((text, 0), ("ab", 1), (f"ab, {text}", 1)):
        more = {"script": "sac_continuous_noisy.py", "script_sha256": sha256}
        finish(folder, more=more, env_id="Pendulum-v1")
        listed, status = view("dry-run", *grid), view("status", *grid)
        whole, report = view("status", "--runs-dir", folder.parent), view("report", *grid)
        assert listed.code == 0 and "0 to do" in listed.err and "1 done" in status.out
        for shown in (listed.err, status.out, whole.out, report.out):
            assert shown.count("1 run was made") == said == shown.count("another text of sac_con")


def test_runs_of_two_releases_are_two_studies(tmp_path):
    grid = ["baseline", *GRID[:-1], "1-2", "--total-timesteps", "1000", "--runs-dir", tmp_path]
    old, new = folders(*grid)
    finish(old, more={"versions": {}}, env_id="Pendulum-v1")
    refused = view("list", *grid)
    assert refused.code == 2 and not refused.out and "by release 0.3" in refused.err
    assert "Finish them with 0.3, or give this sweep another --exp-name" in refused.err
    assert "by release 0.3" in view("status", *grid).out
    finish(new, more={"versions": {}}, env_id="Pendulum-v1", seed=2)
    both = view("dry-run", *grid)  # it is finished: all are of one study
    assert both.code == 0 and "2 runs were made" in both.err and "0 to do" in both.err


# THE SCRIPTS

OWN = '''"""A script of somebody's own."""
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass
class Args:
    """Arguments."""

    env_id: str = "Hopper-v5"
    exp_name: str = Path(__file__).stem
    label: str = "plain"
    """A docstring below an option."""
    hidden: tuple[int, ...] = (64, 2 * 32)
    entropy: float = -math.log(2)
    shift: float = -0.5
    data: Path = Path("x")
    width: int | None = None
    kind: Literal["a", "b"] = "a"
    layer_norm: bool = False
'''


@pytest.fixture
def elsewhere(tmp_path):
    """A folder of the caller's with a script of its own."""
    (tmp_path / "redq_continuous_noisy.py").write_text(OWN)
    return tmp_path


def test_an_algorithm_is_a_script_of_the_project_or_of_the_callers_folder(elsewhere):
    rest = ["--envs", "Pendulum-v1", "--seeds", "1", "--runs-dir", "r"]

    def listed(*algos):
        return view("list", "baseline", "--algos", *algos, *rest, caller=elsewhere)

    found = listed("redq", "sac")
    lines = dict(line.split("\t") for line in found.out.splitlines())
    assert found.code == 0 and len(lines) == 2
    [own] = [command for folder, command in lines.items() if folder.endswith("__redq" + ENDING)]
    path = elsewhere / "redq_continuous_noisy.py"
    assert own.startswith(f"env PYTHONPATH={ROOT} {sys.executable} {path} --env-id ")
    assert sum("PYTHONPATH" in command for command in lines.values()) == 1
    unknown = listed("dqn")
    assert f"no dqn_continuous_noisy.py in {ROOT} or {elsewhere}" in unknown.err
    assert unknown.code == 2 and unknown.err.endswith("; choose from ppo, redq, sac, td3\n")
    (elsewhere / "sac_continuous_noisy.py").write_text(OWN)  # which one is meant?
    (elsewhere / "bad_continuous_noisy.py").write_text("class Args(:")
    (elsewhere / "gone_continuous_noisy.py").symlink_to("nowhere")
    scripts.scripts_in.cache_clear()
    both = listed("sac")
    assert both.code == 2 and "differ: give one of them another name" in both.err
    assert all(f"{name}_continuous_noisy.py: " in listed(name).err for name in ("bad", "gone"))


@pytest.mark.parametrize(
    ("words", "made"),
    [
        ("--label text-1 --hidden 32 32", {"label": "text-1", "hidden": [32, 32]}),
        ("--entropy -1e-3 --shift=-2", {"entropy": -0.001, "shift": -2.0}),
        ("--data /a/b.txt --width 1_000", {"data": "/a/b.txt", "width": 1_000}),
        ("--data /a//b/", {"data": "/a/b"}),
        ("--width None --kind b", {"width": None, "kind": "b"}),
        ("--layer_norm --no-layer_norm", {"layer_norm": False}),
    ],
)
def test_options_are_the_scripts_own_business(words, made, elsewhere, tmp_path):
    """Values of any kind pass, and are compared with what the run has stored."""
    grid = ["baseline", "--algos", "redq", *GRID[2:], "--total-timesteps", "9"]
    grid += ["--runs-dir", tmp_path]
    listed = view("list", *grid, "--", *words.split(), caller=elsewhere)
    [folder, command] = listed.out.rstrip().split("\t")
    passed = shlex.split(command)[shlex.split(command).index(str(tmp_path)) + 1 :]
    assert passed == words.replace("--layer_norm --no-layer_", "--layer-norm --no-layer-").split()
    defaults = {"label": "plain", "hidden": [64, 64], "entropy": -0.69, "shift": -0.5, "data": "x"}
    defaults |= {"width": None, "kind": "a", "layer_norm": False, "eval_episodes": 10}
    args = {"env_id": "Pendulum-v1", "exp_name": "redq_continuous_noisy"} | defaults
    more = {"algorithm": "REDQ", "script": "redq_continuous_noisy.py", "defaults": defaults}
    finish(Path(folder), 9, more, **args | made)
    assert "0 to do" in view("list", *grid, "--", *words.split(), caller=elsewhere).err
    plain = view("list", *grid, caller=elsewhere)  # without the options
    same = defaults | made == defaults
    assert (plain.code == 0) is same and ("other arguments" in plain.err) is not same


def test_the_noise_of_tests_is_part_of_a_runs_name(tmp_path):
    """However it is spelt."""
    grid = ["baseline", *GRID, "--total-timesteps", "9", "--runs-dir", tmp_path, "--"]
    grid += ["--test-noise", "RandomNormalNoisyAction(.10)", "--test-noise-rate", "0.50"]
    [folder] = folders(*grid)
    assert folder.name.endswith("__tests_p0.5_NormalNoisyAction_0.1")
    stored = {"test_noise": ["RandomNormalNoisyAction(0.1)"], "test_noise_rate": [0.5]}
    finish(folder, 9, env_id="Pendulum-v1", exp_name="sac_continuous_noisy", **stored)
    assert "1 run, 0 to do" in view("list", *grid).err
    [folder] = folders(*grid[:-2])  # the rate is 1 if none is given
    assert folder.name.endswith("__tests_p1.0_NormalNoisyAction_0.1")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_what_a_source_tells_is_what_tyro_reads(algorithm):
    script = scripts.find(algorithm, ROOT)
    args = import_module(f"{algorithm}_continuous_noisy").Args
    defaults = {name: getattr(args(), name) for name in args.__dataclass_fields__}
    compared = {name: value for name, value in defaults.items() if name != "exp_name"}
    assert script.defaults == compared
    for words in (
        "--gamma 0.5 --eval_episodes=3 --no-compile --matmul_precision medium",
        "--eval-frequency None",
        "--gamma=.5 --gamma 1 --cuda --no_overwrite --max-episode-steps 1_000",
    ):
        given, command = scripts.read_words(script, words.split())
        read = vars(tyro.cli(args, args=command))
        assert all(scripts.is_same(read[name], given[name]) for name in given)
        assert {name for name in read if read[name] != defaults[name]} <= given.keys()


# HOW MANY RUNS


@pytest.mark.parametrize(
    ("noises", "more", "baselines"),
    [
        (1, "", [1, 2, 3]),
        (3, "", [1, 2, 3, 4, 5, 6]),  # 3 * sqrt(3) = 5.2
        (12, "", list(range(1, 8))),  # 3 * sqrt(12) = 10.4, and at most 2.6 times as many
        (3, "--baseline-seeds 2 7-8", [2, 7, 8]),
    ],
)
def test_baselines_that_pay(noises, more, baselines):
    cells = [f"RandomNormalNoisyReward({i + 1})@0.1" for i in range(noises)]
    grid = ["custom", *GRID[:-1], "1-3", "--noises", *cells, *more.split()]
    lines = dry_run(*grid)
    assert [line.seed for line in lines if not line.noise] == baselines
    assert Counter(line.seed for line in lines if line.noise) == dict.fromkeys([1, 2, 3], noises)
    assert MOST_BASELINES == verdicts.MOST_RATIO  # above which the analysis warns
    said = f"{len(lines)} runs ({len(baselines)} of them without noise)"
    assert view("list", *grid).err == f"{said}, {len(lines)} to do\n"


# BAD INPUT


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("custom --noises Foo(1) --noise-rates 1", "bad noise 'Foo(1)': unknown name; valid are"),
        (f"custom --noises {A}", "--noises needs --noise-rates, or a rate with each"),
        ("custom --noise-rates 1", "--noise-rates needs --noises that have no rate of their own"),
        (f"custom --noises {A}@1+{A}", "give each of these noises a rate with @, or none"),
        (f"custom --noises {KEYS} {JOINED} --noise-rates 1", "would have the same folders: try"),
        ("paper --budget 5", "--budget is an option of choose"),
        (f"{C} --seeds 1-3", "leave out --seeds"),
        (f"{C} --noises paper --budget 89", "--budget must be at least 90, a run for each"),
        (f"{C} --budget 100000", "--budget 100000 is too large: the best would run with"),
        (f"{C} Pusher-v5 --confirm 4", "--confirm must be at least 5, not 4: "),
        (f"{C} --exclude {A}@0.3", "--exclude: RandomNormalNoisyReward(1.0) at 0.3 is not among"),
        (f"{C} --exclude {A}", '--exclude needs a rate with each noise, as in "NOISE@0.1"'),
        ("demo --envs nope:Env-v0", "--envs: there is no environment 'nope:Env-v0': No module"),
        ("demo --seeds 1 2-1", "--seeds: takes numbers and ranges"),
        ("demo --algos sac", "demo has options of PPO: for another algorithm use custom"),
        ("demo -- --exp-name a\tb", "'a\\tb': a command is one line, so its words have no tabs"),
        ("demo --seeds 1-99999999999", "'1-99999999999' is more than 100,000 seeds"),
        (f"{C} --looks 13", "--looks must be from 1 to half of --confirm, not 13"),
        ("best -- --exp-name mine", "--exp-name: several algorithms would write into the same"),
        ("demo --env-id Hopper-v5", "at the end, after --); did you mean --envs?"),
        ("demo --runs-dir=-x", "--runs-dir must be a path"),
        ("demo --runs-dir caf\udce9", r"b'caf\xe9' is not valid UTF-8"),
        ("--algos sac demo", "a preset comes before --algos: one of demo"),
        ("demo -- --overwrite", "--overwrite would start interrupted runs afresh"),
        ("demo -- --gama 0.9", "has no option --gama; did you mean --gamma?"),
        ("paper -- 0.9", "has no option 0.9; "),
        ("demo --total-timesteps 0", "--total-timesteps must be at least 1, not 0"),
        ("demo -- --seed 2", "--seed is part of the grid: use --seeds, before the --"),
        ("best --algos sac ppo -- --tau 0.1", "ppo_continuous_noisy.py has no option --tau"),
    ],
)
def test_bad_input(args, message, tmp_path):
    first, *words = args.split(" ")
    result = view("list", first, "--runs-dir", tmp_path / "runs", *words)
    assert result.code == 2, result.out + result.err
    lines = [line for line in result.err.splitlines() if not line.endswith(" ms a step")]
    assert lines[0].startswith("error: ") and message in lines[0]
    assert len(lines) == (1 + len(noisy_wrappers.WRAPPERS) if "bad noise" in message else 1)
    assert not result.out and not list(tmp_path.iterdir())


def test_a_status_with_grid_options_needs_the_preset():
    """Without one it would count a grid that nobody ran."""
    for words in (["--envs", "Hopper-v5"], ["--", "--gamma", "0.9"]):
        assert "./benchmark.sh status PRESET ..." in view("status", *words).err


def test_a_list_of_runs_waits_for_no_heavy_import(monkeypatch):
    """status, watch and the dry run of 9,100 commands answer in a moment."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)  # which is checked by importing MuJoCo
    code = "import sys; from sweep.__main__ import main; main('list', '/', ['demo']); "
    command = [sys.executable, "-c", f"{code}print(*sys.modules)"]
    shown = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert not {"torch", "scipy", "pandas", "mujoco"} & set(shown.stdout.split())
