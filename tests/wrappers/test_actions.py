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
    low, high = np.array([-1.0, -0.5]), np.array([1.0, np.inf])
    bare = actions_env(gym.spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype))
    env = RandomNormalNoisyAction(bare, rate, 0.4, loc=loc)
    gate, noise = streams(RandomNormalNoisyAction, seed=7)
    env.reset(seed=7)
    rng = np.random.default_rng(0)
    clipped = 0
    for t in range(200):
        action = rng.uniform(-1.5, 1.5, 2).astype(dtype)
        given = action.copy()
        action.flags.writeable = False
        info = env.step(action)[4]
        received = bare.received[-1]
        assert np.array_equal(action, given)
        if gate.random() < rate:
            unclipped = given + noise.normal(loc, 0.4, 2)
            expected = np.clip(unclipped, low, high)
            clipped += np.any(expected != unclipped)
            assert received.dtype == dtype and received is not action
            np.testing.assert_allclose(received, expected, rtol=4 * np.finfo(dtype).eps)
            assert info == {"noise": ("RandomNormalNoisyAction",)}
        else:
            assert received is action and info == {}
        assert env.opportunities == t + 1
    assert 0 < clipped < env.times_applied


def test_noisy_actions_stay_in_the_action_space():
    bare = actions_env(gym.spaces.Box(np.float32([-0.1, 0.3]), np.float32([0.1, 0.7])))
    env = RandomNormalNoisyAction(bare, 1.0, 1e6)
    env.reset(seed=0)
    for _ in range(100):
        env.step([0.0, 0.5])  # a list is an action, too
    assert all(action in bare.action_space for action in bare.received)
    assert {tuple(action) for action in bare.received} == {
        (low, high) for low in np.float32([-0.1, 0.1]) for high in np.float32([0.3, 0.7])
    }


def test_action_noise_needs_a_box_of_floats():
    for space in (gym.spaces.Discrete(3), gym.spaces.Box(-1, 1, (2,), np.int32)):
        with pytest.raises(ValueError, match="needs a Box action space of floats"):
            RandomNormalNoisyAction(actions_env(space), 0.1, 1.0)


ACTIONS = gym.spaces.Discrete(100)


def received(delay, count=6):
    bare = actions_env(ACTIONS)
    env = RandomActionDelay(bare, 1.0, delay)
    env.reset(seed=0)
    marks = [env.step(action)[4].get("noise") for action in range(count)]
    return bare.received, marks, env


def test_a_delay_by_hand():
    name = ("RandomActionDelay",)
    assert received(2)[:2] == ([0, 0, 0, 1, 2, 3], [None] + 5 * [name])
    assert received(1)[0] == [0, 0, 1, 2, 3, 4]
    assert received(0)[:2] == ([0, 1, 2, 3, 4, 5], 6 * [None])
    assert received(10**6)[0] == 6 * [0]


@pytest.mark.parametrize("rate", [0.4, 1.0])
def test_delays_golden(rate):
    """k is uniform on both ends, drawn for every episode, and no action outlives its episode."""
    bare = actions_env(ACTIONS)
    env = RandomActionDelay(bare, rate, 1, 3)
    gate, noise = streams(RandomActionDelay, seed=3)
    seen = []
    for episode in range(100):
        env.reset(seed=3 if episode == 0 else None)
        bare.received.clear()
        for t in range(8):
            env.step(10 * (episode % 10) + t)
        drawn = noise.integers(1, 3, endpoint=True)
        delay = drawn if gate.random() < rate else 0
        assert bare.received == [10 * (episode % 10) + max(0, t - delay) for t in range(8)]
        seen.append(delay)
    assert set(seen) == {1, 2, 3} | ({0} if rate < 1 else set())
    assert env.times_applied == sum(delay > 0 for delay in seen)


def test_a_caller_may_reuse_the_array_of_its_action():
    bare = actions_env(gym.spaces.Box(-1.0, 1.0, (1,)))
    env = RandomActionDelay(bare, 1.0, 1)
    env.reset(seed=0)
    action = np.zeros(1)
    for t in range(4):
        action[:] = t
        env.step(action)
    assert [float(a[0]) for a in bare.received] == [0, 0, 1, 2]


def test_actions_of_any_kind():
    space = gym.spaces.Dict(a=gym.spaces.Discrete(3), b=gym.spaces.Box(-1, 1, (2,)))
    bare = actions_env(space)
    env = RandomActionDelay(bare, 1.0, 1)
    env.reset(seed=0)
    given = [space.sample() for _ in range(3)]
    for action in given:
        env.step(action)
    for got, wanted in zip(bare.received, [given[0], given[0], given[1]], strict=True):
        assert got["a"] == wanted["a"] and (got["b"] == wanted["b"]).all()
