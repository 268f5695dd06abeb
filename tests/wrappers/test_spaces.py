"""Observation and action spaces: which are taken, and how they are widened."""

import gymnasium as gym
import numpy as np
import pytest
from cases import (
    BASES,
    BOX,
    NOISES,
    OBSERVATION_CASES,
    A,
    B,
    C,
    GenericEnv,
    build,
    constant_env,
    hypothesis_settings,
    layers,
    registered,
    rollout,
    streams,
)
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordEpisodeStatistics
from hypothesis import given
from hypothesis import strategies as st

from noisy_wrappers import (
    RandomDropoutObservation,
    RandomMixupObservation,
    RandomNormalNoisyObservation,
    RandomUniformScaleObservation,
    make_noisy,
)


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


numbers, probabilities = st.floats(-100, 100), st.floats(0, 1)
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


def test_the_true_return_stays_where_noises_are_added_later():
    env = make_noisy(gym.wrappers.TimeLimit(constant_env(2.0), 5), [A], [1.0])
    env = make_noisy(env, [B], [1.0])
    assert layers(env).count("RecordEpisodeStatistics") == 1
    env.reset(seed=0)
    assert [env.step(0) for _ in range(5)][-1][4]["episode"]["r"] == 10.0


def test_the_record_of_the_environment_is_kept():
    env = RecordEpisodeStatistics(gym.wrappers.TimeLimit(constant_env(2.0), 5))
    for keep in ({}, {"record_statistics": False}):
        noisy = make_noisy(env, [A, B], [1.0], **keep)
        assert layers(noisy)[-3:] == [layers(env)[-1], A.split("(")[0], B.split("(")[0]]
        noisy.reset(seed=0)
        steps = [noisy.step(0) for _ in range(5)]
        assert steps[-1][4]["episode"]["r"] == 10.0 != sum(step[1] for step in steps)


def test_a_record_would_miss_the_episodes_that_are_ended_above_it():
    env = RecordEpisodeStatistics(gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match="RandomEarlyTermination needs to be inside"):
        make_noisy(env, [A, C], [0.5])


@pytest.mark.filterwarnings("ignore:.*WARN")
@pytest.mark.parametrize("text", NOISES)
def test_check_env(text):
    check_env(build(text, gym.make(registered(text)[0]), 0.3), skip_render_check=True)
    space = gym.spaces.Box(-6, 5, (2, 3), np.int8)
    check_env(build(text, GenericEnv(space), "1.0:0.0"), skip_render_check=True)


@pytest.mark.parametrize("text", BASES)
def test_observations_without_numbers(text):
    category = gym.spaces.Tuple((gym.spaces.Dict(kind=gym.spaces.MultiDiscrete([2, 3])),))
    for space in (category, gym.spaces.Box(0, 1, (3,), np.bool_), gym.spaces.Sequence(BOX)):
        env = GenericEnv(space, reset=lambda env, space=space: (space.sample(), {}))
        if "Observation" not in text:
            build(text, env, 1.0).reset(seed=0)
            continue
        with pytest.raises(ValueError, match="needs observations of floats or integers"):
            build(text, env, 0.1)
