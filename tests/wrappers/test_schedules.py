"""Noise rates that change during training."""

import gymnasium as gym
import pytest
from cases import A, B, constant_env

from noisy_wrappers import (
    RandomDropoutObservation,
    RandomNormalNoisyReward,
    make_noisy,
    noise_statistics,
    noise_wrappers,
    set_progress,
)


@pytest.mark.parametrize(
    ("schedule", "rates"),
    [("1.0:0.0", [1.0, 0.75, 0.5, 0.0]), ("0.1:0.3", [0.1, 0.15, 0.2, 0.3]), (0.3, [0.3] * 4)],
)
def test_the_rate_follows_the_progress_at_the_next_reset(schedule, rates):
    env = gym.wrappers.TimeLimit(RandomNormalNoisyReward(constant_env(), schedule, 1.0), 9)
    env = RandomDropoutObservation(env, schedule, 0.5)
    wrappers = list(noise_wrappers(env).values())
    for fraction, rate in zip([0, 0.25, 0.5, 1], rates, strict=True):
        before = [wrapper.noise_rate for wrapper in wrappers]
        set_progress(env, fraction)
        assert [wrapper.noise_rate for wrapper in wrappers] == before
        env.reset()
        assert [wrapper.noise_rate for wrapper in wrappers] == [pytest.approx(rate, rel=1e-15)] * 2
    assert wrappers[0].noise_rate == rates[-1]  # exactly
    env.noise_rate = 0.9  # a number that is assigned replaces the schedule
    env.reset()
    assert env.noise_rate == 0.9


def noisy_pendulum():
    return make_noisy(gym.make("Pendulum-v1"), [A, B], ["1:0", "0:1"])


def test_a_vector_of_environments():
    """As docs/wrappers.md has it."""
    envs = gym.vector.SyncVectorEnv([noisy_pendulum, noisy_pendulum])
    envs.call("set_progress", 0.75)
    envs.reset(seed=0)
    statistics = envs.call("noise_statistics")
    for each in statistics:
        assert each["RandomNormalNoisyReward/rate"] == 0.25
        assert each["RandomDropoutObservation/rate"] == 0.75
    wrap, tell = (lambda env: make_noisy(env, [A], [0.5])), (lambda env: set_progress(env, 0.5))
    for function in (noise_statistics, wrap, tell):
        with pytest.raises(TypeError, match="needs a single gymnasium.Env, not a .*VectorEnv"):
            function(envs)
