"""A verdict cannot outlive its numbers: rules make the table, and tests hold the sentences."""

from copy import deepcopy

import baselines
import common
import future_work
import harmful
import pandas as pd
import pytest
import readme
import reconstruction
import robustness
import verdicts
from verdicts import CONFIRMED, CONTRADICTED, NOT_TESTED, UNDECIDED

pytestmark = pytest.mark.slow  # they read the committed runs again

OTHERS = ["HalfCheetah", "Hopper", "Humanoid", "Walker2d"]
NOISES = [harmful.NORMAL, harmful.MIXUP]
PAGES = {
    "README.md": readme,
    "baselines.md": baselines,
    "reconstruction.md": reconstruction,
    "robustness.md": robustness,
    "future_work.md": future_work,
}


@pytest.fixture(scope="module")
def numbers():
    """Return the numbers of each page, computed when they are asked for."""
    found = {}

    def of_page(page):
        if page not in found:
            found[page] = PAGES[page].numbers()
        return deepcopy(found[page])

    return of_page


# ------------------------------------------------------------------------------------- the rules


@pytest.mark.parametrize(
    ("effect", "p", "claimed", "expected"),
    [
        (3, 0.05, 1, CONFIRMED),
        (3, 0.051, 1, UNDECIDED),
        (-3, 0.05, 1, CONTRADICTED),
        (-3, 0.01, -1, CONFIRMED),
        (3, 0.01, -1, CONTRADICTED),
    ],
)
def test_the_verdict_on_an_effect(effect, p, claimed, expected):
    assert verdicts.of_effect(effect, p, claimed) == expected


def test_the_verdict_on_several_cases():
    assert verdicts.of_all([CONFIRMED, CONFIRMED]) == CONFIRMED
    assert verdicts.of_all([CONFIRMED, UNDECIDED]) == UNDECIDED
    assert verdicts.of_all([CONFIRMED, NOT_TESTED]) == UNDECIDED
    assert verdicts.of_all([CONFIRMED, UNDECIDED, CONTRADICTED]) == CONTRADICTED
    assert verdicts.of_some([CONTRADICTED, UNDECIDED]) == UNDECIDED
    assert verdicts.of_some([CONTRADICTED, CONFIRMED]) == CONFIRMED


def test_every_row_is_short_and_leads_to_its_section(numbers):
    found = numbers("README.md")
    page = (common.RESULTS / "README.md").read_text()
    headings = {
        "".join(c for c in line.lstrip("# ").lower() if c.isalnum() or c in " -").replace(" ", "-")
        for line in page.splitlines()
        if line.startswith("#")
    }
    for claim, address, paper, ours, verdict in verdicts.claims(found):
        assert len(f"{claim} {paper} {ours} {verdict}".split()) <= 30, claim
        assert verdict in (CONFIRMED, CONTRADICTED, UNDECIDED, NOT_TESTED)
        assert (verdict == NOT_TESTED) == (ours == "\u2013")
        if address.startswith("#"):
            assert address[1:] in headings, address
        else:
            assert (common.RESULTS / address).exists()
    assert len(page.splitlines()) <= 190


# Of each row: a change of the numbers, and the verdict that it makes.
CHANGES = [
    ("helps PPO on Pusher", lambda n: n["pusher"]["p"].update(fresh=0.06), UNDECIDED),
    ("PPO on Walker2d", lambda n: n["five"]["holm"].update(Walker2d=0.04), CONFIRMED),
    ("PPO on Hopper", lambda n: n["five"]["holm"].update(Hopper=0.04), CONTRADICTED),
    ("helps PPO on Humanoid", lambda n: n["five"]["holm"].update(Humanoid=0.04), CONTRADICTED),
    ("PPO on HalfCheetah", lambda n: n["five"]["holm"].update(HalfCheetah=0.01), CONTRADICTED),
    ("Observation(1.0)` harms PPO", lambda n: normal(n).update(p=0.2), UNDECIDED),
    ("recursive=True)` harms PPO", lambda n: mixup(n).update(average=5, p=0.01), CONTRADICTED),
    ("in every environment", lambda n: both_alone(n, -9, 0.01), CONFIRMED),
    ("harms TD3", lambda n: n["td3"]["0.01"].update(p=0.03), UNDECIDED),
    ("Observation noise in", lambda n: unseen(n, "observation").update(p_holm=0.2), UNDECIDED),
    ("Action noise in", lambda n: unseen(n, "action").update(p_holm=0.01), CONFIRMED),
    ("reduce the variance", lambda n: n["spread"]["holm"].update(Humanoid=0.01), CONFIRMED),
    ("gains from reward noise", lambda n: n["five"]["reward"].update(p=0.01), CONTRADICTED),
    ("helps all", lambda n: clear_sac(n, -1), CONTRADICTED),
    ("step of early", lambda n: n["pusher"]["step"].update(p=0.01), CONFIRMED),
    ("halves the steps", lambda n: arrive(n, 400_000, 0.04), CONFIRMED),
    ("scale of the noise", lambda n: scales(n).update(RandomUniformScaleReward=0.05), CONFIRMED),
]


