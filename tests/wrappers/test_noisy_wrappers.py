"""Tests of noisy_wrappers: every expectation is derived here from the paper's formulas."""

import copy
import doctest
import json
import math
import pickle
import re
import subprocess
import sys
import zlib
from pathlib import Path

import gymnasium as gym
import noisyenv.wrappers as noisyenv
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FlattenObservation, RecordEpisodeStatistics
from hypothesis import given, settings
from hypothesis import strategies as st

import noisy_wrappers
from noisy_wrappers import (
    WRAPPERS,
    EnvState,
    FiniteNumbers,
    NoiseWrapper,
    NotFiniteError,
    RandomDropoutObservation,
    RandomEarlyTermination,
    RandomMixupObservation,
    RandomNormalNoisyAction,
    RandomNormalNoisyObservation,
    RandomNormalNoisyReward,
    RandomUniformNoisyObservation,
    RandomUniformNoisyReward,
    RandomUniformScaleObservation,
    RandomUniformScaleReward,
    canonical_env_id,
    canonical_noises,
    make_flat,
    make_noisy,
    noise_slug,
    noise_statistics,
    noise_wrappers,
    parse_noise,
    run_folder,
    run_name,
    set_progress,
    signatures,
)
from sweep.grid import NOISES as NOISES_OF_THE_PAPER

# Derandomized: a failure in CI is a failure on every machine.
hypothesis_settings = settings(deadline=None, derandomize=True, max_examples=150)

# wrapper, arguments, keywords, formula(noise generator, o_t, o_(t-1))
OBSERVATION_CASES = [
    (RandomNormalNoisyObservation, (0.3,), {}, lambda g, o, _: o + g.normal(0, 0.3, o.shape)),
    (
        RandomNormalNoisyObservation,
        (0.3,),
        {"loc": -0.5},
        lambda g, o, _: o + g.normal(-0.5, 0.3, o.shape),
    ),
    (
        RandomNormalNoisyObservation,
        ((0.3, 0.0, 2.0),),
        {},
        lambda g, o, _: o + g.normal(0, [0.3, 0.0, 2.0]),
    ),
    (RandomUniformNoisyObservation, (-0.2, 0.7), {}, lambda g, o, _: o + g.uniform(-0.2, 0.7, 3)),
    (RandomUniformScaleObservation, (0.5, 1.7), {}, lambda g, o, _: o * g.uniform(0.5, 1.7)),
    (
        RandomUniformScaleObservation,
        (0.5, 1.7),
        {"per_dimension": True},
        lambda g, o, _: o * g.uniform(0.5, 1.7, o.shape),
    ),
    (RandomMixupObservation, (0.3,), {}, lambda g, o, previous: 0.3 * o + 0.7 * previous),
    (RandomMixupObservation, (0.0,), {}, lambda g, o, previous: previous),
    (RandomDropoutObservation, (0.3,), {}, lambda g, o, _: (g.random(o.shape) < 0.3) * o),
]
REWARD_CASES = [
    (RandomNormalNoisyReward, (0.3,), {}, lambda g, r: r + g.normal(0, 0.3)),
    (RandomNormalNoisyReward, (0.3,), {"loc": 2.0}, lambda g, r: r + g.normal(2.0, 0.3)),
    (RandomUniformNoisyReward, (-0.2, 0.7), {}, lambda g, r: r + g.uniform(-0.2, 0.7)),
    (RandomUniformScaleReward, (0.5, 1.7), {}, lambda g, r: r * g.uniform(0.5, 1.7)),
]
# One configuration per wrapper, and the variants.
NOISES = [
    "RandomNormalNoisyObservation(0.3)",
    "RandomUniformNoisyObservation(-0.2, 0.7)",
    "RandomUniformScaleObservation(0.5, 1.7)",
    "RandomUniformScaleObservation(-1.0, 0.0, per_dimension=True)",
    "RandomMixupObservation(0.3)",
    "RandomMixupObservation(0.3, recursive=True)",
    "RandomDropoutObservation(0.3)",
    "RandomNormalNoisyReward(0.3)",
    "RandomUniformNoisyReward(-0.2, 0.7)",
    "RandomUniformScaleReward(0.5, 1.7)",
    "RandomEarlyTermination(3, 9)",
    "RandomEarlyTermination(3, 9, truncate=True)",
    "RandomEarlyTermination(each_step=True)",
    "RandomNormalNoisyAction(0.3)",
    "RandomNormalNoisyAction(0.3, loc=-0.5)",
]
STEP_NOISES = [text for text in NOISES if not text.startswith("RandomEarlyTermination(3")]
BOX = gym.spaces.Box(-10.0, 10.0, (3,), np.float64)


class GenericEnv(gym.Env):
    """An endless environment of random observations and rewards, with functions to replace."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, observation_space=BOX, reset=None, step=None):
        self.observation_space = observation_space
        self._reset = reset or (lambda env: (env.draw(), {}))
        self._step = step or (
            lambda env, action: (env.draw(), float(env.np_random.normal()), False, False, {})
        )

    def draw(self):
        space = self.observation_space
        return self.np_random.uniform(-5, 5, space.shape).astype(space.dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._reset(self)

    def step(self, action):
        return self._step(self, action)


def constant_env(value=2.0, shape=(3,)):
    space = gym.spaces.Box(-np.inf, np.inf, shape, np.float64)
    return GenericEnv(
        space,
        reset=lambda env: (np.full(shape, value), {}),
        step=lambda env, action: (np.full(shape, value), value, False, False, {}),
    )


def episodes_env(lengths):
    """An environment whose episodes have the given lengths (None: endless), in turn."""

    def reset(env):
        env.episode = getattr(env, "episode", -1) + 1
        env.t = 0
        return np.zeros(3), {}

    def step(env, action):
        env.t += 1
        done = env.t == lengths[env.episode % len(lengths)]
        return np.zeros(3), 1.0, done, False, {}

    return GenericEnv(reset=reset, step=step)


def build(text, env, rate):
    """Build a wrapper from the notation, without the module's parser."""
    name, arguments = text.split("(", 1)
    return eval(f"wrapper(env, rate, {arguments}", {"wrapper": WRAPPERS[name]} | locals())


def registered(text):
    """A registered environment that a noise can work on, and an action."""
    if "Action" in text:
        return "Pendulum-v1", np.array([0.5], np.float32)
    return "CartPole-v1", 0


def streams(wrapper, seed, position=0):
    """The documented seeding: the gate's and the noise's generator."""
    entropy = [seed, zlib.crc32(wrapper.__name__.encode()), position]
    return [np.random.default_rng(child) for child in np.random.SeedSequence(entropy).spawn(2)]


def rollout(env, seed=None, steps=100, action=0):
    """What a reset and ``steps`` steps return, with resets where episodes end."""
    observation, info = env.reset(seed=seed)
    out = [(observation, None, False, False, info)]
    for _ in range(steps):
        out.append(env.step(action))
        if out[-1][2] or out[-1][3]:
            observation, info = env.reset()
            out.append((observation, None, False, False, info))
    return out


def same(first, second):
    """Two rollouts are equal bit for bit, types included."""
    return len(first) == len(second) and all(
        a[0].dtype == b[0].dtype
        and a[0].shape == b[0].shape
        and a[0].tobytes() == b[0].tobytes()
        and type(a[1]) is type(b[1])
        and a[1:] == b[1:]
        for a, b in zip(first, second, strict=True)
    )


# The formulas


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
    chosen = 0
    for episode in range(100):
        env.reset(seed=5 if episode == 0 else None)
        drawn = noise.integers(3, 10)
        last = drawn if gate.random() < rate else math.inf
        chosen += last < math.inf
        end = natural[episode % 5] or math.inf
        for t in range(1, 30):
            _, _, terminated, truncated, info = env.step(0)
            assert terminated == (t == end or (t == last and not truncate))
            assert truncated == (t == last and truncate)
            assert info == ({"noise": ("RandomEarlyTermination",)} if t == last else {})
            if terminated or truncated:
                break
    assert (env.times_applied, env.opportunities) == (chosen, 100)


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
    env = RandomEarlyTermination(gym.wrappers.TimeLimit(constant_env(), 5), 1.0, 5)
    env.reset(seed=0)
    assert [env.step(0)[2:4] for _ in range(5)][-1] == (True, True)


def numbered_env(reuse=False):
    """Observations 1, 2, 3, ... from the first reset on; with ``reuse`` all in one array."""
    buffer = np.zeros(3)

    def observe(env):
        env.count = getattr(env, "count", 0) + 1
        if not reuse:
            return np.full(3, float(env.count))
        buffer[:] = env.count
        return buffer

    return GenericEnv(
        reset=lambda env: (observe(env), {}),
        step=lambda env, action: (observe(env), 0.0, False, False, {}),
    )


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
    assert (env.times_applied, env.opportunities) == (6, 6)


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

    def measure(rate, steps=40_000):
        env = build(text, constant_env(2.0, (4,)), rate)
        env.reset(seed=1)
        kind = 1 if "Reward" in text else 0
        change = np.array([env.step(0)[kind] for _ in range(steps)]).reshape(steps, -1) - 2
        acted = (change != 0).any(axis=1)
        # Dropout that happens to keep all four elements changes nothing.
        visible = 1 - 0.2**4 if "Dropout" in text else 1
        return change, change[acted], acted.mean() / visible

    change, noise, rate = measure(0.3)
    assert abs(rate - 0.3) < 0.05 * 0.3
    if "Dropout" not in text:
        assert noise.mean() == pytest.approx(mean, abs=0.03)
        assert noise.var() == pytest.approx(variance, rel=0.05)
    # The moments of all steps: p * mean and p * (variance + mean^2).
    assert change.mean() == pytest.approx(0.3 * mean, abs=0.012)
    assert np.square(change).mean() == pytest.approx(0.3 * (variance + mean**2), rel=0.05)
    for wrong in (0.27, 0.33):  # the bound sees an error of 10 %
        assert abs(measure(wrong)[2] - 0.3) > 0.05 * 0.3


@pytest.mark.parametrize("text", NOISES)
@pytest.mark.parametrize("rate", [0.2, 0.6])
def test_applied_fraction_is_the_rate(text, rate):
    env = build(text, episodes_env([10]), rate)
    assert math.isnan(env.applied_fraction)
    steps = rollout(env, seed=3, steps=150_000 if "(3" in text else 40_000)
    seen = sum("noise" in info for *_, info in steps)
    unfinished = 1 if "(3" in text else 0  # the last episode may be chosen and not at its end yet
    assert seen <= env.times_applied <= seen + unfinished
    resets = sum(reward is None for _, reward, *_ in steps)
    if "(3" in text:
        opportunities = resets
    elif "Reward" in text or "Mixup" in text or "each_step" in text or "Action" in text:
        opportunities = len(steps) - resets
    else:
        opportunities = len(steps)
    assert env.opportunities == opportunities
    assert env.applied_fraction == env.times_applied / env.opportunities
    assert env.applied_fraction == pytest.approx(rate, rel=0.05)


