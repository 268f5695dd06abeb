"""Parameters: good ones, and what is said of bad ones."""

import math
import re
from fractions import Fraction

import gymnasium as gym
import numpy as np
import pytest
from cases import constant_env

from noisy_wrappers import (
    WRAPPERS,
    Configuration,
    RandomDropoutObservation,
    RandomEarlyTermination,
    RandomMixupObservation,
    RandomNormalNoisyObservation,
    RandomNormalNoisyReward,
    RandomUniformNoisyReward,
    make_noisy,
    parse_noise,
    run_name,
)

BAD_NUMBERS = [math.nan, math.inf, -math.inf, True, "0.5", None, [0.5], 1j, np.array([0.5, 0.5])]

BAD_STEPS = [0, -1, 2**63, 1.0, 2.5, math.nan, math.inf, True, "3", np.float64(2.0)]

BAD_FLAGS = [0, 1, None, "yes", np.True_]


def bad_parameters():
    for name in WRAPPERS:
        of_steps = ("RandomEarlyTermination", "RandomActionDelay", "RandomObservationDelay")
        args = (3,) if name in of_steps else (0.5,)
        if "Uniform" in name or name == "RandomDynamics":
            args = (0.5, 1.0)
            for bad in BAD_NUMBERS:
                yield name, 0.1, (bad, 1.0), {}, "low", bad
                yield name, 0.1, (0.5, bad), {}, "high", bad
            yield name, 0.1, (1.0, 0.5), {}, "low", 1.0
        for bad in [*BAD_NUMBERS, -0.001, 1.001]:
            yield name, bad, args, {}, "noise_rate", bad
            if "Mixup" in name or "Dropout" in name:
                parameter = "factor" if "Mixup" in name else "keep_prob"
                yield name, 0.1, (bad,), {}, parameter, bad
        if "Normal" in name or "Bias" in name:
            for bad in [*BAD_NUMBERS, -0.001, -1, 10**400]:
                yield name, 0.1, (bad,), {}, "scale", bad
        if "Normal" in name:
            for bad in BAD_NUMBERS:
                yield name, 0.1, (0.5,), {"loc": bad}, "loc", bad
    yield "RandomDynamics", 0.1, (-0.1, 1.0), {}, "low", -0.1
    for bad in ["body_masss", "body_invweight0", "geom_size", 3]:
        yield "RandomDynamics", 0.1, (0.5, 1.0), {"fields": ("body_mass", bad)}, "fields", bad
    for bad in [(), None, 5]:
        yield "RandomDynamics", 0.1, (0.5, 1.0), {"fields": bad}, "fields", bad
    for name in ("RandomActionDelay", "RandomObservationDelay"):
        for bad in [-1, *BAD_STEPS[2:]]:
            yield name, 0.1, (bad,), {}, "low", bad
            yield name, 0.1, (0, bad), {}, "high", bad
        yield name, 0.1, (5, 4), {}, "low", 5
    for bad in [3.5, (), ("a", 1), (None,), True]:
        yield "RandomDropoutObservation", 0.1, (0.5,), {"keys": bad}, "keys", bad
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


def test_noise_rate_is_writable_and_checked():
    env = RandomNormalNoisyReward(constant_env(), 0, 0.3)
    for rate in (1, 0.0, np.float32(0.5), 1.0):
        env.noise_rate = rate
        assert env.noise_rate == rate and type(env.noise_rate) is float
    for bad in (-0.1, 1.1, math.nan, True, "1", None):
        with pytest.raises(ValueError, match="noise_rate"):
            env.noise_rate = bad
        assert env.noise_rate == 1.0
    env.reset(seed=0)
    env.step(0)
    assert env.applied_fraction == 1.0


SCALES = "RandomNormalNoisyObservation((0.1, 0.2, 0.0), loc=1.0)"


@pytest.mark.filterwarnings("ignore:.*WARN")
def test_an_environment_that_resets_itself_is_refused():
    env = gym.wrappers.Autoreset(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="noise must see every reset: apply .*Autoreset last"):
        make_noisy(env, ["RandomActionDelay(2)"], [0.5])


def test_a_scale_for_each_dimension():
    assert str(parse_noise("RandomNormalNoisyObservation(loc=1, scale=(.1, 0.20, -0.0))")) == SCALES
    env = parse_noise(SCALES)(gym.make("Pendulum-v1"), 1.0)
    assert env.scale == (0.1, 0.2, 0.0)
    assert gym.envs.registration.EnvSpec.from_json(env.spec.to_json()).make().scale == env.scale
    assert Configuration.read([SCALES], [0.5]).texts == ([SCALES], [0.5])
    name = "p0.5_s1_NormalNoisyObservation_0.1_0.2_0.0_loc=1.0__E__x"
    assert run_name("E", "x", [SCALES], [0.5], 1) == name


@pytest.mark.parametrize("scale", [(), (0.1,), (0.1, -0.1, 0.1), (0.1, "1", 0.1), ((1, 2), 3, 4)])
def test_bad_scales(scale):
    with pytest.raises(ValueError, match=r"\bscale\b"):
        parse_noise(f"RandomNormalNoisyObservation({scale!r})")


def test_a_scale_needs_as_many_numbers_as_there_are_dimensions():
    for shape in [(2,), (3, 1), ()]:
        with pytest.raises(ValueError, match="scale has 3 numbers and the observation has shape"):
            make_noisy(constant_env(shape=shape), [SCALES], [0.5])
    for name in ("RandomNormalNoisyReward", "RandomNormalNoisyAction"):
        with pytest.raises(ValueError, match=r"\bscale\b"):
            parse_noise(f"{name}((0.1, 0.2))")


def test_limits_of_the_parameters_are_allowed():
    env = constant_env()
    RandomNormalNoisyObservation(env, 0, 0)
    RandomNormalNoisyReward(RandomNormalNoisyReward(env, 1, -0.0), 1, 0).reset(seed=0)
    RandomUniformNoisyReward(env, 1, 0.5, 0.5)
    RandomMixupObservation(env, np.float64(0.5), Fraction(1, 2))
    RandomDropoutObservation(env, 1, 0)
    RandomEarlyTermination(env, 1, np.int64(1), np.int32(1))
    quiet = RandomNormalNoisyReward(env, 1, -0.0)  # Generator.normal refuses -0.0
    quiet.reset(seed=0)
    assert quiet.step(0)[1] == 2.0
