"""The table of claims in results/README.md: the verdicts, and the rules that make them.

A verdict is about our runs. It is made from their numbers, never written by hand.
"""

import numpy as np
from common import markdown
from harmful import MIXUP, NORMAL
from helpful import ENDING, ENDING_ANYWHERE
from paper_tables import RATES

from analysis.paper import PAPER_CONFIGURATIONS, PAPER_SEEDS
from analysis.statistics import LEVEL

CONFIRMED, CONTRADICTED = "confirmed", "contradicted"
UNDECIDED, NOT_TESTED = "undecided", "not tested"
PERCENT = ("percent", "low_percent", "high_percent")  # an estimate and its interval


def of_effect(effect, p, claimed=1):
    """Judge one effect: p is corrected where several were tested; claimed is its sign, 1 or -1."""
    if not p <= LEVEL:  # nor where p is not a number
        return UNDECIDED
    return CONFIRMED if effect * claimed > 0 else CONTRADICTED


def of_all(verdicts):
    """Judge the claim that something holds in every case, from the verdicts on the cases.

    A case that is not tested can neither confirm nor contradict it.
    """
    if CONTRADICTED in verdicts:
        return CONTRADICTED
    return CONFIRMED if set(verdicts) == {CONFIRMED} else UNDECIDED


def of_some(verdicts):
    """Judge the claim that something holds in some cases, from the verdicts on the cases.

    Tests never show that it holds in none, so such a claim is not contradicted.
    """
    return CONFIRMED if CONFIRMED in verdicts else UNDECIDED


def beyond_luck(p):
    """Say how many of these P(luck) are at most 5 %."""
    count = sum(value <= LEVEL for value in p)
    return f"{count if count else 'none'} of {len(p)}"


def gains(numbers):
    """Judge PPO's best noise in each environment: {environment: verdict}.

    By Holm's p over seeds 1 to 10; on Pusher, which had the smallest p, by the fresh seeds.
    """
    five, pusher = numbers["five"], numbers["pusher"]
    found = {name: of_effect(five["percent"][name], p) for name, p in five["holm"].items()}
    found["Pusher"] = of_effect(pusher["percent"]["fresh"], pusher["p"]["fresh"])
    return found


def losses(found):
    """Judge the loss in each environment of a noise of harmful.worse_noises."""
    return {name: of_effect(found["change"][name], p, -1) for name, p in found["alone"].items()}


def td3_losses(found):
    """Judge the loss of TD3 at each of two rates, with Bonferroni's correction."""
    return [of_effect(found[rate]["percent"], 2 * found[rate]["p"], -1) for rate in found["rates"]]


def sac_gains(found):
    """Judge the gain of SAC at each of two rates, with Bonferroni's correction."""
    return [of_effect(found["percent"][rate], 2 * p) for rate, p in found["p"].items()]


def of_speed(found):
    """Judge the claim of half the steps, from headline.numbers.

    The mean with noise must be there before half of the steps, and the runs' steps must differ. A
    run that never gets there counts with all of its steps, so they cannot contradict the claim.
    """
    with_noise, without = (np.mean(found[name]["runs"]) for name in ("noisy", "without"))
    is_half = found["noisy"]["mean"] < found["total"] / 2
    is_faster = of_effect(without - with_noise, found["p_steps"]) == CONFIRMED
    return CONFIRMED if is_half and is_faster else UNDECIDED


def interval(value, low, high, form="+.0f"):
    """Write an estimate with its interval, in percent."""
    return f"{value:{form}} % [{low:{form.strip('+')}}, {high:{form.strip('+')}}]"


