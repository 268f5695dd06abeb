"""What each wrapper does, against the paper's formulas."""

import math

import gymnasium as gym
import numpy as np
import pytest
from cases import (
    BASES,
    EPISODE_NOISES,
    OBSERVATION_CASES,
    REWARD_CASES,
    GenericEnv,
    build,
    constant_env,
    episodes_env,
    numbered_env,
    rollout,
    same,
    streams,
)

from noisy_wrappers import RandomEarlyTermination, RandomMixupObservation


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("rate", [0.3, 1.0])
@pytest.mark.parametrize(("wrapper", "args", "kwargs", "formula"), OBSERVATION_CASES)
def test_observation_golden(wrapper, args, kwargs, formula, rate, dtype):
    space = gym.spaces.Box(-10, 10, (3,), dtype)
    bare = rollout(GenericEnv(space), seed=7)
    noisy = rollout(wrapper(GenericEnv(space), rate, *args, **kwargs), seed=7)
    gate, noise = streams(wrapper, seed=7)
    previous = None
    for t, (clean, got) in enumerate(zip(bare, noisy, strict=True)):
        observation, expected, info = clean[0], clean[0], {}
        may_act = wrapper is not RandomMixupObservation or t > 0
        if may_act and gate.random() < rate:
            expected = formula(noise, observation.astype(np.float64), previous)
            if (expected != observation).any():  # dropout may keep everything
                info = {"noise": (wrapper.__name__,)}
        assert got[0].dtype == dtype
        np.testing.assert_allclose(got[0], expected, rtol=4 * np.finfo(dtype).eps, atol=1e-300)
        assert got[1:] == (*clean[1:4], info)
        previous = observation.astype(np.float64)


@pytest.mark.parametrize("rate", [0.3, 1.0])
@pytest.mark.parametrize(("wrapper", "args", "kwargs", "formula"), REWARD_CASES)
def test_reward_golden(wrapper, args, kwargs, formula, rate):
    bare = rollout(GenericEnv(), seed=7)
    noisy = rollout(wrapper(GenericEnv(), rate, *args, **kwargs), seed=7)
    gate, noise = streams(wrapper, seed=7)
    assert noisy[0][4] == {}
    for clean, got in zip(bare[1:], noisy[1:], strict=True):
        acts = gate.random() < rate
        assert got[1] == (formula(noise, clean[1]) if acts else clean[1])
        assert got[4] == ({"noise": (wrapper.__name__,)} if acts else {})
        assert got[0].tobytes() == clean[0].tobytes()


@pytest.mark.parametrize("truncate", [False, True])
@pytest.mark.parametrize("rate", [0.5, 1.0])
def test_early_termination_golden(rate, truncate):
    natural = [4, None, 20, None, 7]  # a chosen episode may end before its drawn step
    env = RandomEarlyTermination(episodes_env(natural), rate, 3, 9, truncate=truncate)
    gate, noise = streams(RandomEarlyTermination, seed=5)
    ended = 0
    for episode in range(100):
        env.reset(seed=5 if episode == 0 else None)
        drawn = noise.integers(3, 10)
        last = drawn if gate.random() < rate else math.inf
        end = natural[episode % 5] or math.inf
        for t in range(1, 30):
            _, _, terminated, truncated, info = env.step(0)
            assert terminated == (t == end or (t == last and not truncate))
            assert truncated == (t == last and truncate)
            acted = t == last and (truncate or t != end)
            ended += acted
            assert info == ({"noise": ("RandomEarlyTermination",)} if acted else {})
            if terminated or truncated:
                break
    assert (env.times_applied, env.opportunities) == (ended, 100)


@pytest.mark.parametrize("truncate", [False, True])
def test_each_step_golden(truncate):
    env = RandomEarlyTermination(constant_env(), 0.1, each_step=True, truncate=truncate)
    gate, _ = streams(RandomEarlyTermination, seed=5)
    env.reset(seed=5)
    ends = []
    for _ in range(200):
        _, _, terminated, truncated, info = env.step(0)
        ends.append(gate.random() < 0.1)
        assert (terminated, truncated) == (ends[-1] and not truncate, ends[-1] and truncate)
        assert info == ({"noise": ("RandomEarlyTermination",)} if ends[-1] else {})
        if ends[-1]:
            env.reset()
    assert 0 < env.times_applied == sum(ends)
    assert env.opportunities == 200


