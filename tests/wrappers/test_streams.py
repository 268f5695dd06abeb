"""Seeds: who draws what, and in which order; copies, specs and states continue alike."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch
from cases import BASES, GenericEnv, build, constant_env, registered, rollout, same

from noisy_wrappers import EnvState, RandomNormalNoisyReward


@pytest.mark.parametrize("text", BASES)
def test_same_seed_same_noise(text):
    env = build(text, gym.wrappers.TimeLimit(GenericEnv(), 12), 0.5)
    before = np.random.get_state()[1].tobytes()  # of the global generator
    first = rollout(env, seed=1)
    assert same(first, rollout(env, seed=1))
    assert same(first, rollout(build(text, gym.wrappers.TimeLimit(GenericEnv(), 12), 0.5), seed=1))
    episodes = first, rollout(env, seed=2), rollout(env)
    assert len({tuple("noise" in info for *_, info in steps) for steps in episodes}) == 3
    assert np.random.get_state()[1].tobytes() == before


def test_a_lower_rate_perturbs_a_subset_of_the_steps():
    """Also after a rate of 0, which draws as any other."""

    def perturbed(*rates):
        env = RandomNormalNoisyReward(constant_env(), 0.0, 0.3)
        env.reset(seed=4)
        steps = set()
        for t in range(500):
            env.noise_rate = rates[t * len(rates) // 500]
            if "noise" in env.step(0)[4]:
                steps.add(t)
        return steps

    sets = [perturbed(rate) for rate in (0, 0.1, 0.2, 1)]
    assert all(low < high for low, high in zip(sets, sets[1:], strict=False))
    assert perturbed(0, 0.1) == {t for t in sets[1] if t >= 250}


@pytest.mark.parametrize("text", BASES)
def test_spec_round_trip(text):
    env_id, action = registered(text)
    env = RandomNormalNoisyReward(build(text, gym.make(env_id), "1:0.25"), np.float64(0.5), 1)
    for spec in (env.spec, gym.envs.registration.EnvSpec.from_json(env.spec.to_json())):
        made = spec.make()
        assert (str(made), made.spec) == (str(env), env.spec)
        assert made.env.parameters == env.env.parameters
        assert same(rollout(made, 5, action=action), rollout(env, 5, action=action))


@pytest.mark.parametrize("text", BASES)
def test_copies_continue_alike(text):
    env_id, action = registered(text)
    env = build(text, gym.make(env_id), 0.5)
    env.reset(seed=2)
    env.step(action)
    twin = copy.deepcopy(env)
    ours = [env.step(action), *rollout(env, action=action)]
    assert same(ours, [twin.step(action), *rollout(twin, action=action)])
    assert (twin.times_applied, twin.opportunities) == (env.times_applied, env.opportunities)


RELATIVE = [
    "RandomNormalNoisyObservation(0.3, relative=True)",
    "RandomUniformNoisyReward(-0.1, 0.1, relative=True)",
    "RandomObservationBias(0.3, relative=True)",
]


@pytest.mark.parametrize("text", BASES + RELATIVE)
def test_a_state_is_resumed(text, tmp_path):
    """The streams, the counters, what a noise has estimated, and a rate that was assigned."""
    env, other = (build(text, gym.wrappers.TimeLimit(GenericEnv(), 12), 0.5) for _ in range(2))
    env.noise_rate = 0.7
    rollout(env, seed=6, steps=150)
    torch.save(EnvState(env).state_dict(), tmp_path / "state.pt")
    expected = rollout(env)
    rollout(other, seed=99, steps=7)
    EnvState(other).load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert same(rollout(other), expected)
    assert other.state_dict() == env.state_dict()