def claims(numbers):
    """Return the rows of the table: (claim, section, the paper's evidence, ours, verdict)."""
    five, pusher, step = numbers["five"], numbers["pusher"], numbers["pusher"]["step"]
    by, luck = numbers["consistent"]["by"], numbers["luck"]
    normal, mixup = numbers["worse_noises"][NORMAL], numbers["worse_noises"][MIXUP]
    td3, sac, spread = numbers["td3"], numbers["sac"], numbers["spread"]
    worse_at = numbers["worse"]["of"]
    fisher, counts = numbers["kinds"]["fisher"]["observation"], numbers["kinds"]["counts"]
    judged, rows = gains(numbers), []

    def add(claim, section, paper, ours, verdict):
        address = section if section.endswith(".md") else f"#{section}"
        rows.append((claim, address, paper, ours, verdict))

    ours = interval(*(pusher[key]["fresh"] for key in PERCENT))
    add(
        f"`{ENDING}` helps PPO on Pusher",
        "pusher-early-termination-at-step-50",
        f"{five['paper_percent']['Pusher']:+.0f} %",
        f"{ours}, n = {pusher['n']['fresh']:.0f}, fresh seeds",
        judged["Pusher"],
    )
    for name in (name for name in five["percent"] if name != "Pusher"):
        ours = interval(five["percent"][name], five["low"][name], five["high"][name])
        add(
            f"Its best noise helps PPO on {name}",
            "ppo-with-the-papers-best-noises",
            f"{five['paper_percent'][name]:+.0f} %",
            f"{ours}, n = {five['n'][name]}",
            judged[name],
        )
    of_others = luck["algorithm"] != "PPO"
    others, beyond = luck["improvement"][of_others], beyond_luck(luck["p"][of_others])
    add(
        "The best noise of SAC and TD3 helps in each environment",
        "luck-the-best-of-90",
        f"{others.min():+.0f} to {others.max():+.0f} %; {beyond} beyond luck",
        "\u2013",
        NOT_TESTED,
    )
    for noise, found in ((NORMAL, normal), (MIXUP, mixup)):
        ours = interval(found["average"], *found["interval"])
        add(
            f"`{noise}` harms PPO",
            "noises-that-harm-ppo",
            f"{found['paper']:+.0f} % on average",
            f"{ours} on average, n = {found['n']}",
            of_effect(found["average"], found["p"], -1),
        )
    worse = [sum(v == CONFIRMED for v in losses(found).values()) for found in (normal, mixup)]
    low, high = normal["alone_interval"]["Pusher"]
    on_pusher = interval(normal["change"]["Pusher"], low, high)
    add(
        "They harm it in every environment",
        "noises-that-harm-ppo",
        f"{len(normal['change'])} of {len(normal['change'])}",
        f"{min(worse)} of {len(normal['change'])}; Pusher {on_pusher}, n = {normal['n']}",
        of_all([*losses(normal).values(), *losses(mixup).values()]),
    )
    ours = " and ".join(interval(*(td3[rate][key] for key in PERCENT)) for rate in td3["rates"])
    add(
        f"`{NORMAL}` harms TD3 on HalfCheetah at the extreme rates",
        "a-noise-that-harms-td3",
        f"{numbers['worse']['rates'][NORMAL, 'TD3']} of {len(RATES)} rates",
        f"not side by side: {ours}, n = {td3['1.00']['n']}",
        of_all(td3_losses(td3)),
    )
    for name in ("observation noise", "action noise"):
        row = numbers["unseen"][name]
        points = "{difference:+.0f} points [{difference_low:.0f}, {difference_high:.0f}], n = {n}"
        add(
            f"{name.capitalize()} in training raises returns under other noise",
            "robustness.md",
            "conjecture",
            points.format(**row),
            of_effect(row["difference"], row["p_holm"]),
        )
    consistent = ", ".join(f"{name} {by[name]['consistent']}" for name in by)
    by_luck = by["SAC"]["consistent_by_luck"]  # the same for all three, as a test holds
    add(
        "Some noises are consistent",
        "consistent-noises",
        f"{consistent} of {PAPER_CONFIGURATIONS}; by luck {by_luck:.0f} each",
        "\u2013",
        NOT_TESTED,
    )
    change = spread["change"]
    add(
        "Some noises reduce the variance",
        "step-variance-and-speed",
        "smaller with {lower} of {rows} best noises".format(**numbers["paper_spread"]),
        f"PPO: {min(change.values()):+.0f} to {max(change.values()):+.0f} %, n = {spread['n']}",
        of_some([of_effect(change[name], p, -1) for name, p in spread["holm"].items()]),
    )
    reward = five["reward"]
    add(
        "PPO gains from reward noise, TD3 from observation noise",
        "luck-the-best-of-90",
        f"{counts['PPO']['reward']} and {counts['TD3']['observation']} of 5 best "
        f"(afterwards: p = {fisher:.2g})",
        f"PPO only: {reward['won']:.0f} of {reward['pairs']} pairs won, n = {spread['n']}",
        of_all([of_effect(reward["won"] / reward["pairs"] - 0.5, reward["p"]), NOT_TESTED]),
    )
    ours = " and ".join(
        interval(sac["percent"][rate], sac["low"][rate], sac["high"][rate])
        for rate in sac["percent"]
    )
    add(
        f"`{numbers['scaled_reward']}` helps all algorithms",
        "sacs-early-performance",
        f"consistent in each; by luck in {numbers['scaled']['this']:.0f} %",
        f"SAC only: {ours}, n = {min(sac['n'].values()):.0f}",
        of_all([*sac_gains(sac), NOT_TESTED]),
    )
    ours = interval(*(step[key] for key in PERCENT))
    add(
        "The step of early termination matters",
        "step-variance-and-speed",
        f"(1, 100) worse everywhere at {worse_at[ENDING_ANYWHERE]} of "
        f"{len(RATES) * len(PAPER_SEEDS)} rates, "
        f"(50) at {worse_at[ENDING]}",
        f"PPO on Pusher: {ours}, n = {step['n']}",
        of_some([of_effect(abs(step["percent"]), step["p"])]),
    )
    headline, ablation = numbers["headline"], numbers["ablation"]
    steps = headline["noisy"]["mean"]
    ours = f"by {steps / 1e6:g} million, p = {headline['p_steps']:.2g}"
    add(
        "Noise halves the steps to the baseline's return",
        "step-variance-and-speed",
        f"SAC on HalfCheetah: by {numbers['paper_speed']['reached']} million",
        f"{'never' if np.isnan(steps) else ours}, n = {headline['n']}",
        of_speed(headline),
    )
    tests = [
        f"{wrapper.removeprefix('RandomUniform')} p = {p:.2g}"
        for wrapper, p in ablation["p"].items()
    ]
    add(
        "PPO is sensitive to the scale of the noise",
        "ablation.md",
        "a figure without numbers",
        f"{', '.join(tests)}, n = {ablation['seeds']}",
        of_all([of_effect(1, p) for p in ablation["p"].values()]),
    )
    best = numbers["rates"]["best"]
    add(
        "p = 1 is seldom the best rate",
        "rates-and-scaled-rewards",
        f"{best['count']} of {best['of']}; by chance {best['expected']:.1f}",
        "\u2013",
        NOT_TESTED,
    )
    return rows


def table(numbers):
    """Write the table of claims."""
    return markdown(
        [
            {
                "claim": f"[{claim}]({section})",
                "the paper's evidence": paper,
                "ours [95 %]": ours,
                "verdict": f"**{verdict}**",
            }
            for claim, section, paper, ours, verdict in claims(numbers)
        ]
    )
