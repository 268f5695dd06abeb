"""The picture of the project's first page: the paper's best noises for PPO, its gains and ours."""

import re

import pandas as pd
from matplotlib.figure import Figure

from analysis import style
from results.study.returns import RESULTS

COLORS = {"confirmed": style.BETTER, "contradicted": style.WORSE}
CLAIM = r"(?:Best noise helps|Episodes of 50 steps help) PPO on (?P<environment>\w+)(?:, fresh)?"
OURS = r"(?P<change>[+-]?\d+) % \[(?P<low>-?\d+), (?P<high>-?\d+)\]"


def best_noises(claims):
    """Return {environment: row of claims.csv}, of fresh seeds where there are any."""
    found = {}
    for row in claims.itertuples():  # that of fresh seeds comes later
        if claim := re.fullmatch(CLAIM, row.claim):
            found[claim["environment"]] = row
    return found


def draw():
    """Draw a line for each environment: the paper's gain, and ours with its 95 % interval."""
    claims = pd.read_csv(RESULTS / "tables/claims.csv")
    claims.columns = ["claim", "paper", "ours", "covered", "verdict", "runs"]
    best = best_noises(claims)
    fig = Figure(figsize=(style.PAGE, 1.9), layout="constrained")
    ax = fig.subplots()
    for y, row in enumerate(best.values()):
        ours = {name: float(x) for name, x in re.match(OURS, row.ours).groupdict().items()}
        color = COLORS.get(row.verdict, style.UNCLEAR)
        ax.plot([ours["low"], ours["high"]], [y, y], color=color)
        ax.plot(ours["change"], y, "o", color=color, label="ours, with its 95 % interval")
        gain = float(row.paper.rstrip(" %"))
        ax.plot(gain, y, "D", color="black", markerfacecolor="white", label="the paper")
        ax.annotate(row.verdict, (1.01, y), xycoords=("axes fraction", "data"), va="center")
    ax.axvline(0, color="0.6", linewidth=0.6, zorder=0)
    ax.set_yticks(range(len(best)), best)
    ax.margins(y=0.12)
    ax.invert_yaxis()
    ax.set_xlabel("change of PPO's test return by the noise (%)")
    handles, labels = ax.get_legend_handles_labels()
    fig.legend(handles[:2], labels[:2], loc="outside upper center", ncols=2, frameon=False)
    return fig


if __name__ == "__main__":
    draw().savefig(RESULTS / "figures/best_noises.svg", metadata={"Date": None})
