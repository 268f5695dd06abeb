"""docs/wrappers.md is right: its code runs, with Stable-Baselines3 itself."""

import re
from pathlib import Path

import gymnasium as gym
import pytest
import torch
from stable_baselines3.common.monitor import Monitor

from noisy_wrappers import RandomEarlyTermination, parse_noise

PAGE = Path(__file__).parents[2] / "docs" / "wrappers.md"


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # a small network is slower with more
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
def test_the_code_of_the_page():
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL))
    assert "model.learn(10_000," in code
    code = code.replace("model.learn(10_000,", "model.learn(4096,")
    names = {"__name__": "page"}
    exec(compile(code, str(PAGE), "exec"), names)

    recorded = names["model"].ep_info_buffer
    lengths = {episode["l"] for episode in recorded}
    assert lengths == {50, 200}  # those that end early are seen, and half of them do
    [rates] = names["model"].get_env().env_method("noise_statistics")
    assert rates["RandomEarlyTermination/rate"] == 0.5
    assert 0 < rates["RandomNormalNoisyReward/rate"] <= 0.5  # the last rollout began at half time
    assert names["mean"] < -100


def test_the_page_names_only_what_there_is():
    text = PAGE.read_text()
    noises = set(re.findall(r"`(Random\w+\([^`]*(?:\d|True)[^`]*\))`", text))
    fields = set(re.findall(r"`((?:body|geom|pair|dof|jnt|tendon|actuator)_\w+)`", text))
    noises -= {noise for noise in noises if "low" in noise}
    assert len(noises) > 5 and len(fields) > 10
    for noise in [*noises, *(f"RandomDynamics(0.5, 1.5, fields=({name!r},))" for name in fields)]:
        parse_noise(noise)


def test_early_termination_is_refused_outside_of_a_monitor():
    with pytest.raises(ValueError, match="RandomEarlyTermination needs to be inside"):
        RandomEarlyTermination(Monitor(gym.make("Pendulum-v1")), 1.0, 5)
