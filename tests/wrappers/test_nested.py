"""Observations of several parts: dictionaries and tuples."""

import itertools

import numpy as np
import pytest
from cases import OBSERVATION_CASES, GenericEnv, build, rollout, streams
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, Tuple

from noisy_wrappers import (
    ObservationNoise,
    RandomDropoutObservation,
    RandomNormalNoisyObservation,
    RandomUniformNoisyObservation,
    parse_noise,
)

# As Gymnasium-Robotics' Fetch has it; in this order
SIZES = {"achieved_goal": 3, "desired_goal": 3, "observation": 4}
GOALS = Dict({key: Box(-np.inf, np.inf, (size,), np.float64) for key, size in SIZES.items()})
MIXED = Dict(
    image=Box(0, 255, (2, 2), np.uint8),
    inner=Tuple((Discrete(3), Box(-1, 1, (2,), np.float32), MultiBinary(2))),
    flag=Box(0, 1, (2,), np.bool_),
    speed=Box(-1, 1, (1,), np.float64),
)


def sampled(space):
    """An environment that observes samples of a space, the same every time it is made."""
    space.seed(0)
    samples = [space.sample() for _ in range(50)]
    observed = itertools.cycle(samples)
    return GenericEnv(space, lambda env: next(observed)), samples


@pytest.mark.parametrize("text", [text for text in OBSERVATION_CASES if "Uniform" not in text])
def test_numbers_are_perturbed_as_one_vector(text):
    """In the order of the space; categories stay."""
    space = Dict({"b": Box(-5, 5, (1,), np.float64), "a": Tuple((Discrete(2), Box(-5, 5, (1, 2))))})
    env, samples = sampled(space)
    vectors = [np.append(sample["a"][1], sample["b"]) for sample in samples]
    left = iter(vectors)
    flat = GenericEnv(Box(-5, 5, (3,), np.float64), lambda env: next(left))
    rollouts = [rollout(build(text, each, 0.3), seed=7, steps=49) for each in (env, flat)]
    for t, ((got, *_, info), (expected, *_, same)) in enumerate(zip(*rollouts, strict=True)):
        np.testing.assert_allclose(np.append(got["a"][1], got["b"]), expected, rtol=1e-6)
        assert info == same and list(got) == ["a", "b"] and got["a"][0] == samples[t]["a"][0]
        assert (got["a"][1].shape, got["a"][1].dtype) == ((1, 2), np.float32)
        assert (np.append(samples[t]["a"][1], samples[t]["b"]) == vectors[t]).all()


def test_keys_restrict_the_noise():
    env, samples = sampled(GOALS)
    env = RandomNormalNoisyObservation(env, 1.0, 0.3, keys=("observation", "desired_goal"))
    _, noise = streams(RandomNormalNoisyObservation, 0)
    got = env.reset(seed=0)[0]
    eps = noise.normal(0, 0.3, 7)  # in the order of the space
    np.testing.assert_array_equal(got["desired_goal"], samples[0]["desired_goal"] + eps[:3])
    np.testing.assert_array_equal(got["observation"], samples[0]["observation"] + eps[3:])
    assert got["achieved_goal"] is samples[0]["achieved_goal"]
    with pytest.raises(ValueError, match="have the keys .'achieved_goal', 'desired"):
        RandomNormalNoisyObservation(env, 1.0, 0.3, keys=("goal",))
    with pytest.raises(ValueError, match="needs observations of floats or integers"):
        RandomNormalNoisyObservation(sampled(MIXED)[0], 1.0, 0.3, keys=("flag",))


KEYED = ["RandomUniformNoisyObservation(1.0, 2.0", "RandomUniformScaleObservation(2.0, 3.0"]
KEYED += ["RandomMixupObservation(0.5", "RandomDropoutObservation(0.0"]
KEYED += ["RandomObservationBias(0.3", "RandomObservationDelay(1"]


@pytest.mark.parametrize("start", KEYED)
def test_keys_are_those_of_every_wrapper(start):
    text = f"{start}, keys=('observation',))"
    assert str(parse_noise(text)) == text
    env, samples = sampled(GOALS)
    env = build(text, env, 1.0)
    env.reset(seed=0)
    got = env.step(None)[0]
    assert got["achieved_goal"] is samples[1]["achieved_goal"]
    assert got["desired_goal"] is samples[1]["desired_goal"]
    assert (got["observation"] != samples[1]["observation"]).all()


def test_keys_of_a_tuple_are_indices():
    space = Tuple((Box(-1, 1, (2,)), Box(-1, 1, (3,))))
    env, samples = sampled(space)
    env = RandomDropoutObservation(env, 1.0, 0.0, keys=(1,))
    got = env.reset(seed=0)[0]
    assert isinstance(got, tuple) and got[0] is samples[0][0] and not got[1].any()
    with pytest.raises(ValueError, match=r"have the keys \[0, 1\]"):
        RandomDropoutObservation(sampled(space)[0], 1.0, 0.0, keys=(-1,))


def test_the_space_is_widened_in_its_entries():
    env = RandomUniformNoisyObservation(sampled(MIXED)[0], 1.0, -2, 1, keys=("inner", "image"))
    space = env.observation_space
    assert list(space) == list(MIXED) and space["speed"] == MIXED["speed"]
    assert space["image"] == MIXED["image"]
    assert space["inner"][1] == Box(-3, 2, (2,), np.float32)
    assert space["inner"][0] == Discrete(3)


def test_a_noise_must_return_as_many_numbers_as_it_gets():
    class Other(ObservationNoise):
        def _perturb(self, observation):
            return np.ones(len(observation) + 1)

    with pytest.raises(ValueError, match="must return an array of shape"):
        Other(sampled(GOALS)[0], 1.0).reset(seed=0)
