"""Noise in standard deviations of what the environment gives, and in halves of its actions."""

import gymnasium as gym
import numpy as np
import pytest
from cases import OBSERVATION_CASES, REWARD_CASES, GenericEnv, build, rollout, streams
from test_actions import actions_env

from noisy_wrappers import Configuration, RandomNormalNoisyAction, RandomObservationBias

UNITS = np.array([0.001, 1.0, 500.0])
SPACE = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)


def units_env():
    """Observations in millimetres, and in other units; rewards in dollars."""
    return GenericEnv(
        SPACE,
        observe=lambda env: 7 * UNITS + UNITS * env.np_random.normal(size=3),
        reward=lambda env: 1e4 * env.np_random.random(),
    )


ADDITIVE = {text: f for text, f in (OBSERVATION_CASES | REWARD_CASES).items() if "Noisy" in text}


@pytest.mark.parametrize("rate", [0.3, 1.0])
@pytest.mark.parametrize("text", ADDITIVE)
def test_relative_golden(text, rate):
    """The gate and the noise draw as otherwise, also while the first 99 samples stay clean."""
    kind = 1 if "Reward" in text else 0
    bare = rollout(units_env(), seed=7, steps=300)[kind:]
    env = build(f"{text[:-1]}, relative=True)", units_env(), rate)
    gate, noise = streams(text, seed=7)
    received, noisy = [], 0
    for clean, got in zip(bare, rollout(env, seed=7, steps=300)[kind:], strict=True):
        received.append(clean[kind])
        expected, acts = clean[kind], gate.random() < rate
        if acts:
            zero = (0.0, None) if kind == 0 else (0.0,)
            drawn = ADDITIVE[text](noise, *zero)
            if len(received) >= 100:
                expected = expected + drawn * np.std(received, axis=0, ddof=1)
        np.testing.assert_allclose(got[kind], expected, rtol=1e-12)
        changed = acts and len(received) >= 100
        noisy += changed
        assert ("noise" in got[4]) == changed
    assert env.times_applied == noisy > 0 and env.opportunities == len(received)
    env.reset(seed=8)  # the estimates go on
    assert env._spread.count == len(received) + (kind == 0)
    env._spread.add(np.full(3, np.nan) if kind == 0 else np.nan)  # does not count
    assert np.isfinite(env._spread.deviation).all()


def test_actions_are_perturbed_in_halves_of_their_range():
    low, high = np.float32([-1, 15]), np.float32([1, 30])
    bare = actions_env(gym.spaces.Box(low, high))
    env = RandomNormalNoisyAction(bare, 1.0, 0.1, relative=True)
    _, noise = streams(RandomNormalNoisyAction, seed=3)
    env.reset(seed=3)
    for _ in range(50):
        env.step(np.float32([0, 20]))
        expected = [0, 20] + noise.normal(0, 0.1, 2) * [1, 7.5]
        np.testing.assert_allclose(bare.received[-1], np.clip(expected, low, high), rtol=1e-6)
    largest = np.finfo(np.float32).max
    for bound in (np.inf, largest):
        with pytest.raises(ValueError, match="relative=True needs bounded actions"):
            space = gym.spaces.Box(np.float32([-1, -bound]), np.float32([1, 1]))
            RandomNormalNoisyAction(actions_env(space), 0.1, 1.0, relative=True)


def test_what_a_test_may_have():
    """A running scale would depend on the policy; a test has neither beginning nor end."""
    for noise, rate, problem in [
        ("RandomObservationBias(1.0, relative=True)", 0.5, "relative=True"),
        ("RandomUniformNoisyReward(0, 1, relative=True)", 1.0, "relative=True"),
        ("RandomDropoutObservation(0.5)", "1:0", "1.0:0.0"),
    ]:
        with pytest.raises(ValueError, match=problem):
            Configuration.read([noise], [rate]).for_tests()
    allowed = Configuration.read(["RandomNormalNoisyAction(0.1, relative=True)"], [0.5])
    assert allowed.for_tests() is allowed


def test_a_relative_bias_is_constant_within_an_episode():
    env = RandomObservationBias(gym.wrappers.TimeLimit(units_env(), 120), 1.0, 0.5, relative=True)
    twin = units_env()
    _, noise = streams(RandomObservationBias, 5)
    received = []
    for episode in range(3):
        drawn = noise.normal(0, 0.5, 3)
        deviation = np.std(received, axis=0, ddof=1) if received else 0
        seed = 5 if episode == 0 else None
        steps = [(env.reset(seed=seed)[0], twin.reset(seed=seed)[0])]
        steps += [(env.step(0)[0], twin.step(0)[0]) for _ in range(120)]
        for seen, clean in steps:
            np.testing.assert_allclose(seen, clean + drawn * deviation, rtol=1e-12)
            received.append(clean)
    assert (env.times_applied, env.opportunities) == (2, 3)
