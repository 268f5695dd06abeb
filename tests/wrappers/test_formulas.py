"""What each wrapper does, against the paper's formulas."""

import math

import gymnasium as gym
import numpy as np
import pytest
from cases import (
    OBSERVATION_CASES,
    REWARD_CASES,
    GenericEnv,
    build,
    constant_env,
    numbered_env,
    rollout,
    same,
    streams,
)

from noisy_wrappers import RandomEarlyTermination, RandomMixupObservation


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("rate", [0.3, 1.0])
@pytest.mark.parametrize("text", OBSERVATION_CASES)
def test_observation_golden(text, rate, dtype):
    space = gym.spaces.Box(-10, 10, (3,), dtype)
    bare = rollout(GenericEnv(space), seed=7)
    env = build(text, GenericEnv(space), rate)
    noisy = rollout(env, seed=7)
    gate, noise = streams(text, seed=7)
    previous = None
    for t, (clean, got) in enumerate(zip(bare, noisy, strict=True)):
        observation, expected, info = clean[0], clean[0], {}
        may_act = "Mixup" not in text or t > 0
        if may_act and gate.random() < rate:
            expected = OBSERVATION_CASES[text](noise, observation.astype(np.float64), previous)
            if (expected != observation).any():  # dropout may keep everything
                info = {"noise": (text.partition("(")[0],)}
        assert got[0].dtype == dtype
        np.testing.assert_allclose(got[0], expected, rtol=4 * np.finfo(dtype).eps, atol=1e-300)
        assert got[1:] == (*clean[1:4], info)
        previous = (got[0] if "recursive" in text else observation).astype(np.float64)
    assert env.opportunities == (100 if "Mixup" in text else 101)
    assert env.times_applied == sum("noise" in step[4] for step in noisy)
    assert env.applied_fraction == env.times_applied / env.opportunities


@pytest.mark.parametrize("rate", [0.3, 1.0])
@pytest.mark.parametrize("text", REWARD_CASES)
def test_reward_golden(text, rate):
    bare = rollout(GenericEnv(), seed=7)
    env = build(text, GenericEnv(), rate)
    noisy = rollout(env, seed=7)
    gate, noise = streams(text, seed=7)
    assert noisy[0][4] == {}
    for clean, got in zip(bare[1:], noisy[1:], strict=True):
        acts = gate.random() < rate
        assert got[1] == (REWARD_CASES[text](noise, clean[1]) if acts else clean[1])
        assert got[4] == ({"noise": (text.partition("(")[0],)} if acts else {})
        assert got[0].tobytes() == clean[0].tobytes()
    assert (env.times_applied, env.opportunities) == (sum("noise" in s[4] for s in noisy), 100)


@pytest.mark.parametrize("truncate", [False, True])
@pytest.mark.parametrize("rate", [0.5, 1.0])
def test_early_termination_golden(rate, truncate):
    """A chosen episode may also end by itself before its drawn step, or at it."""

    def step(env, action):
        return env.draw(), 1.0, env.np_random.random() < 0.1, False, {}

    bare, twin = GenericEnv(step=step), GenericEnv(step=step)
    env = RandomEarlyTermination(twin, rate, 3, 9, truncate=truncate)
    gate, noise = streams(RandomEarlyTermination, seed=5)
    ended = 0
    for episode in range(100):
        for each in (bare, env):
            each.reset(seed=5 if episode == 0 else None)
        drawn = noise.integers(3, 10)
        last = drawn if gate.random() < rate else math.inf
        for t in range(1, 30):
            end = bare.step(0)[2]
            _, _, terminated, truncated, info = env.step(0)
            acted = t == last and not end
            assert terminated == (end or (acted and not truncate))
            assert truncated == (acted and truncate)
            ended += acted
            assert info == ({"noise": ("RandomEarlyTermination",)} if acted else {})
            if terminated or truncated:
                break
    assert (env.times_applied, env.opportunities) == (ended, 100)


def test_each_step_golden():
    env = RandomEarlyTermination(constant_env(), 0.1, each_step=True)
    gate, _ = streams(RandomEarlyTermination, seed=5)
    env.reset(seed=5)
    for _ in range(200):
        end = gate.random() < 0.1
        info = {"noise": ("RandomEarlyTermination",)} if end else {}
        assert env.step(0)[2:] == (end, False, info)
        if end:
            env.reset()
    assert env.times_applied > 0 and env.opportunities == 200


def test_termination_at_the_time_limit_is_a_termination():
    env = RandomEarlyTermination(gym.wrappers.TimeLimit(constant_env(), 5), 1.0, 5)
    env.reset(seed=0)
    assert [env.step(0)[2:4] for _ in range(5)][-1] == (True, True)
    assert env.times_applied == 1


IDLE = ["RandomDropoutObservation(1)", "RandomNormalNoisyReward(0)", "RandomNormalNoisyAction(0)"]
IDLE += ["RandomActionDelay(0)", "RandomDynamics(1, 1)"]


@pytest.mark.parametrize("text", IDLE)
def test_noise_that_changes_nothing_is_not_applied(text):
    env = build(text, gym.make("Cart-v0"), 1.0)
    bare = rollout(gym.make("Cart-v0"), seed=0, action=np.ones(2))
    assert same(rollout(env, seed=0, action=np.ones(2)), bare)
    assert env.times_applied == 0 < env.opportunities


@pytest.mark.parametrize(
    ("recursive", "expected"), [(False, [1, 1.5, 2.5, 3.5]), (True, [1, 1.5, 2.25, 3.125])]
)
def test_mixup_by_hand(recursive, expected):
    env = RandomMixupObservation(numbered_env(), 1.0, 0.5, recursive=recursive)
    for before in (0, 4):  # nothing of an episode is left in the next
        seen = [env.reset()[0][0], *(env.step(0)[0][0] for _ in range(3))]
        assert [value - before for value in seen] == expected
    assert (env.times_applied, env.opportunities) == (6, 6)