def test_termination_at_the_time_limit_is_a_termination():
    env = RandomEarlyTermination(gym.wrappers.TimeLimit(constant_env(), 5), 1.0, 5)
    env.reset(seed=0)
    assert [env.step(0)[2:4] for _ in range(5)][-1] == (True, True)
    assert env.times_applied == 1


def test_a_termination_beyond_the_time_limit_never_acts():
    with pytest.warns(UserWarning, match="never acts: episodes have at most 5 steps"):
        env = RandomEarlyTermination(gym.wrappers.TimeLimit(constant_env(), 5), 1.0, 6)
    steps = rollout(env, seed=0, steps=20)
    assert not any("noise" in step[4] for step in steps)
    assert (env.times_applied, env.opportunities) == (0, 5)


@pytest.mark.parametrize(
    "text",
    [
        "RandomDropoutObservation(1)",
        "RandomNormalNoisyReward(0)",
        "RandomNormalNoisyAction(0)",
        "RandomActionDelay(0)",
        "RandomDynamics(1, 1)",
    ],
)
def test_noise_that_changes_nothing_is_not_applied(text):
    env = build(text, gym.make("Cart-v0"), 1.0)
    bare = rollout(gym.make("Cart-v0"), seed=0, action=np.ones(2))
    assert same(rollout(env, seed=0, action=np.ones(2)), bare)
    assert env.times_applied == 0 < env.opportunities


def test_the_dtype_of_the_space_alone_is_no_noise():
    """Where an environment declares float32 and returns float64, noise rounds to float32."""
    env = constant_env(0.1)
    env.observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    steps = rollout(build("RandomDropoutObservation(0.5)", env, 1.0), seed=0)
    kept = [bool(np.all(observation)) for observation, *_ in steps]
    assert 0 < sum(kept) < len(kept)
    assert ["noise" not in info for *_, info in steps] == kept


@pytest.mark.parametrize("reuse", [False, True])
@pytest.mark.parametrize(
    ("factor", "recursive", "episodes"),
    [
        (0.5, False, [[1, 1.5, 2.5, 3.5], [5, 5.5, 6.5, 7.5]]),
        (0.5, True, [[1, 1.5, 2.25, 3.125], [5, 5.5, 6.25, 7.125]]),
        (0.0, False, [[1, 1, 2, 3], [5, 5, 6, 7]]),
        (0.0, True, [[1, 1, 1, 1], [5, 5, 5, 5]]),  # the agent sees one observation for ever
        (1.0, False, [[1, 2, 3, 4], [5, 6, 7, 8]]),
    ],
)
def test_mixup_by_hand(factor, recursive, episodes, reuse):
    env = RandomMixupObservation(numbered_env(reuse), 1.0, factor, recursive=recursive)
    for expected in episodes:
        observation, info = env.reset()
        seen = [observation[0]]
        assert info == {}
        seen += [env.step(0)[0][0] for _ in range(3)]
        assert seen == expected
    assert (env.times_applied, env.opportunities) == (0 if factor == 1 else 6, 6)


def test_mixup_remembers_unperturbed_steps_too():
    env = RandomMixupObservation(numbered_env(), 0.0, 0.5)
    env.reset()
    env.step(0)
    env.step(0)
    env.noise_rate = 1.0
    assert env.step(0)[0][0] == 3.5


@pytest.mark.parametrize("text", BASES)
@pytest.mark.parametrize("rate", [0.2, 0.6])
def test_applied_fraction_is_the_rate(text, rate):
    """Up to four standard deviations."""
    env = build(text, episodes_env([10]), rate)
    assert env.applied_fraction == 0
    steps = rollout(env, seed=3, steps=2000)
    seen = sum("noise" in info for *_, info in steps)
    resets = sum(reward is None for _, reward, *_ in steps)
    if text in EPISODE_NOISES:
        opportunities = resets
        starts = [i for i, step in enumerate(steps) if step[1] is None]
        seen = sum(any("noise" in step[4] for step in steps[i : i + 11]) for i in starts)
    elif "Reward" in text or "Mixup" in text or "each_step" in text or "Action" in text:
        opportunities = len(steps) - resets
    else:
        opportunities = len(steps)
    assert env.opportunities == opportunities
    assert env.applied_fraction == env.times_applied / env.opportunities
    assert env.times_applied == seen
    deviation = math.sqrt(rate * (1 - rate) / opportunities)
    assert env.applied_fraction == pytest.approx(rate, abs=4 * deviation)
