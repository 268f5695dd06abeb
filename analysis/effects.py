"""The figure of the effects: every noise in every environment; and the palette of all figures."""

import re

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from analysis.verdicts import seeds_of
from noisy_wrappers import rate_order

WIDTH = 10  # inches of most figures
WIDTHS = (5.2, 8, WIDTH, 12, 12)  # with one to five panels in a row
NARROW_WIDTH = 4.2  # inches of those for a telephone
# Colour-blind readers tell these apart (Okabe and Ito, 2008); report.html.jinja has them, too.
BETTER, WORSE, UNCLEAR = "#0072B2", "#D55E00", "#8C8C8C"
PALETTE = [BETTER, WORSE, "#009E73"]  # of lines that are no verdicts, from the same source
COLORS = {"better": BETTER, "worse": WORSE}  # of verdicts; all others are grey
DIVERGING = LinearSegmentedColormap.from_list("effects", [WORSE, "white", BETTER])
FOREST_ROWS = 25  # configurations of a forest plot; more of them are a heatmap
ACROSS = 5  # panels of effects side by side
ENDS = ["improvement_iqm_percent", "improvement_low", "improvement_high"]


def broken(label):
    """Put each noise or rate of a combination on a line of its own."""
    return str(label).replace(" + ", " +\n")


def ink_on(value, limit):
    """Return the colour of a number that can be read on its cell of a heatmap."""
    return "white" if value > 0.7 * limit else "black"  # only the blue is dark


def of_environments(statistics):
    """Keep the rows of single environments that have an improvement."""
    known = statistics["improvement_iqm_percent"].notna() & statistics["p"].notna()
    return statistics[known & (statistics["scope"] == "environment")]


def cut_at(values):
    """Return where a scale of percentages ends: a whole number, at most 100."""
    return int(np.clip(np.ceil(np.nanmax(np.abs(values.astype(float)))), 1, 100))


def effects_caption(study, statistics):
    """Say what effects_figure shows."""
    rows = of_environments(statistics)
    clear = rows["verdict"].isin(COLORS).any()
    if len(configurations(rows)) > FOREST_ROWS:
        text = f"{study.name}: improvement over no noise in percent (interquartile mean). "
        text += "A dot marks a clear verdict. " if clear else "No verdict is clear. "
        return f"{text}The colours end at \u00b1 {cut_at(rows[ENDS[0]])} %."
    text = f"{study.name}: improvement over no noise (interquartile mean) with its 95 % interval, "
    text += "by noise and rate. "
    text += "Filled marks are clear verdicts" if clear else "No verdict is clear"
    if rows[ENDS[0]].abs().max() > cut_at(rows[ENDS]):
        text += "; triangles lie beyond the scale"
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
    axes = fig.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
    for ax in axes[len(environments) :]:
        ax.remove()
    axes = axes[: len(environments)]
    limit = cut_at(rows[ENDS] if forest else rows[ENDS[0]])
    for ax, environment in zip(axes, environments, strict=True):
        ax.set_title(environment, fontsize=9)
        ax.tick_params(axis="y", labelsize=6.5 if narrow else 9)
        panel = rows[rows["environment"] == environment]
        if forest:
            forest_panel(ax, panel, configs, limit)
        else:
            image = heat_panel(ax, panel, configs, limit)
    axes[0].set_yticks(range(len(lines)), lines)
    axes[0].set_ylim(len(lines) - 0.5, -0.5)  # the first noise on top
    label = "improvement over no noise (%)"
    below = fig.supxlabel if across > 1 else axes[-1].set_xlabel
    below(label if forest else "noise rate", fontsize=9)
    if forest:
        scale_forest(axes[0], rows, limit, (width - 2) / across)
    else:
        beyond = "both" if rows[ENDS[0]].abs().max() > limit else "neither"
        place = {"location": "bottom", "fraction": 0.05} if narrow else {"fraction": 0.02}
        fig.colorbar(image, ax=list(axes), extend=beyond, label=label, pad=0.01, **place)
    return fig


def scale_forest(ax, rows, limit, inches):
    """Set the scale that all panels of a forest plot share, with room for n at its right.

    inches: how wide a panel is, roughly.
    """
    ends = rows[ENDS].astype(float)
    low = max(-limit, min(0, ends.min(axis=None)))
    high = min(limit, max(0, ends.max(axis=None)))
    wide = (high - low) or 1
    margin = 0.5 / inches  # of the panel's width
    ax.set_xlim(low - 0.06 * wide, high + wide * (0.06 + margin / (1 - margin)))
    ticks = MaxNLocator(nbins=max(2, min(6, int(inches / 0.6)))).tick_values(low, high)
    ax.set_xticks([tick for tick in ticks if low <= tick <= high])


def forest_panel(ax, rows, configs, limit):
    """Draw one environment's improvements with intervals, and n at the side."""
    ax.axvline(0, color="black", linewidth=0.8)
    ax.grid(axis="y", color="0.92")
    ax.set_axisbelow(True)
    for row in rows.itertuples():
        y = configs.index((row.noise, row.noise_rate))
        color = COLORS.get(row.verdict, UNCLEAR)
        x, clear = row.improvement_iqm_percent, row.verdict in COLORS
        low, high = np.clip([row.improvement_low, row.improvement_high], -limit, limit)
        ax.hlines(y, low, high, color=color, linewidth=1.5)
        mark = "o" if abs(x) <= limit else "><"[int(x < 0)]
        face = color if clear else "white"
        x = np.clip(x, -limit, limit)
        ax.plot(x, y, mark, color=color, markerfacecolor=face, markersize=6, zorder=3)
        side = {"transform": ax.get_yaxis_transform(), "ha": "right", "va": "center"}
        ax.text(1, y, seeds_of(row.n, row.n_baseline), color="0.35", fontsize=7, **side)
    side = {"transform": ax.transAxes, "ha": "right", "va": "bottom"}
    ax.text(1, 1, "n", color="0.35", fontsize=7, **side)
    ax.tick_params(axis="y", length=0)


def heat_panel(ax, rows, configs, limit):
    """Draw one environment's improvements, noises by rates, dots where the verdict is clear."""
    noises = list(dict.fromkeys(noise for noise, _ in configs))
    rates = sorted({rate for _, rate in configs}, key=rate_order)
    grid = np.full((len(noises), len(rates)), np.nan)
    places = [(noises.index(r.noise), rates.index(r.noise_rate)) for r in rows.itertuples()]
    for place, value in zip(places, rows["improvement_iqm_percent"], strict=True):
        grid[place] = value
    image = ax.imshow(grid, cmap=DIVERGING, vmin=-limit, vmax=limit, aspect="auto")
    if len(rates) <= 8:  # else there is no room for numbers
        for (i, j), value in zip(places, grid[tuple(zip(*places, strict=True))], strict=True):
            text = f"{round(value):+d}" if abs(value) < 1000 else f"{value:+.0e}"
            ink = ink_on(value, limit)
            ax.text(j, i, text, ha="center", va="center", color=ink, fontsize=6)
    clear = [p for p, word in zip(places, rows["verdict"], strict=True) if word in COLORS]
    for i, j in clear:
        ax.plot(j + 0.35, i - 0.3, "o", color="black", markersize=2.5)
    ax.set_xticks(range(len(rates)), rates, fontsize=7, rotation=90 if len(rates) > 4 else 0)
    ax.set_facecolor("0.93")  # not tried
    return image
