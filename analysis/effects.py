"""The figure of the effects: every noise in every environment."""

import re

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from analysis.style import (
    COLORS,
    DIVERGING,
    NARROW_WIDTH,
    UNCLEAR,
    WIDTHS,
    broken,
    color_limit,
    ink_on,
)
from analysis.verdicts import seeds_of
from noisy_wrappers import rate_order

FOREST_ROWS = 25  # configurations of a forest plot; more of them are a heatmap
ACROSS = 5  # panels of effects side by side
ENDS = ["difference", "difference_low", "difference_high"]


def of_environments(statistics):
    """Keep the rows of single environments that have a difference from no noise."""
    return statistics[statistics["difference"].notna() & (statistics["scope"] == "environment")]


def heatmap_scale(rows):
    """Return the column that a heatmap shows, its unit, and where the colours end.

    All environments share a scale: percent, or standard deviations where one has no percent.
    """
    if rows["difference_percent"].notna().all():
        return "difference_percent", "%", color_limit(rows["difference_percent"], 100)
    return "effect_size", "standard deviations", color_limit(rows["effect_size"], 5)


def effects_caption(study, statistics):
    """Say what effects_figure shows."""
    rows = of_environments(statistics)
    clear = rows["verdict"].isin(COLORS).any()
    if len(configurations(rows)) > FOREST_ROWS:
        _, unit, limit = heatmap_scale(rows)
        text = f"{study.name}: difference from no noise in mean final return ({unit}). "
        text += "A dot marks a clear verdict. " if clear else "No verdict is clear. "
        return f"{text}The colours end at \u00b1 {limit:.3g} {unit}."
    text = f"{study.name}: difference from no noise in mean final return, with its 95 % interval "
    text += "from five seeds on, by noise and rate; every environment has its own scale. "
    text += "Filled marks are clear verdicts" if clear else "No verdict is clear"
    return f"{text}. n: seeds (with / without noise)."


def configurations(rows):
    """Return the (noise, rate) of rows of statistics, in order."""
    configs = dict.fromkeys(zip(rows["noise"], rows["noise_rate"], strict=True))
    return sorted(configs, key=lambda config: (config[0], rate_order(config[1])))