def normal(n):
    return n["worse_noises"][harmful.NORMAL]


def mixup(n):
    return n["worse_noises"][harmful.MIXUP]


def arrive(n, steps, p):
    """Let SAC's runs with noise reach the baseline's return after these steps."""
    n["headline"]["noisy"].update(mean=steps, runs=3 * [steps])
    n["headline"].update(p_steps=p)


def scales(n):
    return n["ablation"]["p"]


def unseen(n, noise):
    return n["unseen"][f"{noise} noise"]


def of_paper(n, name):
    """Return the difference of a baseline of a million steps from the paper's."""
    return n["full"]["numbers"][name]["paper"]


def is_above_paper(n, name):
    """Return whether a baseline of a million steps ends above the paper's, with p at most 5 %."""
    found = of_paper(n, name)
    return found["p"] <= 0.05 and found["se"] > 0


def clear_sac(n, sign):
    """Give SAC a gain, or a loss, that is clear at both rates."""
    rates = n["sac"]["p"]
    n["sac"].update(p=dict.fromkeys(rates, 0.02), percent=dict.fromkeys(rates, 9 * sign))


def both_alone(n, change, p):
    for noise in NOISES:
        n["worse_noises"][noise]["change"]["Pusher"] = change
        n["worse_noises"][noise]["alone"]["Pusher"] = p


def verdict_on(row, found):
    (value,) = (verdict for claim, *_, verdict in verdicts.claims(found) if row in claim)
    return value


@pytest.mark.parametrize(("row", "change", "expected"), CHANGES)
def test_a_verdict_changes_with_its_numbers(numbers, row, change, expected):
    found = numbers("README.md")
    assert verdict_on(row, found) != expected
    change(found)
    assert verdict_on(row, found) == expected


def test_one_algorithm_does_not_confirm_a_claim_about_several(numbers):
    found = numbers("README.md")
    clear_sac(found, 1)
    found["five"]["reward"].update(won=300, p=0.001)
    assert verdict_on("helps all", found) == verdict_on("gains from reward", found) == UNDECIDED


def test_fewer_steps_must_be_half_and_not_by_chance(numbers):
    found = numbers("README.md")
    found["headline"]["without"].update(runs=[800_000, 800_000, 1_000_000])
    for steps, p, expected in (
        (400_000, 0.04, CONFIRMED),
        (400_000, 0.06, UNDECIDED),
        (400_000, float("nan"), UNDECIDED),
        (500_000, 0.04, UNDECIDED),
        (1_000_000, 0.04, UNDECIDED),
    ):
        arrive(found, steps, p)
        assert verdict_on("halves the steps", found) == expected, (steps, p)


def test_the_row_of_the_steps_says_when_the_mean_arrives(numbers):
    found = numbers("README.md")
    for steps, expected in ((400_000, "by 0.4 million, p = 0.04, n = 3"), (None, "never, n = 3")):
        arrive(found, float("nan") if steps is None else steps, 0.04)
        [ours] = (ours for claim, _, _, ours, _ in verdicts.claims(found) if "halves" in claim)
        assert ours == expected


def test_each_row_with_a_verdict_is_among_the_changes(numbers):
    for claim, *_, verdict in verdicts.claims(numbers("README.md")):
        assert verdict == NOT_TESTED or sum(row in claim for row, *_ in CHANGES) == 1, claim


# --------------------------------------------------------------------------------- the sentences

