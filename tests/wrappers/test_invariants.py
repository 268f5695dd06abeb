"""What no noise may change."""

import gymnasium as gym
import numpy as np
import pytest
from cases import BASES, GenericEnv, build, constant_env, registered, rollout, same

from noisy_wrappers import (
    RandomEarlyTermination,
    RandomNormalNoisyObservation,
    RandomUniformScaleReward,
)


@pytest.mark.parametrize("text", BASES)
def test_rate_zero_is_the_bare_environment(text):
    env_id, action = registered(text)
    bare = rollout(gym.make(env_id), seed=3, action=action)
    assert same(rollout(build(text, gym.make(env_id), 0.0), seed=3, action=action), bare)


@pytest.mark.parametrize("text", BASES)
def test_data_of_the_environment_are_never_mutated(text):
    first, owned = np.zeros(3), np.arange(1.0, 4.0)
    first.flags.writeable = owned.flags.writeable = False
    info = {"key": "value"}
    reward = np.array(1.5)
    reward.flags.writeable = False
    env = GenericEnv(
        observe=lambda env: first, step=lambda env, action: (owned, reward, False, False, info)
    )
    env = build(text, env, 1.0)
    name = type(env).__name__
    for _, given, *_, told in rollout(env, seed=0, steps=20):
        if given is not None:  # no reset, which has no info here; names do not pile up
            assert told in ({"key": "value"}, {"key": "value", "noise": (name,)})
    assert info == {"key": "value"}
    assert env.times_applied > 0


def test_info_names_the_wrappers_innermost_first():
    env = RandomNormalNoisyObservation(constant_env(), 1.0, 0.1)
    env = RandomEarlyTermination(env, 1.0, 2)
    env = RandomUniformScaleReward(env, 1.0, 0.5, 1.5)
    assert env.reset(seed=0)[1] == {"noise": ("RandomNormalNoisyObservation",)}
    both = ("RandomNormalNoisyObservation", "RandomUniformScaleReward")
    assert env.step(0)[4] == {"noise": both}
    assert env.step(0)[4]["noise"] == (both[0], "RandomEarlyTermination", both[1])
