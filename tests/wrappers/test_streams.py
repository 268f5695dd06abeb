"""Seeds: who draws what, and in which order."""

import gymnasium as gym
import numpy as np
import pytest
from cases import (
    BASES,
    STEP_NOISES,
    WIDE,
    GenericEnv,
    build,
    constant_env,
    episodes_env,
    rollout,
    same,
    streams,
)

from noisy_wrappers import RandomNormalNoisyReward


def pattern(steps):
    """Which steps were perturbed."""
    return ["noise" in info for *_, info in steps]


@pytest.mark.parametrize("text", BASES)
def test_same_seed_same_noise(text):
    env = build(text, gym.wrappers.TimeLimit(GenericEnv(), 12), 0.5)
    first = rollout(env, seed=1)
    assert same(first, rollout(env, seed=1))
    assert same(first, rollout(build(text, gym.wrappers.TimeLimit(GenericEnv(), 12), 0.5), seed=1))
    assert pattern(first) != pattern(rollout(env, seed=2))


@pytest.mark.parametrize("text", BASES)
def test_reset_without_seed_keeps_the_stream(text):
    env = build(text, episodes_env([12]), 0.5)
    runs = [pattern(rollout(env, seed)) for seed in (1, None, None)]
    assert runs[0] != runs[1] != runs[2] != runs[0]


@pytest.mark.parametrize("text", BASES)
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


@pytest.mark.parametrize("text", BASES)
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


@pytest.mark.parametrize("text", BASES)
def test_global_generator_is_untouched(text):
    before = np.random.get_state()[1].tobytes()
    rollout(build(text, GenericEnv(), 1.0), seed=0)
    assert np.random.get_state()[1].tobytes() == before


@pytest.mark.parametrize("text", STEP_NOISES)
def test_a_lower_rate_perturbs_a_subset_of_the_steps(text):
    def perturbed(rate):
        env = build(text, GenericEnv(WIDE), rate)
        steps = [env.reset(seed=4)[1]] + [env.step(0)[4] for _ in range(500)]
        return {t for t, info in enumerate(steps) if "noise" in info}

    sets = [perturbed(rate) for rate in (0, 0.1, 0.2, 0.7, 1)]
    assert all(low < high for low, high in zip(sets, sets[1:], strict=False))


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
        env = build(text, GenericEnv(WIDE), rate)
        env.reset(seed=0)
        env._gate = Constant(uniform)
        assert ("noise" in env.step(0)[4]) == (rate == 1)
