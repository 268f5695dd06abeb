"""The figure of the effects: every noise in every environment; and the palette of all figures."""

import re

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from analysis.configurations import rate_order

WIDTH = 10  # inches of every figure
# Colour-blind readers tell these apart (Okabe and Ito, 2008); report.html.jinja has them, too.
BETTER, WORSE, UNCLEAR = "#0072B2", "#D55E00", "#8C8C8C"
COLORS = {"better": BETTER, "worse": WORSE}  # of verdicts; all others are grey
DIVERGING = LinearSegmentedColormap.from_list("effects", [WORSE, "white", BETTER])
FOREST_ROWS = 25  # configurations of a forest plot; more of them are a heatmap
ACROSS = 5  # panels of effects side by side


def broken(label):
    """Put each noise or rate of a combination on a line of its own."""
    return str(label).replace(" + ", " +\n")


def ink_on(value, limit):
    """Return the colour of a number that can be read on its cell of a heatmap."""
    return "white" if abs(value) > 0.7 * limit else "black"


def of_environments(statistics):
    """Keep the rows of single environments that have an improvement."""
    known = statistics["improvement_iqm_percent"].notna() & statistics["p"].notna()
    return statistics[known & (statistics["scope"] == "environment")]


def cut_at(values):
    """Return where a scale of percentages ends: a whole number, at most 100."""
    return int(np.clip(np.ceil(np.nanmax(np.abs(values))), 1, 100))


def effects_caption(study, statistics):
    """Say what effects_figure shows, and how many of its verdicts are clear."""
    rows = of_environments(statistics)
    clear = " and ".join(f"{(rows['verdict'] == word).sum()} {word}" for word in COLORS)
    start = f"{study.name}: improvement over no noise in percent (interquartile mean); "
    start += f"{clear} of {len(rows)}."
    if len(rows.drop_duplicates(["noise", "noise_rate"])) > FOREST_ROWS:
        limit = cut_at(rows["improvement_iqm_percent"])
        return f"{start} A dot marks a clear verdict; the colours end at \u00b1 {limit} %."
    start += (
        " Bars are 95 % intervals, filled marks clear verdicts; triangles lie beyond the scale."
    )
    return f"{start} Rows: noise and rate; at the side: n, with/without noise."


def effects_figure(statistics):
    """Draw the effect of every noise, a panel for each environment in which any was tried.

    statistics: the tested rows of one study. Up to FOREST_ROWS noises and rates are a forest plot;
    more are heatmaps of noises by rates.
    """
    rows = of_environments(statistics)
    configs = list(dict.fromkeys(zip(rows["noise"], rows["noise_rate"], strict=True)))
    configs.sort(key=lambda config: (config[0], rate_order(config[1])))
    environments = sorted(set(rows["environment"]))
    forest = len(configs) <= FOREST_ROWS
    lines = [f"{broken(noise)}, {broken(rate)}" for noise, rate in configs]
    if len(environments) > 2:  # little room for names beside the panels
        lines = [re.sub(r"(?<=\w)\((?=.{10})", "\n(", line) for line in lines]
    if not forest:
        lines = [broken(noise) for noise in dict.fromkeys(noise for noise, _ in configs)]
    across = min(ACROSS, len(environments))
    down = -(-len(environments) // across)
    high = 0.22 * len("\n".join(lines).split("\n"))
    fig = Figure(figsize=(WIDTH, 0.6 + down * (0.7 + high)), layout="constrained")
    axes = fig.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
    for ax in axes[len(environments) :]:
        ax.remove()
    axes = axes[: len(environments)]
    panels = [rows[rows["environment"] == environment] for environment in environments]
    for ax, environment in zip(axes, environments, strict=True):
        ax.set_title(environment, fontsize=9)
    if forest:
        ends = rows[["improvement_iqm_percent", "improvement_low", "improvement_high"]]
        ends = ends.astype(float)
        limit = cut_at(ends)
        low = max(-limit, min(0, ends.min(axis=None)))
        high = min(limit, max(0, ends.max(axis=None)))
        wide = (high - low) or 1  # n stands in the last third, at the side of the marks
        axes[0].set_xlim(low - 0.08 * wide, high + (0.45 if across > 2 else 0.15) * wide)
        for ax, panel in zip(axes, panels, strict=True):
            forest_panel(ax, panel, configs, limit)
        axes[0].set_yticks(range(len(lines)), lines)
        axes[0].set_ylim(len(lines) - 0.4, -0.6)  # the first noise on top
        fig.supxlabel("improvement over no noise (%)", fontsize=9)
    else:
        limit = cut_at(rows["improvement_iqm_percent"])
        for ax, panel in zip(axes, panels, strict=True):
            image = heat_panel(ax, panel, configs, limit)
        axes[0].set_yticks(range(len(lines)), lines)
        fig.supxlabel("noise rate", fontsize=9)
        beyond = "both" if rows["improvement_iqm_percent"].abs().max() > limit else "neither"
        label = "improvement over no noise (%)"
        fig.colorbar(image, ax=list(axes), extend=beyond, label=label, fraction=0.02, pad=0.01)
    return fig


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
        n = f"{row.n:.0f}" if row.n == row.n_baseline else f"{row.n:.0f}/{row.n_baseline:.0f}"
        side = {"transform": ax.get_yaxis_transform(), "ha": "right", "va": "center"}
        ax.text(1, y, n, color="0.35", fontsize=7, **side)
    ax.xaxis.get_major_locator().set_params(nbins=4)
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
            ax.text(j, i, text, ha="center", va="center", color=ink, fontsize=5.5)
    clear = [p for p, word in zip(places, rows["verdict"], strict=True) if word in COLORS]
    for i, j in clear:
        ax.plot(j + 0.35, i - 0.3, "o", color="black", markersize=2.5)
    ax.set_xticks(range(len(rates)), rates, fontsize=7, rotation=90 if len(rates) > 4 else 0)
    ax.set_facecolor("0.93")  # not tried
    return image
