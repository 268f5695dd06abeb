"""The notation of the command line, stacks of noises, and configurations."""

import math

import numpy as np
import pytest
from cases import NOISES, A, B, C, constant_env, layers, named

from noisy_wrappers import (
    BASELINE,
    Configuration,
    make_noisy,
    noise_statistics,
    noise_wrappers,
    parse_noise,
    signatures,
    split_noises,
)


@pytest.mark.parametrize("text", NOISES)
def test_notation_round_trips(text):
    assert str(parse_noise(text)) == text
    assert len({parse_noise(text), parse_noise(f" {text}")}) == 1


SPELLINGS = """
RandomUniformScaleReward(0.5, 1.5) | RandomUniformScaleReward( .50, high=15e-1 )
RandomNormalNoisyReward(0.001, loc=2.0) | RandomNormalNoisyReward(loc=2,scale=1e-3)
RandomUniformNoisyReward(0.0, 0.5) | RandomUniformNoisyReward(-0.0, .5, relative=False)
RandomEarlyTermination(50) | RandomEarlyTermination(high=50, low=50)
RandomEarlyTermination(50) | RandomEarlyTermination(50, None, truncate=False)
RandomMixupObservation(0.0, recursive=True) | RandomMixupObservation(recursive=True, factor=0)
RandomDropoutObservation(0.5, keys=('a', 'b')) | RandomDropoutObservation(.5, keys=['b', 'a', 'b'])
RandomNormalNoisyObservation((0.1, 0.0)) | RandomNormalNoisyObservation(loc=0, scale=(.10, -0.0))
"""


@pytest.mark.parametrize("line", SPELLINGS.strip().split("\n"))
def test_canonical_spelling(line):
    canonical, text = line.split(" | ")
    assert str(parse_noise(text)) == canonical == str(parse_noise(canonical))
    assert named([text], [0.1]) == named([canonical], [0.10])


ARGUMENTS = ["", "1, 2", "-1", "1, sigma=2", "1, noise_rate=0.5", "'1'", "2 * 3", "1e999", "x"]
ARGUMENTS += ["*[1]", "1, **{'loc': 2}", "1, loc=1, loc=2", "{[]: 1}", "1)(2", "__import__('os')"]
NOT_NOISES = ["", "Baseline", "RandomNormalNoisyReward", "NoiseWrapper(1)", "dict()", "(" * 500]
NOT_NOISES += ["RandomNormalNoisyReward(1", "noisy_wrappers.RandomNormalNoisyReward(1)"]


