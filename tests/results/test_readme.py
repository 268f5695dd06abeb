"""The numbers in "What we found" of the project's README are those that results/ computes."""

import baselines
import harmful
import pytest
import readme
import verdicts
from common import RESULTS

pytestmark = pytest.mark.slow  # they read the committed runs again

OTHERS = ["HalfCheetah", "Hopper", "Humanoid", "Walker2d"]


@pytest.fixture(scope="module")
def numbers():
    return readme.numbers()


@pytest.fixture(scope="module")
def section():
    text = (RESULTS.parent / "README.md").read_text()
    return " ".join(text.split("## What we found")[1].split("\n## ")[0].split())


def test_the_confirmed_gain(numbers, section):
    found, paper = numbers["pusher"], numbers["five"]["paper_percent"]["Pusher"]
    assert f"{found['percent']['fresh']:+.0f} % on twenty fresh seeds" in section
    assert f"(p < 0.001; the paper: {paper:+.0f} %)" in section
    assert found["n"]["fresh"] == 20 and found["p"]["fresh"] < 0.001
    gains = verdicts.gains(numbers)
    assert [name for name in gains if gains[name] == verdicts.CONFIRMED] == ["Pusher"]


def test_the_other_four(numbers, section):
    *changes, last = (f"{numbers['five']['percent'][name]:+.0f}" for name in OTHERS)
    assert f"{', '.join(changes)} and {last} % (ten seeds)" in section
    power = numbers["five"]["power_at_5"]
    assert f"with a power of {power['Walker2d']:.2f}; the other three tests" in section
    assert max(power[name] for name in OTHERS[:3]) < 0.5


def test_the_harmful_noise(numbers, section):
    found = numbers["worse_noises"][harmful.NORMAL]
    losses = [-found["change"][name] for name in OTHERS]
    text = f"costs PPO {min(losses):.0f} to {max(losses):.0f} % in four of five environments"
    assert text in section and "Pusher is undecided" in section
    judged = verdicts.losses(found)
    assert [judged[name] for name in OTHERS] == 4 * [verdicts.CONFIRMED]
    assert judged["Pusher"] == verdicts.UNDECIDED


def test_luck(numbers, section):
    p = numbers["luck"]["p"]
    assert f"(P = {p.min():.2f} to {p.max():.2f})" in section
    assert "None of the paper's 15" in section and verdicts.beyond_luck(p) == "none of 15"


def test_robustness(numbers, section):
    seeing, acting = (numbers["unseen"][f"{name} noise"] for name in ("observation", "action"))
    points = -seeing["difference"], -seeing["difference_high"], -seeing["difference_low"]
    assert "return {:.0f} points less [{:.0f}, {:.0f}]".format(*points) in section
    limits = (acting[key] for key in ("difference", "difference_low", "difference_high"))
    assert "nothing was shown ({:+.0f} [{:.0f}, {:.0f}])".format(*limits) in section
    assert seeing["p_holm"] <= 0.05 < acting["p_holm"]


def test_baselines(section):
    """ "Clear" is PPO's tests against the paper with Holm's correction, and others without."""
    found = baselines.numbers()
    assert "except that PPO returns more than the paper's on Hopper and Walker2d" in section
    assert [name for name in found["holm"] if found["holm"][name] <= 0.05] == ["Hopper", "Walker2d"]
    clear = [
        (name, who, other["se"] > 0)
        for length in ("full", "short")
        for name, others in found[length]["numbers"].items()
        for who, other in others.items()
        if other["p"] <= 0.05
    ]
    of_ppo = [f"PPO on {name}" for name in ("Hopper-v5", "Walker2d-v4", "Walker2d-v5")]
    on_cheetah = ["SAC on HalfCheetah-v5", "TD3 on HalfCheetah-v5"]
    assert clear == [(name, "paper", True) for name in (*of_ppo, *on_cheetah)]
    sac, td3 = (found["full"]["numbers"][name]["paper"]["p"] for name in on_cheetah)
    assert f"and SAC and TD3 on HalfCheetah (p = {sac:.2g} and {td3:.2g}, uncorrected)" in section
