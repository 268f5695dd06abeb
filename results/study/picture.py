"""The picture of the project's first page, and those of sets of plans.md."""

import re

import pandas as pd
from matplotlib.figure import Figure

from analysis import style
from results.study.__main__ import IN_LOOKS
from results.study.compare import TOGETHER
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


def draw_set(table):
    """Draw a set's changes with their 95 % intervals: a panel a noise, a line an environment.

    table: of compare. Where it has looks, each of them is a line.
    """
    noises = table["noise"].unique()
    lines = len(table) // len(noises)
    size = style.PAGE, 0.85 + 0.2 * lines
    fig = Figure(figsize=size, layout="constrained")
    axes = fig.subplots(1, len(noises), sharey=True, squeeze=False)[0]
    for noise, ax in zip(noises, axes, strict=True):
        rows = list(table[table["noise"] == noise].itertuples())
        for y, row in enumerate(rows):
            color = {"helps": style.BETTER, "harms": style.WORSE}.get(row.verdict, style.UNCLEAR)
            ax.plot([row.low_percent, row.high_percent], [y, y], color=color)
            ax.plot(row.difference_percent, y, "o", color=color)
            verdict = "" if pd.isna(row.verdict) else row.verdict
            ax.annotate(verdict, (1.01, y), xycoords=("axes fraction", "data"), va="center")
        ax.axvline(0, color="0.6", linewidth=0.6, zorder=0)
        room = (style.PAGE - 1.5) / len(noises)
        ax.set_title(style.fitted(f"{noise}, rate {rows[0].rate:g}", room))
    has_looks = table["environment"].nunique() == 1
    seeds = [f"{row.n:.0f} + {row.n_without:.0f} seeds" for row in rows]
    axes[0].set_yticks(range(lines), seeds if has_looks else [row.environment for row in rows])
    axes[0].margins(y=0.12)
    axes[0].invert_yaxis()
    fig.supxlabel("change of the test return by the noise (%)", fontsize=style.TEXT)
    return fig


def pictures():
    """Return {name: figure}; a set has one when it has a table."""
    found = {"best_noises": draw()}
    for name in (*IN_LOOKS, *TOGETHER):
        path = RESULTS / f"tables/{name}.csv"
        if path.exists():
            found[name] = draw_set(pd.read_csv(path))
    return found


if __name__ == "__main__":
    for name, fig in pictures().items():
        fig.savefig(RESULTS / f"figures/{name}.svg", metadata={"Date": None})