@pytest.mark.parametrize(
    "text", [*(f"RandomNormalNoisyReward({a})" for a in ARGUMENTS), *NOT_NOISES]
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
    names = ["RandomEarlyTermination(9)", "RandomNormalNoisyReward(1.0)"]
    assert canonical([A, C], [0.5]) == (names, [0.5, 0.5])  # dynamics noise comes first
    assert canonical([A, B, C], [0.5, 0, 1]) == (names, [1.0, 0.5])
    assert canonical([A, B], ["-0.0:0", 0.0]) == ([], [])
    assert canonical([A, C], ["1:0", "0:.5"]) == (names, ["0.0:0.5", "1.0:0.0"])
    assert canonical([A], ["0.50:.5"]) == (names[1:], [0.5])
    assert canonical(np.array([A, B]), np.array([0.5, 0.0])) == canonical([A, B], [0.5, 0.0])
    inner = ["RandomDynamics(1.0, 2.0)", "RandomEarlyTermination(9)"]  # from the environment on
    inner += ["RandomActionDelay(1)", "RandomNormalNoisyAction(1.0)", names[1]]
    assert canonical(inner[::-1], [0.5])[0] == inner


@pytest.mark.parametrize(
    ("noises", "rates"),
    [([], [0.1]), ([A], []), ([A], [0.1, 0.2]), ([A, B, C], [0.1, 0.2]), (["Nothing(1)"], [0.0])]
    + [(A, [0.5]), ([A], 0.5), ([A], "1:0")]  # no lists
    + [([A], [rate]) for rate in (1.1, math.nan, "0.5:", "1:2", "a:b", "1:0.5:0", "nan:0")],
)
def test_bad_noises_and_rates(noises, rates):
    with pytest.raises(ValueError) as error:
        canonical(noises, rates)
    lines = str(error.value).split("\n  ")
    assert "\n" not in lines[0]
    assert lines[1:] == (signatures() if "Nothing" in str(noises) else [])


def test_make_noisy_order():
    statistics = "RecordEpisodeStatistics"
    reward, dropout, end = (text.split("(")[0] for text in (A, B, C))
    assert layers(make_noisy(constant_env(), [], [])) == [statistics]
    assert layers(make_noisy(constant_env(), [A, B], [0.5])) == [statistics, reward, dropout]
    env = make_noisy(constant_env(), [A, "RandomNormalNoisyAction(1)", B, C], ["0:1"])
    assert layers(env) == [end, "RandomNormalNoisyAction", statistics, reward, dropout]
    env = make_noisy(constant_env(), [B, A, C], [0.1, 0.2, 0.3])
    assert layers(env) == [end, statistics, dropout, reward]
    rates = [(name, wrapper.noise_rate) for name, wrapper in noise_wrappers(env).items()]
    assert rates == [(end, 0.3), (dropout, 0.1), (reward, 0.2)]
    env = make_noisy(constant_env(), [A, C], [0.5], record_statistics=False)
    assert layers(env) == [end, reward]


def test_noise_statistics():
    env = make_noisy(constant_env(), [A, B, A], [1.0, 0.5, "1:0"])
    rates = {name: rate for name, rate in noise_statistics(env).items() if rate}
    name = "RandomNormalNoisyReward"  # the second of a class has a number
    assert rates == {f"{name}/rate": 1, "RandomDropoutObservation/rate": 0.5, f"{name}_2/rate": 1}
    assert noise_statistics(constant_env()) == {}


# CONFIGURATIONS

SCALE = "RandomUniformScaleReward(0.5, 1.5)"
SHIFT = "RandomNormalNoisyReward(0.3)"
ENDING = "RandomEarlyTermination(50)"


@pytest.mark.parametrize(
    ("noises", "rates", "noise", "noise_rate"),
    [
        ([], [], "", "0.00"),
        ([SCALE], [0.5], SCALE, "0.50"),
        ([SCALE], [0.125], SCALE, "0.125"),
        ([SCALE], ["1.0:0.0"], SCALE, "1.00 to 0.00"),
        ([SCALE, SHIFT], [0.05, "0.5:1.0"], f"{SCALE} + {SHIFT}", "0.05 + 0.50 to 1.00"),
    ],
)
def test_it_is_read_and_written(noises, rates, noise, noise_rate):
    config = Configuration.read(noises, rates)
    assert (config.noise, config.noise_rate) == (noise, noise_rate)
    assert config.texts == (noises, rates)
    assert Configuration.read(*config.texts, stored=True) == config
    assert Configuration.parse(*config.columns) == config
    assert Configuration.parse(noise, noise_rate) == config
    assert (config == BASELINE) == (not noises)


def test_it_is_ordered_by_noise_and_by_its_rates_as_numbers():
    rates = [0.05, "0.1:0.0", 0.1, 0.1234, 1.0]
    ordered = [BASELINE, *(Configuration.read([SCALE], [rate]) for rate in rates)]
    ordered.append(Configuration.read([SCALE, SHIFT], [0.01, 0.01]))
    assert sorted(ordered[::-1]) == ordered


def test_what_stands_in_sentences_csv_files_and_names_of_files():
    config = Configuration.read([ENDING, SCALE], [0.05, "1.0:0.0"])
    assert str(config) == f"{ENDING} + {SCALE} at 0.05 + 1.0 to 0.0"
    assert config.columns == (f"{ENDING} + {SCALE}", "0.05 + 1.0:0.0")
    assert config.slug == "p0.05+1.0to0.0_EarlyTermination_50+UniformScaleReward_0.5_1.5"
    assert (str(BASELINE), BASELINE.slug, BASELINE.columns) == ("no noise", "", ("", "0.0"))


def test_what_a_program_has_stored():
    assert Configuration.parse("Gone(1)", 0.5).columns == ("Gone(1)", "0.5")
    for noise, rates in (("A(1) + B(1)", "0.5"), ("A(1)", "0.5 + 0.5")):
        with pytest.raises(ValueError, match="needs a rate for each noise, got '0.5"):
            Configuration.parse(noise, rates)
    own = "no_such_module:Sticky(3)"  # whose module need not be here
    config = Configuration.read([own, SCALE], ["1.0:0.0", 0.5], stored=True)
    assert config.texts == ([own, SCALE], ["1.0:0.0", 0.5])
    for bad in ("Gone(1)", "no_such_module:Sticky(", 3):
        with pytest.raises(ValueError, match="bad noise"):
            Configuration.read([bad], [0.5], stored=True)


def test_an_entry_is_split_into_its_noises():
    assert split_noises(f"{SCALE}+{SHIFT}") == split_noises(f" {SCALE} + {SHIFT} ")
    assert split_noises("A(1e+5)@1:0+B()@.5") == ["A(1e+5)@1:0", "B()@.5"]
    assert split_noises("own:A('x + y()')+B()") == ["own:A('x + y()')", "B()"]


def test_a_mistyped_name_is_told_what_it_resembles():
    with pytest.raises(ValueError, match=r"unknown name \(did you mean RandomMixupObservation\?\)"):
        parse_noise("RandomMixUpObservation(0.5)")
