"""The figure of the effects: every noise in every environment."""

from itertools import groupby

import numpy as np
import pandas as pd
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from analysis import style
from analysis.folders import SUCCESS
from analysis.formatting import seeds_between
from analysis.power import detectable_shift
from analysis.statistics import SEEDS_FOR_INTERVAL
from analysis.verdicts import BETTER, UNCLEAR, WORSE
from noisy_wrappers import BASELINE, rate_order

MOST_IN_FOREST = 25  # configurations of a forest plot; more of them are a heatmap
LABELS = 2.0  # inches for the names of noises, at most; in a narrow figure a part of its width
PART = 0.45
ROW = 1.1 * style.LINE
CELL = 0.34  # inches of a heatmap's cell, with room for a number


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
    text += ". n: seeds (with / without noise)."
    if has_few(rows).any():
        text += " With fewer than five, small dots are the seeds, and a difference beyond the grey "
        text += "bar would be found in 80 % of cases (three against three find none: then the bar "
        text += "is that of four against four)."
    return text


def configurations(rows):
    """Return the (noise, rate) of rows of statistics, in order."""
    configs = dict.fromkeys(zip(rows["noise"], rows["noise_rate"], strict=True))
    return sorted(configs, key=lambda config: (config[0], rate_order(config[1])))


def has_few(rows):
    """Tell which comparisons have too few seeds for an interval."""
    return rows[["n", "n_baseline"]].min(axis=1) < SEEDS_FOR_INTERVAL


def titles_of(rows):
    """Return the lines of the title above each panel: its environment, its seeds."""
    return [
        [style.short(name), seeds_between(panel["n"], panel["n_baseline"].iloc[0])]
        for name, panel in rows.groupby("environment")
    ]


def effects_figure(study, rows, width=None):
    """Draw the effect of every noise, a panel for each environment.

    rows: those of statistics in which environments of the study were compared. Up to MOST_IN_FOREST
    noises and rates are a forest plot; more are heatmaps of noises by rates.
    """
    width = width or style.PAGE
    if len(configurations(rows)) > MOST_IN_FOREST:
        return heatmaps_figure(rows, width)
    return forest_figure(study, rows, width)


# ------------------------------------------------------------------------------------- forest plot


def forest_figure(study, rows, width):
    """Draw differences with their intervals: panels that share their lines, one for each rate."""
    with_seeds = has_few(rows).any()
    lines, heads, y = {}, {}, 0  # what stands at which height, in lines
    if with_seeds:
        lines[BASELINE.noise, BASELINE.noise_rate], y = y, y + 1
    for noise, configs in groupby(configurations(rows), lambda config: config[0]):
        name = style.fitted(noise, min(LABELS, PART * width))
        heads[name], y = y, y + name.count("\n") + 1
        for config in configs:
            lines[config], y = y, y + 1
    labels = ["no noise" if not noise else rate for noise, rate in lines]
    left = max(map(style.inches_of, [*heads, *labels])) + 0.12
    titles = titles_of(rows)
    marks = marks_of(rows, with_seeds)
    _, legend = style.legend_columns(list(marks), width)
    unit = " (percentage points)" if study.metric == SUCCESS else ""
    below = f"difference from no noise in mean {study.metric}{unit}"
    fig, axes = style.panels(
        titles,
        width,
        len(titles) * [ROW * y + 0.1],
        least=0.88,
        left=left,
        beside=0.12,
        below=below,
        legend=legend,
    )
    for ax, (_, panel) in zip(axes, rows.groupby("environment"), strict=True):
        forest_panel(ax, study, panel, lines)
        ax.set_yticks(list(lines.values()), labels if ax.is_first else [])
        ax.tick_params(axis="y", length=0, pad=2)
        ax.set_ylim(y - 0.4, -0.6)  # the first noise on top
        for head, place in heads.items() if ax.is_first else ():
            at = {"transform": ax.get_yaxis_transform(), "va": "top", "linespacing": 1.1}
            inches = ax.get_position().width * width
            ax.text(-(left + 0.06) / inches, place - 0.45, head, **at)
    style.add_legend(fig, list(marks.values()), list(marks))
    return fig


def marks_of(rows, with_seeds):
    """Return what the legend of a forest plot explains: {label: handle}."""
    found = set(rows["verdict"].dropna())
    marks = {}
    for word in (BETTER, WORSE, UNCLEAR):
        if word in found or (word == UNCLEAR and found - {BETTER, WORSE}):
            marks[word] = mark_of(word)
    if with_seeds:
        marks["one seed"] = Line2D([], [], color="0.4", marker=".", markersize=3, linestyle="")
        marks["not found in 80 % of cases"] = Patch(color="0.88")
    return marks


def mark_of(verdict):
    """Return the mark of a verdict: filled where it is clear."""
    color = style.COLORS.get(verdict, style.UNCLEAR)
    face = color if verdict in style.COLORS else "white"
    return Line2D([], [], color=color, marker="o", markerfacecolor=face, linestyle="-")


