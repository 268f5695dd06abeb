"""A configuration: how it is read, written and ordered."""

import pytest

from analysis.configurations import BASELINE, Configuration, rate_order
from noisy_wrappers import WRAPPERS

SCALE = "RandomUniformScaleReward(0.5, 1.5)"
PUSH = "RandomNormalNoisyAction(0.3)"
ENDING = "RandomEarlyTermination(50)"


@pytest.mark.parametrize(
    ("noises", "rates", "noise", "noise_rate"),
    [
        ([], [], "", "0.00"),
        ([SCALE], [0.5], SCALE, "0.50"),
        ([SCALE], [0.125], SCALE, "0.125"),
        ([SCALE], ["1.0:0.0"], SCALE, "1.00 to 0.00"),
        ([SCALE, PUSH], [0.05, "0.5:1.0"], f"{SCALE} + {PUSH}", "0.05 + 0.50 to 1.00"),
    ],
)
def test_it_is_read_and_written(noises, rates, noise, noise_rate):
    config = Configuration.read(noises, rates)
    assert (config.noise, config.noise_rate) == (noise, noise_rate)
    assert Configuration.parse(noise, " + ".join(map(str, rates))) == config
    assert config.is_baseline == (not noises)


def test_there_is_one_baseline():
    for rate in ("0.0", "0.00", 0, ""):
        assert Configuration.parse("", rate) == BASELINE == Configuration()


def test_it_is_ordered_by_noise_and_by_its_rates_as_numbers():
    rates = [0.05, "0.1:0.0", 0.1, 0.1234, 1.0]
    ordered = [BASELINE, *(Configuration.read([SCALE], [rate]) for rate in rates)]
    ordered.append(Configuration.read([SCALE, PUSH], [0.01, 0.01]))
    assert sorted(ordered[::-1]) == ordered
    texts = [config.noise_rate for config in ordered[1:6]]
    assert sorted(texts[::-1], key=rate_order) == texts


def test_its_parts_wrappers_and_kinds():
    config = Configuration.read([ENDING, SCALE], [1.0, 0.5])
    assert config.parts == [
        Configuration.read([ENDING], [1.0]),
        Configuration.read([SCALE], [0.5]),
    ]
    assert config.wrappers == ["RandomEarlyTermination", "RandomUniformScaleReward"]
    assert config.kinds == {"dynamics", "reward"} and BASELINE.kinds == set()


def test_every_wrapper_says_its_kind():
    kinds = {name: wrapper.kind for name, wrapper in WRAPPERS.items()}
    assert set(kinds.values()) == {"observation", "reward", "action", "dynamics"}
    for name, kind in kinds.items():
        assert name.lower().endswith(kind) or kind == "dynamics"
