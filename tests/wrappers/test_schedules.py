"""Noise rates that change during training."""

import copy
import math
import pickle

import gymnasium as gym
import numpy as np
import pytest
from cases import (
    BASES,
    STEP_NOISES,
    WIDE,
    A,
    B,
    GenericEnv,
    build,
    constant_env,
    episodes_env,
    plain,
    registered,
    rollout,
    same,
)

from noisy_wrappers import (
    RandomDropoutObservation,
    RandomNormalNoisyReward,
    make_noisy,
    noise_statistics,
    noise_wrappers,
    set_progress,
)


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
    env = build(text, GenericEnv(WIDE), "0:1")
    for fraction, acts in [(0, False), (1, True), (0, False)]:
        set_progress(env, fraction)
        env.reset()
        for later in (0.3, 1 - fraction, fraction):
            set_progress(env, later)
            assert ("noise" in env.step(0)[4]) == acts


@pytest.mark.parametrize("text", BASES)
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
        return [(step[0].tobytes(), plain(step[-1])) for step in out], env.state_dict()

    scheduled = episodes("0.9:0.1", assigned=False)
    assert scheduled == episodes(0.5, assigned=True)
    assert scheduled[1] != episodes(0.9, assigned=False)[1]


@pytest.mark.parametrize("text", BASES)
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


@pytest.mark.parametrize("text", BASES)
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
