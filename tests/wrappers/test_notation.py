"""The notation of the command line, and stacks of noises."""

import math

import gymnasium as gym
import numpy as np
import pytest
from cases import NOISES, A, B, C, GenericEnv, build, constant_env, layers, rollout, streams
from gymnasium.wrappers import RecordEpisodeStatistics

from noisy_wrappers import (
    Configuration,
    RandomEarlyTermination,
    RandomNormalNoisyObservation,
    RandomNormalNoisyReward,
    RandomUniformScaleReward,
    make_noisy,
    noise_statistics,
    noise_wrappers,
    parse_noise,
    run_name,
    set_progress,
    signatures,
)


@pytest.mark.parametrize("text", NOISES)
def test_notation_round_trips(text):
    noise = parse_noise(text)
    assert str(noise) == text
    assert parse_noise(str(noise)) == noise
    assert len({noise, parse_noise(text)}) == 1
    wrapper = noise(constant_env(), 0.5)
    assert str(wrapper).startswith(f"<{text.split('(')[0]}<")
    assert rollout(wrapper, 0)[-1][1:] == rollout(build(text, constant_env(), 0.5), 0)[-1][1:]


SPELLINGS = """
RandomUniformScaleReward(0.5, 1.5) | RandomUniformScaleReward(.5,1.50)
RandomUniformScaleReward(0.5, 1.5) | RandomUniformScaleReward( 0.50, high=15e-1 )
RandomUniformScaleReward(0.5, 1.5) | RandomUniformScaleReward(high=1.5, low=5e-1)
RandomNormalNoisyReward(1.0) | RandomNormalNoisyReward(+1)
RandomNormalNoisyReward(0.001) | RandomNormalNoisyReward(1e-3, loc=-0.0)
RandomNormalNoisyReward(0.001, loc=2.0) | RandomNormalNoisyReward(loc=2,scale=.001)
RandomUniformNoisyReward(0.0, 0.5) | RandomUniformNoisyReward(-0.0, .5, relative=False)
RandomEarlyTermination(50) | RandomEarlyTermination(high=50, low=50)
RandomEarlyTermination(50) | RandomEarlyTermination(50, None, truncate=False)
RandomEarlyTermination(each_step=True, truncate=True) | RandomEarlyTermination(truncate=True, each_step=True)
RandomMixupObservation(0.0) | RandomMixupObservation(0, recursive=False)
RandomMixupObservation(0.0, recursive=True) | RandomMixupObservation(recursive=True, factor=0)
"""  # noqa: E501


@pytest.mark.parametrize("line", SPELLINGS.strip().split("\n"))
def test_canonical_spelling(line):
    canonical, text = line.split(" | ")
    assert str(parse_noise(text)) == canonical
    assert parse_noise(text) == parse_noise(canonical)
    assert run_name("E", "x", [text], [0.1], 1) == run_name("E", "x", [canonical], [0.10], 1)


@pytest.mark.parametrize(
    "arguments",
    ["", "1, 2", "-1", "1, sigma=2", "1, noise_rate=0.5", "'1'", "True", "2 * 3", "1e999", "x"]
    + ["*[1]", "1, **{'loc': 2}", "1, loc=1, loc=2", "{[]: 1}", "1)(2", "__import__('os')", "\x00"],
)
def test_bad_arguments(arguments):
    test_bad_notation(f"RandomNormalNoisyReward({arguments})")


@pytest.mark.parametrize(
    "text",
    ["", "Baseline", "RandomNormalNoisyReward", "RandomNormalNoisyReward(1", "NoiseWrapper(1)"]
    + ["dict()", "RandomUniformScaleReward(1.5, 0.5)", "RandomEarlyTermination(5.0)", "(" * 500]
    + ["noisy_wrappers.RandomNormalNoisyReward(1)", "__import__('os').system('true')"],
)
def test_bad_notation(text):
    with pytest.raises(ValueError) as error:
        parse_noise(text)
    reason, *lines = str(error.value).split("\n  ")
    assert "\n" not in reason and repr(text) in reason
    assert lines == signatures()


def canonical(noises, rates):
    """Return noises and rates as config.json holds them."""
    return Configuration.read(noises, rates).texts


