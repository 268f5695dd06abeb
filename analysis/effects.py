"""The figure of the effects: every noise in every environment."""

import re
from textwrap import wrap

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from analysis import style
from analysis.folders import SUCCESS
from analysis.formatting import WHOLE_WORDS, seeds_of
from noisy_wrappers import rate_order

MOST_IN_FOREST = 25  # configurations of a forest plot; more of them are a heatmap


def heatmap_scale(rows):
    """Return the column that a heatmap shows, its unit, and where the colours end.

    All environments share a scale: percent, or standard deviations where one has no percent.
    """
    if rows["difference_percent"].notna().all():
        return "difference_percent", "%", style.color_limit(rows["difference_percent"], 100)
    return "effect_size", "standard deviations", style.color_limit(rows["effect_size"], 5)


def effects_caption(study, rows):
    """Say what effects_figure shows."""
    clear = rows["verdict"].isin(style.COLORS).any()
    text = f"{study.name}: difference from no noise in mean final {study.metric}"
    if len(configurations(rows)) > MOST_IN_FOREST:
        _, unit, limit = heatmap_scale(rows)
        dots = "A dot marks a clear verdict." if clear else "No single verdict is clear."
        return f"{text} ({unit}). {dots} The colours end at \u00b1 {limit:.3g} {unit}."
    text += ", with its 95 % interval from five seeds on, by noise and rate; every environment has "
    text += "its own scale. "
    text += "Filled marks are clear verdicts" if clear else "No single verdict is clear"
    return f"{text}. n: seeds (with / without noise)."


def configurations(rows):
    """Return the (noise, rate) of rows of statistics, in order."""
    configs = dict.fromkeys(zip(rows["noise"], rows["noise_rate"], strict=True))
    return sorted(configs, key=lambda config: (config[0], rate_order(config[1])))


def effects_figure(rows, metric):
    """Draw the effect of every noise, a panel for each environment with what was tried there.

    rows: those of statistics in which environments of one study were compared. Up to MOST_IN_FOREST
    noises and rates are a forest plot; more are heatmaps of noises by rates.
    """
    is_forest = len(configurations(rows)) <= MOST_IN_FOREST
    scale = column, unit, limit = heatmap_scale(rows)
    panels = list(rows.groupby("environment"))
    labels = [labels_of(panel, is_forest) for _, panel in panels]
    across = min(2, len(panels))
    width = style.WIDTH if across == 2 else style.WIDTHS[0]
    lines = [len("\n".join(names).split("\n")) for names in labels]
    lines = [max(lines[i : i + across]) for i in range(0, len(lines), across)]
    heights = [0.75 + 0.22 * number for number in lines]
    fig = Figure(figsize=(width, 0.4 + sum(heights)), layout="constrained")
    grid = fig.add_gridspec(len(heights), across, height_ratios=heights)
    axes = [fig.add_subplot(grid[i]) for i in range(len(panels))]
    for ax, (environment, panel), names in zip(axes, panels, labels, strict=True):
        if is_forest:
            forest_panel(ax, panel, (width - 2 * across) / across)
        else:
            image = heat_panel(ax, panel, scale)
        ax.set_yticks(range(len(names)), names, fontsize=8)
        style.set_title(ax, environment, width / across)
    write_below = fig.supxlabel if across > 1 else axes[-1].set_xlabel
    unit_of = " (percentage points)" if metric == SUCCESS else ""
    quantity = f"difference from no noise in mean {metric}{unit_of}"
    write_below(quantity if is_forest else "noise rate", fontsize=9)
    if not is_forest:
        beyond = "both" if rows[column].abs().max() > limit else "neither"
        fig.colorbar(image, ax=axes, label=unit, fraction=0.02, pad=0.01, extend=beyond)
    return fig


def labels_of(rows, is_forest):
    """Return what stands beside the lines of a panel, broken where it is long."""
    if is_forest:
        labels = [f"{noise}, {rate}" for noise, rate in configurations(rows)]
    else:
        labels = sorted(set(rows["noise"]))
    return list(map(folded, labels))


