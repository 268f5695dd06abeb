"""A configuration: how it is read, written and ordered."""

import pytest

from noisy_wrappers import BASELINE, WRAPPERS, Configuration, rate_order, split_noises

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
    assert (
        Configuration.parse(*config.columns)
        == config
        == Configuration.read(*config.texts, stored=True)
    )
    assert Configuration.parse(noise, noise_rate) == config
    assert config.texts == (noises, rates)
    assert (config == BASELINE) == (not noises)


def test_there_is_one_baseline():
    for rate in ("0.0", "0.00", 0, ""):
        assert Configuration.parse("", rate) == BASELINE == Configuration()


def test_it_is_ordered_by_noise_and_by_its_rates_as_numbers():
    rates = [0.05, "0.1:0.0", 0.1, 0.1234, 1.0]
    ordered = [BASELINE, *(Configuration.read([SCALE], [rate]) for rate in rates)]
    ordered.append(Configuration.read([SCALE, SHIFT], [0.01, 0.01]))
    assert sorted(ordered[::-1]) == ordered
    texts = [config.noise_rate for config in ordered[1:6]]
    assert sorted(texts[::-1], key=rate_order) == texts


def test_its_wrappers_and_kinds():
    config = Configuration.read([ENDING, SCALE], [1.0, 0.5])
    assert config.wrappers == ["RandomEarlyTermination", "RandomUniformScaleReward"]
    assert config.kinds == {"dynamics", "reward"} and BASELINE.kinds == set()


def test_spellings_of_one_configuration_are_one():
    config = Configuration.read(["RandomUniformScaleReward(.50, high=1.5)", ENDING], ["1:0", 0.05])
    assert config == Configuration.read([ENDING, SCALE], [0.05, "1.0:0.0"])
    assert str(config) == f"{ENDING} + {SCALE} at 0.05 + 1.0 to 0.0"
    assert config.columns == (f"{ENDING} + {SCALE}", "0.05 + 1.0:0.0")
    assert config.slug == "p0.05+1.0to0.0_EarlyTermination_50+UniformScaleReward_0.5_1.5"
    assert (str(BASELINE), BASELINE.slug, BASELINE.columns) == ("no noise", "", ("", "0.0"))
    assert Configuration.read([SCALE, ENDING], [0.0, "0:0"]) == BASELINE


def test_what_a_program_has_stored():
    assert Configuration.parse("Gone(1)", 0.5).columns == ("Gone(1)", "0.5")
    own = "no_such_module:Sticky(3)"  # whose module need not be here
    config = Configuration.read([own, SCALE], ["1.0:0.0", 0.5], stored=True)
    assert config.texts == ([own, SCALE], ["1.0:0.0", 0.5]) and config.kinds == {"own", "reward"}
    for bad in ("Gone(1)", "no_such_module:Sticky(", 3):
        with pytest.raises(ValueError, match="bad noise"):
            Configuration.read([bad], [0.5], stored=True)


@pytest.mark.parametrize("text", [f"{SCALE}+{SHIFT}", f" {SCALE} + {SHIFT} "])
def test_an_entry_is_split_into_its_noises(text):
    assert split_noises(text) == [SCALE, SHIFT]
    assert split_noises("A(1e+5)@1:0+B()@.5") == ["A(1e+5)@1:0", "B()@.5"]


def test_every_wrapper_says_its_kind():
    kinds = {name: wrapper.kind for name, wrapper in WRAPPERS.items()}
    assert set(kinds.values()) == {"observation", "reward", "action", "dynamics"}
    for name, kind in kinds.items():
        assert kind in name.lower() or kind == "dynamics"
