"""Noise on actions, and actions that take effect later, which the paper does not have."""

import gymnasium as gym
import numpy as np
import pytest
from cases import GenericEnv, streams

from noisy_wrappers import RandomActionDelay, RandomNormalNoisyAction


def actions_env(space):
    """An environment that keeps the actions it receives."""

    def step(env, action):
        env.received.append(action)
        return env.draw(), 0.0, False, False, {}

    env = GenericEnv(step=step)
    env.action_space = space
    env.received = []
    return env


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("rate", "loc"), [(0.3, 0.5), (1.0, 0.0)])
def test_action_golden(rate, loc, dtype):
    low, high = np.array([-1.0, -0.7], dtype), np.array([0.3, np.inf], dtype)
    bare = actions_env(gym.spaces.Box(low, high, dtype=dtype))
    env = RandomNormalNoisyAction(bare, rate, 0.4, loc=loc)
    gate, noise = streams(RandomNormalNoisyAction, seed=7)
    env.reset(seed=7)
    rng = np.random.default_rng(0)
    clipped = 0
    for _ in range(200):
        action = rng.uniform(-1.5, 1.5, 2).astype(dtype)
        given = action.copy()
        action.flags.writeable = False
        info = env.step(action)[4]
        received = bare.received[-1]
        if gate.random() < rate:
            unclipped = given + noise.normal(loc, 0.4, 2)
            expected = np.clip(unclipped, low, high)
            clipped += np.any(expected != unclipped)
            assert received in bare.action_space and received is not action
            np.testing.assert_allclose(received, expected, rtol=4 * np.finfo(dtype).eps)
            assert info == {"noise": ("RandomNormalNoisyAction",)}
        else:
            assert received is action and info == {}
    assert 0 < clipped < env.times_applied and env.opportunities == 200


def test_action_noise_needs_a_box_of_floats():
    for space in (gym.spaces.Discrete(3), gym.spaces.Box(-1, 1, (2,), np.int32)):
        with pytest.raises(ValueError, match="needs Box actions of floats"):
            RandomNormalNoisyAction(actions_env(space), 0.1, 1.0)


@pytest.mark.parametrize("rate", [0.4, 1.0])
def test_delays_golden(rate):
    """k is uniform on both ends, drawn for every episode, and no action outlives its episode."""
    bare = actions_env(gym.spaces.Discrete(100))
    env = RandomActionDelay(bare, rate, 1, 3)
    gate, noise = streams(RandomActionDelay, seed=3)
    seen = []
    for episode in range(100):
        env.reset(seed=3 if episode == 0 else None)
        bare.received.clear()
        first = 10 * (episode % 10)
        marked = ["noise" in env.step(first + t)[4] for t in range(8)]
        drawn = noise.integers(1, 3, endpoint=True)
        delay = drawn if gate.random() < rate else 0
        assert bare.received == [first + max(0, t - delay) for t in range(8)]
        assert marked == [delay > 0 and t > 0 for t in range(8)]
        seen.append(delay)
    assert set(seen) == {1, 2, 3} | ({0} if rate < 1 else set())
    assert env.times_applied == sum(delay > 0 for delay in seen)


def test_delayed_actions_may_be_of_any_kind_and_in_arrays_that_are_used_again():
    bare = actions_env(gym.spaces.Dict(a=gym.spaces.Discrete(9), b=gym.spaces.Box(-1, 1, (1,))))
    env = RandomActionDelay(bare, 1.0, 1)
    env.reset(seed=0)
    action = {"a": 0, "b": np.zeros(1)}
    for t in range(4):
        action["a"] = t
        action["b"][:] = t
        env.step(action)
    received = [(got["a"], got["b"].item()) for got in bare.received]
    assert received == [(0, 0), (0, 0), (1, 1), (2, 2)]