# Action noise


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


def test_action_moments_and_rate():
    def measure(scale, loc):
        bare = actions_env(gym.spaces.Box(-np.inf, np.inf, (4,), np.float64))
        env = RandomNormalNoisyAction(bare, 0.3, scale, loc=loc)
        env.reset(seed=1)
        for _ in range(40_000):
            env.step(np.full(4, 2.0))
        change = np.array(bare.received) - 2
        acted = change[(change != 0).any(axis=1)]
        assert len(acted) / 40_000 == pytest.approx(0.3, rel=0.05)
        return acted.mean(axis=0), acted.var(axis=0), np.corrcoef(acted.T)

    for scale, loc in [(0.5, 0.0), (0.5, 1.0)]:
        mean, variance, correlation = measure(scale, loc)
        np.testing.assert_allclose(mean, loc, atol=0.03)
        np.testing.assert_allclose(variance, scale**2, rtol=0.06)
        np.testing.assert_allclose(correlation, np.eye(4), atol=0.05)


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


# Rates that change


@pytest.mark.parametrize(
    ("schedule", "rates"),
    [
        ("1.0:0.0", [1.0, 0.75, 0.5, 0.0]),
        ("0:1", [0.0, 0.25, 0.5, 1.0]),
        ("0.1:0.3", [0.1, 0.15, 0.2, 0.3]),
        ("0.3:0.3", [0.3, 0.3, 0.3, 0.3]),
        (0.3, [0.3, 0.3, 0.3, 0.3]),
    ],
)
def test_the_rate_follows_the_progress_at_the_next_reset(schedule, rates):
    env = gym.wrappers.TimeLimit(RandomNormalNoisyReward(constant_env(), schedule, 1.0), 9)
    env = RandomDropoutObservation(env, schedule, 0.5)
    wrappers = list(noise_wrappers(env).values())
    assert [wrapper.noise_rate for wrapper in wrappers] == [rates[0]] * 2
    for fraction, rate in zip([0, 0.25, 0.5, 1], rates, strict=True):
        before = [wrapper.noise_rate for wrapper in wrappers]
        set_progress(env, fraction)
        assert [wrapper.noise_rate for wrapper in wrappers] == before
        env.reset()
        assert [wrapper.noise_rate for wrapper in wrappers] == [pytest.approx(rate, rel=1e-15)] * 2
    assert wrappers[0].noise_rate == rates[-1]  # exactly


@pytest.mark.parametrize("text", STEP_NOISES)
def test_a_rate_is_constant_within_an_episode(text):
    env = build(text, constant_env(), "0:1")
    for fraction, acts in [(0, False), (1, True), (0, False)]:
        set_progress(env, fraction)
        env.reset()
        for later in (0.3, 1 - fraction, fraction):
            set_progress(env, later)
            assert ("noise" in env.step(0)[4]) == acts


def test_realised_rate_of_a_schedule():
    """With episodes of one length, the mean over training is that of the episodes' rates."""
    env = RandomNormalNoisyObservation(episodes_env([20]), "0.9:0.1", 0.1)
    rates = []
    acted = 0
    for step in range(0, 40_000, 20):
        set_progress(env, step / 40_000)
        acted += "noise" in env.reset(seed=3 if step == 0 else None)[1]
        rates.append(env.noise_rate)
        acted += sum("noise" in env.step(0)[4] for _ in range(20))
    assert rates == pytest.approx(np.linspace(0.9, 0.1, 2001)[:-1].tolist())
    rates = np.repeat(rates, 21)
    error = math.sqrt(np.sum(rates * (1 - rates))) / len(rates)
    assert env.applied_fraction == acted / len(rates)
    assert abs(env.applied_fraction - rates.mean()) < 3 * error
    assert 3 * error < 0.01  # and the bound sees a rate that stays at either end


@pytest.mark.parametrize("text", NOISES)
def test_a_schedule_draws_what_its_rates_draw(text):
    """One uniform per opportunity whatever the rate: an episode is that of a constant rate."""
    fractions = [0.0, 0.5, 0.5, 1.0]

    def episodes(rate, assigned):
        env = build(text, episodes_env([6]), rate)
        out = []
        for episode, fraction in enumerate(fractions):
            if assigned:
                env.noise_rate = 0.9 - 0.8 * fraction
            else:
                set_progress(env, fraction)
            out += [(*env.reset(seed=4 if episode == 0 else None),)]
            out += [env.step(np.zeros(1)) for _ in range(6)]
        return [(step[0].tobytes(), step[1:]) for step in out], env.state_dict()

    scheduled = episodes("0.9:0.1", assigned=False)
    assert scheduled == episodes(0.5, assigned=True)
    assert scheduled[1] != episodes(0.9, assigned=False)[1]


@pytest.mark.parametrize("text", NOISES)
def test_progress_leaves_a_constant_rate_alone(text):
    constant = build(text, episodes_env([12]), 0.1)
    expected = rollout(constant, seed=1)
    for rate in (0.1, "0.1:0.1"):
        env = build(text, episodes_env([12]), rate)
        set_progress(env, 0.7)
        assert same(rollout(env, seed=1), expected)
        assert env.noise_rate == 0.1
    scheduled = build(text, episodes_env([12]), "0.9:0.5")
    scheduled.noise_rate = 0.1  # a number that is assigned replaces the schedule
    set_progress(scheduled, 1.0)
    assert same(rollout(scheduled, seed=1), expected)


def test_resuming_a_schedule_needs_the_progress_and_the_streams():
    def make():
        return make_noisy(episodes_env([5]), [A, B], ["1:0", "0.2:0.6"])

    env = make()
    set_progress(env, 0.25)
    rollout(env, seed=8, steps=10)
    states = [wrapper.state_dict() for wrapper in noise_wrappers(env).values()]
    set_progress(env, 0.5)
    expected = rollout(env)
    resumed = make()
    for wrapper, state in zip(noise_wrappers(resumed).values(), states, strict=True):
        wrapper.load_state_dict(state)
    set_progress(resumed, 0.5)
    env.unwrapped.episode = resumed.unwrapped.episode = 0
    assert [step[1:4] for step in rollout(resumed)] == [step[1:4] for step in expected]
    rates = {name: wrapper.noise_rate for name, wrapper in noise_wrappers(resumed).items()}
    assert rates == {"RandomNormalNoisyReward": 0.5, "RandomDropoutObservation": 0.4}


def noisy_pendulum():
    return make_noisy(gym.make("Pendulum-v1"), [A, B], ["1:0", "0:1"])


RATES_OF_A_PENDULUM = {"RandomNormalNoisyReward/rate": 0.25, "RandomDropoutObservation/rate": 0.75}


@pytest.mark.parametrize("vector", [gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv])
@pytest.mark.parametrize("wrap", [lambda env: env, gym.wrappers.vector.RecordEpisodeStatistics])
def test_progress_reaches_the_environments_of_a_vector(vector, wrap):
    env = wrap(vector([noisy_pendulum, noisy_pendulum]))
    try:
        set_progress(env, 0.75)
        env.reset(seed=0)
        env.step(env.action_space.sample())
        each = env.unwrapped.call("noise_statistics")
        means = noise_statistics(env)
    finally:
        env.close()
    for statistics in (*each, means):
        assert RATES_OF_A_PENDULUM.items() <= statistics.items()
    for name in each[0]:
        assert means[name] == (each[0][name] + each[1][name]) / 2
    assert means["RandomNormalNoisyReward/applied_fraction"] in (0, 0.5, 1)


def test_vectors_with_and_without_noise():
    def bare():
        return gym.make("Pendulum-v1")

    mixed = gym.vector.SyncVectorEnv([noisy_pendulum, bare])
    names = set(vars(mixed.envs[1]))
    set_progress(mixed, 0.75)
    mixed.reset(seed=0)
    assert RATES_OF_A_PENDULUM.items() <= noise_statistics(mixed.envs[0]).items()
    assert set(vars(mixed.envs[1])) == names  # nothing was left in the other
    with pytest.raises(ValueError, match="different noises"):
        noise_statistics(mixed)
    without = [gym.vector.SyncVectorEnv([bare]), gym.make_vec("CartPole-v1", num_envs=2), bare()]
    assert not hasattr(without[1].unwrapped, "call")  # it is one program, not two environments
    for env in without:
        set_progress(env, 0.75)
        assert noise_statistics(env) == {}


@pytest.mark.parametrize("function", [lambda env: set_progress(env, 0.5), noise_statistics])
def test_progress_and_statistics_of_what_is_no_environment(function):
    for no_env in (None, "Pendulum-v1", [noisy_pendulum()]):
        with pytest.raises(TypeError, match=f"needs an environment.* {type(no_env).__name__}"):
            function(no_env)


def test_what_takes_a_single_environment_refuses_a_vector():
    vector = gym.vector.SyncVectorEnv([noisy_pendulum])
    for function in (noise_wrappers, lambda env: make_noisy(env, [A], [0.5])):
        with pytest.raises(TypeError, match="SyncVectorEnv"):
            function(vector)


@pytest.mark.parametrize("fraction", [-0.1, 1.1, math.nan, "0.5", None, True])
def test_bad_progress(fraction):
    env = RandomNormalNoisyReward(constant_env(), "1:0", 1.0)
    with pytest.raises(ValueError, match="fraction"):
        set_progress(env, fraction)
    assert env.training_progress == 0


@pytest.mark.parametrize("text", NOISES)
def test_spec_and_copies_of_a_schedule(text):
    env_id, action = registered(text)
    env = build(text, gym.make(env_id), "1:0.25")
    for spec in (env.spec, gym.envs.registration.EnvSpec.from_json(env.spec.to_json())):
        made = spec.make()
        assert (made.spec, made.schedule) == (env.spec, (1.0, 0.25))
    set_progress(env, 1.0)
    env.reset(seed=2)
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert (twin.schedule, twin.training_progress, twin.noise_rate) == ((1.0, 0.25), 1.0, 0.25)
        assert twin.reset()[0] in twin.observation_space
        assert twin.noise_rate == 0.25


def ks_distance(a, b):
    """The two-sample Kolmogorov-Smirnov statistic."""
    a, b = np.sort(np.ravel(a)), np.sort(np.ravel(b))
    grid = np.concatenate([a, b])
    below = [np.searchsorted(sample, grid, side="right") / len(sample) for sample in (a, b)]
    return np.abs(below[0] - below[1]).max()


