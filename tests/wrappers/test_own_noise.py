"""Noises of one's own: the docstring's, from a folder of its own, through all commands."""

import csv
import json
import os
import re
import shlex
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from cases import GenericEnv, named
from commands import ROOT, run
from gymnasium.utils.env_checker import check_env

from noisy_wrappers import Configuration, EnvState, ObservationNoise, RewardNoise, parse_noise

TEXT = "my_noises:StickyAction(3)"
PAGE = (ROOT / "docs" / "wrappers.md").read_text()
[MODULE] = [code for code in re.findall(r"```python\n(.*?)```", PAGE, re.S) if "StickyAct" in code]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with my_noises.py, in which Python is started."""
    (tmp_path / "my_noises.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "my_noises", raising=False)
    yield tmp_path
    sys.modules.pop("my_noises", None)


@pytest.mark.filterwarnings("ignore:.*WARN")
def test_it_is_a_wrapper_like_the_others(folder):
    assert str(parse_noise("my_noises:StickyAction(longest=3)")) == TEXT
    config = Configuration.read([TEXT, "RandomEarlyTermination(9)"], ["1:0"])
    assert config.texts[0] == ["RandomEarlyTermination(9)", TEXT]  # an action noise
    assert Configuration.parse(*config.columns) == config
    assert named([TEXT], [0.5]) == "p0.5_s1_my_noises--StickyAction_3__E__x"
    env = config.wrap(gym.make("Pendulum-v1"))
    check_env(env, skip_render_check=True)
    assert env.spec.make().spec == env.spec


BAD = """
class Other: pass

class Strict(NoiseWrapper):
    kind = "action"
    def __init__(self, env, noise_rate, x):
        raise ValueError("x is bad")

class Vague(NoiseWrapper): pass

class Degrees(StickyAction):
    def __init__(self, env, noise_rate, longest):
        super().__init__(env, noise_rate, longest / 2)
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no_such:A(1)", "No module named 'no_such'"),
        ("my_noises:Other(1)", "my_noises has no subclass Other of noisy_wrappers.NoiseWrapper"),
        ("my_noises:StickyAction()", "missing a required argument: 'longest'"),
        ("my_noises:Strict(1)", "x is bad"),
        ("my_noises:Vague(1)", "Vague.kind must be one of"),
        ("my_noises:Degrees(90)", "pass them on as they came; my_noises:Degrees(45.0) would"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(folder, text, message):
    (folder / "my_noises.py").write_text(MODULE + BAD)
    with pytest.raises(ValueError) as error:
        parse_noise(text)
    assert str(error.value).startswith(f"bad noise {text!r}: ") and message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_sweep_and_a_test_from_the_folder_of_the_noise(folder):
    def succeed(path, *words):
        done = run(path, words, cwd=folder)
        assert done.code == 0, done.out + done.err

    sweep = "custom --algos ppo --envs InvertedPendulum-v5 --seeds 1 --total-timesteps 512"
    sweep = [*sweep.split(), "--runs-dir", "runs", "--noises", TEXT, "--noise-rates", "0.5"]
    small = ["--dry-run", "--", "--no-compile", "--num-steps", "256", "--eval-episodes", "2"]
    env = os.environ | {"PYTHON": sys.executable}
    words = [ROOT / "benchmark.sh", *sweep, *small]
    shown = subprocess.check_output(words, cwd=folder, env=env, text=True)
    for line in shown.splitlines():
        before, _, options = line.partition("ppo_continuous_noisy.py")
        assert "PYTHONPATH=" in before and str(folder) in before
        succeed(ROOT / "ppo_continuous_noisy.py", *shlex.split(options))
    [noisy] = folder.glob("runs/p0.5_s1_my_noises--StickyAction_3__*/result.json")
    applied, of = json.loads(noisy.read_text())["noise_applied"]["StickyAction"]
    assert 0 < applied < 0.6 * of
    assert len([*folder.glob("runs/*/result.json")]) == 2
    test = ["--noises", TEXT, "--noise-rates", "1", "--episodes", "2"]
    succeed(ROOT / "evaluate.py", "runs", *test)
    (folder / "my_noises.py").unlink()
    succeed(ROOT / "analyze.py")  # reads runs without their noise
    tables = (folder / "runs/results/robustness.csv", folder / "runs/results/summary_PPO.csv")
    assert all(TEXT in table.read_text() for table in tables)
    rows = list(csv.DictReader((noisy.parent / "robustness.csv").open()))
    assert {row["noise"] for row in rows} == {"", TEXT}
    assert np.isfinite([float(row["episodic_return"]) for row in rows]).all()


class Shift(ObservationNoise):
    """Defines nothing but what docs/wrappers.md says."""

    def __init__(self, env, noise_rate, by):
        super().__init__(env, noise_rate, by=by)
        self.by = by

    def _perturb(self, observation):
        return observation + self.by


@pytest.mark.filterwarnings("ignore:.*WARN")
def test_noise_on_observations_stays_within_its_space_and_can_be_made_again():
    env = Shift(gym.make("Pendulum-v1"), 1.0, 5.0)
    check_env(env, skip_render_check=True)
    assert gym.make(env.spec).by == 5.0


class Walk(RewardNoise):
    """Has a generator of its own, which is resumed by itself, and a state, which is not."""

    def __init__(self, env, noise_rate):
        super().__init__(env, noise_rate)
        self.generator, self.at = np.random.default_rng(7), np.zeros(1)

    def _perturb(self, reward):
        self.at = self.at + self.generator.normal(size=1)
        return reward + self.at.item()

    def state_dict(self):
        return {**super().state_dict(), "at": self.at}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.at = np.array(state["at"])


def test_a_noise_with_a_state_of_its_own_resumes():
    env, resumed = Walk(GenericEnv(), 1.0), Walk(GenericEnv(), 1.0)
    env.reset(seed=1)
    env.step(0)
    saved = json.loads(json.dumps(EnvState(env).state_dict()))
    resumed.reset(seed=1)
    EnvState(resumed).load_state_dict(saved)
    env.reset()
    resumed.reset()
    assert env.step(0)[1] == resumed.step(0)[1]
