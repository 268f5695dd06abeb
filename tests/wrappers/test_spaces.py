"""Observation and action spaces: which are taken, and how they are widened."""

import gymnasium as gym
import numpy as np
import pytest
from cases import (
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
from gymnasium.wrappers import FlattenObservation, RecordEpisodeStatistics
from hypothesis import given
from hypothesis import strategies as st

from noisy_wrappers import (
    RandomDropoutObservation,
    RandomMixupObservation,
    RandomNormalNoisyObservation,
    RandomNormalNoisyReward,
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


numbers = st.floats(-100, 100)

probabilities = st.floats(0, 1)

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


@pytest.mark.parametrize("given", [np.array([1, 2, 3]), [1, 2, 3], np.array([1.0, 2.0, 3.0])])
def test_noise_has_the_dtype_of_the_space_whatever_the_environment_returns(given):
    """Rounding to the integers that an environment happens to return would undo the noise."""
    space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    env = GenericEnv(space, reset=lambda env: (given, {}))
    env = RandomNormalNoisyObservation(env, 1.0, 0.1)
    _, noise = streams(RandomNormalNoisyObservation, 0)
    expected = [1, 2, 3] + noise.normal(0, 0.1, 3)
    got = env.reset(seed=0)[0]
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, expected.astype(np.float32))


def test_an_environments_own_info_of_noise_gives_way():
    env = GenericEnv(gym.spaces.Box(-1, 1, (3,)), reset=lambda env: (np.ones(3), {"noise": 0.3}))
    assert env.reset()[1] == {"noise": 0.3}
    env = RandomNormalNoisyObservation(RandomDropoutObservation(env, 1.0, 0.0), 1.0, 0.1)
    names = ("RandomDropoutObservation", "RandomNormalNoisyObservation")
    assert env.reset()[1]["noise"] == names


class Monitor(gym.Wrapper):
    """Records episodes as Stable-Baselines3's wrapper of this name does."""

    def reset(self, **kwargs):
        self.rewards = []
        return self.env.reset(**kwargs)

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.rewards.append(reward)
        if terminated or truncated:
            info["episode"] = {"r": sum(self.rewards), "l": len(self.rewards), "t": 0.0}
        return observation, reward, terminated, truncated, info

    def get_episode_rewards(self):
        return []


class Bonus(gym.RewardWrapper):
    """Shapes the reward outside of the environment's own record, as some of Meta-World's do."""

    def reward(self, reward):
        return reward + 1.0


@pytest.mark.parametrize("recorder", [RecordEpisodeStatistics, Monitor])
def test_our_record_takes_the_place_of_the_environments(recorder):
    env = recorder(gym.wrappers.TimeLimit(constant_env(2.0), 5))
    env = make_noisy(Bonus(env), ["RandomNormalNoisyAction(0.1)", A, B], [1.0])
    for _ in range(2):
        env.reset(seed=0)
        info = [env.step(np.zeros(1, np.float32)) for _ in range(5)][-1][4]
        assert info["episode"]["r"] == 15.0 and info["episode"]["l"] == 5
        assert not any("noisy_wrappers" in key for key in info)
    assert list(env.get_wrapper_attr("return_queue")) == [15.0, 15.0]


def test_the_true_return_stays_where_noises_are_added_later():
    env = make_noisy(gym.wrappers.TimeLimit(constant_env(2.0), 5), [A], [1.0])
    env = make_noisy(env, [B], [1.0])
    assert layers(env).count("RecordEpisodeStatistics") == 1
    env.reset(seed=0)
    assert [env.step(0) for _ in range(5)][-1][4]["episode"]["r"] == 10.0
    # an environment may have been made with noise, and changes the reward or the end itself
    env = make_noisy(gym.wrappers.TimeLimit(Bonus(env), 3), [], [])
    env.reset(seed=0)
    steps = [env.step(0) for _ in range(3)]
    assert steps[-1][4]["episode"]["r"] == pytest.approx(sum(step[1] for step in steps))


@pytest.mark.parametrize("recorder", [RecordEpisodeStatistics, Monitor])
def test_the_record_of_the_environment_is_kept(recorder):
    env = recorder(gym.wrappers.TimeLimit(constant_env(2.0), 5))
    env = make_noisy(env, [A, B], [1.0], record_statistics=False)
    assert layers(env)[-3:] == [recorder.__name__, A.split("(")[0], B.split("(")[0]]
    env.reset(seed=0)
    steps = [env.step(0) for _ in range(5)]
    assert steps[-1][4]["episode"]["r"] == 10.0
    assert steps[-1][4]["episode"]["l"] == 5
    assert sum(step[1] for step in steps) != 10.0


@pytest.mark.parametrize("recorder", [RecordEpisodeStatistics, Monitor])
def test_a_record_would_miss_the_episodes_that_are_ended_above_it(recorder):
    env = recorder(gym.make("CartPole-v1"))
    for recorded in (env, RandomNormalNoisyReward(env, 0.1, 1.0)):
        with pytest.raises(ValueError, match="RandomEarlyTermination ends") as error:
            make_noisy(recorded, [A, C], [0.5], record_statistics=False)
        assert "\n" not in str(error.value)
    make_noisy(env, [C], [0], record_statistics=False)  # no noise
    # What the agent meets and what is recorded agree about noisy actions.
    env = recorder(gym.make("Pendulum-v1"))
    make_noisy(env, ["RandomNormalNoisyAction(1)"], [1.0], record_statistics=False)


def test_no_record_where_none_is_wanted():
    env = make_noisy(constant_env(), [A, C], [0.5], record_statistics=False)
    assert layers(env) == ["RandomEarlyTermination", "RandomNormalNoisyReward"]
    assert layers(make_noisy(constant_env(), [], [], record_statistics=False)) == []


@pytest.mark.parametrize("dtype", [np.int64, np.uint64])
def test_wide_integers_do_not_overflow(dtype):
    limits = np.iinfo(dtype)
    space = gym.spaces.Box(limits.min, limits.max - 1, (2,), dtype)
    values = np.array([limits.min, limits.max - 1], dtype)
    env = GenericEnv(space, reset=lambda env: (values, {}))
    env = RandomUniformScaleObservation(env, 1.0, 1.5, 1.5)
    got = env.reset(seed=0)[0]
    assert got[0] == limits.min
    assert got[1] == pytest.approx(limits.max, rel=1e-9) and got[1] > 0
    assert got in env.observation_space


@pytest.mark.filterwarnings("ignore:.*WARN")
@pytest.mark.parametrize("text", NOISES)
@pytest.mark.parametrize(
    "env",
    [
        lambda text: gym.make(registered(text)[0]),
        lambda text: gym.make("InvertedPendulum-v5"),
        lambda text: GenericEnv(gym.spaces.Box(-6, 5, (2, 3), np.int8)),
        lambda text: GenericEnv(gym.spaces.Box(-5, 5, (), np.float32)),
    ],
    ids=["registered", "InvertedPendulum", "int8", "scalar"],
)
def test_check_env(text, env):
    for rate in (1.0, 0.3, "1.0:0.0"):
        check_env(build(text, env(text), rate), skip_render_check=True)


WITHOUT_NUMBERS = [
    gym.spaces.Discrete(3),
    gym.spaces.MultiBinary(3),
    gym.spaces.Tuple((gym.spaces.Dict(kind=gym.spaces.MultiDiscrete([2, 3])),)),
    gym.spaces.Box(0, 1, (3,), np.bool_),
    gym.spaces.Sequence(BOX),
]


@pytest.mark.parametrize("space", WITHOUT_NUMBERS, ids=lambda space: type(space).__name__)
@pytest.mark.parametrize("text", NOISES)
def test_observations_without_numbers(text, space):
    env = GenericEnv(space, reset=lambda env: (space.sample(), {}))
    if "Observation" not in text:
        build(text, env, 1.0).reset(seed=0)
        return
    of_numbers = isinstance(space, gym.spaces.Box | gym.spaces.Sequence)
    reason = "floats or integers" if of_numbers else "cannot perturb categories.*reward noise"
    with pytest.raises(ValueError, match=reason) as error:
        build(text, env, 0.1)
    assert "\n" not in str(error.value)


def test_flattened_categories_are_not_perturbed_as_if_they_were_quantities():
    env = GenericEnv(gym.spaces.Dict(x=BOX, kind=gym.spaces.Discrete(3)))
    flat = RandomNormalNoisyReward(gym.wrappers.TimeLimit(FlattenObservation(env), 9), 0.1, 1)
    with pytest.raises(ValueError, match="apply it before gymnasium.wrappers.FlattenObservation"):
        RandomDropoutObservation(flat, 0.1, 0.5)