@pytest.mark.parametrize(
    ("name", "ours", "theirs", "other"),
    [
        ("RandomNormalNoisyObservation", {"scale": 0.5}, {"scale": 0.5}, {"scale": 0.6}),
        ("RandomUniformNoisyObservation", {"low": -1, "high": 2}, None, {"low": -1, "high": 2.4}),
        ("RandomUniformScaleObservation", {"low": 0.5, "high": 2}, None, {"low": 0.3, "high": 2}),
        (
            "RandomUniformScaleObservation",
            {"low": 0.5, "high": 2, "per_dimension": True},
            {"low": 0.5, "high": 2, "size": None},
            {"low": 0.3, "high": 2},
        ),
        ("RandomDropoutObservation", {"keep_prob": 0.9}, {"p": 0.1}, {"p": 0.9}),
        ("RandomNormalNoisyReward", {"scale": 0.5}, None, {"scale": 0.6}),
        ("RandomUniformNoisyReward", {"low": -1, "high": 2}, None, {"low": -1, "high": 2.4}),
        ("RandomUniformScaleReward", {"low": 0.5, "high": 2}, None, {"low": 0.3, "high": 2}),
    ],
)
def test_distribution_of_noisyenv(name, ours, theirs, other):
    kind, steps = (1, 10_000) if "Reward" in name else (0, 10_000)

    def sample(env):
        env.reset(seed=0)
        return np.array([np.ravel(env.step(0)[kind])[0] for _ in range(steps)])

    np.random.seed(0)  # noisyenv draws from the global generator
    theirs_wrapper = getattr(noisyenv, name)
    reference = sample(theirs_wrapper(constant_env(), noise_rate=0.7, **(theirs or ours)))
    distorted = sample(theirs_wrapper(constant_env(), noise_rate=0.7, **other))
    got = sample(WRAPPERS[name](constant_env(), 0.7, **ours))
    critical = 1.95 * math.sqrt(2 / steps)  # the 0.1 % point
    assert ks_distance(got, reference) < critical
    assert ks_distance(got, distorted) > critical  # and the test has power


def test_recursive_mixup_of_noisyenv():
    """Within the first episode: noisyenv also carries its memory into the next one."""
    ours = RandomMixupObservation(numbered_env(), 1.0, 0.3, recursive=True)
    theirs = noisyenv.RandomMixupObservation(numbered_env(), noise_rate=1.0, factor=0.3)
    assert np.array_equal(ours.reset()[0], theirs.reset()[0])
    for _ in range(10):
        np.testing.assert_allclose(ours.step(0)[0], theirs.step(0)[0], rtol=1e-14)


# Seeds and streams


def pattern(steps):
    """Which steps were perturbed."""
    return ["noise" in info for *_, info in steps]


@pytest.mark.parametrize("text", NOISES)
def test_same_seed_same_noise(text):
    env = build(text, gym.wrappers.TimeLimit(GenericEnv(), 12), 0.5)
    first = rollout(env, seed=1)
    assert same(first, rollout(env, seed=1))
    assert same(first, rollout(build(text, gym.wrappers.TimeLimit(GenericEnv(), 12), 0.5), seed=1))
    assert pattern(first) != pattern(rollout(env, seed=2))


@pytest.mark.parametrize("text", NOISES)
def test_reset_without_seed_keeps_the_stream(text):
    env = build(text, episodes_env([12]), 0.5)
    runs = [pattern(rollout(env, seed)) for seed in (1, None, None)]
    assert runs[0] != runs[1] != runs[2] != runs[0]


@pytest.mark.parametrize("text", NOISES)
def test_never_seeded_draws_entropy(text):
    first, second = (rollout(build(text, episodes_env([12]), 0.5), steps=500) for _ in range(2))
    assert pattern(first) != pattern(second)


def test_equal_wrappers_in_a_stack_draw_different_noise():
    inner = RandomNormalNoisyReward(constant_env(0.0), 1.0, 0.3)
    middle = gym.wrappers.TimeLimit(inner, 1000)  # positions count noise wrappers only
    outer = RandomNormalNoisyReward(middle, 1.0, 0.3)
    outer.reset(seed=7)
    rewards = [outer.step(0)[1] for _ in range(20)]
    (_, inner_noise), (_, outer_noise) = (
        streams(RandomNormalNoisyReward, 7, position) for position in (0, 1)
    )
    both = [(inner_noise.normal(0, 0.3), outer_noise.normal(0, 0.3)) for _ in range(20)]
    assert rewards == [a + b for a, b in both]
    assert all(a != b for a, b in both)


def test_streams_of_different_wrappers_differ():
    states = set()
    for seed in range(3):
        for position in range(3):
            env = constant_env()
            for _ in range(position):
                env = RandomNormalNoisyReward(env, 0.5, 0.1)
            for text in ("RandomUniformNoisyReward(0, 1)", "RandomNormalNoisyReward(1)"):
                noisy = build(text, env, 0.5)
                noisy.reset(seed=seed)
                state = noisy.state_dict()
                states |= {str(state["gate"]), str(state["noise"])}
    assert len(states) == 3 * 3 * 2 * 2


@pytest.mark.parametrize("text", NOISES)
def test_initial_states_are_those_of_the_bare_environment(text):
    def initial_states(env):
        states = []
        for episode in range(4):
            env.reset(seed=11 if episode == 0 else None)
            data = env.unwrapped.data
            states.append((data.qpos.tobytes(), data.qvel.tobytes()))
            for _ in range(2):
                env.step(np.zeros(1))
        return states

    bare = initial_states(gym.make("InvertedPendulum-v5"))
    assert len(set(bare)) == 4
    assert initial_states(build(text, gym.make("InvertedPendulum-v5"), 1.0)) == bare
    assert initial_states(build(text, gym.make("InvertedPendulum-v5"), 0.3)) == bare


@pytest.mark.parametrize("text", NOISES)
def test_global_generator_is_untouched(text):
    before = np.random.get_state()[1].tobytes()
    rollout(build(text, GenericEnv(), 1.0), seed=0)
    assert np.random.get_state()[1].tobytes() == before


@pytest.mark.parametrize("text", STEP_NOISES)
def test_a_lower_rate_perturbs_a_subset_of_the_steps(text):
    def perturbed(rate):
        env = build(text, constant_env(), rate)
        steps = [env.reset(seed=4)[1]] + [env.step(0)[4] for _ in range(500)]
        return {t for t, info in enumerate(steps) if "noise" in info}

    sets = [perturbed(rate) for rate in (0, 0.1, 0.2, 0.7, 1)]
    assert all(low < high for low, high in zip(sets, sets[1:], strict=False))


def test_a_lower_rate_ends_a_subset_of_the_episodes_at_the_same_steps():
    def ends(rate):
        env = RandomEarlyTermination(episodes_env([60]), rate, 1, 50)
        found = set()
        for episode in range(200):
            env.reset(seed=4 if episode == 0 else None)
            for t in range(1, 61):
                _, _, terminated, _, info = env.step(0)
                if "noise" in info:
                    found.add((episode, t))
                if terminated:
                    break
        return found

    sets = [ends(rate) for rate in (0, 0.1, 0.2, 0.7, 1)]
    assert all(low < high for low, high in zip(sets, sets[1:], strict=False))
    assert len(sets[-1]) == 200


class Constant:
    """A generator whose uniforms are all one value."""

    def __init__(self, value):
        self.value = value

    def random(self):
        return self.value


@pytest.mark.parametrize("text", STEP_NOISES)
def test_the_gate_at_the_ends_of_the_unit_interval(text):
    """Rate 0 never acts and rate 1 always, also on the smallest and the largest uniform."""
    for rate, uniform in [(0, 0.0), (1, np.nextafter(1.0, 0.0))]:
        env = build(text, constant_env(), rate)
        env.reset(seed=0)
        env._gate = Constant(uniform)
        assert ("noise" in env.step(0)[4]) == (rate == 1)


# What must not change


@pytest.mark.parametrize("text", NOISES)
@pytest.mark.parametrize("env_id", ["Pendulum-v1", None, "InvertedPendulum-v5"])
def test_rate_zero_is_the_bare_environment(text, env_id):
    env_id = env_id or registered(text)[0]
    env = gym.make(env_id)
    env.action_space.seed(0)
    action = env.action_space.sample()
    bare = rollout(env, seed=3, steps=50, action=action)
    assert same(rollout(build(text, gym.make(env_id), 0.0), 3, 50, action), bare)


@pytest.mark.parametrize("text", NOISES)
def test_unperturbed_data_are_the_very_same_objects(text):
    data = (np.ones(3), 1.5, False, False, {"key": 1})
    env = GenericEnv(reset=lambda env: (data[0], data[4]), step=lambda env, action: data)
    env = build(text, env, 0.0)
    observation, info = env.reset(seed=0)
    assert observation is data[0] and info is data[4]
    assert all(got is given for got, given in zip(env.step(0), data, strict=True))


@pytest.mark.parametrize("text", NOISES)
def test_data_of_the_environment_are_never_mutated(text):
    owned = np.arange(1.0, 4.0)
    owned.flags.writeable = False
    info = {"key": "value"}
    reward = np.array(1.5)
    reward.flags.writeable = False
    env = GenericEnv(
        reset=lambda env: (owned, info),
        step=lambda env, action: (owned, reward, False, False, info),
    )
    env = build(text, env, 1.0)
    for step in rollout(env, seed=0, steps=20):
        name = type(env).__name__
        assert step[4] in ({"key": "value"}, {"key": "value", "noise": (name,)})  # no pile-up
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


@pytest.mark.parametrize(("wrapper", "args", "kwargs", "formula"), REWARD_CASES)
@pytest.mark.parametrize(
    ("reward", "kind"),
    [(1.5, float), (np.float64(1.5), np.float64), (np.float32(1.5), np.float32), (2, float)],
)
def test_reward_type(wrapper, args, kwargs, formula, reward, kind):
    env = GenericEnv(step=lambda env, action: (np.zeros(3), reward, False, False, {}))
    env = wrapper(env, 1.0, *args, **kwargs)
    env.reset(seed=0)
    got = env.step(0)[1]
    assert type(got) is kind
    assert got == pytest.approx(formula(streams(wrapper, 0)[1], float(reward)), rel=1e-6)


@pytest.mark.parametrize(("wrapper", "args", "kwargs", "formula"), REWARD_CASES)
@pytest.mark.parametrize("rate", [0.5, 1.0])
def test_a_reward_of_shape_one_is_a_number(wrapper, args, kwargs, formula, rate):
    reward = np.array([1.5], np.float32)
    env = GenericEnv(step=lambda env, action: (np.zeros(3), reward, False, False, {}))
    env = wrapper(env, rate, *args, **kwargs)
    env.reset(seed=0)
    gate, noise = streams(wrapper, 0)
    for _ in range(20):
        got = env.step(0)[1]
        if gate.random() < rate:
            assert type(got) is float and got == pytest.approx(formula(noise, 1.5))
        else:
            assert got is reward
    assert reward == 1.5


