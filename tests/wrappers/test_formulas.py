"""What each wrapper does, against the paper's formulas."""

import math

import gymnasium as gym
import numpy as np
import pytest
from cases import (
    EPISODE_NOISES,
    NOISES,
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


def test_early_termination_includes_both_ends_and_is_uniform():
    env = RandomEarlyTermination(constant_env(), 1.0, 2, 6)
    counts = dict.fromkeys(range(1, 9), 0)
    for episode in range(2000):
        env.reset(seed=0 if episode == 0 else None)
        length = 1
        while not env.step(0)[2]:
            length += 1
        counts[length] += 1
    assert counts[1] == counts[7] == counts[8] == 0
    expected = 2000 / 5
    chi_square = sum((counts[k] - expected) ** 2 / expected for k in range(2, 7))
    assert chi_square < 18.5  # the 0.1 % point at 4 degrees of freedom


@pytest.mark.parametrize("high", [None, 1])
def test_early_termination_at_the_first_step(high):
    env = RandomEarlyTermination(constant_env(), 1.0, 1, high)
    for _ in range(3):
        env.reset(seed=0)
        assert env.step(0)[2:] == (True, False, {"noise": ("RandomEarlyTermination",)})


def test_termination_at_the_time_limit_is_a_termination():
    with pytest.warns(UserWarning, match="only turns truncated into terminated"):
        env = RandomEarlyTermination(gym.wrappers.TimeLimit(constant_env(), 5), 1.0, 5)
    env.reset(seed=0)
    assert [env.step(0)[2:4] for _ in range(5)][-1] == (True, True)
    assert env.times_applied == 1


@pytest.mark.parametrize(("low", "kwargs"), [(6, {}), (5, {"truncate": True})])
def test_a_termination_beyond_the_time_limit_never_acts(low, kwargs):
    with pytest.warns(UserWarning, match="never acts: episodes have at most 5 steps"):
        env = RandomEarlyTermination(gym.wrappers.TimeLimit(constant_env(), 5), 1.0, low, **kwargs)
    steps = rollout(env, seed=0, steps=20)
    assert not any("noise" in step[4] for step in steps)
    assert (env.times_applied, env.opportunities) == (0, 5)


@pytest.mark.parametrize(
    "text",
    [
        "RandomDropoutObservation(1)",
        "RandomNormalNoisyObservation(0)",
        "RandomUniformScaleObservation(1, 1)",
        "RandomUniformScaleReward(1, 1)",
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


@pytest.mark.parametrize("text", ["RandomDropoutObservation(1)", "RandomNormalNoisyReward(1)"])
def test_nan_that_stays_nan_is_not_changed(text):
    env = build(text, constant_env(np.nan), 1.0)
    env.reset(seed=0)
    assert "noise" not in env.step(0)[-1]


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0])
def test_mixup_of_infinite_observations_is_infinite(factor):
    env = RandomMixupObservation(constant_env(np.inf), 1.0, factor)
    env.reset()
    assert env.step(0)[0].tolist() == [np.inf] * 3


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


def test_mixup_survives_a_caller_that_writes_into_observations():
    env = RandomMixupObservation(numbered_env(), 1.0, 0.0)
    env.reset()[0][:] = 99
    assert env.step(0)[0][0] == 1


@pytest.mark.parametrize(
    ("text", "mean", "variance"),
    [
        ("RandomNormalNoisyObservation(0.5)", 0, 0.5**2),
        ("RandomNormalNoisyObservation(0.5, loc=1.0)", 1, 0.5**2),
        ("RandomUniformNoisyObservation(-1.0, 2.0)", 0.5, 3**2 / 12),
        ("RandomUniformScaleObservation(0.5, 2.0)", 2 * 0.25, 4 * 1.5**2 / 12),
        ("RandomUniformScaleObservation(0.5, 2.0, per_dimension=True)", 0.5, 4 * 1.5**2 / 12),
        ("RandomDropoutObservation(0.2)", 2 * -0.8, 4 * 0.2 * 0.8),
        ("RandomNormalNoisyReward(0.5)", 0, 0.5**2),
        ("RandomNormalNoisyReward(0.5, loc=1.0)", 1, 0.5**2),
        ("RandomUniformNoisyReward(-1.0, 2.0)", 0.5, 3**2 / 12),
        ("RandomUniformScaleReward(0.5, 2.0)", 2 * 0.25, 4 * 1.5**2 / 12),
    ],
)
def test_mean_variance_and_rate(text, mean, variance):
    """On a constant 2 the change has the formula's moments, at a rate known to 5 %."""
    change, noise, rate = changes(text, 0.3)
    assert abs(rate - 0.3) < 0.05 * 0.3
    if "Dropout" not in text:
        assert noise.mean() == pytest.approx(mean, abs=0.03)
        assert noise.var() == pytest.approx(variance, rel=0.05)
    # The moments of all steps: p * mean and p * (variance + mean^2).
    assert change.mean() == pytest.approx(0.3 * mean, abs=0.012)
    assert np.square(change).mean() == pytest.approx(0.3 * (variance + mean**2), rel=0.05)


def changes(text, rate, steps=40_000):
    """Return the change at every step, at the steps that are perturbed, and the rate of these."""
    env = build(text, constant_env(2.0, (4,)), rate)
    env.reset(seed=1)
    kind = 1 if "Reward" in text else 0
    change = np.array([env.step(0)[kind] for _ in range(steps)]).reshape(steps, -1) - 2
    acted = (change != 0).any(axis=1)
    # Dropout that happens to keep all four elements changes nothing.
    visible = 1 - 0.2**4 if "Dropout" in text else 1
    return change, change[acted], acted.mean() / visible


@pytest.mark.parametrize("wrong", [0.27, 0.33])
def test_a_rate_that_is_wrong_by_ten_percent_would_be_seen(wrong):
    assert abs(changes("RandomNormalNoisyReward(0.5)", wrong)[2] - 0.3) > 0.05 * 0.3


@pytest.mark.parametrize("text", NOISES)
@pytest.mark.parametrize("rate", [0.2, 0.6])
def test_applied_fraction_is_the_rate(text, rate):
    """Up to four standard deviations."""
    env = build(text, episodes_env([10]), rate)
    assert env.applied_fraction == 0
    steps = rollout(env, seed=3, steps=4000)
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
