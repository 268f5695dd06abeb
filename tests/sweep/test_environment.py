"""What a plan asks the environment: who can be trained in it, with which noise, and how fast."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from views import ROOT, finish, view

from noisy_wrappers import BASELINE
from sweep import environment
from sweep.environment import Environment, ask, run_seconds
from sweep.grid import make_run
from sweep.options import parse_args

SCALE = "RandomUniformScaleObservation(0.8, 1.2)"
LATE = "RandomEarlyTermination(50)"
KNOWN = Environment(0.001, 100, 3, True, {})


def choose(env, *words, view_name="dry-run"):
    return view(view_name, "choose", "--algos", "ppo", "--envs", f"toy_envs:{env}-v0", *words)


def planned(algorithm, env_id, *words):
    """Return the baseline of a grid with these options."""
    args = parse_args("list", "/", ["custom", *words])
    return make_run(args, algorithm, env_id, BASELINE, 1)


@pytest.fixture(autouse=True)
def short(monkeypatch, tmp_path):
    """Time environments for a moment, and keep answers away from the project."""
    monkeypatch.setattr(environment, "SECONDS", 0.01)
    monkeypatch.chdir(tmp_path)


# THE QUESTION


def test_how_long_a_step_and_an_episode_take():
    found = ask("toy_envs:Slow-v0")
    assert 0.005 < found.step_seconds < 1  # the machine may be busy
    assert (found.episode_steps, found.observed, found.bounded) == (100, 1, True)
    assert ask("toy_envs:Slow-v0", max_episode_steps=7).episode_steps == 7
    # without a time limit, tests are as long as the episodes that were timed
    assert ask("toy_envs:NoLimit-v0").episode_steps == 20
    assert ask("toy_envs:Endless-v0").episode_steps == 10_000


@pytest.mark.parametrize(
    ("env", "algos", "message"),
    [
        ("DiscreteAction", ["ppo"], "DiscreteAction-v0: needs Box actions of floats in one dim"),
        ("Unbounded", ["ppo", "sac"], "SAC needs bounded actions; some actions of toy_envs:Unb"),
        ("Buggy", ["ppo"], f"Buggy-v0: KeyError: 'missing' ({ROOT}/tests/toy_envs.py, line "),
        ("NanReward", ["ppo"], "NanReward-v0: "),
    ],
)
def test_what_cannot_be_trained_is_refused_in_a_line(env, algos, message, tmp_path):
    grid = ["--algos", *algos, "--envs", f"toy_envs:{env}-v0", "--runs-dir", tmp_path]
    for words in (["list", "choose"], ["dry-run", "custom", "--seeds", "1"]):
        shown = view(*words, *grid)
        *_, line = shown.err.splitlines()
        assert shown.code == 2 and line.startswith("error: ")
        assert message in line and shown.err.count("error: ") == 1 and not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["1 / 0", "def f(:", "raise SystemExit(3)"])
def test_a_module_that_cannot_be_imported_is_one_line(text, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "bad_envs.py").write_text(text)
    shown = view("list", "demo", "--envs", "bad_envs:Bad-v0")
    assert shown.code == 2 and re.fullmatch(r"error: --envs: .*bad_envs.py, line 1\)\n", shown.err)


def test_noises_that_cannot_act_are_left_out_or_refused(tmp_path):
    shown = choose("CategoryObservation", "--runs-dir", tmp_path)
    assert shown.code == 0 and shown.out.count("\n") == 8  # actions, delays at two rates and seeds
    left_out = rf"left out: {re.escape(SCALE)} \(.*needs observations of floats or integers"
    assert re.search(left_out, shown.err)
    assert f"left out: {LATE} (an episode has at most 8 steps)" in shown.err
    named = ["--noises", LATE, "RandomNormalNoisyReward(1.0)", "--noise-rates", "1"]
    said = f"error: --noises: these cannot act in toy_envs:Tiny-v0: {LATE} (an episode has at most "
    for limit, code in ("51", 0), ("50", 2):  # its last step ends the episode anyway
        words = ["--runs-dir", tmp_path, "--", "--max-episode-steps", limit]
        shown = choose("Tiny", *named, *words)
        assert shown.code == code and (said in shown.err) is bool(code)


def test_noise_on_rewards_that_take_few_values_is_left_out(tmp_path):
    """From the default list: who names it, or takes the paper's, wants it."""
    words = ["--runs-dir", tmp_path]  # every reward is 1.0
    shown = choose("Count", *words)
    assert "(rewards take only 1 value there)" in shown.err and "Reward(" not in shown.out
    assert "Reward(" not in choose("Count", *words, view_name="list").out
    assert "Reward(" not in choose("Count", *words, view_name="status").out  # which does not ask
    for named in ("paper", "RandomNormalNoisyReward(1)@1"):
        assert "Reward(" in choose("Count", *words, "--noises", named).out


