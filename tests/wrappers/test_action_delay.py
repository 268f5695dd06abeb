"""Actions that take effect later, which the paper does not have."""

import gymnasium as gym
import numpy as np
import pytest
from cases import GenericEnv, streams
from test_action_noise import actions_env

from noisy_wrappers import RandomActionDelay, make_noisy

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
    assert received(10**6)[0] == received(2**63 - 1)[0] == 6 * [0]


@pytest.mark.parametrize("noise", ["RandomActionDelay(1)", "RandomNormalNoisyAction(0.1)"])
def test_a_step_of_four_values_is_an_error(noise):
    env = GenericEnv(step=lambda env, action: (0.0, 1.0, False, {}))
    env = make_noisy(env, [noise], [1.0], record_statistics=False)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="expected 5, got 4"):
        env.step(env.action_space.sample())


def test_it_counts_the_episodes_in_which_an_action_came_late():
    for count, applied in [(1, 0), (2, 1), (6, 1)]:
        env = received(2, count)[2]
        assert (env.times_applied, env.opportunities) == (applied, 1)


@pytest.mark.parametrize("rate", [0.4, 1.0])
def test_delays_golden(rate):
    """k is uniform on both ends, drawn for every episode, and no action outlives its episode."""
    bare = actions_env(ACTIONS)
    env = RandomActionDelay(bare, rate, 1, 3)
    gate, noise = streams(RandomActionDelay, seed=3)
    seen = []
    for episode in range(300):
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
