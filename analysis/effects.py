"""The figure of the effects: every noise in every environment."""

from itertools import groupby

import numpy as np
import pandas as pd
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from analysis import style
from analysis.folders import SUCCESS
from analysis.formatting import seeds_between
from analysis.power import CONFIDENCE
from analysis.statistics import SEEDS_FOR_INTERVAL
from analysis.verdicts import BETTER, UNCLEAR, WORSE
from noisy_wrappers import BASELINE, parse_rates

MOST_RATES = 25  # lines of a figure; of more, each noise has its rates together
LABELS = 2.0  # inches for the names of noises, at most; in a narrow figure a part of its width
PART = 0.45
ROW = 1.1 * style.LINE


def effects_caption(study, rows):
    """Say what effects_figure shows."""
    clear = rows["verdict"].isin(style.COLORS).any()
    text = (
        f"{study.name}: difference from no noise in mean final {study.metric}, with its "
        f"{CONFIDENCE} interval from five seeds on, by noise and rate; every environment has its "
        "own scale. "
    )
    text += "Filled marks are clear verdicts" if clear else "No single verdict is clear"
    text += ". n: seeds (with / without noise)."
    if has_few(rows).any():
        text += (
            " With fewer than five, small dots are the seeds, and a difference beyond the grey bar "
            "would be found in 80 % of cases: the column detectable of the csv file. Where the bar "
            "spans the panel, no difference would."
        )
    return text


def configurations(rows):
    """Return the (noise, rate) of rows of comparisons, in order."""
    configs = dict.fromkeys(zip(rows["noise"], rows["noise_rate"], strict=True))
    return sorted(configs, key=lambda config: (config[0], parse_rates(config[1].split(", ")[0])))


def has_few(rows):
    """Tell which comparisons have too few seeds for an interval."""
    return rows[["n", "n_baseline"]].min(axis=1) < SEEDS_FOR_INTERVAL


def effects_figure(study, rows, width=None):
    """Draw differences with their intervals: panels that share their lines, one for each rate.

    rows: comparisons in environments of the study.
    """
    width = width or style.PAGE
    with_seeds = has_few(rows).any()
    lines, heads, y = {}, {}, 0  # what stands at which height, in lines
    if with_seeds:
        lines[BASELINE.noise, BASELINE.noise_rate], y = y, y + 1
    for noise, configs in groupby(configurations(rows), lambda config: config[0]):
        name = style.fitted(noise, min(LABELS, PART * width))
        heads[name], y = y, y + name.count("\n") + 1
        for config in configs:
            lines[config], y = y, y + 1
    labels = [label_of(*line) for line in lines]
    left = max(map(style.inches_of, [*heads, *labels])) + 0.12
    titles = [
        [style.short(name), seeds_between(panel["n"], panel["n_baseline"].iloc[0])]
        for name, panel in rows.groupby("environment")
    ]
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


def label_of(noise, rate):
    """Return the label of a line: its rate, or how many rates it has together."""
    if not noise:
        return "no noise"
    return f"{rate.count(',') + 1} rates" if "," in rate else rate


def marks_of(rows, with_seeds):
    """Return what the legend of a forest plot explains: {label: handle}."""
    found = set(rows["verdict"].dropna())
    marks = {}
    for word in (BETTER, WORSE, UNCLEAR):
        if word in found or (word == UNCLEAR and found - {BETTER, WORSE}):
            marks[word] = mark_of(word)
    if rows["verdict"].isna().any():  # of lopsided numbers of seeds, or `choose` has not judged it
        marks["no verdict"] = mark_of(None)
    if with_seeds:
        marks["one seed"] = Line2D([], [], color="0.4", marker=".", markersize=3, linestyle="")
        marks["not found in 80 % of cases"] = Patch(color="0.88")
    return marks


def mark_of(verdict):
    """Return the mark of a verdict: filled where it is clear, grey where there is none."""
    color = style.COLORS.get(verdict, style.UNCLEAR) if isinstance(verdict, str) else "0.4"
    face = color if verdict in style.COLORS else "white"
    return Line2D([], [], color=color, marker="o", markerfacecolor=face, linestyle="-")


def forest_panel(ax, study, rows, lines):
    """Draw one environment's differences, with intervals or with the seeds."""
    e = study.environments.index(rows["environment"].iloc[0])
    baseline = study.sample(BASELINE, e)
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
            bar = {"color": "0.88", "linewidth": 6, "zorder": 0.5}
            if np.isnan(row.detectable):
                ax.axhline(y, **bar)
            else:
                ax.hlines(y, -row.detectable, row.detectable, **bar)
            rates = row.noise_rate.split(", ")
            same = [c for c in study.finals if c.noise == row.noise and c.noise_rate in rates]
            seeds = np.concatenate([study.sample(config, e) for config in same])
            ax.plot(seeds - baseline.mean(), np.full(len(seeds), y), **dots)
        look = {"color": mark.get_color(), "markerfacecolor": mark.get_markerfacecolor()}
        ax.plot(row.difference, y, "o", zorder=3, **look)
    ax.margins(x=0.08)
    style.set_ticks(ax, "x", 5)