@pytest.mark.slow
def test_what_a_module_prints_is_no_command(tmp_path):
    """Nor what its native code prints."""
    text = "import os\n\nprint('loaded')\nos.write(1, b'pybullet build time\\n')\n"
    (tmp_path / "native_envs.py").write_text(text)
    words = ["custom", "--algos", "ppo", "--envs", "native_envs:Hopper-v5", "--seeds", "1"]
    env = os.environ | {"PYTHONPATH": "/x", "PYTHON": sys.executable}
    command = [ROOT / "benchmark.sh", *words, "--runs-dir", "runs", "--dry-run"]
    shown = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert shown.returncode == 0 and "pybullet build time" in shown.stderr
    [command] = shown.stdout.splitlines()
    assert command.startswith(f"env PYTHONPATH=/x:{tmp_path} ")


# WHAT IT COSTS


def test_the_seconds_of_a_run():
    # 5,000 steps without learning; 20 tests of 10 episodes with 100 steps of 1 ms
    run = planned("sac", "toy_envs:Tiny-v0", "--total-timesteps", "200000")
    learning = 195_000 * (6.8e-3 + 3 * 22e-6)
    assert run_seconds(run, KNOWN) == pytest.approx(10 + learning + 200 + 20)
    words = ["--total-timesteps", "100000", "--", "--eval-frequency", "0", "--eval-episodes", "3"]
    run = planned("ppo", "toy_envs:Tiny-v0", *words)
    learning = 100_000 * (0.103e-3 + 3 * 0.2e-6)
    assert run_seconds(run, KNOWN) == pytest.approx(10 + learning + 100 + 0.3)


def test_any_dry_run_says_what_it_costs_and_finished_runs_tell_better(tmp_path):
    grid = ["baseline", "--algos", "ppo", "--envs", "toy_envs:Slow-v0", "--seeds", "1-3"]
    grid += ["--total-timesteps", "4000", "--runs-dir", tmp_path]
    shown = view("dry-run", *grid)
    assert shown.code == 0 and shown.out.count("\n") == 3
    speed, line = shown.err.splitlines()
    assert re.fullmatch(r"toy_envs:Slow-v0: [\d.]+ ms a step", speed)
    assert re.match(r"3 runs, 3 to do; about [\d.]+ min of processor time left$", line)
    assert view("list", *grid).err == "3 runs, 3 to do\n"
    first, second = (Path(line.split("\t")[0]) for line in shown.out.splitlines()[:2])
    finish(first, 4000, env_id="toy_envs:Slow-v0")
    result = json.loads((first / "result.json").read_text())
    result |= {"wall_time_seconds": 9000, "processor_seconds": 3600}  # on a busy machine
    (first / "result.json").write_text(json.dumps(result))
    assert "3 runs, 2 to do; about 2.0 h of processor time left" in view("dry-run", *grid).err
    finish(second, 4000, env_id="toy_envs:Slow-v0")  # it does not say how long it took
    assert "3 runs, 1 to do; about 1.0 h of processor" in view("dry-run", *grid).err
    # PPO's time tells nothing about TD3, which does not learn yet
    with_td3 = ["baseline", "--algos", "ppo", "td3", *grid[3:]]
    assert re.search(r"6 runs, 4 to do; about 1.[012] h", view("dry-run", *with_td3).err)


# THE MEMORY


def test_a_status_makes_no_environment(tmp_path, monkeypatch):
    """A dry run does, and says what the choice will decide and what it costs; it keeps nothing."""
    words = ["--runs-dir", tmp_path, "--noise-rates", "1"]
    assert "of 11 configurations" in choose("Tiny", *words, view_name="status").out
    said = choose("Tiny", *words).err
    assert "of 9 configurations" in said and not list(tmp_path.iterdir())
    assert re.search(r"at most \d+ runs, .*, about .* of processor time left\n", said)
    assert "25 fresh seeds confirm a true gain of 0.8 standard deviations" in said
    assert choose("Tiny", *words, view_name="list").code == 0
    monkeypatch.setattr(environment, "ask", None)
    shown = choose("Tiny", *words, view_name="status").out
    assert "9 of 9 configurations" in shown and "of processor time left" in shown


def test_another_choice_in_the_folder_changes_no_noises_of_the_first(tmp_path):
    first = ["--runs-dir", tmp_path, "--noise-rates", "1"]
    assert choose("Tiny", *first, view_name="list").code == 0
    other = ["--runs-dir", tmp_path, "--noises", f"{SCALE}@1"]
    assert choose("Tiny", *other, view_name="list").code == 0
    assert "9 of 9 configurations" in choose("Tiny", *first, view_name="status").out
    # what no earlier choice tried is tried, and one that cannot act is refused whoever asks again
    for _ in range(2):
        other[-1] = f"{LATE[:-1]}, 60)@1"
        shown = choose("Tiny", *other, view_name="list")
        assert shown.code == 2 and "60) (an episode has at most 8 steps)" in shown.err
