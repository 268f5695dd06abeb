"""Sensors as they fail: a bias and a delay of an episode."""

import gymnasium as gym
import numpy as np
import pytest
from cases import GenericEnv, numbered_env, rollout, streams

from noisy_wrappers import RandomObservationBias, RandomObservationDelay


@pytest.mark.parametrize(("rate", "scale"), [(0.4, 0.3), (1.0, (0.3, 0.0, 2.0))])
def test_bias_golden(rate, scale):
    bare = rollout(gym.wrappers.TimeLimit(GenericEnv(), 9), seed=3, steps=200)
    env = RandomObservationBias(gym.wrappers.TimeLimit(GenericEnv(), 9), rate, scale)
    gate, noise = streams(RandomObservationBias, seed=3)
    chosen = []
    for clean, got in zip(bare, rollout(env, seed=3, steps=200), strict=True):
        if clean[1] is None:  # a reset
            bias = noise.normal(0, scale, 3)
            chosen.append(gate.random() < rate)
        np.testing.assert_array_equal(got[0], clean[0] + (bias if chosen[-1] else 0))
        assert got[4] == ({"noise": ("RandomObservationBias",)} if chosen[-1] else {})
    assert (env.times_applied, env.opportunities) == (sum(chosen), len(chosen))
    assert len({*chosen}) == (1 if rate == 1 else 2)


@pytest.mark.parametrize("rate", [0.4, 1.0])
def test_delay_golden(rate):
    """The agent may write into what it sees, and the environment uses its array again."""
    env = RandomObservationDelay(numbered_env(), rate, 1, 3)
    gate, noise = streams(RandomObservationDelay, seed=3)
    delays = []
    for episode in range(200):
        observation, info = env.reset(seed=3 if episode == 0 else None)
        first = observation[0]
        drawn = noise.integers(1, 3, endpoint=True)
        delays.append(drawn if gate.random() < rate else 0)
        assert info == {}
        for t in range(1, 9):
            observation, *_, info = env.step(0)
            assert observation[0] - first == max(0, t - delays[-1])
            assert ("noise" in info) == (delays[-1] > 0)
            observation[:] = 99
    assert set(delays) == {1, 2, 3} | ({0} if rate < 1 else set())
    assert env.times_applied == np.count_nonzero(delays) and env.opportunities == 200