def forest_panel(ax, study, rows, lines):
    """Draw one environment's differences, with intervals or with the seeds."""
    e = study.environments.index(rows["environment"].iloc[0])
    baseline = study.sample(BASELINE, e)
    configs = {(config.noise, config.noise_rate): config for config in study.finals}
    ax.axvline(0, color="black", linewidth=0.6)
    ax.grid(axis="y", color="0.92", linewidth=0.6)
    ax.set_axisbelow(True)
    dots = {"marker": ".", "markersize": 3, "linestyle": "", "color": "0.4"}
    if len(baseline) < SEEDS_FOR_INTERVAL and ("", BASELINE.noise_rate) in lines:
        ax.plot(baseline - baseline.mean(), np.zeros(len(baseline)), **dots)
    for row, few in zip(rows.itertuples(), has_few(rows), strict=True):
        y = lines[row.noise, row.noise_rate]
        mark = mark_of(row.verdict)
        if pd.notna(row.difference_low):
            ends = row.difference_low, row.difference_high
            ax.hlines(y, *ends, color=mark.get_color(), linewidth=1.1)
        if few:
            shift = row.detectable
            if pd.isna(shift):
                shift = detectable_shift(4, 4) * row.pooled_std
            ax.hlines(y, -shift, shift, color="0.88", linewidth=6, zorder=0.5)
            seeds = study.sample(configs[row.noise, row.noise_rate], e)
            ax.plot(seeds - baseline.mean(), np.full(len(seeds), y), **dots)
        look = {"color": mark.get_color(), "markerfacecolor": mark.get_markerfacecolor()}
        ax.plot(row.difference, y, "o", zorder=3, **look)
    ax.margins(x=0.08)
    style.set_ticks(ax, "x", 5)


# ----------------------------------------------------------------------------------------- heatmap


def heatmaps_figure(rows, width):
    """Draw noises by rates, a heatmap for each environment, with dots where verdicts are clear."""
    column, unit, limit = heatmap_scale(rows)
    panels = list(rows.groupby("environment"))
    most = rows.groupby("environment")["noise_rate"].nunique().max()
    names = {noise: style.fitted(noise, min(LABELS, PART * width)) for noise in set(rows["noise"])}
    left = max(map(style.inches_of, names.values())) + 0.12
    line = style.LINE * (1 + max(name.count("\n") for name in names.values())) + 0.03
    shared = len({tuple(panel["noise"].unique()) for _, panel in panels}) == 1
    beside = 0.15 if shared else left
    place = {"least": CELL * most + beside, "left": left if shared else 0.0}
    _, slot = style.row_of(len(panels), width, **place)
    longest = max(map(style.inches_of, rows["noise_rate"]))
    turned = longest + 0.05 > (slot - beside) / most
    fig, axes = style.panels(
        titles_of(rows),
        width,
        [line * panel["noise"].nunique() for _, panel in panels],
        **place,
        beside=beside,
        below="noise rate",
        legend=0.62,
        ticks=longest + 0.1 if turned else style.TICKS,
    )

    def number(value):
        if abs(value) >= 1000:
            return f"{value:+.0e}"
        return f"{value:+z.{0 if unit == '%' else 1}f}"

    for ax, (_, panel) in zip(axes, panels, strict=True):
        rates = sorted(set(panel["noise_rate"]), key=rate_order)
        grid = panel.pivot(index="noise", columns="noise_rate", values=[column, "verdict"])
        dots = grid["verdict"][rates].isin([*style.COLORS])
        image = heatmap(ax, grid[column][rates].astype(float), limit, number, dots)
        has_labels = ax.is_first or not shared
        ax.set_yticks(range(len(grid)), [names[noise] for noise in grid.index if has_labels])
        ax.tick_params(axis="x", rotation=90 if turned else 0)
    height = fig.get_figheight()
    bar = fig.add_axes([0.25, 0.4 / height, 0.5, 0.08 / height])
    beyond = "both" if rows[column].abs().max() > limit else "neither"
    fig.colorbar(
        image,
        cax=bar,
        label=f"difference from no noise ({unit})",
        orientation="horizontal",
        extend=beyond,
    )
    return fig


def heatmap(ax, grid, limit, number, dots):
    """Draw a frame of numbers: in each cell its colour, number(value), and a dot if it has one.

    The numbers are left out where the cells are too small. The colours end at \u00b1 limit.
    dots: as grid, of bool.
    """
    image = ax.imshow(
        grid.clip(-limit, limit), cmap=style.DIVERGING, vmin=-limit, vmax=limit, aspect="auto"
    )
    cell = ax.get_position().width * ax.figure.get_figwidth() / grid.shape[1]
    texts = {
        place: number(value)
        for place, value in np.ndenumerate(grid.to_numpy())
        if not np.isnan(value)
    }
    has_room = max(map(style.inches_of, texts.values()), default=0) <= cell - 0.02
    for (i, j), text in texts.items():
        ink = "white" if grid.iat[i, j] > 0.7 * limit else "black"  # only the blue is dark
        if has_room:
            ax.text(j, i, text, ha="center", va="center", color=ink)
        if dots.iat[i, j]:
            ax.plot(j + 0.36, i - 0.28, "o", color="black", markersize=2)
    ax.set_xticks(range(len(grid.columns)), grid.columns)
    ax.tick_params(length=0, pad=3)
    ax.set_facecolor("0.93")  # where there is no number
    return image
