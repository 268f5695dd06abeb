"""Policies that leave the project: what their run's folder tells of them."""

import importlib
import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete

SMALL = {
    "sac": {"learning_starts": 100, "batch_size": 32, "buffer_size": 1000},
    "td3": {"learning_starts": 100, "batch_size": 32, "buffer_size": 1000},
    "ppo": {"num_steps": 100, "num_minibatches": 4},
}


class Sensors(gym.Env):
    """A dictionary within a dictionary; actions with bounds of their own."""

    arm = Dict({"speed": Box(-np.inf, np.inf, (2,)), "angle": Box(-3, 3, (1,))})
    observation_space = Dict({"mode": Discrete(3), "camera": Box(0, 1, (2, 2)), "arm": arm})
    action_space = Box(np.float32([-1, 0.5]), np.float32([2, 0.7]))

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


class Plain(Sensors):
    """A dictionary of two vectors."""

    observation_space = Dict({"speed": Box(-9, 9, (2,)), "angle": Box(-3, 3, (1,))})

    def observe(self):
        return super().observe()["arm"]


class Unbounded(Plain):
    """One action is bounded on one side only; for PPO."""

    action_space = Box(np.float32([-np.inf, -0.01]), np.float32([0.01, np.inf]))


for environment in (Sensors, Plain, Unbounded):
    gym.register(f"{environment.__name__}-v0", environment, max_episode_steps=20)


def train(algorithm, env_id, runs_dir):
    """Train for a moment; return the script and the run's folder."""
    script = importlib.import_module(f"{algorithm}_continuous_noisy")
    args = {"env_id": env_id, "total_timesteps": 300, "eval_episodes": 1, "compile": False}
    args |= {"eval_frequency": 0, "runs_dir": str(runs_dir)}
    assert script.train(script.Args(**args, **SMALL[algorithm]))
    [run_dir] = Path(runs_dir).iterdir()
    return script, run_dir


@pytest.mark.parametrize(
    ("env_id", "keys"),
    [
        ("Sensors-v0", [["arm.angle", 1], ["arm.speed", 2], ["camera", 4], ["mode", 3]]),
        ("Pendulum-v1", []),
    ],
)
def test_config_json_tells_the_order_of_a_dictionary(env_id, keys, tmp_path):
    script, run_dir = train("ppo", env_id, tmp_path)
    config = json.loads((run_dir / "config.json").read_text())
    assert config["observation_keys"] == keys
    if keys:
        observation, _ = gym.make(env_id).reset(seed=0)
        parts = [observation["arm"]["angle"], observation["arm"]["speed"], observation["camera"]]
        parts += [np.eye(3)[observation["mode"]]]
        flat = np.concatenate([part.ravel() for part in parts])
        got, _ = script.make_env(env_id).reset(seed=0)
        np.testing.assert_array_equal(got, flat)
        assert sum(size for _, size in keys) == len(got) == config["observation_space"]["shape"][0]
