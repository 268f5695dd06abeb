"""The look of all figures: sizes, palette, and where panels, titles and legends stand.

All figures are drawn at the size that they have in a paper, so their text has eight points there.
Places are in inches.
"""

import re
from functools import cache

import matplotlib
import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath
from matplotlib.ticker import MaxNLocator

COLUMN, PAGE = 3.25, 6.75  # the width of one column of a paper, and of two
TEXT = 8  # points
LINE = 1.25 * TEXT / 72  # the height of a line of text
TICKS = 0.24  # what tick labels below a panel take
EDGE = 0.12  # at the right: half of the last tick label
BREAKS = r"(?<=[a-z0-9])(?=[A-Z(])|(?<=[_/-])(?![\d.])|(?<=[^,] )"  # of names; brackets stay whole
STYLE = {
    "font.size": TEXT,
    **dict.fromkeys(("axes.titlesize", "legend.fontsize", "legend.title_fontsize"), TEXT),
    **dict.fromkeys(("axes.labelsize", "xtick.labelsize", "ytick.labelsize"), TEXT),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.1,
    "lines.markersize": 4,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "axes.titley": 1.0,  # above the axes, without a search for labels that are in the way
    "svg.hashsalt": "noisy",  # equal figures are equal files
    "pdf.fonttype": 42,  # TrueType: ICML and GECCO refuse a paper with Type 3 fonts
    "text.parse_math": False,  # names of experiments are no formulas
}
matplotlib.rcParams.update(STYLE)
# Colour-blind readers tell these apart (Okabe and Ito, 2008); report.html.jinja has them, too.
BETTER, WORSE, UNCLEAR = "#0072B2", "#D55E00", "#AA4499"
COLORS = {"better": BETTER, "worse": WORSE}  # of verdicts; all others are UNCLEAR
DIVERGING = LinearSegmentedColormap.from_list("diverging", [WORSE, "white", BETTER])
HUES = ["#4477AA", "#EE6677", "#228833", "#CCBB44", "#AA3377", "#66CCEE"]  # Paul Tol's "bright"


def hues(number):
    """Return colours for so many lines beside the black one of no noise."""
    if number <= len(HUES):
        return HUES[:number]
    return list(matplotlib.colormaps["turbo"](np.linspace(0.05, 0.95, number)))


# ---------------------------------------------------------------------------------------- text


@cache
def inches_of(text):
    """Return how wide a text is in a figure: its longest line."""
    lines = [TextPath((0, 0), line, TEXT) for line in text.split("\n") if line.strip()]
    # From the points alone: DejaVu Sans has one at each end of a glyph. get_extents, which solves
    # for the ends of every curve, finds the same in ten times as long.
    ends = [line.vertices[line.codes != line.CLOSEPOLY, 0] for line in lines]
    return max(map(np.ptp, ends), default=0) / 72


def fitted(text, inches):
    """Break a text into lines of this width: between words, also those of a name, or anywhere."""
    lines = [""]
    for piece in re.split(BREAKS, str(text).replace(" + ", " +\n")):
        while inches_of(piece) > inches and "\n" not in piece:
            fits = max(1, int(len(piece) * inches / inches_of(piece)) - 1)
            lines += [piece[:fits]]
            piece = piece[fits:]
        start = lines[-1].rpartition("\n")[2] + piece.partition("\n")[0]
        if lines[-1] and inches_of(start) > inches:
            lines.append("")
        lines[-1] += piece
    return "\n".join(line.strip() for line in "\n".join(filter(None, lines)).split("\n"))


def short(environment):
    """Return the name of an environment above a panel, without its module; tables have that."""
    return environment.rpartition(":")[2]


def in_thousands(value):
    """Write a tick of an axis: "10k", "2.5M"."""
    size, unit = next((pair for pair in ((1e6, "M"), (1e3, "k")) if abs(value) >= pair[0]), (1, ""))
    return f"{value / size:.4g}{unit}".replace("-", "\u2212")


