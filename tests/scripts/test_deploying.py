"""docs/deploying.md is right: its code runs, and plays every policy as load_policy does."""

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "deploying.md"
SMALL = {
    "sac": {"learning_starts": 100, "batch_size": 32, "buffer_size": 1000},
    "td3": {"learning_starts": 100, "batch_size": 32, "buffer_size": 1000},
    "ppo": {"num_steps": 100, "num_minibatches": 4},
}


class Sensors(gym.Env):
    """A dictionary within a dictionary; actions with bounds of their own."""

    arm = Dict({"speed": Box(-np.inf, np.inf, (2,)), "angle": Box(-3, 3, (1,))})
    observation_space = Dict({"mode": Discrete(3), "camera": Box(0, 1, (2, 2)), "arm": arm})
    action_space = Box(np.float32([-1, -0.5]), np.float32([2, 0.7]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observe(), {}

    def observe(self):
        arm = {"speed": self.np_random.normal(0, 5, 2).astype(np.float32)}
        arm["angle"] = self.np_random.uniform(-3, 3, 1).astype(np.float32)
        camera = self.np_random.uniform(0, 1, (2, 2)).astype(np.float32)
        return {"mode": self.np_random.integers(3), "camera": camera, "arm": arm}

    def step(self, action):
        ended = bool(self.np_random.random() < 0.1)
        return self.observe(), float(action.sum()), ended, False, {}


class HalfBounded(Sensors):
    """One action is bounded on one side only; for PPO."""

    action_space = Box(np.float32([-np.inf, -0.01]), np.float32([0.01, np.inf]))


for environment in (Sensors, HalfBounded):
    gym.register(f"{environment.__name__}-v0", environment, max_episode_steps=20)


def train(algorithm, env_id, runs_dir):
    """Train for a moment; return the script and the run's folder."""
    script = importlib.import_module(f"{algorithm}_continuous_noisy")
    args = {"env_id": env_id, "total_timesteps": 200, "eval_episodes": 1, "compile": False}
    args |= {"eval_frequency": 0, "runs_dir": str(runs_dir)}
    assert script.train(script.Args(**args, **SMALL[algorithm]))
    [run_dir] = Path(runs_dir).iterdir()
    return script, run_dir


def test_config_json_tells_the_order_of_a_dictionary(tmp_path):
    script, run_dir = train("ppo", "Sensors-v0", tmp_path)
    config = json.loads((run_dir / "config.json").read_text())
    keys = [["arm.angle", 1], ["arm.speed", 2], ["camera", 4], ["mode", 3]]
    assert config["observation_keys"] == keys
    assert config["observation_space"]["shape"] == [10]
    observation, _ = gym.make("Sensors-v0").reset(seed=0)
    parts = [observation["arm"]["angle"], observation["arm"]["speed"], observation["camera"]]
    parts += [np.eye(3)[observation["mode"]]]
    got, _ = script.make_env("Sensors-v0").reset(seed=0)
    np.testing.assert_array_equal(got, np.concatenate(parts, axis=None))


def follow_page(algorithm, env_id, folder):
    """Do what the page says, but for ONNX; return its names and 50 observations."""
    script, run_dir = train(algorithm, env_id, folder / "runs")
    page = PAGE.read_text().replace("sac_continuous_noisy", f"{algorithm}_continuous_noisy")
    load, save, play, *onnx = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(onnx) == 2
    names = {"onnx": onnx[algorithm == "ppo"]}
    shutil.copy(run_dir / "config.json", folder)
    for block in (load, save, play):
        exec(block.replace("Pendulum-v1", env_id), names)
    assert folder / names["run_dir"] == run_dir
    env = script.make_env(env_id)
    return names, [env.reset(seed=0)[0], *(env.reset()[0] for _ in range(49))]


@pytest.mark.parametrize(
    ("algorithm", "env_id"),
    [
        pytest.param("sac", "Sensors-v0", marks=pytest.mark.slow),
        pytest.param("td3", "Sensors-v0", marks=pytest.mark.slow),
        ("ppo", "HalfBounded-v0"),
    ],
)
def test_numpy_alone_plays_a_policy(algorithm, env_id, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names, observations = follow_page(algorithm, env_id, tmp_path)
    actions = np.array([names["policy"](observation) for observation in observations])
    played = np.array([names["act"](observation) for observation in observations])
    np.testing.assert_allclose(played, actions, rtol=0, atol=1e-5)
    assert played.dtype == actions.dtype
    assert (np.ptp(actions, 0) > 1e-3).all()  # or this shows less than it seems to
    with mock.patch("torch.onnx.export") as export:
        exec(names["onnx"], names)
    network, inputs = export.call_args.args[:2]
    with torch.no_grad():
        result = network(*inputs)
    if algorithm == "ppo":
        mean = result[0].numpy().clip(names["low"], names["high"])  # of normalized observations
        at_zero = names["saved"]["observation_stats"]["mean"]
    else:
        actions = result[0] if isinstance(result, tuple) else result  # SAC's first output
        mean, at_zero = actions[0].numpy(), np.zeros(len(observations[0]))
    np.testing.assert_allclose(names["policy"](at_zero), mean, rtol=0, atol=1e-5)
    if env_id == "HalfBounded-v0":
        assert names["low"].tolist() == [-np.inf, np.float32(-0.01)]
        assert (actions[:, 0] == np.float32(0.01)).any()  # and it is clipped there


@pytest.mark.slow
def test_a_policy_of_a_gpu_needs_no_gpu_no_environment_and_no_tyro(tmp_path):
    code, expected = "import sys, numpy\n", []
    on_gpu = mock.patch("torch.serialization.location_tag", return_value="cuda:0")
    for algorithm in SMALL:
        with on_gpu:  # this is what a file of a GPU says of its tensors
            script, run_dir = train(algorithm, "Sensors-v0", tmp_path / algorithm)
        code += f"from {script.__name__} import load_policy\n"
        code += f"print(load_policy({str(run_dir)!r})(numpy.ones(10)).tolist())\n"
        expected.append(f"{script.load_policy(run_dir)(np.ones(10)).tolist()}\n")
    code += "print({'tyro', 'mujoco', 'pandas'} & {*sys.modules})"
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True
    )
    assert (result.stdout, result.returncode) == ("".join(expected) + "set()\n", 0), result.stderr
