"""Parameters: good ones, and what is said of bad ones."""

import math
import re

import gymnasium as gym
import numpy as np
import pytest
from cases import constant_env

from noisy_wrappers import (
    WRAPPERS,
    RandomEarlyTermination,
    RandomNormalNoisyObservation,
    RandomNormalNoisyReward,
    RandomObservationBias,
    make_noisy,
    set_progress,
)

BAD_NUMBERS = [math.nan, -math.inf, True, "0.5", None, [0.5], 1j, 10**400]
BAD_STEPS = [-1, 2.5, math.nan, True, "3", None]
BAD_FIELDS = [("body_masss",), ("geom_size",), ("body_inertia", "body_mass"), ()]
# a noise with good arguments, and those of its parameters for which values are bad
BAD = [
    ("RandomNormalNoisyObservation", {"scale": 0.5}, "scale loc", BAD_NUMBERS),
    ("RandomNormalNoisyObservation", {"scale": 0.5}, "noise_rate", [math.nan, True, None, [0.5]]),
    ("RandomNormalNoisyObservation", {}, "scale", [-0.1, (), (0.1, -0.1), ((1, 2), 3)]),
    ("RandomNormalNoisyReward", {"scale": 0.5}, "scale", [*BAD_NUMBERS, (0.1, 0.2)]),
    ("RandomNormalNoisyAction", {}, "scale", [*BAD_NUMBERS, -0.1, (0.1, 0.2)]),
    ("RandomObservationBias", {}, "scale", [*BAD_NUMBERS, -0.1]),
    ("RandomUniformNoisyObservation", {"low": 0.5, "high": 1.0}, "low high", BAD_NUMBERS),
    ("RandomUniformNoisyReward", {"high": 0.5}, "low", [1.0]),
    ("RandomUniformScaleObservation", {"low": 0, "high": 1}, "per_dimension", [1, "yes"]),
    ("RandomUniformScaleReward", {"low": 0.5, "high": 1.0}, "low high", BAD_NUMBERS),
    ("RandomMixupObservation", {}, "factor", [*BAD_NUMBERS, -0.001, 1.001]),
    ("RandomMixupObservation", {"factor": 0.5}, "recursive", [0, None]),
    ("RandomDropoutObservation", {}, "keep_prob", [*BAD_NUMBERS, -0.001, 1.001]),
    ("RandomDropoutObservation", {"keep_prob": 0.5}, "keys", [(), (None,), True]),
    ("RandomDynamics", {"low": 0.5, "high": 1.0}, "low", [*BAD_NUMBERS, -0.1, 2.0]),
    ("RandomDynamics", {"low": 0.5, "high": 1.0}, "fields", BAD_FIELDS),
    ("RandomActionDelay", {"low": 1}, "low high", BAD_STEPS[:-1]),
    ("RandomObservationDelay", {"low": 1}, "low high", [*BAD_STEPS[:-1]]),
    ("RandomEarlyTermination", {}, "low", [0, *BAD_STEPS]),
    ("RandomEarlyTermination", {"low": 3}, "high", [2, *BAD_STEPS[:-1]]),
    ("RandomEarlyTermination", {"low": 3}, "truncate each_step", [1, None, "yes"]),
    ("RandomEarlyTermination", {"each_step": True}, "low high", [5]),
]


@pytest.mark.parametrize(("name", "good", "parameters", "values"), BAD)
def test_bad_parameters(name, good, parameters, values):
    for parameter in parameters.split():
        for value in values:
            with pytest.raises(ValueError) as error:
                WRAPPERS[name](constant_env(), **{"noise_rate": 0.1, **good, parameter: value})
            message = str(error.value)
            assert re.search(rf"\b{parameter}\b", message), (parameter, value, message)
            assert isinstance(value, tuple | list) or repr(value) in message, message


def test_rate_and_progress_are_writable_and_checked():
    env = RandomNormalNoisyReward(constant_env(), 0, 0.3)
    for rate in (1, 0.0, np.float32(0.5), 1.0):
        env.noise_rate = rate
        assert env.noise_rate == rate and type(env.noise_rate) is float
    for bad in (-0.1, 1.1, math.nan, True, "1", None):
        with pytest.raises(ValueError, match="noise_rate"):
            env.noise_rate = bad
        with pytest.raises(ValueError, match="fraction"):
            set_progress(env, bad)
        assert env.noise_rate == 1.0


@pytest.mark.filterwarnings("ignore:.*WARN")
def test_an_environment_that_resets_itself_is_refused():
    env = gym.wrappers.Autoreset(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="noise must see every reset: apply .*Autoreset last"):
        make_noisy(env, ["RandomActionDelay(2)"], [0.5])


def test_numbers_and_arrays_of_numpy():
    half = np.float32(0.5)
    env = RandomNormalNoisyReward(constant_env(), half, half, loc=half)
    assert {type(number) for number in (env.noise_rate, env.scale, env.loc)} == {float}
    assert type(RandomEarlyTermination(constant_env(), 0.5, np.int64(9)).low) is int
    env = RandomNormalNoisyObservation(gym.make("Pendulum-v1"), 0.5, np.array([1, 2, 3]))
    assert gym.envs.registration.EnvSpec.from_json(env.spec.to_json()).make().scale == (1, 2, 3)


def test_a_scale_needs_as_many_numbers_as_there_are_dimensions():
    for shape in [(2,), (3, 1), ()]:
        for noise in (RandomNormalNoisyObservation, RandomObservationBias):
            with pytest.raises(ValueError, match="scale has 3 numbers and the observation has"):
                noise(constant_env(shape=shape), 0.5, (0.1, 0.2, 0.0))