# Spaces


def spaces(draw):
    """A Box of any numeric dtype and shape, partly unbounded if of floats."""
    dtype = np.dtype(draw(st.sampled_from(["f2", "f4", "f8", "u1", "i1", "i2", "i4", "i8", "u8"])))
    shape = draw(st.sampled_from([(), (1,), (3,), (2, 3), (2, 1, 2)]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    low = rng.uniform(0 if dtype.kind == "u" else -100, 50, shape).astype(dtype)
    high = (low + rng.uniform(0, 50, shape)).astype(dtype)
    if dtype.kind == "f" and draw(st.booleans()):
        low = np.where(rng.random(shape) < 0.5, -np.inf, low).astype(dtype)
        high = np.where(rng.random(shape) < 0.5, np.inf, high).astype(dtype)
    return gym.spaces.Box(low, np.maximum(low, high), dtype=dtype)


numbers = st.floats(-100, 100)
probabilities = st.floats(0, 1)
intervals = st.tuples(numbers, numbers).map(sorted)


@st.composite
def observation_wrappers(draw):
    """A function that wraps an environment in some observation noise."""
    wrapper = draw(st.sampled_from([case[0] for case in OBSERVATION_CASES]))
    kwargs = {}
    if wrapper is RandomNormalNoisyObservation:
        args = (draw(st.floats(0, 50)),)
        kwargs = {"loc": draw(numbers)}
    elif wrapper in (RandomMixupObservation, RandomDropoutObservation):
        args = (draw(probabilities),)
        if wrapper is RandomMixupObservation:
            kwargs = {"recursive": draw(st.booleans())}
    else:
        args = draw(intervals)
        if wrapper is RandomUniformScaleObservation:
            kwargs = {"per_dimension": draw(st.booleans())}
    rate = draw(probabilities)
    return lambda env: wrapper(env, rate, *args, **kwargs)


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")  # float16 times 10^4
@hypothesis_settings
@given(st.data())
def test_observations_stay_in_the_space(data):
    space = spaces(data.draw)
    wrap = data.draw(observation_wrappers())
    low = np.clip(space.low.astype(float), -100, 100)
    high = np.clip(space.high.astype(float), -100, 100)
    rng = np.random.default_rng(0)
    given_out = []

    def observe(env):
        values = (low, high, rng.uniform(low, high))[len(given_out) % 3]
        observation = np.array(values, space.dtype)
        given_out.append((observation, observation.copy()))
        return observation

    env = GenericEnv(
        space,
        reset=lambda env: (observe(env), {}),
        step=lambda env, action: (observe(env), 0.0, False, False, {}),
    )
    noisy = wrap(wrap(env))
    for step in rollout(noisy, seed=0, steps=12):
        observation = step[0]
        assert isinstance(observation, np.ndarray)
        assert (observation.dtype, observation.shape) == (space.dtype, space.shape)
        assert observation in noisy.observation_space
        if "noise" not in step[4]:
            assert observation in space
    assert all(np.array_equal(observation, kept) for observation, kept in given_out)
    assert np.all(noisy.observation_space.low <= space.low)
    assert np.all(noisy.observation_space.high >= space.high)


def test_rounding_keeps_a_mixture_in_the_space():
    """0.1 * x + 0.9 * x is not x for every double."""
    top = np.random.default_rng(0).uniform(1, 2, 1000)
    assert np.any(0.1 * top + 0.9 * top > top)
    env = GenericEnv(
        gym.spaces.Box(-top, top, dtype=np.float64),
        reset=lambda env: (top.copy(), {}),
        step=lambda env, action: (top.copy(), 0.0, False, False, {}),
    )
    env = RandomMixupObservation(env, 1.0, 0.1)
    assert all(step[0] in env.observation_space for step in rollout(env, seed=0, steps=3))


@pytest.mark.parametrize(
    ("text", "low", "high"),
    [
        ("RandomNormalNoisyObservation(0.1)", [-np.inf] * 3, [np.inf] * 3),
        ("RandomUniformNoisyObservation(-0.5, 1.0)", [-1.5, 1.5, -np.inf], [3, 4, np.inf]),
        ("RandomUniformNoisyObservation(0.5, 1.0)", [-1, 2, -np.inf], [3, 4, np.inf]),
        ("RandomUniformScaleObservation(0.5, 2.0)", [-2, 1, -np.inf], [4, 6, np.inf]),
        ("RandomUniformScaleObservation(-1.0, 0.0)", [-2, -3, -np.inf], [2, 3, np.inf]),
        ("RandomUniformScaleObservation(0.0, 0.0)", [-1, 0, -np.inf], [2, 3, np.inf]),
        ("RandomMixupObservation(0.5)", [-1, 2, -np.inf], [2, 3, np.inf]),
        ("RandomDropoutObservation(0.5)", [-1, 0, -np.inf], [2, 3, np.inf]),
    ],
)
def test_widened_space(text, low, high):
    space = gym.spaces.Box(
        np.array([-1, 2, -np.inf], np.float32), np.array([2, 3, np.inf], np.float32)
    )
    widened = build(text, GenericEnv(space), 0.1).observation_space
    assert widened.dtype == np.float32
    np.testing.assert_array_equal(widened.low, low)
    np.testing.assert_array_equal(widened.high, high)


def test_integer_observations_are_rounded_and_clipped():
    values = np.array([0, 3, 100, 255], np.uint8)
    space = gym.spaces.Box(0, 255, (4,), np.uint8)
    env = GenericEnv(space, reset=lambda env: (values, {}))
    env = RandomNormalNoisyObservation(env, 1.0, 40.0)
    _, noise = streams(RandomNormalNoisyObservation, 2)
    env.reset(seed=2)
    noise.normal(0, 40, 4)
    got = np.array([env.reset()[0] for _ in range(50)])
    expected = np.clip(np.rint(values + noise.normal(0, 40, (50, 4))), 0, 255)
    assert got.dtype == np.uint8
    np.testing.assert_array_equal(got, expected)
    assert 0 in got[:, 1] and 255 in got[:, 2:] and len(np.unique(got)) > 50


@pytest.mark.parametrize("given", [np.array([1, 2, 3]), [1, 2, 3], np.array([1.0, 2.0, 3.0])])
def test_noise_has_the_dtype_of_the_space_whatever_the_environment_returns(given):
    """Rounding to the integers that an environment happens to return would undo the noise."""
    space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    env = GenericEnv(space, reset=lambda env: (given, {}))
    env = RandomNormalNoisyObservation(env, 1.0, 0.1)
    _, noise = streams(RandomNormalNoisyObservation, 0)
    expected = [1, 2, 3] + noise.normal(0, 0.1, 3)
    got = env.reset(seed=0)[0]
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, expected.astype(np.float32))


def test_an_environments_own_info_of_noise_gives_way():
    env = GenericEnv(gym.spaces.Box(-1, 1, (3,)), reset=lambda env: (np.zeros(3), {"noise": 0.3}))
    assert env.reset()[1] == {"noise": 0.3}
    env = RandomNormalNoisyObservation(RandomDropoutObservation(env, 1.0, 0.5), 1.0, 0.1)
    names = ("RandomDropoutObservation", "RandomNormalNoisyObservation")
    assert env.reset()[1]["noise"] == names


class Monitor(gym.Wrapper):
    """Records episodes as Stable-Baselines3's wrapper of this name does."""

    def reset(self, **kwargs):
        self.rewards = []
        return self.env.reset(**kwargs)

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.rewards.append(reward)
        if terminated or truncated:
            info["episode"] = {"r": sum(self.rewards), "l": len(self.rewards), "t": 0.0}
        return observation, reward, terminated, truncated, info

    def get_episode_rewards(self):
        return []


@pytest.mark.parametrize("recorder", [RecordEpisodeStatistics, Monitor])
def test_statistics_are_recorded_once(recorder):
    env = recorder(gym.make("CartPole-v1"))
    for recorded in (env, RandomNormalNoisyReward(env, 0.1, 1.0)):
        with pytest.raises(ValueError, match="record_statistics=False") as error:
            make_noisy(recorded, [], [])
        assert "\n" not in str(error.value)


def test_a_record_that_shows_only_when_the_episode_ends():
    def step(env, action):
        assert action is not None
        return np.zeros(3), 1.0, True, False, {"episode": {"r": 1.0}}

    env = make_noisy(GenericEnv(step=step), [A], [0.5])
    env.reset(seed=0)
    with pytest.raises(ValueError, match="record_statistics=False"):
        env.step(0)
    with pytest.raises(AssertionError):  # an assertion of the environment's own stays what it is
        env.step(None)


@pytest.mark.parametrize("recorder", [RecordEpisodeStatistics, Monitor])
def test_the_record_of_the_environment_is_kept(recorder):
    env = recorder(gym.wrappers.TimeLimit(constant_env(2.0), 5))
    env = make_noisy(env, [A, B], [1.0], record_statistics=False)
    assert layers(env)[-3:] == [recorder.__name__, A.split("(")[0], B.split("(")[0]]
    env.reset(seed=0)
    steps = [env.step(0) for _ in range(5)]
    assert steps[-1][4]["episode"]["r"] == 10.0
    assert steps[-1][4]["episode"]["l"] == 5
    assert sum(step[1] for step in steps) != 10.0


@pytest.mark.parametrize("recorder", [RecordEpisodeStatistics, Monitor])
def test_a_record_would_miss_the_episodes_that_are_ended_above_it(recorder):
    env = recorder(gym.make("CartPole-v1"))
    for recorded in (env, RandomNormalNoisyReward(env, 0.1, 1.0)):
        with pytest.raises(ValueError, match=r"Monitor\(make_noisy\(env") as error:
            make_noisy(recorded, [A, C], [0.5], record_statistics=False)
        assert "\n" not in str(error.value)
    make_noisy(env, [C], [0], record_statistics=False)  # no noise
    # What the agent meets and what is recorded agree about noisy actions.
    env = recorder(gym.make("Pendulum-v1"))
    make_noisy(env, ["RandomNormalNoisyAction(1)"], [1.0], record_statistics=False)


def test_no_record_where_none_is_wanted():
    env = make_noisy(constant_env(), [A, C], [0.5], record_statistics=False)
    assert layers(env) == ["RandomEarlyTermination", "RandomNormalNoisyReward"]
    assert layers(make_noisy(constant_env(), [], [], record_statistics=False)) == []


@pytest.mark.parametrize("dtype", [np.int64, np.uint64])
def test_wide_integers_do_not_overflow(dtype):
    limits = np.iinfo(dtype)
    space = gym.spaces.Box(limits.min, limits.max - 1, (2,), dtype)
    values = np.array([limits.min, limits.max - 1], dtype)
    env = GenericEnv(space, reset=lambda env: (values, {}))
    env = RandomUniformScaleObservation(env, 1.0, 1.5, 1.5)
    got = env.reset(seed=0)[0]
    assert got[0] == limits.min
    assert got[1] == pytest.approx(limits.max, rel=1e-9) and got[1] > 0
    assert got in env.observation_space


@pytest.mark.filterwarnings("ignore:.*WARN")
@pytest.mark.parametrize("text", NOISES)
@pytest.mark.parametrize(
    "env",
    [
        lambda text: gym.make(registered(text)[0]),
        lambda text: gym.make("Pendulum-v1"),
        lambda text: gym.make("InvertedPendulum-v5"),
        lambda text: GenericEnv(gym.spaces.Box(-6, 5, (2, 3), np.int8)),
        lambda text: GenericEnv(gym.spaces.Box(-5, 5, (), np.float32)),
    ],
    ids=["CartPole", "Pendulum", "InvertedPendulum", "int8", "scalar"],
)
def test_check_env(text, env):
    for rate in (1.0, 0.3, "1.0:0.0"):
        check_env(build(text, env(text), rate), skip_render_check=True)


UNSUITABLE_SPACES = [
    gym.spaces.Dict(x=BOX),
    gym.spaces.Tuple((BOX, BOX)),
    gym.spaces.MultiBinary(3),
]


@pytest.mark.parametrize("space", UNSUITABLE_SPACES, ids=lambda space: type(space).__name__)
@pytest.mark.parametrize("text", NOISES)
def test_spaces_other_than_box(text, space):
    env = GenericEnv(space)
    if not text.split("(")[0].endswith("Observation"):
        build(text, env, 0.1)
        return
    with pytest.raises(ValueError, match="FlattenObservation") as error:
        build(text, env, 0.1)
    assert type(space).__name__ in str(error.value) and "\n" not in str(error.value)
    build(text, FlattenObservation(env), 0.1)


CATEGORIES = [
    gym.spaces.Discrete(3),
    gym.spaces.MultiDiscrete([2, 3]),
    gym.spaces.Dict(x=BOX, kind=gym.spaces.Discrete(3)),
    gym.spaces.Tuple((BOX, gym.spaces.Dict(kind=gym.spaces.MultiDiscrete([2, 3])))),
]


@pytest.mark.parametrize("space", CATEGORIES, ids=lambda space: type(space).__name__)
@pytest.mark.parametrize("text", NOISES)
def test_categories_are_not_perturbed_as_if_they_were_quantities(text, space):
    env = GenericEnv(space, reset=lambda env: (space.sample(), {}))
    flat = RandomNormalNoisyReward(gym.wrappers.TimeLimit(FlattenObservation(env), 9), 0.1, 1)
    if not text.split("(")[0].endswith("Observation"):
        build(text, flat, 1.0).reset(seed=0)
        return
    for unsuitable in (env, flat):
        with pytest.raises(ValueError, match="cannot perturb categories.*reward noise") as error:
            build(text, unsuitable, 0.1)
        assert "\n" not in str(error.value)


# Parameters


BAD_NUMBERS = [math.nan, math.inf, -math.inf, True, "0.5", None, [0.5], 1j, np.array([0.5, 0.5])]
BAD_STEPS = [0, -1, 2**63, 1.0, 2.5, math.nan, math.inf, True, "3", np.float64(2.0)]
BAD_FLAGS = [0, 1, None, "yes", np.True_]


def bad_parameters():
    for name in WRAPPERS:
        args = {"RandomEarlyTermination": (3,)}.get(name, (0.5,))
        if "Uniform" in name:
            args = (0.5, 1.0)
            for bad in BAD_NUMBERS:
                yield name, 0.1, (bad, 1.0), {}, "low", bad
                yield name, 0.1, (0.5, bad), {}, "high", bad
            yield name, 0.1, (1.0, 0.5), {}, "low", 1.0
        for bad in [*BAD_NUMBERS, -0.001, 1.001, -1, 2]:
            yield name, bad, args, {}, "noise_rate", bad
            if "Mixup" in name or "Dropout" in name:
                parameter = "factor" if "Mixup" in name else "keep_prob"
                yield name, 0.1, (bad,), {}, parameter, bad
        if "Normal" in name:
            for bad in [*BAD_NUMBERS, -0.001, -1, 10**400]:
                yield name, 0.1, (bad,), {}, "scale", bad
            for bad in BAD_NUMBERS:
                yield name, 0.1, (0.5,), {"loc": bad}, "loc", bad
    for bad in BAD_STEPS:
        yield "RandomEarlyTermination", 0.1, (bad,), {}, "low", bad
        yield "RandomEarlyTermination", 0.1, (3, bad), {}, "high", bad
    yield "RandomEarlyTermination", 0.1, (), {}, "low", None
    yield "RandomEarlyTermination", 0.1, (None, 5), {}, "low", None
    yield "RandomEarlyTermination", 0.1, (5, 4), {}, "low", 5
    yield "RandomEarlyTermination", 0.1, (5,), {"each_step": True}, "low", 5
    yield "RandomEarlyTermination", 0.1, (None, 5), {"each_step": True}, "high", 5
    for bad in BAD_FLAGS:
        yield "RandomEarlyTermination", 0.1, (5,), {"truncate": bad}, "truncate", bad
        yield "RandomEarlyTermination", 0.1, (5,), {"each_step": bad}, "each_step", bad
        yield "RandomMixupObservation", 0.1, (0.5,), {"recursive": bad}, "recursive", bad
        keywords = {"per_dimension": bad}
        yield "RandomUniformScaleObservation", 0.1, (0, 1), keywords, "per_dimension", bad


def test_bad_parameters():
    cases = list(bad_parameters())
    assert len(cases) > 250
    for name, rate, args, kwargs, parameter, value in cases:
        with pytest.raises(ValueError) as error:
            WRAPPERS[name](constant_env(), rate, *args, **kwargs)
        message = str(error.value)
        assert re.search(rf"\b{parameter}\b", message), (name, args, kwargs, message)
        assert repr(value) in message, (name, args, kwargs, message)


@pytest.mark.parametrize("text", NOISES)
def test_noise_rate_is_writable_and_checked(text):
    env = build(text, constant_env(), 0)
    for rate in (1, 0.0, np.float32(0.5), 1.0):
        env.noise_rate = rate
        assert env.noise_rate == rate and type(env.noise_rate) is float
    for bad in (-0.1, 1.1, math.nan, True, "1", None):
        with pytest.raises(ValueError, match="noise_rate"):
            env.noise_rate = bad
        assert env.noise_rate == 1.0
    env.reset(seed=0)
    for _ in range(9):
        env.step(0)
    assert env.applied_fraction == 1.0


SCALES = "RandomNormalNoisyObservation((0.1, 0.2, 0.0), loc=1.0)"


@pytest.mark.filterwarnings("ignore:.*WARN")
def test_a_scale_for_each_dimension():
    assert str(parse_noise("RandomNormalNoisyObservation(loc=1, scale=(.1, 0.20, -0.0))")) == SCALES
    env = parse_noise(SCALES)(gym.make("Pendulum-v1"), 1.0)
    assert env.scale == (0.1, 0.2, 0.0)
    for spec in (env.spec, gym.envs.registration.EnvSpec.from_json(env.spec.to_json())):
        assert spec.make().scale == env.scale
    check_env(env, skip_render_check=True)
    noises, rates = canonical_noises([SCALES], [0.5])
    assert noises == [SCALES]
    name = "p0.5_s1_NormalNoisyObservation_0.1_0.2_0.0_loc=1.0__E__x"
    assert run_name("E", "x", noises, rates, 1) == name
    others = ["((0.1, 0.2), loc=1)", "(0.1, loc=1)", "((0.1, 0.2, 0), loc=0)", "((0.1, 0.2, 1.0))"]
    names = {run_name("E", "x", [f"RandomNormalNoisyObservation{o}"], rates, 1) for o in others}
    assert len(names | {name}) == 5


@pytest.mark.parametrize("shape", [(2,), (4,), (3, 1), (1, 3), ()])
def test_a_scale_for_each_of_other_dimensions(shape):
    with pytest.raises(ValueError, match="scale has 3 numbers and the observation has") as error:
        make_noisy(constant_env(shape=shape), [SCALES], [0.5])
    assert str(shape) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("scale", [(), (0.1,), (0.1, -0.1, 0.1), (0.1, "1", 0.1), ((1, 2), 3, 4)])
def test_bad_scales(scale):
    with pytest.raises(ValueError, match=r"\bscale\b"):
        RandomNormalNoisyObservation(constant_env(), 0.5, scale)
    with pytest.raises(ValueError, match=r"\bscale\b"):
        parse_noise(f"RandomNormalNoisyObservation({scale!r})")
    for name in ("RandomNormalNoisyReward", "RandomNormalNoisyAction"):
        with pytest.raises(ValueError, match=r"\bscale\b"):
            parse_noise(f"{name}((0.1, 0.2))")


def test_limits_of_the_parameters_are_allowed():
    env = constant_env()
    RandomNormalNoisyObservation(env, 0, 0)
    RandomNormalNoisyReward(RandomNormalNoisyReward(env, 1, -0.0), 1, 0).reset(seed=0)
    RandomUniformNoisyReward(env, 1, 0.5, 0.5)
    RandomMixupObservation(env, np.float64(0.5), 1)
    RandomDropoutObservation(env, 1, 0)
    RandomEarlyTermination(env, 1, np.int64(1), np.int32(1))
    quiet = RandomNormalNoisyReward(env, 1, -0.0)  # Generator.normal refuses -0.0
    quiet.reset(seed=0)
    assert quiet.step(0)[1] == 2.0


# Copies, specs, checkpoints


@pytest.mark.parametrize("text", NOISES)
def test_spec_round_trip(text):
    env_id, action = registered(text)
    env = RandomNormalNoisyReward(build(text, gym.make(env_id), 0.25), np.float64(0.5), 1)
    for spec in (env.spec, gym.envs.registration.EnvSpec.from_json(env.spec.to_json())):
        made = spec.make()
        assert str(made) == str(env)
        assert made.spec == env.spec
        assert made.env.noise_rate == 0.25
        assert vars(made.env).keys() == vars(env.env).keys()
        for name in ("low", "high", "scale", "factor", "keep_prob", "recursive", "truncate"):
            assert getattr(made.env, name, None) == getattr(env.env, name, None)
        assert same(rollout(made, 5, action=action), rollout(env, 5, action=action))


@pytest.mark.parametrize("text", NOISES)
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_continue_alike(text, duplicate):
    env_id, action = registered(text)
    env = build(text, gym.make(env_id), 0.5)
    env.reset(seed=2)
    env.step(action)
    twin = duplicate(env)
    ours = [env.step(action), *rollout(env, action=action)]
    assert same(ours, [twin.step(action), *rollout(twin, action=action)])
    assert (twin.times_applied, twin.opportunities) == (env.times_applied, env.opportunities)


@pytest.mark.parametrize("text", NOISES)
def test_state_dict_continues_the_streams(text, tmp_path):
    env = build(text, constant_env(), 0.5)
    rollout(env, seed=6)
    torch.save(env.state_dict(), tmp_path / "state.pt")
    expected = rollout(env)
    other = build(text, constant_env(), 0.5)
    rollout(other, seed=99, steps=7)
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert same(rollout(other), expected)
    assert other.state_dict() == env.state_dict()


def test_state_dict_is_a_snapshot():
    env = RandomNormalNoisyReward(constant_env(), 1.0, 1.0)
    env.reset(seed=0)
    before = env.state_dict()
    kept = copy.deepcopy(before)
    env.step(0)
    assert before == kept != env.state_dict()


# The notation


@pytest.mark.parametrize("text", NOISES)
def test_notation_round_trips(text):
    noise = parse_noise(text)
    assert str(noise) == text
    assert parse_noise(str(noise)) == noise
    assert len({noise, parse_noise(text)}) == 1
    wrapper = noise(constant_env(), 0.5)
    assert str(wrapper).startswith(f"<{text.split('(')[0]}<")
    assert rollout(wrapper, 0)[-1][1:] == rollout(build(text, constant_env(), 0.5), 0)[-1][1:]


@pytest.mark.parametrize(
    ("canonical", "spellings"),
    [
        (
            "RandomUniformScaleReward(0.5, 1.5)",
            ["RandomUniformScaleReward(.5,1.50)", " RandomUniformScaleReward( 0.50, high=15e-1 ) "]
            + ["RandomUniformScaleReward(high=1.5, low=5e-1)"],
        ),
        (
            "RandomNormalNoisyReward(1.0)",
            ["RandomNormalNoisyReward(1)", "RandomNormalNoisyReward(+1)"],
        ),
        ("RandomNormalNoisyReward(0.001)", ["RandomNormalNoisyReward(1e-3, loc=-0.0)"]),
        ("RandomNormalNoisyReward(0.001, loc=2.0)", ["RandomNormalNoisyReward(loc=2,scale=.001)"]),
        ("RandomUniformNoisyReward(-0.001, 0.001)", ["RandomUniformNoisyReward(-.001, .001)"]),
        ("RandomUniformNoisyReward(0.0, 0.5)", ["RandomUniformNoisyReward(-0.0, .5)"]),
        ("RandomEarlyTermination(50)", ["RandomEarlyTermination(50, 50)"]),
        ("RandomEarlyTermination(50)", ["RandomEarlyTermination(high=50, low=50)"]),
        ("RandomEarlyTermination(50)", ["RandomEarlyTermination(50, None, truncate=False)"]),
        ("RandomEarlyTermination(1, 100)", ["RandomEarlyTermination(1,100,each_step=False)"]),
        (
            "RandomEarlyTermination(each_step=True, truncate=True)",
            ["RandomEarlyTermination(truncate=True, each_step=True)"],
        ),
        ("RandomMixupObservation(0.0)", ["RandomMixupObservation(0, recursive=False)"]),
        (
            "RandomMixupObservation(0.0, recursive=True)",
            ["RandomMixupObservation(recursive=True, factor=0)"],
        ),
        (
            "RandomUniformScaleObservation(0.8, 1.2)",
            ["RandomUniformScaleObservation(0.8, 1.2, per_dimension=False)"],
        ),
    ],
)
def test_canonical_spelling(canonical, spellings):
    for text in spellings:
        assert str(parse_noise(text)) == canonical
        assert parse_noise(text) == parse_noise(canonical)
        assert run_name("E", "x", [text], [0.1], 1) == run_name("E", "x", [canonical], [0.10], 1)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Baseline",
        "RandomNormalNoisyReward",
        "RandomNormalNoisyReward()",
        "RandomNormalNoisyReward(1, 2)",
        "RandomNormalNoisyReward(-1)",
        "RandomNormalNoisyReward(1",
        "RandomNormalNoisyReward(1, sigma=2)",
        "RandomNormalNoisyReward(1, noise_rate=0.5)",
        "RandomNormalNoisyReward(1, env=0)",
        "RandomNormalNoisyReward('1')",
        "RandomNormalNoisyReward(True)",
        "RandomNormalNoisyReward(2 * 3)",
        "RandomNormalNoisyReward(1e999)",
        "RandomNormalNoisyReward(x)",
        "RandomNormalNoisyReward(*[1])",
        "RandomNormalNoisyReward(1, **{'loc': 2})",
        "RandomNormalNoisyReward(1, loc=1, loc=2)",
        "RandomNormalNoisyReward(1)\nRandomNormalNoisyReward(1)",
        "RandomNormalNoisyReward({[]: 1})",
        "RandomNormalNoisyReward(1)(2)",
        "noisy_wrappers.RandomNormalNoisyReward(1)",
        "NoiseWrapper(1)",
        "dict()",
        "RandomUniformScaleReward(0.5)",
        "RandomUniformScaleReward(1.5, 0.5)",
        "RandomEarlyTermination()",
        "RandomEarlyTermination(0)",
        "RandomEarlyTermination(5.0)",
        "RandomEarlyTermination(5, 1)",
        "RandomEarlyTermination(5, each_step=True)",
        "RandomMixupObservation(2)",
        "RandomMixupObservation(0, True)",
        "__import__('os').system('true')",
        "RandomNormalNoisyReward(__import__('os').getpid())",
        "RandomNormalNoisyReward(\x00)",
        "(" * 500,
    ],
)
def test_bad_notation(text):
    with pytest.raises(ValueError) as error:
        parse_noise(text)
    reason, *lines = str(error.value).split("\n  ")
    assert "\n" not in reason and repr(text) in reason
    assert lines == signatures()