# Of each page: a sentence, when it holds, and a change of the numbers with which it does not.
SENTENCES = [
    (
        "README.md",
        "One gain is confirmed: PPO on Pusher with early termination.",
        lambda n: [e for e, v in verdicts.gains(n).items() if v == CONFIRMED] == ["Pusher"],
        lambda n: n["pusher"]["p"].update(fresh=0.2),
    ),
    (
        "README.md",
        "PPO's best noises on the other four environments could not be shown to help;",
        lambda n: all(verdicts.gains(n)[e] == UNDECIDED for e in OTHERS),
        lambda n: n["five"]["holm"].update(Walker2d=0.01),
    ),
    (
        "README.md",
        "three of the tests had little power.",
        lambda n: sum(n["five"]["power_at_5"][e] < 0.5 for e in OTHERS) == 3,
        lambda n: n["five"]["power_at_5"].update(Hopper=0.6),
    ),
    (
        "README.md",
        "The two harmful noises that we ran do harm PPO, in four of five environments;",
        lambda n: all(
            verdicts.losses(n["worse_noises"][noise])[e] == CONFIRMED
            for noise in NOISES
            for e in OTHERS
        ),
        lambda n: normal(n)["alone"].update(Hopper=0.06),
    ),
    (
        "README.md",
        "Pusher is undecided.",
        lambda n: all(
            verdicts.losses(n["worse_noises"][noise])["Pusher"] == UNDECIDED for noise in NOISES
        ),
        lambda n: mixup(n)["alone"].update(Pusher=0.01),
    ),
    (
        "README.md",
        "None of the paper's 15 best improvements is beyond luck",
        lambda n: verdicts.beyond_luck(n["luck"]["p"]) == "none of 15",
        lambda n: n["luck"]["p"].update({3: 0.04}),
    ),
    (
        "README.md",
        "Truncation does not shrink rewards, yet gains nearly as much",
        lambda n: (
            n["scale"]["RandomEarlyTermination(50, truncate=True)", "terminated"]
            <= n["scale"]["", "terminated"]
            and n["pusher"]["p"]["truncated"] <= 0.05
            and n["pusher"]["percent"]["truncated"] > 0.75 * n["pusher"]["percent"]["all"]
        ),
        lambda n: n["pusher"]["percent"].update(truncated=10),
    ),
    (
        "README.md",
        "The averages are close to the paper's.",
        lambda n: all(
            abs(n["worse_noises"][noise]["average"] - n["worse_noises"][noise]["paper"]) < 5
            for noise in NOISES
        ),
        lambda n: normal(n).update(average=-40),
    ),
    (
        "README.md",
        "With both noises every run ends below every run without noise on "
        "HalfCheetah, Hopper, Humanoid, Walker2d.",
        lambda n: normal(n)["lowest"] == mixup(n)["lowest"] == OTHERS,
        lambda n: mixup(n).update(lowest=OTHERS[:3]),
    ),
    (
        "README.md",
        "neither loss is clear:",
        lambda n: all(n["worse_noises"][noise]["alone"]["Pusher"] > 0.05 for noise in NOISES),
        lambda n: normal(n)["alone"].update(Pusher=0.03),
    ),
    (
        "README.md",
        "At both rates every run with noise ends below every run without.",
        lambda n: all(
            n["td3"][rate]["p"] == pytest.approx(2 / 252) and n["td3"][rate]["percent"] < 0
            for rate in n["td3"]["rates"]
        ),
        lambda n: n["td3"]["0.01"].update(p=4 / 252),
    ),
    (
        "README.md",
        "None of the five is significant at 5 % after the correction.",
        lambda n: min(n["five"]["holm"].values()) > 0.05,
        lambda n: n["five"]["holm"].update(Pusher=0.05),
    ),
    (
        "README.md",
        "HalfCheetah, Hopper and Humanoid decide nothing:",
        lambda n: [e for e, p in n["five"]["power_at_5"].items() if p < 0.5] == OTHERS[:3],
        lambda n: n["five"]["power_at_5"].update(HalfCheetah=0.5),
    ),
    (
        "README.md",
        "On Walker2d it would probably have been found.",
        lambda n: n["five"]["power_at_5"]["Walker2d"] >= 0.8,
        lambda n: n["five"]["power_at_5"].update(Walker2d=0.7),
    ),
    (
        "README.md",
        "Two baselines, at",
        lambda n: len(n["half_cheetah"]["tops"]) == n["half_cheetah"]["fixed"]["count"] == 2,
        lambda n: n["half_cheetah"]["tops"].append(4000),
    ),
    (
        "README.md",
        "the interval allows losing three quarters of the gain.",
        lambda n: (
            0.7 < -n["pusher"]["step"]["low"] / n["pusher"]["difference"]["all"] < 0.8
            and n["pusher"]["step"]["high"] > 0
        ),
        lambda n: n["pusher"]["step"].update(low=-5),
    ),
    (
        "README.md",
        "Neither rate differs clearly from no noise.",
        lambda n: min(n["sac"]["p"].values()) > 0.05,
        lambda n: n["sac"]["p"].update({"0.01": 0.03}),
    ),
    (
        "README.md",
        "elsewhere not earlier.",
        lambda n: not any(n["speed"]["with"][e] < n["speed"]["without"][e] for e in OTHERS),
        lambda n: n["speed"]["with"].update(Walker2d=600_000),
    ),
    (
        "README.md",
        "No consistent row is beyond luck on its own",
        lambda n: all(row["consistent_beyond_luck"] == 0 for row in n["consistent"]["by"].values()),
        lambda n: n["consistent"]["by"]["SAC"].update(consistent_beyond_luck=1),
    ),
    (
        "README.md",
        "most of the harmful rows of SAC and TD3 are.",
        lambda n: all(
            row["consistently_worse_beyond_luck"] > row["consistently_worse"] / 2
            for row in (n["consistent"]["by"][name] for name in ("SAC", "TD3"))
        ),
        lambda n: n["consistent"]["by"]["SAC"].update(consistently_worse_beyond_luck=7),
    ),
    (
        "README.md",
        "| 5 of 5 |",
        lambda n: all("paper" in n["worse_noises"][noise] for noise in NOISES),
        lambda n: mixup(n).pop("paper"),
    ),
    (
        "README.md",
        "On Pusher, where the paper has both worse,",
        lambda n: all("paper" in n["worse_noises"][noise] for noise in NOISES),
        lambda n: normal(n).pop("paper"),
    ),
    (
        "README.md",
        "consistent in each;",
        lambda n: all(name in n["scaled"]["where"] for name in ("PPO", "SAC", "TD3")),
        lambda n: n["scaled"].update(where="SAC at 0.05, PPO at 0.01"),
    ),
    (
        "README.md",
        "by luck 17 each",
        lambda n: (
            {round(row["consistent_by_luck"]) for row in n["consistent"]["by"].values()} == {17}
        ),
        lambda n: n["consistent"]["by"]["TD3"].update(consistent_by_luck=12),
    ),
    (
        "README.md",
        "one noise is worse everywhere at all six rates, this one with TD3;",
        lambda n: (
            n["worse"]["at_every_rate"] == 1 and n["worse"]["rates"][harmful.NORMAL, "TD3"] == 6
        ),
        lambda n: n["worse"]["rates"].update({(harmful.NORMAL, "TD3"): 5}),
    ),
    (
        "README.md",
        "Five seeds find an improvement",
        lambda n: set(n["sac"]["n"].values()) == {5},
        lambda n: n["sac"]["n"].update({"0.01": 8}),
    ),
    (
        "README.md",
        "ten seeds find a halved one",
        lambda n: n["spread"]["n"] == 10,
        lambda n: n["spread"].update(n=20),
    ),
    (
        "README.md",
        "p = 1 is the most frequent best rate:",
        lambda n: n["rates"]["best"]["most_frequent"] == [1],
        lambda n: n["rates"]["best"].update(most_frequent=[0.05, 1]),
    ),
    (
        "baselines.md",
        "On Hopper and Walker2d our PPO ends higher than the paper's:",
        lambda n: all(
            n["holm"][e] <= 0.05 and of_paper(n, f"PPO on {e}-v5")["se"] > 0
            for e in ("Hopper", "Walker2d")
        ),
        lambda n: n["holm"].update(Hopper=0.06),
    ),
    (
        "baselines.md",
        "In the other three it does not differ clearly.",
        lambda n: all(n["holm"][e] > 0.05 for e in ("HalfCheetah", "Humanoid", "Pusher")),
        lambda n: n["holm"].update(Pusher=0.05),
    ),
    (
        "baselines.md",
        "On HalfCheetah SAC and TD3 end above the paper,",
        lambda n: all(is_above_paper(n, f"{name} on HalfCheetah-v5") for name in ("SAC", "TD3")),
        lambda n: of_paper(n, "SAC on HalfCheetah-v5").update(p=0.06),
    ),
    (
        "baselines.md",
        "but not clearly above CleanRL",
        lambda n: all(
            n["full"]["numbers"][f"{name} on HalfCheetah-v5"]["cleanrl"]["p"] > 0.05
            for name in ("SAC", "TD3")
        ),
        lambda n: n["full"]["numbers"]["TD3 on HalfCheetah-v5"]["cleanrl"].update(p=0.04),
    ),
    (
        "baselines.md",
        "neither difference is clear",
        lambda n: all(
            other["p"] > 0.05 for other in n["full"]["numbers"]["TD3 on Walker2d-v5"].values()
        ),
        lambda n: of_paper(n, "TD3 on Walker2d-v5").update(p=0.04),
    ),
    (
        "baselines.md",
        "The change from v4 to v5 alone does not explain Walker2d.",
        lambda n: is_above_paper(n, "PPO on Walker2d-v4"),
        lambda n: of_paper(n, "PPO on Walker2d-v4").update(p=0.06),
    ),
    (
        "baselines.md",
        "On Hopper-v4 three seeds cannot tell",
        lambda n: of_paper(n, "PPO on Hopper-v4")["p"] > 0.05,
        lambda n: of_paper(n, "PPO on Hopper-v4").update(p=0.01),
    ),
    (
        "baselines.md",
        "All six ways are excluded",
        lambda n: set(n["ways"]["verdicts"].values()) == {"excluded"},
        lambda n: n["ways"]["verdicts"].update({"own_per_test-mean": "not excluded"}),
    ),
    (
        "reconstruction.md",
        "So the paper's runs probably had a memory.",
        lambda n: n["mixtures"]["needed"] < -100 and n["mixtures"]["high"] < 0,
        lambda n: n["mixtures"].update(needed=-90),
    ),
    (
        "reconstruction.md",
        "near ours with a memory,",
        lambda n: abs(n["mixup"]["average"] - n["mixup"]["paper"]) < 5,
        lambda n: n["mixup"].update(average=-60),
    ),
    (
        "reconstruction.md",
        "**The paper's tables of SAC and TD3** agree.",
        lambda n: all(
            abs(n["mixture"][name]["std_then"] / n["mixture"][name]["std"] - 1) < 0.01
            for name in ("SAC", "TD3")
        ),
        lambda n: n["mixture"]["SAC"].update(std_then=450),
    ),
    (
        "reconstruction.md",
        "does not have this form, nor do our runs.",
        lambda n: abs(n["mixture"]["PPO"]["std_then"] / n["mixture"]["PPO"]["std"] - 1) > 0.1,
        lambda n: n["mixture"]["PPO"].update(std_then=40),
    ),
    (
        "reconstruction.md",
        "early termination shrinks them here, and made them larger there",
        lambda n: (
            n["scale"]["", "terminated"]
            < n["scale"]["RandomEarlyTermination(50)", "any end"]
            < n["scale"]["", "any end"]
        ),
        lambda n: n["scale"].update({("", "terminated"): 20}),
    ),
    (
        "robustness.md",
        "**Under noise that was not in training, no gain in return was shown.**",
        lambda n: all(
            verdicts.of_effect(row["difference"], row["p_holm"]) != CONFIRMED
            for row in (unseen(n, "observation"), unseen(n, "action"))
        ),
        lambda n: unseen(n, "action").update(p_holm=0.01),
    ),
    (
        "robustness.md",
        "Observation noise in training lowers the score",
        lambda n: (
            unseen(n, "observation")["p_holm"] <= 0.05
            and unseen(n, "observation")["difference"] < 0
        ),
        lambda n: unseen(n, "observation").update(p_holm=0.06),
    ),
    (
        "robustness.md",
        "which is undecided:",
        lambda n: unseen(n, "action")["p_holm"] > 0.05,
        lambda n: unseen(n, "action").update(p_holm=0.01),
    ),
    (
        "robustness.md",
        "**But a smaller share is lost.**",
        lambda n: min(row["low"] for row in n["kept"].values()) > 0,
        lambda n: n["kept"]["action noise"].update(low=-1),
    ),
    (
        "robustness.md",
        "averaged over the three rates, no clear difference was shown:",
        lambda n: (
            min(n["seen"][f"{noise} noise"]["p"] for noise in ("observation", "action")) > 0.05
        ),
        lambda n: n["seen"]["action noise"].update(p=0.04),
    ),
    (
        "robustness.md",
        "At p = 1, as in training, the score is higher:",
        lambda n: all(
            rates["1.00"]["p"] <= 0.05 and rates["1.00"]["difference"] > 0
            for rates in n["own"].values()
        ),
        lambda n: n["own"]["action noise"]["1.00"].update(p=0.06),
    ),
    (
        "robustness.md",
        "At p = 0.2 it is lower with observation noise,",
        lambda n: (
            n["own"]["observation noise"]["0.20"]["p"] <= 0.05
            and n["own"]["observation noise"]["0.20"]["difference"] < 0
        ),
        lambda n: n["own"]["observation noise"]["0.20"].update(p=0.06),
    ),
    (
        "robustness.md",
        "and undecided with action noise,",
        lambda n: n["own"]["action noise"]["0.20"]["p"] > 0.05,
        lambda n: n["own"]["action noise"]["0.20"].update(p=0.04),
    ),
    (
        "robustness.md",
        "The other differences are not clear.",
        lambda n: (
            sorted(name for name, p in n["clean"]["holm"].items() if p <= 0.05)
            == ["Hopper, action noise", "Hopper, observation noise", "Walker2d, observation noise"]
        ),
        lambda n: n["clean"]["holm"].update({"Walker2d, action noise": 0.04}),
    ),
    (
        "future_work.md",
        "**confirmed** on ten fresh seeds",
        lambda n: n["choice"]["p"] <= 0.05,
        lambda n: n["choice"].update(p=0.06),
    ),
    (
        "future_work.md",
        "**better than no noise**",
        lambda n: n["falling"]["holm"][1] <= 0.05,
        lambda n: n["falling"].update(holm=[0.05, 0.06]),
    ),
    (
        "future_work.md",
        "whether it is worse than the constant rate is undecided",
        lambda n: n["falling"]["holm"][0] > 0.05,
        lambda n: n["falling"].update(holm=[0.04, 0.01]),
    ),
    (
        "future_work.md",
        "Nothing suggests that a falling rate is better than a constant one.",
        lambda n: n["falling"]["all"]["difference"] < 0,
        lambda n: n["falling"]["all"].update(difference=0.1),
    ),
    (
        "future_work.md",
        "Nor do ten seeds show that the two together differ from no noise;",
        lambda n: n["together"]["holm"][1] > 0.05,
        lambda n: n["together"].update(holm=[0.7, 0.04, 0.7]),
    ),
    (
        "future_work.md",
        "**nothing shown**: interaction",
        lambda n: n["together"]["low"] < 0 < n["together"]["high"],
        lambda n: n["together"].update(low=1),
    ),
]


@pytest.mark.parametrize(("page", "sentence", "holds", "change"), SENTENCES)
def test_a_sentence_holds_and_would_be_seen_not_to(numbers, page, sentence, holds, change):
    assert sentence in " ".join((common.RESULTS / page).read_text().split())
    found = numbers(page)
    assert holds(found)
    change(found)
    assert not holds(found)


def noises_of_sac_and_td3(runs):
    """Return the (algorithm, environment, noise) of SAC and TD3 that were run."""
    runs = runs.query("algorithm != 'PPO' and noise != ''")
    return set(zip(runs["algorithm"], runs["environment"], runs["noise"], strict=True))


def test_sac_and_td3_with_noise_are_hardly_tested():
    """The fifth sentence: one noise and one environment each."""
    assert "SAC and TD3 with noise are hardly tested." in (common.RESULTS / "README.md").read_text()
    runs = common.read_returns(common.DATA / "runs")
    assert len(noises_of_sac_and_td3(runs)) == 2
    more = runs.assign(environment="Hopper")
    assert len(noises_of_sac_and_td3(pd.concat([runs, more]))) == 4
