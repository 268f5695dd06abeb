"""Observation and action spaces: which are taken, and how they are widened."""

import gymnasium as gym
import numpy as np
import pytest
from cases import (
    BASES,
    BOX,
    A,
    B,
    C,
    GenericEnv,
    build,
    constant_env,
    layers,
    registered,
    rollout,
    streams,
)
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordEpisodeStatistics
from hypothesis import given, settings
from hypothesis import strategies as st

from noisy_wrappers import RandomNormalNoisyObservation, make_noisy


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


numbers = st.floats(-100, 100)
wide = ["RandomNormalNoisyObservation(50, loc=9)", "RandomMixupObservation(0.1)"]
wide += ["RandomMixupObservation(0.3, recursive=True)", "RandomDropoutObservation(0.5)"]
wide += ["RandomObservationBias(50)", "RandomObservationDelay(1, 3)"]
intervals = ["RandomUniformNoisyObservation({}, {})", "RandomUniformScaleObservation({}, {})"]
intervals += ["RandomUniformScaleObservation({}, {}, per_dimension=True)"]


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")  # float16 times 10^4
@settings(deadline=None, derandomize=True, max_examples=100)
@given(st.data(), st.sampled_from(wide + intervals), st.tuples(numbers, numbers).map(sorted))
def test_observations_stay_in_the_space(data, text, interval):
    """To the last bit: 0.1 * x + 0.9 * x is not x for every double."""
    space = spaces(data.draw)
    low = np.clip(space.low.astype(float), -100, 100)
    high = np.clip(space.high.astype(float), -100, 100)
    rng = np.random.default_rng(0)

    def observe(env):
        env.count = getattr(env, "count", -1) + 1
        return np.array((low, high, high, rng.uniform(low, high))[env.count % 4], space.dtype)

    text = text.format(*interval)
    noisy = build(text, build(text, GenericEnv(space, observe), 0.5), 0.5)
    for observation, *_, info in rollout(noisy, seed=0, steps=16):
        assert isinstance(observation, np.ndarray)
        assert (observation.dtype, observation.shape) == (space.dtype, space.shape)
        assert observation in (noisy.observation_space if "noise" in info else space)
    assert np.all(noisy.observation_space.low <= space.low)
    assert np.all(noisy.observation_space.high >= space.high)


def test_integer_observations_are_rounded_and_clipped():
    values = np.array([0, 3, 100, 255], np.uint8)
    env = GenericEnv(gym.spaces.Box(0, 255, (4,), np.uint8), lambda env: values)
    env = RandomNormalNoisyObservation(env, 1.0, 40.0)
    _, noise = streams(RandomNormalNoisyObservation, 2)
    got = np.array([env.reset(seed=2)[0], *(env.reset()[0] for _ in range(50))])
    expected = np.clip(np.rint(values + noise.normal(0, 40, (51, 4))), 0, 255)
    assert got.dtype == np.uint8
    np.testing.assert_array_equal(got, expected)


def test_a_record_below_other_wrappers_is_refused():
    """Gymnasium's would end a run at the end of an episode, with an empty AssertionError."""
    env = gym.wrappers.TimeLimit(RecordEpisodeStatistics(constant_env(2.0)), 5)
    with pytest.raises(ValueError, match="this environment records its returns"):
        make_noisy(env, [], [])
    assert make_noisy(env, [], [], record_statistics=False) is env


def test_a_record_of_the_true_return_that_there_is_is_kept():
    env = RecordEpisodeStatistics(gym.wrappers.TimeLimit(constant_env(2.0), 5))
    noisy = make_noisy(make_noisy(env, [A], [1.0]), [B], [1.0])
    assert layers(noisy) == ["TimeLimit", *layers(env)[1:], A.split("(")[0], B.split("(")[0]]
    noisy.reset(seed=0)
    steps = [noisy.step(0) for _ in range(5)]
    assert steps[-1][4]["episode"]["r"] == 10.0 != sum(step[1] for step in steps)
    # and it would miss the episodes that are ended above it
    with pytest.raises(ValueError, match="RandomEarlyTermination needs to be inside"):
        make_noisy(env, [A, C], [0.5])


@pytest.mark.filterwarnings("ignore:.*WARN")
@pytest.mark.parametrize("text", BASES)
def test_check_env(text):
    check_env(build(text, gym.make(registered(text)[0]), 0.3), skip_render_check=True)
    space = gym.spaces.Box(-6, 5, (2, 3), np.int8)
    check_env(build(text, GenericEnv(space), "1.0:0.0"), skip_render_check=True)


def test_observations_without_numbers():
    category = gym.spaces.Tuple((gym.spaces.Dict(kind=gym.spaces.MultiDiscrete([2, 3])),))
    for space in (category, gym.spaces.Box(0, 1, (3,), np.bool_), gym.spaces.Sequence(BOX)):
        env = GenericEnv(space, lambda env, space=space: space.sample())
        with pytest.raises(ValueError, match="needs observations of floats or integers"):
            RandomNormalNoisyObservation(env, 0.1, 1.0)
        make_noisy(env, [A, C], [1.0]).reset(seed=0)