def set_ticks(ax, name, most):
    """Give an axis, "x" or "y", at most so many intervals, fewer where labels would touch."""
    low, high = sorted(getattr(ax, f"get_{name}lim")())
    position, size = ax.get_position(), ax.figure.get_size_inches()
    inches = position.width * size[0] if name == "x" else position.height * size[1]
    for intervals in range(most, 0, -1):
        ticks = MaxNLocator(intervals, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
        ticks = [tick for tick in ticks if low <= tick <= high]
        labels = [in_thousands(tick) for tick in ticks]
        needed = max(map(inches_of, labels)) + 0.08 if name == "x" else LINE
        if len(ticks) < 2 or inches * (ticks[1] - ticks[0]) / (high - low) >= needed:
            break
    getattr(ax, f"set_{name}ticks")(ticks, labels)


# -------------------------------------------------------------------------------------- places


def row_of(number, width, least, left):
    """Return how many of so many panels stand in a row, and the width of each; see panels."""
    room = width - left - EDGE
    most = 1 if width <= COLUMN else max(1, int(room / least))
    across = -(-number // -(-number // most))
    return across, room / across


def panels(titles, width, heights, *, least, left, beside, below="", legend=0.0, ticks=TICKS):
    """Make a figure with a panel for each title, in rows as full as there is room.

    In a figure as narrow as a column every panel has a row. The first panel of a row has
    `is_first`.

    titles: lists of lines; width: of the figure; heights: of each panel; least: the width of a
    panel with what is beside it; left: a margin before each row; beside: a margin left of each
    panel; below: the label below all panels; legend: the height of a legend below that; ticks: that
    of the tick labels below a panel.
    """
    number = len(titles)
    across, slot = row_of(number, width, least, left)
    down = -(-number // across)
    titles = [[*fitted(name, slot - 0.03).split("\n"), *more] for name, *more in titles]
    rows = [range(start, min(start + across, number)) for start in range(0, number, across)]
    above = [LINE * max(len(titles[i]) for i in row) + 0.12 for row in rows]
    tall = [max(heights[i] for i in row) for row in rows]
    foot = (LINE + 0.04 if below else 0) + legend
    total = sum(above) + sum(tall) + ticks * down + foot
    fig, top, axes = Figure(figsize=(width, total)), total, []
    for row, title_height, height in zip(rows, above, tall, strict=True):
        bottom = top - title_height - height
        for i in row:
            start = left + beside + slot * (i - row[0])
            size = (slot - beside) / width, height / total
            ax = fig.add_axes([start / width, bottom / total, *size])
            middle = (slot / 2 - beside) / (slot - beside)  # of the panel and what is beside it
            ax.set_title("\n".join(titles[i]), x=middle, pad=4)
            ax.is_first = i == row[0]
            axes.append(ax)
        top = bottom - ticks
    half = inches_of(below) / 2 + 0.03
    center = min((left + beside + width - EDGE) / 2, width - half)
    fig.text(center / width, foot / total, below, ha="center", va="top")
    return fig, axes


def legend_columns(labels, width, title=""):
    """Return in how many columns a legend fits, and its height."""
    widest = max(map(inches_of, labels)) + 0.55  # with its handle
    columns = max(1, min(len(labels), int((width - 0.1) / widest)))
    rows = -(-len(labels) // columns)
    lines = rows * (1 + max(label.count("\n") for label in labels))
    lines += title.count("\n") + 1 if title else 0
    return columns, 1.05 * LINE * lines + 0.04


def add_legend(fig, handles, labels, title=""):
    """Add a legend at the bottom of a figure; see legend_columns."""
    columns, _ = legend_columns(labels, fig.get_figwidth(), title)
    look = {"frameon": False, "borderaxespad": 0.2, "borderpad": 0.1, "labelspacing": 0.25}
    look |= {"handlelength": 1.6, "columnspacing": 1.2, "title": title or None}
    fig.legend(handles, labels, loc="lower center", ncols=columns, **look)
