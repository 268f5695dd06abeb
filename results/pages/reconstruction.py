"""Write results/reconstruction.md from the runs in data/: python results/pages/reconstruction.py.

What the paper probably ran: which mixture, which dropout, and the scale of its rewards.
reconstruction.md.jinja has the text, this file every number in it.
"""

import numpy as np
import pandas as pd
from common import (
    DATA,
    ENVIRONMENTS,
    FEW_SEEDS,
    FIXED_SEEDS,
    RESULTS,
    by_environment,
    read_returns,
    render,
)
from harmful import MIXUP, PLAIN_MIXUP, WORSE, worse_noises

from analysis.paper import PAPER_SEEDS, read_paper
from analysis.statistics import contrast, improvement_percent


def mixture(paper):
    """What the averages of mixup at p = 1 say about which mixture the paper ran.

    If four environments lose all (-100 %), the fifth follows from the average, and so does the
    standard deviation.
    """
    rows = paper["consistently_worse"].query("noise == @MIXUP")
    rows = rows[rows["noise_rate"].astype(float) == 1].set_index("algorithm")
    result = {}
    for algorithm in PAPER_SEEDS:
        average = rows.loc[algorithm, "average_improvement_percent"]
        fifth = 5 * average + 400
        result[algorithm] = {
            "average": average,
            "std": rows.loc[algorithm, "std_improvement_percent"],
            "fifth": fifth,
            "std_then": np.std([-100] * 4 + [fifth], ddof=1),
        }
    return result


def mixtures(runs, paper):
    """PPO with the two kinds of mixup, in the environments that both were run in.

    Averages over environments of the change in percent of the mean without noise, which is taken as
    known, and the difference of the two with its interval (Welch, Satterthwaite). `needed` is what
    the plain kind's change in each other environment would have to be for the paper's average.
    """
    average = paper["consistently_worse"].query(
        "algorithm == 'PPO' and noise == @MIXUP and noise_rate == '1.00'"
    )["average_improvement_percent"]
    environments = WORSE[PLAIN_MIXUP]
    base = by_environment(runs[runs["noise"] == ""], FIXED_SEEDS)[environments].mean()
    noisy = (
        by_environment(runs.query("noise == @noise and noise_rate == '1.00'"), FEW_SEEDS)
        for noise in (MIXUP, PLAIN_MIXUP)
    )
    recursive, plain = (improvement_percent(returns[environments], base) for returns in noisy)
    others = len(ENVIRONMENTS) - len(environments)
    needed = (len(ENVIRONMENTS) * average.item() - plain.mean().sum()) / others
    samples = [table[name].to_numpy() for table in (recursive, plain) for name in environments]
    weight = 1 / len(environments)
    difference, _, low, high = contrast(samples, 3 * [weight] + 3 * [-weight])
    return {
        "recursive": recursive.mean().mean(),
        "plain": plain.mean().mean(),
        "needed": needed,
        "difference": difference,
        "low": low,
        "high": high,
    }


def reward_scale():
    """The standard deviation by which PPO would divide its reward on Pusher (reward_scale.py)."""
    table = pd.read_csv(DATA / "reward_scale/reward_scale.csv").fillna({"noise": ""})
    return table.set_index(["noise", "begins_anew_when"])["std"].to_dict()


def numbers():
    """Compute all that the page says."""
    paper = read_paper(RESULTS / "paper")
    ppo = read_returns(DATA / "runs").query("algorithm == 'PPO'")
    return {
        "plain_mixup": PLAIN_MIXUP,
        "mixup": worse_noises(ppo, paper)[MIXUP],
        "mixture": mixture(paper),
        "mixtures": mixtures(ppo, paper),
        "scale": reward_scale(),
    }


def page():
    """Return the text of reconstruction.md."""
    return render("reconstruction.md.jinja", numbers())


if __name__ == "__main__":
    (RESULTS / "reconstruction.md").write_text(page())
    print(f"Wrote {RESULTS / 'reconstruction.md'}")
