"""Environments for networks."""

import json
import random
import weakref
from contextlib import nullcontext
from types import SimpleNamespace
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from cases import BOX, A, GenericEnv, layers
from gymnasium.wrappers import FlattenObservation

from noisy_wrappers import (
    EnvState,
    FiniteNumbers,
    NotFiniteError,
    RandomNormalNoisyReward,
    SpaceError,
    kept_generators,
    make_environments,
    make_flat,
    make_noisy,
    outcome,
    play,
)


class Given(gym.Env):
    """Observes and rewards what it is told to."""

    def __init__(self, observation_space, action_space=gym.spaces.Box(-1, 1, (2,))):  # noqa: B008
        self.observation_space, self.action_space = observation_space, action_space
        self.observation, self.reward = observation_space.sample(), 1.0

    def reset(self, *, seed=None, options=None):
        return self.observation, {}

    def step(self, action):
        return self.observation, self.reward, np.array([True]), np.bool_(False), {"some": "info"}


@pytest.mark.parametrize(
    "space",
    [
        BOX,
        gym.spaces.Box(0, 255, (2, 3), np.uint8),
        gym.spaces.Tuple([gym.spaces.Dict({"a": BOX, "b": gym.spaces.Discrete(4)}), BOX]),
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
    flattened = isinstance(env, FlattenObservation)
    assert flattened == (space is not BOX)  # a vector passes as it is


def test_noise_goes_beneath_flattening():
    space = gym.spaces.Dict({"a": BOX, "b": gym.spaces.Discrete(4), "c": gym.spaces.MultiBinary(2)})
    env = make_flat(Given(space))
    clean = env.reset()[0]
    noisy = make_noisy(env, [A, "RandomNormalNoisyObservation(1.0, keys='a')"], [1.0])
    names = ["FiniteNumbers", "RecordEpisodeStatistics", "RandomNormalNoisyReward"]
    assert layers(noisy) == [*names, "RandomNormalNoisyObservation", "FlattenObservation"]
    got = noisy.reset(seed=0)[0]
    assert (got[:3] != clean[:3]).all() and (got[3:] == clean[3:]).all()


def test_finite_numbers_look_into_dictionaries():
    inner = Given(gym.spaces.Dict(a=gym.spaces.Tuple((BOX, BOX)), b=gym.spaces.Discrete(4)))
    env = make_flat(inner)
    first = env.reset()[0]
    inner.observation["a"][1][2] = np.nan
    assert not np.isnan(first).any()  # a copy
    with pytest.raises(NotFiniteError, match=r"step 1 .*the observation \[.*nan\]"):
        env.step(None)
    inner.observation["a"] = (np.zeros(3), np.zeros(4))
    with pytest.raises(SpaceError, match=r"observation of shape \(4,\), not \(3,\) as"):
        env.step(None)


def test_make_flat_refuses_what_networks_cannot_take():
    for observations in (gym.spaces.Sequence(BOX), gym.spaces.Box(0, 1, (1,), np.bool_)):
        with pytest.raises(SpaceError, match="needs Box observations of numbers; .* has "):
            make_flat(Given(observations))
    ints = gym.spaces.Box(-1, 1, (1,), np.int32)
    for actions in (gym.spaces.Discrete(3), ints, gym.spaces.Box(-1, 1, (2, 2))):
        with pytest.raises(SpaceError, match="needs Box actions of floats in one dimension"):
            make_flat(Given(BOX, actions))


@pytest.mark.parametrize("broken", [0, 1])
def test_what_was_made_is_closed_where_the_rest_cannot_be_made(broken):
    """Whether the second environment, or a noise, is at fault."""
    made = []

    def make_env(env_id, **kwargs):
        if len(made) == 2 - broken:
            raise RuntimeError("no simulator is free")
        made.append(mock.Mock(wraps=Given(BOX), spec=Given))
        return made[-1]

    args = {"env_id": "Given", "seed": 1, "env_kwargs": (), "max_episode_steps": None}
    args |= {"noise": ["RandomDynamics(1, 2)"], "noise_rate": [1]}
    args |= {"test_noise": (), "test_noise_rate": ()}
    with pytest.raises((RuntimeError, SpaceError)):
        make_environments(make_env, args, test_seed=1)
    assert len(made) == 2 - broken and all(env.close.call_count == 1 for env in made)


@pytest.mark.parametrize("name", ["NormalizeObservation", "NormalizeReward"])
def test_statistics_that_only_training_would_have_are_refused(name):
    args = {"env_id": "Given", "seed": 1, "env_kwargs": (), "max_episode_steps": None}
    args |= dict.fromkeys(("noise", "noise_rate", "test_noise", "test_noise_rate"), ())

    def make_env(env_id, **kwargs):
        env = getattr(gym.wrappers, name)(Given(BOX))
        env.update_running_mean = updates
        return env

    for updates in (False, True):
        with pytest.raises(SpaceError, match="other statistics") if updates else nullcontext():
            make_environments(make_env, args, test_seed=1)


def test_an_environment_may_tell_of_a_noise_of_its_own():
    env = RandomNormalNoisyReward(Given(BOX), 1, 1)
    env.env.step = mock.Mock(return_value=(0, 1.0, False, False, {"noise": "rain"}))
    assert env.step(None)[-1]["noise"] == ("RandomNormalNoisyReward",)


@pytest.mark.parametrize("reward", [2, np.float32(2), np.array([2.0]), torch.tensor([2])])
def test_rewards_are_floats(reward):
    env = FiniteNumbers(Given(BOX))
    env.env.reward = reward
    observation, number, terminated, truncated, info = env.step(None)
    assert (number, type(number)) == (2, float)
    np.testing.assert_array_equal(observation, env.env.observation)
    assert observation.dtype == np.float32
    assert terminated is True and truncated is False and info == {"some": "info"}


def test_an_environment_may_record_itself():
    """Its record is dropped, because Gymnasium would refuse a second one."""
    env = gym.wrappers.RecordEpisodeStatistics(gym.make("Pendulum-v1", max_episode_steps=2))
    for noise, length in ((A, 2), ("RandomEarlyTermination(1)", 1)):
        noisy = make_noisy(make_flat(env), [noise], [1.0])
        noisy.reset(seed=0)
        for _ in range(length):
            *_, info = noisy.step(np.zeros(1, np.float32))
        assert info["episode"]["l"] == length


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_finite_numbers_stop_at_what_is_not_finite(bad):
    env = make_noisy(make_flat(Given(BOX)), [A], [1.0])  # beneath noise
    for _ in range(2):  # steps are those of the episode
        env.reset()
        env.step(np.zeros(2))
    env.unwrapped.reward = bad
    with pytest.raises(NotFiniteError, match=f"step 2 of an episode.*returned the reward {bad}"):
        env.step(np.zeros(2))
    with pytest.raises(NotFiniteError, match=r"was given the action \[0.0, nan\]"):
        env.step(np.array([0, np.nan]))  # as after a divergence
    env.unwrapped.observation = np.array([0.5, bad, 0.5])
    with pytest.raises(NotFiniteError, match=rf"step 0 .*observation \[0.5, {bad}, 0.5\]"):
        env.reset()


class Drawing(gym.Env):
    """Draws from all kinds of generators that are its attributes, and spawns at every reset.

    What it calls its own generator is in something inside, as in shimmy's environments of
    dm_control. The state of a RandomState holds an array.
    """

    observation_space = gym.spaces.Box(-9, 9, (5,), np.float64)
    action_space = gym.spaces.Dict(a=gym.spaces.Box(-1, 1, (1,)))

    def __init__(self):
        self.goals = gym.spaces.Box(-1, 1, (1,))
        self.gone = weakref.proxy(Drawing.reset.__get__(self))  # of what has been deleted

    @property
    def np_random(self):
        return self.inside.random

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.inside = SimpleNamespace(random=np.random.RandomState(seed))
            self.rng = np.random.Generator(np.random.MT19937(seed))
            self.python = random.Random(seed)
            self.goals.seed(seed)
        drawn = [self.rng.normal(), self.rng.spawn(2)[1].normal(), self.python.random()]
        return np.array([*drawn, self.np_random.normal(), self.goals.sample()[0]]), {}


def test_an_env_state_has_the_generators_among_the_attributes():
    def draw(env):
        return [*env.reset()[0], env.action_space.sample()["a"][0]]

    env = gym.wrappers.TransformReward(Drawing(), abs)
    env.reset(seed=1)
    first = draw(env)
    saved = json.loads(json.dumps(EnvState(env).state_dict()))
    second, third = draw(env), draw(env)
    other = gym.wrappers.TransformReward(Drawing(), abs)
    for episodes in (0, 3):  # fewer children have been spawned, then more
        other.reset(seed=2)
        [draw(other) for _ in range(episodes)]
        EnvState(other).load_state_dict(saved)
        assert draw(other) == second
    assert all(one != two for one, two in zip(first, second, strict=True))
    with kept_generators(other):
        assert draw(other) == third
    assert draw(other) == third


def test_a_policy_with_memory_is_told_where_a_test_episode_begins():
    policy = mock.Mock(return_value=np.zeros(1))
    play(make_noisy(gym.make("Pendulum-v1", max_episode_steps=3), (), ()), policy, 2, seed=7)
    assert [name for name, *_ in policy.mock_calls] == 2 * ["begin_episode", "", "", ""]


def test_outcomes():
    for value in (1, [True], np.float32(1), torch.tensor(True)):
        assert outcome({"success": value}) == 1.0
    assert outcome({"is_success": torch.tensor(False)}) == 0.0
    assert np.isnan(outcome({"success": [True, False]})) and np.isnan(outcome({}))
    assert outcome({"is_success": np.nan, "success": True}) == 1.0
    assert np.isnan(outcome({"success": np.nan}))


class Heedless(GenericEnv):
    """Ignores the seed of a reset, as Meta-World's environments do."""

    def reset(self, *, seed=None, options=None):
        return super().reset()


def test_an_environment_that_ignores_its_seed_is_seeded_all_the_same():
    first, second = (make_flat(Heedless()).reset(seed=3)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    pendulum, bare = make_flat(gym.make("Pendulum-v1")), gym.make("Pendulum-v1")
    for seed in (3, None, 4):
        np.testing.assert_array_equal(pendulum.reset(seed=seed)[0], bare.reset(seed=seed)[0])
