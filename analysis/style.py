"""The look of all figures: palette, widths, scales."""

import matplotlib
import numpy as np
from matplotlib.colors import LinearSegmentedColormap

STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titley": 1.0,  # above the axes, without a search for labels that are in the way
    "svg.hashsalt": "noisy",  # equal figures are equal files
    "pdf.fonttype": 42,  # TrueType: ICML and GECCO refuse a paper with Type 3 fonts
    "text.parse_math": False,  # names of experiments are no formulas
}
matplotlib.rcParams.update(STYLE)
WIDTH = 10  # inches of most figures
WIDTHS = (5.2, 8, WIDTH)  # with one to three panels in a row
HEIGHT = 3.6  # inches, at least
# Colour-blind readers tell these apart (Okabe and Ito, 2008); report.html.jinja has them, too.
BETTER, WORSE, UNCLEAR = "#0072B2", "#D55E00", "#8C8C8C"
COLORS = {"better": BETTER, "worse": WORSE}  # of verdicts; all others are grey
DIVERGING = LinearSegmentedColormap.from_list("effects", [WORSE, "white", BETTER])
viridis = matplotlib.colormaps["viridis"]  # ordered by lightness, so it reads in grey


def line_style(i, number):
    """Return the look of line i of so many; the first is the baseline, in black."""
    color = viridis(0.7 * (i - 1) / max(1, number - 2)) if i else "black"
    line, marker = ["-", "--", "-.", ":"][i % 4], ["", "o", "s", "^", "D", "v", "P", "X"][i % 8]
    return {"color": color, "linestyle": line, "marker": marker}


def set_title(ax, environment, inches, more=""):
    """Set a title that begins with an environment's id, as small as a panel so wide needs it.

    Of module:Environment-v0 only the environment is shown; tables have the whole.
    """
    name = environment.rpartition(":")[2]
    size = min(7.5 if more else 9, 100 * inches / len(name))
    ax.set_title(f"{name}{more}", fontsize=size)


def broken(label):
    """Put each noise or rate of a combination on a line of its own."""
    return str(label).replace(" + ", " +\n")


def color_limit(values, most=np.inf):
    """Return where the colours of a heatmap end: at its largest number, at most `most`."""
    sizes = np.abs(np.asarray(values, float))
    limit = min(most, sizes[np.isfinite(sizes)].max(initial=0)) or 1.0
    return float(np.ceil(limit)) if most == 100 else limit
