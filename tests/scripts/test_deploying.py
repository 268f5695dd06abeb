"""docs/deploying.md is right: its code runs, and plays every policy as load_policy does."""

import json
import os
import re
import shutil
import subprocess
import sys
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from small_runs import ROOT, SCRIPTS, run, slow

import ppo_continuous_noisy as ppo

PAGE = ROOT / "docs" / "deploying.md"


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


def test_config_json_tells_the_order_of_a_dictionary(tmp_path):
    run_dir = run("PPO", tmp_path, env_id="Sensors-v0")
    config = json.loads((run_dir / "config.json").read_text())
    keys = [["arm.angle", 1], ["arm.speed", 2], ["camera", 4], ["mode", 3]]
    assert config["observation_keys"] == keys
    assert config["observation_space"]["shape"] == [10]
    observation, _ = gym.make("Sensors-v0").reset(seed=0)
    parts = [observation["arm"]["angle"], observation["arm"]["speed"], observation["camera"]]
    parts += [np.eye(3)[observation["mode"]]]
    got, _ = ppo.make_env("Sensors-v0").reset(seed=0)
    np.testing.assert_array_equal(got, np.concatenate(parts, axis=None))


def follow_page(algorithm, env_id, folder):
    """Do what the page says, but for ONNX; return its names and 50 observations."""
    run_dir = run(algorithm, folder / "runs", env_id=env_id)
    name = f"{algorithm.lower()}_continuous_noisy"
    page = PAGE.read_text().replace("sac_continuous_noisy", name)
    load, save, play, *onnx = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(onnx) == 2
    names = {"onnx": onnx[algorithm == "PPO"]}
    shutil.copy(run_dir / "config.json", folder)
    for block in (load, save, play):
        exec(block.replace("Pendulum-v1", env_id), names)
    assert folder / names["run_dir"] == run_dir
    env = SCRIPTS[algorithm].make_env(env_id)
    return names, [env.reset(seed=0)[0], *(env.reset()[0] for _ in range(49))]


@pytest.mark.parametrize(
    ("algorithm", "env_id"),
    [slow("SAC", "Sensors-v0"), slow("TD3", "Sensors-v0"), ("PPO", "HalfBounded-v0")],
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
    if algorithm == "PPO":
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
    # this is what a file of a GPU says of its tensors
    with mock.patch("torch.serialization.location_tag", return_value="cuda:0"):
        run_dir = run("PPO", tmp_path, env_id="Sensors-v0")
    code = "import sys, numpy\nfrom ppo_continuous_noisy import load_policy\n"
    code += f"print(load_policy({str(run_dir)!r})(numpy.ones(10)).tolist())\n"
    expected = f"{ppo.load_policy(run_dir)(np.ones(10)).tolist()}\n"
    code += "print({'tyro', 'mujoco', 'pandas'} & {*sys.modules})"
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True
    )
    assert (result.stdout, result.returncode) == (f"{expected}set()\n", 0), result.stderr