def test_signatures():
    assert [text.split("(")[0] for text in signatures()] == list(WRAPPERS)
    assert "RandomMixupObservation(factor, *, recursive=False)" in signatures()
    assert "RandomUniformScaleReward(low, high)" in signatures()
    assert "RandomNormalNoisyAction(scale, *, loc=0.0)" in signatures()


def test_the_registry_is_complete():
    assert list(WRAPPERS) == [
        "RandomNormalNoisyObservation",
        "RandomUniformNoisyObservation",
        "RandomUniformScaleObservation",
        "RandomMixupObservation",
        "RandomDropoutObservation",
        "RandomNormalNoisyReward",
        "RandomUniformNoisyReward",
        "RandomUniformScaleReward",
        "RandomEarlyTermination",
        "RandomNormalNoisyAction",
    ]
    assert all(issubclass(wrapper, NoiseWrapper) for wrapper in WRAPPERS.values())
    assert {text.split("(")[0] for text in NOISES} == set(WRAPPERS)


A, B, C = (
    "RandomNormalNoisyReward(1)",
    "RandomDropoutObservation(.5)",
    "RandomEarlyTermination(9,9)",
)


def test_canonical_noises():
    assert canonical_noises([], []) == ([], [])
    assert canonical_noises([A], [0.5]) == (["RandomNormalNoisyReward(1.0)"], [0.5])
    names = ["RandomEarlyTermination(9)", "RandomNormalNoisyReward(1.0)"]
    assert canonical_noises([A, C], [0.5]) == (names, [0.5, 0.5])  # dynamics noise comes first
    assert canonical_noises([A, B, C], [0.5, 0, 1]) == (names, [1.0, 0.5])
    assert canonical_noises([A, B], [0]) == ([], [])
    assert canonical_noises([A, B], ["0:0", 0.0]) == ([], [])
    assert canonical_noises([A, C], ["1:0", "0:.5"]) == (names, ["0.0:0.5", "1.0:0.0"])
    assert canonical_noises([A], ["-0.0:0"]) == ([], [])
    assert canonical_noises([A], ["0.50:.5"]) == (names[1:], [0.5])
    assert canonical_noises([A, A], ["1:0"])[1] == ["1.0:0.0", "1.0:0.0"]
    action = "RandomNormalNoisyAction(1.0)"
    assert canonical_noises([A, action, C], [0.1, 0.2, 0.3]) == (
        ["RandomEarlyTermination(9)", action, "RandomNormalNoisyReward(1.0)"],
        [0.3, 0.2, 0.1],
    )
    again = canonical_noises([B, A, C], [0.1, 0.2, 0.3])
    assert canonical_noises(*again) == again
    for rate in again[1]:
        assert type(rate) is float


