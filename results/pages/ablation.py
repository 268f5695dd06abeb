"""How sensitive PPO is to the scale of the noise: the runs in data/ablation/, and their figure.

`./benchmark.sh ablation` trains them: two noises, five values of beta each, five environments. The
paper calls PPO sensitive and shows bars without numbers. results/README.md has the verdict. The
rule was fixed before any run: for each noise, is the return the same at all values of beta?
"""

from bisect import bisect_left

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from common import (
    DATA,
    ENVIRONMENTS,
    RESULTS,
    markdown,
    read_returns,
    render,
    spell_average,
)
from scipy import stats

from analysis.effects import PALETTE
from analysis.paper import read_paper
from analysis.statistics import LEVEL, POWER, holm, improvement_percent
from noisy_wrappers import canonical_noises
from sweep.grid import ABLATION

FOLDER = DATA / "ablation"
SHUFFLES = 10_000
plt.rcParams["svg.hashsalt"] = "noisy"  # equal figures are equal files


def scales():
    """Return {wrapper: {beta: noise}}, all in canonical notation."""
    found = {}
    for noise, rate in ABLATION:
        [noise], _ = canonical_noises([noise], [rate])
        wrapper, arguments = noise.rstrip(")").split("(")
        found.setdefault(wrapper, {})[float(arguments.split(",")[1])] = noise
    return found


def spread(returns):
    """Return Kruskal and Wallis's H, up to constants, summed over environments.

    returns (..., environments x scales x seeds); the result has the leading dimensions.
    """
    ranks = stats.rankdata(returns.reshape(*returns.shape[:-2], -1), axis=-1)
    return ranks.reshape(returns.shape).mean(-1).var(-1).sum(-1)


def same_at_all_scales(returns):
    """Test "the scale does not matter" -> p.

    returns (environments x scales x seeds). The statistic is spread; its null distribution comes
    from shuffling the runs within each environment.
    """
    runs = returns.reshape(len(returns), -1)
    copies = np.broadcast_to(runs, (SHUFFLES, *runs.shape))
    shuffled = np.random.default_rng(0).permuted(copies, axis=-1)
    at_least = spread(shuffled.reshape(SHUFFLES, *returns.shape)) >= spread(returns) - 1e-9
    return (1 + at_least.sum()) / (1 + SHUFFLES)


def smallest_shown(environments, scales, seeds):
    """Return the shift that the test finds with 80 % power at 5 %, in standard deviations.

    One scale moves the return in every environment; returns are normal.
    """
    draws = np.random.default_rng(0).normal(size=(SHUFFLES, environments, scales, seeds))
    limit = np.quantile(spread(draws), 1 - LEVEL)
    moved = np.arange(scales)[:, None] == 0

    def power(shift):
        return np.mean(spread(draws + shift * moved) > limit)

    shifts = np.arange(0, 10, 0.1)
    return shifts[bisect_left(shifts, POWER, key=power)]


def numbers(runs, paper):
    """Compute what the page says; runs is a frame of read_returns."""
    by = runs.pivot(index=["environment", "noise"], columns="seed", values="test")
    averages = paper["consistent"].query("algorithm == 'PPO'").set_index(["noise", "noise_rate"])
    rows, p, p_smaller = [], {}, {}
    for wrapper, noises in scales().items():
        returns = np.array(
            [[by.loc[env, noise] for noise in noises.values()] for env in ENVIRONMENTS]
        )
        p[wrapper] = same_at_all_scales(returns)
        p_smaller[wrapper] = same_at_all_scales(returns[:, :-1])
        rate = next(rate for noise, rate in ABLATION if noise.startswith(wrapper))
        for noise in noises.values():
            change = pd.Series(
                {
                    env: improvement_percent(by.loc[env, noise].mean(), by.loc[env, ""].mean())
                    for env in ENVIRONMENTS
                }
            )
            row = {"noise": f"`{noise}`"}
            row |= {env: f"{round(value):+d} %" for env, value in change.items()}
            row["average"] = f"{round(change.mean()):+d} ± {change.std(ddof=1):.0f} %"
            row["the paper"] = "\u2013"
            if (noise, f"{rate:.2f}") in averages.index:
                row["the paper"] = spell_average(averages.loc[noise, f"{rate:.2f}"])
            rows.append(row)
    corrected = dict(zip(p, holm(np.array(list(p.values()))), strict=True))
    seeds = runs["seed"].nunique()
    return {
        "seeds": seeds,
        "level": LEVEL,
        "p": corrected,
        "p_smaller": p_smaller,  # without the largest beta, asked afterwards
        "finds": smallest_shown(len(ENVIRONMENTS), len(noises), seeds),
        "table": markdown(rows),
    }


def draw(runs):
    """Draw the paper's bars from our runs: a row per noise, a panel per environment."""
    fig, axes = plt.subplots(
        2, len(ENVIRONMENTS), figsize=(12, 6), sharey="col", layout="constrained"
    )
    for row, (wrapper, noises) in zip(axes, scales().items(), strict=True):
        for ax, environment in zip(row, ENVIRONMENTS, strict=True):
            here = runs[runs["environment"] == environment].groupby("noise")["test"]
            bars = {"None": here.get_group("")}
            bars |= {f"{beta:g}": here.get_group(noise) for beta, noise in noises.items()}
            heights = [returns.mean() for returns in bars.values()]
            errors = [returns.std(ddof=1) for returns in bars.values()]
            colors = ["grey"] + [PALETTE[0]] * len(noises)
            ax.bar(list(bars), heights, yerr=errors, color=colors)
            ax.set_title(environment)
            ax.set_xlabel("\u03b2")
            ax.tick_params(axis="x", labelrotation=60)
        row[0].set_ylabel(f"{wrapper}\ntest return")
    fig.savefig(RESULTS / "figures/ablation.svg", metadata={"Date": None})
    plt.close(fig)


def page():
    """Return the text of ablation.md."""
    paper = read_paper(RESULTS / "paper")
    return render("ablation.md.jinja", {"ablation": numbers(read_returns(FOLDER), paper)})


if __name__ == "__main__":
    draw(read_returns(FOLDER))
    (RESULTS / "ablation.md").write_text(page())
    print(f"Wrote {RESULTS / 'ablation.md'}")
