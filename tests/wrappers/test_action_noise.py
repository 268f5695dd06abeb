"""Noise on actions, which the paper does not have."""

import gymnasium as gym
import numpy as np
import pytest
from cases import GenericEnv, streams

from noisy_wrappers import RandomNormalNoisyAction


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
@pytest.mark.parametrize("rate", [0.3, 1.0])
@pytest.mark.parametrize(
    ("kwargs", "loc"), [({}, 0.0), ({"loc": 0.5}, 0.5)], ids=["loc=0", "loc=0.5"]
)
def test_action_golden(kwargs, loc, rate, dtype):
    low, high = np.array([-1.0, -0.5]), np.array([1.0, np.inf])
    bare = actions_env(gym.spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype))
    env = RandomNormalNoisyAction(bare, rate, 0.4, **kwargs)
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


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Discrete(3),
        gym.spaces.MultiBinary(2),
        gym.spaces.Box(-1, 1, (2,), np.int32),
        gym.spaces.Dict(a=gym.spaces.Box(-1, 1)),
    ],
    ids=lambda space: type(space).__name__,
)
def test_action_noise_needs_a_box_of_floats(space):
    with pytest.raises(ValueError, match="needs a Box action space of floats") as error:
        RandomNormalNoisyAction(actions_env(space), 0.1, 1.0)
    assert "\n" not in str(error.value)