def test_canonical_notation():
    assert canonical([], []) == ([], [])
    assert canonical([A], [0.5]) == (["RandomNormalNoisyReward(1.0)"], [0.5])
    names = ["RandomEarlyTermination(9)", "RandomNormalNoisyReward(1.0)"]
    assert canonical([A, C], [0.5]) == (names, [0.5, 0.5])  # dynamics noise comes first
    assert canonical([A, B, C], [0.5, 0, 1]) == (names, [1.0, 0.5])
    assert canonical([A, B], [0]) == ([], [])
    assert canonical([A, B], ["0:0", 0.0]) == ([], [])
    assert canonical([A, C], ["1:0", "0:.5"]) == (names, ["0.0:0.5", "1.0:0.0"])
    assert canonical([A], ["-0.0:0"]) == ([], [])
    assert canonical([A], ["0.50:.5"]) == (names[1:], [0.5])
    assert canonical([A, A], ["1:0"])[1] == ["1.0:0.0", "1.0:0.0"]
    action = "RandomNormalNoisyAction(1.0)"
    assert canonical([A, action, C], [0.1, 0.2, 0.3]) == (
        ["RandomEarlyTermination(9)", action, "RandomNormalNoisyReward(1.0)"],
        [0.3, 0.2, 0.1],
    )
    again = canonical([B, A, C], [0.1, 0.2, 0.3])
    assert canonical(*again) == again
    for rate in again[1]:
        assert type(rate) is float


@pytest.mark.parametrize(
    ("noises", "rates"),
    [([], [0.1]), ([A], []), ([A], [0.1, 0.2]), ([A, B, C], [0.1, 0.2]), (["Nothing(1)"], [0.0])]
    + [([A], [rate]) for rate in (1.1, math.nan, "0.5:", "1:2", "a:b", "0.5", "1:0.5:0", "nan:0")],
)
def test_bad_noises_and_rates(noises, rates):
    for function in (
        lambda: canonical(noises, rates),
        lambda: make_noisy(constant_env(), noises, rates),
        lambda: run_name("E", "x", noises, rates, 1),
    ):
        with pytest.raises(ValueError) as error:
            function()
        lines = str(error.value).split("\n  ")
        assert "\n" not in lines[0]
        assert lines[1:] == (signatures() if "Nothing" in str(noises) else [])


@pytest.mark.parametrize("function", [canonical, make_noisy])
def test_noises_and_rates_are_lists(function):
    first = [constant_env()] if function is make_noisy else []
    for noises, rates, name in [(A, [0.5], "noises"), ([A], 0.5, "rates"), ([A], "1:0", "rates")]:
        with pytest.raises(ValueError, match=rf"^{name} must be a list, for example \[.*\], got "):
            function(*first, noises, rates)
    with pytest.raises(ValueError, match="bad noise <class"):
        function(*first, [RandomNormalNoisyReward], [0.5])


def test_numbers_and_arrays_of_numpy():
    rates = np.array([0.5, 0.0])
    assert canonical(np.array([A, B]), rates) == canonical([A, B], [0.5, 0.0])
    assert canonical(np.array([A]), np.array([0.0])) == ([], [])
    for half in (np.float64(0.5), np.float32(0.5), np.array(0.5)):
        env = RandomNormalNoisyReward(constant_env(), half, half, loc=half)
        assert (env.noise_rate, env.scale, env.loc) == (0.5, 0.5, 0.5)
        assert {type(env.noise_rate), type(env.scale), type(env.loc)} == {float}
        set_progress(env, half)
    for nine in (np.int64(9), np.uint8(9), np.array(9)):
        assert type(RandomEarlyTermination(constant_env(), 0.5, nine).low) is int
    env = GenericEnv(gym.spaces.Box(-1, 1, (3,)))
    scales = RandomNormalNoisyObservation(env, 0.5, np.array([1, 2, 3])).scale
    assert scales == (1.0, 2.0, 3.0)
    assert {type(scale) for scale in scales} == {float}
    for bad in (np.array([[1.0, 2.0]]), np.array([0.1, np.nan]), np.array([0.1])):
        with pytest.raises(ValueError, match="scale"):
            RandomNormalNoisyObservation(env, 0.5, bad)
    for bad in (np.array([0.5, 0.5]), np.array(True), np.array(2.0)):
        with pytest.raises(ValueError, match="noise_rate"):
            RandomNormalNoisyReward(constant_env(), bad, 0.1)