def folded(label):
    """Break a label between noises, before a long bracket, and where a line is still too long."""
    label = re.sub(r"(?<=\w)\((?=.{10})", "\n(", style.broken(label))
    lines = [wrap(line, 44, **WHOLE_WORDS) for line in label.split("\n")]
    return "\n".join(sum(lines, []))


def forest_panel(ax, rows, inches):
    """Draw one environment's differences with intervals, and n at the side.

    inches: how wide the panel is, roughly.
    """
    configs = configurations(rows)
    ax.axvline(0, color="black", linewidth=0.8)
    ax.grid(axis="y", color="0.92")
    ax.set_axisbelow(True)
    side = {"color": "0.35", "fontsize": 7, "ha": "right"}
    for row in rows.itertuples():
        y = configs.index((row.noise, row.noise_rate))
        color = style.COLORS.get(row.verdict, style.UNCLEAR)
        face = style.COLORS.get(row.verdict, "white")
        if pd.notna(row.difference_low):
            ax.hlines(y, row.difference_low, row.difference_high, color=color, linewidth=1.5)
        ax.plot(row.difference, y, "o", color=color, markerfacecolor=face, markersize=6, zorder=3)
        n = seeds_of(row.n, row.n_baseline)
        ax.text(1, y, n, transform=ax.get_yaxis_transform(), va="center", **side)
    ax.text(1, 1, "n", transform=ax.transAxes, va="bottom", **side)
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(len(configs) - 0.5, -0.5)  # the first noise on top
    ends = rows[["difference", "difference_low", "difference_high"]].astype(float)
    low, high = min(0, ends.min(axis=None)), max(0, ends.max(axis=None))
    wide = (high - low) or 1
    margin = 0.5 / inches  # of the panel's width, for n
    ax.set_xlim(low - 0.06 * wide, high + wide * (0.06 + margin / (1 - margin)))
    ticks = MaxNLocator(nbins=max(2, min(6, int(inches / 0.6)))).tick_values(low, high)
    ax.set_xticks([tick for tick in ticks if low <= tick <= high])


def heat_panel(ax, rows, scale):
    """Draw one environment's differences, noises by rates, dots where the verdict is clear."""
    column, unit, limit = scale
    rates = sorted(set(rows["noise_rate"]), key=rate_order)
    grid = rows.pivot(index="noise", columns="noise_rate", values=[column, "verdict"])

    def number(value):
        text = f"{value:+z.{0 if unit == '%' else 1}f}" if abs(value) < 1000 else f"{value:+.0e}"
        return text if len(rates) <= 8 else ""  # there is no room

    dots = grid["verdict"][rates].isin([*style.COLORS])
    image = heatmap(ax, grid[column][rates].astype(float), limit, number, dots, 6)
    ax.tick_params(axis="x", labelsize=7, rotation=90 if len(rates) > 4 else 0)
    return image


def heatmap(ax, grid, limit, number, dots, size):
    """Draw a frame of numbers: in each cell its colour, number(value), and a dot if it has one.

    The colours end at \u00b1 limit. dots: as grid, of bool; size: of the numbers, in points.
    """
    image = ax.imshow(
        grid.clip(-limit, limit), cmap=style.DIVERGING, vmin=-limit, vmax=limit, aspect="auto"
    )
    for (i, j), value in np.ndenumerate(grid.to_numpy()):
        if not np.isnan(value):
            ink = "white" if value > 0.7 * limit else "black"  # only the blue is dark
            ax.text(j, i, number(value), fontsize=size, ha="center", va="center", color=ink)
        if dots.iat[i, j]:
            ax.plot(j + 0.36, i - 0.28, "o", color="black", markersize=2.5)
    ax.set_xticks(range(len(grid.columns)), grid.columns)
    ax.set_facecolor("0.93")  # where there is no number
    return image