def effects_figure(statistics, narrow=False):
    """Draw the effect of every noise, a panel for each environment in which any was tried.

    statistics: the tested rows of one study. Up to FOREST_ROWS noises and rates are a forest plot;
    more are heatmaps of noises by rates. The panels stand side by side, or below each other if the
    figure shall be narrow.
    """
    rows = of_environments(statistics)
    configs = configurations(rows)
    environments = sorted(set(rows["environment"]))
    forest = len(configs) <= FOREST_ROWS
    lines = [f"{broken(noise)}, {broken(rate)}" for noise, rate in configs]
    if not forest:
        lines = [broken(noise) for noise in dict.fromkeys(noise for noise, _ in configs)]
    if narrow or (forest and len(environments) != 2):  # little room for names beside the panels
        lines = [re.sub(r"(?<=\w)\((?=.{10})", "\n(", line) for line in lines]
    across = 1 if narrow else min(ACROSS, len(environments))
    down = -(-len(environments) // across)
    width = NARROW_WIDTH if narrow else WIDTHS[across - 1]
    high = (0.18 if narrow else 0.22) * len("\n".join(lines).split("\n"))
    fig = Figure(figsize=(width, 0.6 + down * (0.7 + high)), layout="constrained")
    axes = fig.subplots(down, across, sharey=True, squeeze=False).ravel()
    for ax in axes[len(environments) :]:
        ax.remove()
    axes = axes[: len(environments)]
    for ax, environment in zip(axes, environments, strict=True):
        ax.set_title(environment, fontsize=9)
        ax.tick_params(axis="y", labelsize=6.5 if narrow else 9)
        panel = rows[rows["environment"] == environment]
        if forest:
            forest_panel(ax, panel, configs, (width - 2) / across)
        else:
            image = heat_panel(ax, panel, configs, *heatmap_scale(rows))
    axes[0].set_yticks(range(len(lines)), lines)
    axes[0].set_ylim(len(lines) - 0.5, -0.5)  # the first noise on top
    label = "difference from no noise in mean return"
    below = fig.supxlabel if across > 1 else axes[-1].set_xlabel
    below(label if forest else "noise rate", fontsize=9)
    if not forest:
        column, unit, limit = heatmap_scale(rows)
        beyond = "both" if rows[column].abs().max() > limit else "neither"
        place = {"location": "bottom", "fraction": 0.05} if narrow else {"fraction": 0.02}
        text = {"extend": beyond, "label": f"{label} ({unit})"}
        fig.colorbar(image, ax=list(axes), pad=0.01, **text, **place)
    return fig


def scale_forest(ax, rows, inches):
    """Set the scale of a panel of a forest plot, with room for n at its right.

    inches: how wide the panel is, roughly.
    """
    ends = rows[ENDS].astype(float)
    low, high = min(0, ends.min(axis=None)), max(0, ends.max(axis=None))
    wide = (high - low) or 1
    margin = 0.5 / inches  # of the panel's width
    ax.set_xlim(low - 0.06 * wide, high + wide * (0.06 + margin / (1 - margin)))
    ticks = MaxNLocator(nbins=max(2, min(6, int(inches / 0.6)))).tick_values(low, high)
    ax.set_xticks([tick for tick in ticks if low <= tick <= high])


def forest_panel(ax, rows, configs, inches):
    """Draw one environment's differences with intervals, and n at the side."""
    ax.axvline(0, color="black", linewidth=0.8)
    ax.grid(axis="y", color="0.92")
    ax.set_axisbelow(True)
    for row in rows.itertuples():
        y = configs.index((row.noise, row.noise_rate))
        color = COLORS.get(row.verdict, UNCLEAR)
        if pd.notna(row.difference_low):
            ax.hlines(y, row.difference_low, row.difference_high, color=color, linewidth=1.5)
        face = color if row.verdict in COLORS else "white"
        look = {"color": color, "markerfacecolor": face, "markersize": 6, "zorder": 3}
        ax.plot(row.difference, y, "o", **look)
        side = {"transform": ax.get_yaxis_transform(), "ha": "right", "va": "center"}
        ax.text(1, y, seeds_of(row.n, row.n_baseline), color="0.35", fontsize=7, **side)
    side = {"transform": ax.transAxes, "ha": "right", "va": "bottom"}
    ax.text(1, 1, "n", color="0.35", fontsize=7, **side)
    ax.tick_params(axis="y", length=0)
    scale_forest(ax, rows, inches)


def heat_panel(ax, rows, configs, column, unit, limit):
    """Draw one environment's differences, noises by rates, dots where the verdict is clear."""
    noises = list(dict.fromkeys(noise for noise, _ in configs))
    rates = sorted({rate for _, rate in configs}, key=rate_order)
    grid = np.full((len(noises), len(rates)), np.nan)
    places = [(noises.index(r.noise), rates.index(r.noise_rate)) for r in rows.itertuples()]
    for place, value in zip(places, rows[column], strict=True):
        grid[place] = value
    image = ax.imshow(grid, cmap=DIVERGING, vmin=-limit, vmax=limit, aspect="auto")
    if len(rates) <= 8:  # else there is no room for numbers
        for (i, j), value in zip(places, grid[tuple(zip(*places, strict=True))], strict=True):
            text = (
                f"{value:+z.{0 if unit == '%' else 1}f}" if abs(value) < 1000 else f"{value:+.0e}"
            )
            ink = ink_on(value, limit)
            ax.text(j, i, text, ha="center", va="center", color=ink, fontsize=6)
    clear = [p for p, word in zip(places, rows["verdict"], strict=True) if word in COLORS]
    for i, j in clear:
        ax.plot(j + 0.35, i - 0.3, "o", color="black", markersize=2.5)
    ax.set_xticks(range(len(rates)), rates, fontsize=7, rotation=90 if len(rates) > 4 else 0)
    ax.set_facecolor("0.93")  # not tried
    return image
