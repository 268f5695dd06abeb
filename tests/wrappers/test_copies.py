"""Copies, specs and the state of an environment."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch
from cases import BASES, NOISES, build, constant_env, registered, rollout, same

from noisy_wrappers import RandomNormalNoisyReward


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
        assert made.env.parameters == env.env.parameters
        assert same(rollout(made, 5, action=action), rollout(env, 5, action=action))


@pytest.mark.parametrize("text", BASES)
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


@pytest.mark.parametrize("text", BASES)
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