def test_make_noisy_order():
    statistics = "RecordEpisodeStatistics"
    reward, dropout, end = (text.split("(")[0] for text in (A, B, C))
    assert layers(make_noisy(constant_env(), [], [])) == [statistics]
    assert layers(make_noisy(constant_env(), [A], [0])) == [statistics]
    assert layers(make_noisy(constant_env(), [A, B], [0.5])) == [statistics, reward, dropout]
    for noises in ([A, B, C], [A, C, B], [C, A, B]):
        env = make_noisy(constant_env(), noises, [0.5])
        assert layers(env) == [end, statistics, reward, dropout]
    env = make_noisy(constant_env(), [A, "RandomNormalNoisyAction(1)", B, C], ["0:1"])
    assert layers(env) == [end, "RandomNormalNoisyAction", statistics, reward, dropout]
    assert {wrapper.schedule for wrapper in noise_wrappers(env).values()} == {(0.0, 1.0)}
    env = make_noisy(constant_env(), [B, A, C], [0.1, 0.2, 0.3])
    assert layers(env) == [end, statistics, dropout, reward]
    rates = {name: wrapper.noise_rate for name, wrapper in noise_wrappers(env).items()}
    assert rates == {end: 0.3, dropout: 0.1, reward: 0.2}
    assert list(rates) == [end, dropout, reward]


def test_noise_wrappers_numbers_repeats():
    env = make_noisy(constant_env(), [A, B, A, A], [0.1, 0.2, 0.3, 0.4])
    found = noise_wrappers(RecordEpisodeStatistics(env))
    name = "RandomNormalNoisyReward"
    assert list(found) == [name, "RandomDropoutObservation", f"{name}_2", f"{name}_3"]
    assert [wrapper.noise_rate for wrapper in found.values()] == [0.1, 0.2, 0.3, 0.4]
    assert noise_wrappers(constant_env()) == {}


def test_noise_statistics():
    env = make_noisy(constant_env(), [A, B, A], [1.0, 0.5, "1:0"])
    env.reset(seed=1)
    for _ in range(9):
        env.step(0)
    name, statistics = "RandomNormalNoisyReward", noise_statistics(env)
    assert list(statistics) == [
        f"{wrapper}/{number}"
        for wrapper in (name, "RandomDropoutObservation", f"{name}_2")
        for number in ("rate", "applied_fraction")
    ]
    wrappers = noise_wrappers(env)
    for wrapper in wrappers:
        assert statistics[f"{wrapper}/rate"] == wrappers[wrapper].noise_rate
        assert statistics[f"{wrapper}/applied_fraction"] == wrappers[wrapper].applied_fraction
    assert statistics[f"{name}/rate"] == statistics[f"{name}/applied_fraction"] == 1
    alone = make_noisy(constant_env(), [A], [0.25])
    assert list(noise_statistics(alone)) == ["rate", "applied_fraction"]
    assert noise_statistics(alone)["rate"] == 0.25
    assert noise_statistics(constant_env()) == {}


def test_statistics_see_the_true_return_and_length():
    noises = ["RandomUniformScaleReward(0, 0)", "RandomNormalNoisyReward(5)", C]
    env = make_noisy(GenericEnv(), noises, [1.0])
    rewards = [step[1] for step in rollout(GenericEnv(), seed=8, steps=9)[1:]]
    env.reset(seed=8)
    steps = [env.step(0) for _ in range(9)]
    assert [step[2] for step in steps] == [False] * 8 + [True]
    assert steps[-1][4]["episode"]["r"] == pytest.approx(sum(rewards))
    assert steps[-1][4]["episode"]["l"] == 9
    assert sum(step[1] for step in steps) != pytest.approx(sum(rewards))


def test_combined_noise_is_the_composition_of_the_formulas():
    noises = ["RandomUniformScaleReward(0.5, 1.5)", "RandomNormalNoisyReward(2)"]
    env = make_noisy(GenericEnv(), noises, [1.0])
    clean = [step[1] for step in rollout(GenericEnv(), seed=3)[1:]]
    noisy = [step[1] for step in rollout(env, seed=3)[1:]]
    _, scale = streams(RandomUniformScaleReward, 3, 0)
    _, shift = streams(RandomNormalNoisyReward, 3, 1)
    assert noisy == [r * scale.uniform(0.5, 1.5) + shift.normal(0, 2) for r in clean]