@pytest.mark.parametrize(
    ("noises", "rates"),
    [
        ([], [0.1]),
        ([A], []),
        ([A], [0.1, 0.2]),
        ([A, B], []),
        ([A, B, C], [0.1, 0.2]),
        ([A], [1.1]),
        ([A], [-0.1]),
        ([A], [math.nan]),
        ([A, B], [0.1, 2]),
        (["Nothing(1)"], [0.0]),
        ([A], ["0.5:"]),
        ([A], ["1:2"]),
        ([A], ["a:b"]),
        ([A], ["0.5"]),
        ([A], ["1:0.5:0"]),
        ([A], ["nan:0"]),
    ],
)
def test_bad_noises_and_rates(noises, rates):
    for function in (
        lambda: canonical_noises(noises, rates),
        lambda: make_noisy(constant_env(), noises, rates),
        lambda: run_name("E", "x", noises, rates, 1),
    ):
        with pytest.raises(ValueError) as error:
            function()
        lines = str(error.value).split("\n  ")
        assert "\n" not in lines[0]
        assert lines[1:] == (signatures() if "Nothing" in str(noises) else [])


@pytest.mark.parametrize("function", [canonical_noises, noise_slug, make_noisy])
def test_noises_and_rates_are_lists(function):
    first = [constant_env()] if function is make_noisy else []
    for noises, rates, name in [(A, [0.5], "noises"), ([A], 0.5, "rates"), ([A], "1:0", "rates")]:
        with pytest.raises(ValueError, match=rf"^{name} must be a list, for example \[.*\], got "):
            function(*first, noises, rates)
    with pytest.raises(ValueError, match="bad noise <class"):
        function(*first, [RandomNormalNoisyReward], [0.5])


def test_numbers_and_arrays_of_numpy():
    rates = np.array([0.5, 0.0])
    assert canonical_noises(np.array([A, B]), rates) == canonical_noises([A, B], [0.5, 0.0])
    assert canonical_noises(np.array([A]), np.array([0.0])) == ([], [])
    for half in (np.float64(0.5), np.float32(0.5), np.array(0.5)):
        env = RandomNormalNoisyReward(constant_env(), half, half, loc=half)
        assert (env.noise_rate, env.scale, env.loc) == (0.5, 0.5, 0.5)
        assert {type(env.noise_rate), type(env.scale), type(env.loc)} == {float}
        set_progress(env, half)
    for nine in (np.int64(9), np.uint8(9), np.array(9)):
        assert type(RandomEarlyTermination(constant_env(), 0.5, nine).low) is int
    env = GenericEnv(gym.spaces.Box(-1, 1, (3,)))
    scales = RandomNormalNoisyObservation(env, 0.5, np.array([1, 2, 3])).scale
    assert scales == (1.0, 2.0, 3.0)
    assert {type(scale) for scale in scales} == {float}
    for bad in (np.array([[1.0, 2.0]]), np.array([0.1, np.nan]), np.array([0.1])):
        with pytest.raises(ValueError, match="scale"):
            RandomNormalNoisyObservation(env, 0.5, bad)
    for bad in (np.array([0.5, 0.5]), np.array(True), np.array(2.0)):
        with pytest.raises(ValueError, match="noise_rate"):
            RandomNormalNoisyReward(constant_env(), bad, 0.1)


def layers(env):
    names = []
    while isinstance(env, gym.Wrapper):
        names.append(type(env).__name__)
        env = env.env
    return names[::-1]


def test_make_noisy_order():
    statistics = "RecordEpisodeStatistics"
    reward, dropout, end = (text.split("(")[0] for text in (A, B, C))
    assert layers(make_noisy(constant_env(), [], [])) == [statistics]
    assert layers(make_noisy(constant_env(), [A], [0])) == [statistics]
    assert layers(make_noisy(constant_env(), [A, B], [0.5])) == [statistics, reward, dropout]
    for noises in ([A, B, C], [A, C, B], [C, A, B]):
        env = make_noisy(constant_env(), noises, [0.5])
        assert layers(env) == [end, statistics, reward, dropout]
    env = make_noisy(constant_env(), [A, "RandomNormalNoisyAction(1)", B, C], ["0:1"])
    assert layers(env) == [end, "RandomNormalNoisyAction", statistics, reward, dropout]
    assert {wrapper.schedule for wrapper in noise_wrappers(env).values()} == {(0.0, 1.0)}
    env = make_noisy(constant_env(), [B, A, C], [0.1, 0.2, 0.3])
    assert layers(env) == [end, statistics, dropout, reward]
    rates = {name: wrapper.noise_rate for name, wrapper in noise_wrappers(env).items()}
    assert rates == {end: 0.3, dropout: 0.1, reward: 0.2}
    assert list(rates) == [end, dropout, reward]


def test_noise_wrappers_numbers_repeats():
    env = make_noisy(constant_env(), [A, B, A, A], [0.1, 0.2, 0.3, 0.4])
    found = noise_wrappers(RecordEpisodeStatistics(env))
    name = "RandomNormalNoisyReward"
    assert list(found) == [name, "RandomDropoutObservation", f"{name}_2", f"{name}_3"]
    assert [wrapper.noise_rate for wrapper in found.values()] == [0.1, 0.2, 0.3, 0.4]
    assert noise_wrappers(constant_env()) == {}


def test_noise_statistics():
    env = make_noisy(constant_env(), [A, B, A], [1.0, 0.5, "1:0"])
    env.reset(seed=1)
    for _ in range(9):
        env.step(0)
    name, statistics = "RandomNormalNoisyReward", noise_statistics(env)
    assert list(statistics) == [
        f"{wrapper}/{number}"
        for wrapper in (name, "RandomDropoutObservation", f"{name}_2")
        for number in ("rate", "applied_fraction")
    ]
    wrappers = noise_wrappers(env)
    for wrapper in wrappers:
        assert statistics[f"{wrapper}/rate"] == wrappers[wrapper].noise_rate
        assert statistics[f"{wrapper}/applied_fraction"] == wrappers[wrapper].applied_fraction
    assert statistics[f"{name}/rate"] == statistics[f"{name}/applied_fraction"] == 1
    alone = make_noisy(constant_env(), [A], [0.25])
    assert list(noise_statistics(alone)) == ["rate", "applied_fraction"]
    assert noise_statistics(alone)["rate"] == 0.25
    assert noise_statistics(constant_env()) == {}


def test_statistics_see_the_true_return_and_length():
    noises = ["RandomUniformScaleReward(0, 0)", "RandomNormalNoisyReward(5)", C]
    env = make_noisy(GenericEnv(), noises, [1.0])
    rewards = [step[1] for step in rollout(GenericEnv(), seed=8, steps=9)[1:]]
    env.reset(seed=8)
    steps = [env.step(0) for _ in range(9)]
    assert [step[2] for step in steps] == [False] * 8 + [True]
    assert steps[-1][4]["episode"]["r"] == pytest.approx(sum(rewards))
    assert steps[-1][4]["episode"]["l"] == 9
    assert sum(step[1] for step in steps) != pytest.approx(sum(rewards))


def test_combined_noise_is_the_composition_of_the_formulas():
    noises = ["RandomUniformScaleReward(0.5, 1.5)", "RandomNormalNoisyReward(2)"]
    env = make_noisy(GenericEnv(), noises, [1.0])
    clean = [step[1] for step in rollout(GenericEnv(), seed=3)[1:]]
    noisy = [step[1] for step in rollout(env, seed=3)[1:]]
    _, scale = streams(RandomUniformScaleReward, 3, 0)
    _, shift = streams(RandomNormalNoisyReward, 3, 1)
    assert noisy == [r * scale.uniform(0.5, 1.5) + shift.normal(0, 2) for r in clean]


# Names of runs


def test_run_names():
    assert run_name("Hopper-v5", "sac", [], [], 1) == "baseline_s1__Hopper-v5__sac"
    assert run_name("Hopper-v5", "sac", [A], [0], 1) == "baseline_s1__Hopper-v5__sac"
    assert run_name("ALE/Pong-v5", "my exp", [], [], 2) == "baseline_s2__ALE-Pong-v5__my--exp"
    assert run_name("module:Env-v0", "x", [], [], 2) != run_name("module/Env-v0", "x", [], [], 2)
    noises = ["RandomMixupObservation(0, recursive=True)", "RandomUniformNoisyReward(-.5, 1)", C]
    assert run_name("E", "x", noises, [1, 0.05, 0.2], 3) == (
        "p0.2+1.0+0.05_s3_EarlyTermination_9+MixupObservation_0.0_recursive=True"
        "+UniformNoisyReward_-0.5_1.0__E__x"
    )

    name = run_name("E", "x", [A, C, B], ["1:0", 0.5, "0:.25"], 3)
    assert name == (
        "p0.5+1.0to0.0+0.0to0.25_s3_EarlyTermination_9+NormalNoisyReward_1.0"
        "+DropoutObservation_0.5__E__x"
    )


@pytest.mark.parametrize("noise", NOISES_OF_THE_PAPER)
@pytest.mark.parametrize("seed", [1, 10])
def test_31_characters_of_a_name_tell_rate_seed_and_kind(noise, seed):
    """TensorBoard's list shows no more. Kinds are told apart even where a name is cut."""
    kinds = {noise.partition("(")[0].removeprefix("Random") for noise in NOISES_OF_THE_PAPER}
    shown = run_name("HalfCheetah-v5", "ppo_continuous_noisy", [noise], [0.01], seed)[:31]
    rate, shown_seed, text = shown.split("_", 2)
    assert (rate, shown_seed) == ("p0.01", f"s{seed}")
    [kind] = [kind for kind in kinds if text.startswith(kind) or kind.startswith(text)]
    assert noise.startswith(f"Random{kind}(")


def test_a_folder_of_version_0_1_is_found(tmp_path):
    run = ("ALE/Pong-v5", "x", [A, C], ["1:0", 0.5], 3)
    new = tmp_path / "p0.5+1.0to0.0_s3_EarlyTermination_9+NormalNoisyReward_1.0__ALE-Pong-v5__x"
    assert run_folder(tmp_path, *run) == new
    name = "ALE-Pong-v5__x__RandomEarlyTermination_9_p0.5+RandomNormalNoisyReward_1.0_p1.0to0.0__3"
    (tmp_path / name).mkdir()
    assert run_folder(tmp_path, *run) == tmp_path / name
    (tmp_path / "Hopper-v5__x__baseline__1").mkdir()
    found = run_folder(str(tmp_path), "Hopper-v5", "x", [], [], 1)
    assert found == tmp_path / "Hopper-v5__x__baseline__1"


def test_long_run_names_fit_into_a_file_system():
    def name(last):
        scale = tuple(i / 1000 for i in range(1, 60)) + (last,)
        return run_name("Humanoid-v5", "sac", [f"RandomNormalNoisyObservation({scale})"], [1], 3)

    assert len(name(0.5)) <= 240 and name(0.5) != name(0.6)
    assert name(0.5) == name(0.50)
    assert name(0.5).startswith("p1.0_s3_NormalNoisyObservation_0.001_0.002_")
    assert name(0.5).endswith("__Humanoid-v5__sac") and re.fullmatch(
        r"[A-Za-z0-9._=+-]+", name(0.5)
    )


@st.composite
def configurations(draw):
    """Noises and rates from few values, so that equal ones come up."""
    few = st.sampled_from([0.0, -0.0, 0.05, 0.5, 1.0, 1e-7, 12.0, 1e16])
    noises = []
    for _ in range(draw(st.integers(0, 2))):
        name = draw(st.sampled_from(list(WRAPPERS)))
        if name == "RandomEarlyTermination":
            steps = sorted(draw(st.lists(st.sampled_from([1, 2, 12]), min_size=1, max_size=2)))
            arguments = [str(k) for k in steps] if draw(st.booleans()) else ["each_step=True"]
            arguments += draw(st.sampled_from([[], ["truncate=True"], ["truncate=False"]]))
        elif "Uniform" in name:
            arguments = [str(x) for x in sorted(draw(st.tuples(few, few)))]
        else:
            most = 1 if "Mixup" in name or "Dropout" in name else 1e16
            arguments = [str(min(draw(few), most))]
            if name == "RandomNormalNoisyObservation" and draw(st.booleans()):
                arguments = [str(tuple(draw(st.lists(few, min_size=2, max_size=3))))]
            if "Normal" in name and draw(st.booleans()):
                arguments.append(f"loc={draw(few)}")
        noises.append(f"{name}({', '.join(arguments)})")
    rates = [draw(st.sampled_from([0.0, 0.05, 0.5, 1.0, "0:0", "1:0", "0:.5"])) for _ in noises]
    return noises, rates


@settings(hypothesis_settings, max_examples=400)
@given(configurations(), configurations())
def test_names_are_equal_exactly_if_the_configurations_are(one, two):
    names = [run_name("Hopper-v5", "sac", *configuration, 1) for configuration in (one, two)]
    assert (names[0] == names[1]) == (canonical_noises(*one) == canonical_noises(*two))
    assert all(re.fullmatch(r"[A-Za-z0-9._=+-]+", name) for name in names)
    assert run_name("Hopper-v5", "sac", *canonical_noises(*one), 1) == names[0]


# Names of environments


def test_canonical_env_id():
    toy = "toy_envs:Tiny-v0"
    for env_id, canonical in [
        ("Hopper", "Hopper-v5"),
        ("Hopper-v5", "Hopper-v5"),
        ("Hopper-v4", "Hopper-v4"),
        ("Pendulum", "Pendulum-v1"),
        ("phys2d/CartPole", "phys2d/CartPole-v1"),
        (toy, toy),
        ("toy_envs:Tiny", toy),
    ]:
        assert canonical_env_id(env_id) == canonical
        assert canonical_env_id(canonical) == canonical


@pytest.mark.parametrize(
    ("env_id", "reason"),
    [
        ("Hoper-v5", "Did you mean: `Hopper`"),
        ("Hopper-v77", "v77"),
        ("Hopper v5", "Malformed"),
        ("", "Malformed"),
        ("no_such_module:Env-v0", "No module named 'no_such_module'"),
        ("toy_envs:Nothing-v0", "Nothing"),
        ("toy_envs.nothing:Env-v0", "toy_envs.nothing"),
        ("..toy_envs:Tiny-v0", "'..toy_envs' is no module's name"),
    ],
)
def test_unknown_environments(env_id, reason):
    with pytest.raises(ValueError) as error:
        canonical_env_id(env_id)
    message = str(error.value)
    assert repr(env_id) in message and reason in message and "\n" not in message


@pytest.mark.parametrize(
    ("source", "error"),
    [("{}[1]", KeyError), ("import no_such_module", ModuleNotFoundError), ("x = ][", SyntaxError)],
)
def test_what_a_module_raises_passes_through(source, error, tmp_path, monkeypatch):
    (tmp_path / "buggy_module.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    path = sys.path[:]
    with pytest.raises(error):
        canonical_env_id("buggy_module:Env-v0")
    assert sys.path == path


# Environments for networks


class Given(gym.Env):
    """Observes and rewards what it is told to."""

    def __init__(self, observation_space, action_space=gym.spaces.Box(-1, 1, (2,))):  # noqa: B008
        self.observation_space, self.action_space = observation_space, action_space
        self.observation, self.reward = observation_space.sample(), 1.0

    def reset(self, *, seed=None, options=None):
        return self.observation, {}

    def step(self, action):
        return self.observation, self.reward, True, False, {"some": "info"}


BOX = gym.spaces.Box(-1, 1, (3,), np.float32)


@pytest.mark.parametrize(
    "space",
    [
        BOX,
        gym.spaces.Box(0, 255, (2, 3), np.uint8),
        gym.spaces.Dict({"a": BOX, "b": gym.spaces.Discrete(4)}),
        gym.spaces.Tuple([gym.spaces.MultiBinary(2), BOX]),
        gym.spaces.Discrete(5),
    ],
)
def test_make_flat_makes_observations_vectors(space):
    inner = Given(space)
    env = make_flat(inner)
    assert isinstance(env.observation_space, gym.spaces.Box)
    assert len(env.observation_space.shape) == 1
    for observation in (env.reset()[0], env.step(None)[0]):
        np.testing.assert_array_equal(observation, gym.spaces.flatten(space, inner.observation))
        assert env.observation_space.contains(observation)
    flattened = isinstance(env.env, FlattenObservation)
    assert flattened == (space is not BOX)  # a vector passes as it is


@pytest.mark.parametrize(
    ("observations", "actions", "word"),
    [
        (gym.spaces.Sequence(BOX), BOX, "Box observations of numbers"),
        (gym.spaces.Box(0, 1, (1,), np.bool_), BOX, "Box observations of numbers"),
        (BOX, gym.spaces.Discrete(3), "Box actions of floats"),
        (BOX, gym.spaces.Box(-1, 1, (1,), np.int32), "Box actions of floats"),
        (BOX, gym.spaces.Box(-1, 1, (2, 2)), "in one dimension"),
    ],
)
def test_make_flat_refuses_what_networks_cannot_take(observations, actions, word):
    with pytest.raises(ValueError, match=word) as error:
        make_flat(Given(observations, actions))
    assert str(actions if "actions" in word or "dim" in word else observations) in str(error.value)


@pytest.mark.parametrize("reward", [2, np.float32(2), np.array([2.0], np.float32), np.array(2)])
def test_rewards_are_floats(reward):
    env = FiniteNumbers(Given(BOX))
    env.env.reward = reward
    observation, number, terminated, truncated, info = env.step(None)
    assert (number, type(number)) == (2, float)
    np.testing.assert_array_equal(observation, env.env.observation)
    assert observation.dtype == np.float32
    assert (terminated, truncated, info) == (True, False, {"some": "info"})


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_finite_numbers_stop_at_what_is_not_finite(bad):
    env = make_noisy(make_flat(Given(BOX)), [A], [1.0])  # beneath noise
    for _ in range(2):  # steps are those of the episode
        env.reset()
        for _ in range(3):
            env.step(None)
    env.unwrapped.reward = bad
    with pytest.raises(NotFiniteError, match=f"step 4 of an episode.*reward {bad}"):
        env.step(None)
    env.unwrapped.reward, env.unwrapped.observation = 1.0, np.array([0.5, bad, 0.5])
    with pytest.raises(NotFiniteError, match=rf"observation \[0.5, {bad}, 0.5\]"):
        env.step(None)
    with pytest.raises(NotFiniteError, match="step 0 of an episode"):
        env.reset()


def test_finite_numbers_tell_a_divergence_from_a_broken_environment():
    env = FiniteNumbers(Given(BOX))
    env.env.reward = np.nan
    with pytest.raises(NotFiniteError, match=r"was given the action \[0.0, nan\]"):
        env.step(np.array([0, np.nan]))
    with pytest.raises(NotFiniteError, match="returned the reward nan"):
        env.step(np.zeros(2))


def test_observations_are_arrays_of_their_own():
    """Some environments write every observation into the same array."""
    env = FiniteNumbers(numbered_env(reuse=True))
    seen = [env.reset()[0], *(env.step(0)[0] for _ in range(3))]
    assert [observation.flat[0] for observation in seen] == [1, 2, 3, 4]


def test_finite_numbers_are_part_of_the_spec():
    env = gym.make(make_flat(gym.make("Pendulum-v1")).spec)
    assert isinstance(env, FiniteNumbers)
    assert env.spec.max_episode_steps == 200


def pendulum():
    """Return an environment whose own actions are rescaled, with noise, and a generator."""
    env = gym.make("Pendulum-v1", max_episode_steps=7)
    env = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    env = make_noisy(env, [A, B, "RandomEarlyTermination(2, 5)"], [0.5, 0.5, 0.5])
    env.action_space.seed(1)
    env.reset(seed=1)
    return env, np.random.default_rng(1)


def play_on(env, rng, episodes):
    """Return all that happens in some episodes."""
    seen = []
    for _ in range(episodes):
        seen.append((*env.reset()[0].tolist(), rng.random()))
        ended = False
        while not ended:
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            seen.append((*observation.tolist(), reward, terminated, truncated, info.get("noise")))
            ended = terminated or truncated
    counts = [(w.times_applied, w.opportunities) for w in noise_wrappers(env).values()]
    return seen, counts, list(env.get_wrapper_attr("return_queue"))


def test_an_env_state_continues_what_was_interrupted():
    env, rng = pendulum()
    play_on(env, rng, 4)
    saved = copy.deepcopy(EnvState(env, rng).state_dict())
    expected = play_on(env, rng, 5)
    assert len(expected[2]) == 9
    other, other_rng = pendulum()
    play_on(other, other_rng, 2)
    EnvState(other, other_rng).load_state_dict(saved)
    assert play_on(other, other_rng, 5) == expected


def mersenne(seed):
    return np.random.Generator(np.random.MT19937(seed))


@pytest.mark.parametrize("make_generator", [np.random.default_rng, np.random.RandomState, mersenne])
def test_an_env_state_has_only_pythons_own_types(make_generator):
    """dm_control's environments have a RandomState, whose state holds an array."""
    env, rng = pendulum()
    env.unwrapped.np_random = make_generator(3)
    play_on(env, rng, 2)
    env.unwrapped.np_random.normal(size=3)  # a RandomState keeps every second one
    saved = json.loads(json.dumps(EnvState(env, rng).state_dict()))
    expected = env.unwrapped.np_random.normal(size=5).tolist()
    env.unwrapped.np_random = make_generator(4)
    EnvState(env, rng).load_state_dict(saved)
    assert env.unwrapped.np_random.normal(size=5).tolist() == expected


def test_an_env_state_of_another_stack_is_refused():
    env, rng = pendulum()
    saved = EnvState(env, rng).state_dict()
    with pytest.raises(ValueError):
        EnvState(env).load_state_dict(saved)
    bare = gym.make("Pendulum-v1")
    bare.reset(seed=1)
    assert EnvState(bare).state_dict()["returns"] == []
    with pytest.raises(ValueError):
        EnvState(bare, rng).load_state_dict(saved)


# The module


def test_doctests():
    results = doctest.testmod(noisy_wrappers)
    assert results.failed == 0
    assert results.attempted > 20


def test_public_names():
    version = noisy_wrappers.__version__
    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    root = Path(noisy_wrappers.__file__).parent
    assert f"\nversion: {version}\n" in (root / "CITATION.cff").read_text()
    assert f"\n## [{version}] - " in (root / "CHANGELOG.md").read_text()
    for name in noisy_wrappers.__all__:
        assert getattr(noisy_wrappers, name).__doc__
    assert set(WRAPPERS) < set(noisy_wrappers.__all__)


def test_every_public_wrapper_has_a_doctest():
    for wrapper in WRAPPERS.values():
        assert ">>>" in wrapper.__doc__
        ours = wrapper is RandomNormalNoisyAction
        assert ("(section 3." in wrapper.__doc__) == (not ours)
        assert ("Ours, not the paper's." in wrapper.__doc__) == ours


def test_import_needs_no_torch():
    code = "import sys, noisy_wrappers; sys.exit('torch' in sys.modules)"
    root = noisy_wrappers.__file__.rpartition("/")[0]
    assert subprocess.run([sys.executable, "-c", code], cwd=root).returncode == 0
