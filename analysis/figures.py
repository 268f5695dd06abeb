"""The figures of analyze.py."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import groupby

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy import special

from analysis import effects, style
from analysis.episodes import wrapper_names
from analysis.folders import RETURN, SUCCESS
from analysis.formatting import seeds_between, seeds_of
from analysis.heatmap import heatmaps
from analysis.power import CONFIDENCE, LEVEL
from analysis.runs import KEYS, rows_of
from analysis.statistics import SEEDS_FOR_INTERVAL, least_variance
from analysis.words import slug
from noisy_wrappers import BASELINE, parse_rates

COLUMN_END = "_column"  # of the name of a figure that is as wide as a column
INTERVAL, STD = "interval", "std"  # what a band shows
BANDS = {
    INTERVAL: f"the {CONFIDENCE} interval of the mean, with fewer than five seeds each seed",
    STD: "\u00b1 one standard deviation over seeds",
}
LABELS = {RETURN: "test return", SUCCESS: "test success rate (%)"}
PLACE = {"least": 1.28, "left": style.LINE + 0.05}  # of panels, in inches
BESIDE = 0.4  # for their tick labels
DUE = "training steps when tests were due"
COMPARED = ("noises", "statistics", "best")  # tables that figures draw


@dataclass
class Drawing:
    """A figure with what the report needs to know of it."""

    kind: str  # effects, best_curves, curves, parameters or robustness
    label: str  # what sets it apart from others of its kind
    caption: str
    draw: Callable[..., Figure]  # of its width in inches, by default that of a page

    @property
    def name(self):
        """The name of its files."""
        return f"{self.kind}_{slug(self.label)}"


def figures(studies, tables, band=INTERVAL):
    """Return a Drawing for every figure, in the order of the report; each has another name."""
    drawings, used = [], set()
    for study in studies:
        drawings += comparison_figures(study, {name: tables[name].frame for name in COMPARED}, band)
        for noise in study.noises or [""]:
            title = f"{study.name}, {noise or 'no noise'}"
            caption = f"{title}: learning curves, mean over n seeds; shaded: {BANDS[band]}."
            draw = partial(noise_figure, study, noise, band)
            drawings.append(Drawing("curves", title, caption, draw))
        drawings += parameter_figures(study, band)
    if "robustness" in tables:
        tested = heatmaps(tables["robustness"].frame, studies[0].metric)
        drawings += [Drawing("robustness", *heatmap) for heatmap in tested]
    for drawing in drawings:
        while drawing.name in used:  # of "lr 1" and "lr_1", say, which are one name of a file
            drawing.label += " again"
        used.add(drawing.name)
    return drawings


def comparison_figures(study, tables, band):
    """Yield the Drawing of a study's effects, and that of the curves of its best noises.

    tables: {name: frame} of the tables COMPARED.
    """
    rows = {name: frame[rows_of(frame, study.key)] for name, frame in tables.items()}
    rates = rows["statistics"][rows["statistics"]["difference"].notna()]
    if rates.empty:
        return
    compared = rates if len(effects.configurations(rates)) <= effects.MOST_RATES else rows["noises"]
    draw = partial(effects.effects_figure, study, compared)
    yield Drawing("effects", study.name, effects.effects_caption(study, compared), draw)
    if len(study.finals) > 2:
        caption = (
            f"{study.name}: test {study.metric} without noise and with the best noise of each "
            f"environment, mean over n seeds; shaded: {BANDS[band]}. "
            "The best of many looks better than it is."
        )
        draw = partial(best_figure, study, rows["best"][KEYS].merge(rates), band)
        yield Drawing("best_curves", study.name, caption, draw)


def seeds_in(study, configs, e):
    """Write the numbers of seeds in a panel; see seeds_between."""
    noisy = [n for config in configs if config != BASELINE and (n := len(study.sample(config, e)))]
    baseline = len(study.sample(BASELINE, e)) if BASELINE in configs else 0
    noisy = noisy or [baseline]
    return seeds_between(noisy, baseline or max(noisy))


def panels(study, titles, width, below, legend, **more):
    """Make a panel for each title (lists of lines), above a legend of this height."""
    alone = len(titles) == 1 or width <= style.COLUMN
    heights = [min(2.4, 0.55 * width) if alone else 1.15] * len(titles)
    more |= PLACE | {"beside": BESIDE, "below": below, "legend": legend}
    fig, axes = style.panels(titles, width, heights, **more)
    middle = np.mean([ax.get_position().intervaly.mean() for ax in axes])
    fig.text(0.03 / width, middle, LABELS[study.metric], rotation=90, va="center", ha="left")
    return fig, axes


def band_of(runs, band, episodes=None):
    """Return the mean of runs (rows, seeds), and the low and high ends of its band (rows,).

    The interval is Student's, from five seeds on, as for differences; of rates of success, each of
    so many episodes, it has no width zero and stays from 0 to 100. Where there is no band, the ends
    are NaN.
    """
    table = pd.DataFrame(runs)
    found = table.mean(axis=1), table.std(axis=1), table.count(axis=1)
    mean, std, n = (column.to_numpy() for column in found)
    if band == STD:
        return mean, mean - std, mean + std
    variance = std**2 / np.maximum(1, n)
    if episodes:
        variance = np.maximum(variance, least_variance(mean, episodes * n))
    half = special.stdtrit(np.maximum(1, n - 1), 1 - LEVEL / 2) * np.sqrt(variance)
    half[n < SEEDS_FOR_INTERVAL] = np.nan
    low, high = (0, 100) if episodes else (-np.inf, np.inf)
    return mean, np.maximum(mean - half, low), np.minimum(mean + half, high)


def curve(ax, x, runs, band, episodes=None, **look):
    """Draw the mean of runs (steps x seeds) with its band, or with thin lines of the seeds."""
    runs = runs[:, np.isfinite(runs).any(axis=0)]
    mean, low, high = band_of(runs, band, episodes)
    ax.plot(x, mean, zorder=3, **look)
    if np.isfinite(low).any():
        ax.fill_between(x, low, high, alpha=0.2, linewidth=0, **look)
    elif runs.shape[1] > 1:
        ax.plot(x, runs, linewidth=0.4, alpha=0.7, **look)


def best_figure(study, best, band, width=None):
    """Draw no noise against the best noise of each environment.

    best: the rows of statistics of these noises.
    """
    configs = {(config.noise, config.noise_rate): config for config in study.finals}
    panels = []
    for row in best.itertuples():
        verdict = row.verdict if isinstance(row.verdict, str) else "not judged"
        lines = [verdict, f"n = {seeds_of(row.n, row.n_baseline)}"]
        shown = [BASELINE, configs[row.noise, row.noise_rate]]
        panels.append((study.environments.index(row.environment), shown, lines))
    return curves_figure(study, panels, band, width)


def noise_figure(study, noise, band=INTERVAL, width=None):
    """Draw one line per noise rate, and one without noise.

    There is a panel for each environment in which this noise was tried.
    """
    configs = [config for config in study.finals if config.noise in ("", noise)]
    panels = []
    for e in range(len(study.environments)):
        shown = [config for config in configs if len(study.sample(config, e))]
        if any(config.noise == noise for config in shown):
            panels.append((e, shown, [seeds_in(study, shown, e)]))
    return curves_figure(study, panels, band, width, noise)


def curves_figure(study, curves, band, width=None, noise=None):
    """Draw learning curves: a panel for each (environment's number, configurations, title below).

    noise: that of all curves, if it is one; then the legend has it as a title.
    """
    width = width or style.PAGE
    used = {config for _, shown, _ in curves for config in shown}
    shown = [config for config in study.finals if config in used]
    noisy = [config for config in shown if config != BASELINE]
    colors = dict(zip(noisy, style.hues(len(noisy)), strict=True)) | {BASELINE: "black"}
    labels = [rate_label(config, noise, width) for config in shown]
    title = style.fitted(noise, width - 0.3) if noise else ""
    titles = [[style.short(study.environments[e]), *lines] for e, _, lines in curves]
    height = style.legend_columns(labels, width, title)[1]
    unit, word = (1e6, "millions") if study.steps[-1] >= 1e6 else (1e3, "thousands")
    fig, axes = panels(study, titles, width, f"{DUE} ({word})", height)
    for ax, (e, configs, _) in zip(axes, curves, strict=True):
        for config in configs:
            runs = study.curves[config][..., e]
            curve(ax, study.steps / unit, runs, band, study.episodes, color=colors[config])
        ax.set_xlim(0, study.steps[-1] / unit)
        style.set_ticks(ax, "x", 5)
        style.set_ticks(ax, "y", 4)
    handles = [Line2D([], [], color=colors[config]) for config in shown]
    style.add_legend(fig, handles, labels, title)
    return fig


def rate_label(config, noise, width):
    """Return a configuration as a label of a legend, which may have its noise as a title."""
    if config == BASELINE:
        return "no noise"
    rate = f"rate {config.noise_rate}"
    return rate if noise else style.fitted(f"{config.noise} at {rate}", width - 0.6)


def parameter_figures(study, band):
    """Yield a Drawing for every wrapper that a study has with several parameters."""
    dotted = "" if not np.isfinite(study.finals[BASELINE]).any() else "; dotted: no noise"
    single = [config for config in study.finals if len(config.noises) == 1]  # sorted by noise
    for wrapper, configs in groupby(single, lambda config: wrapper_names(config)[0]):
        configs = list(configs)
        if len({config.noise for config in configs}) > 1:
            caption = (
                f"{study.name}, {wrapper}: final test {study.metric} by parameters and noise rate, "
                f"mean over n seeds; lines: {BANDS[band]}{dotted}."
            )
            draw = partial(parameters_figure, study, configs, band)
            yield Drawing("parameters", f"{study.name} {wrapper}", caption, draw)


def parameters_figure(study, configs, band=INTERVAL, width=None):
    """Draw points of the final return: a wrapper's parameters side by side, by noise rate."""
    width = width or style.PAGE
    noises = list(dict.fromkeys(config.noise for config in configs))
    rates = sorted({config.noise_rate for config in configs}, key=parse_rates)
    colors = dict(zip(noises, style.hues(len(noises)), strict=True))
    shifts = 0.7 * ((np.arange(len(noises)) + 0.5) / len(noises) - 0.5)
    beside = dict(zip(noises, shifts, strict=True))
    places = range(len(study.environments))
    tried = [e for e in places if any(len(study.sample(config, e)) for config in configs)]
    if any(len(study.sample(BASELINE, e)) for e in tried):
        configs = [BASELINE, *configs]
        rates = [BASELINE.noise_rate, *rates]
        colors, beside = {"": "black"} | colors, {"": 0} | beside
    ticks = ["none" if rate == BASELINE.noise_rate else rate for rate in rates]
    labels = [style.fitted(noise, width - 0.6) or "no noise" for noise in colors]
    titles = [[style.short(study.environments[e]), seeds_in(study, configs, e)] for e in tried]
    height = style.legend_columns(labels, width)[1]
    room = style.row_of(len(titles), width, **PLACE)[1] - BESIDE
    longest = max(map(style.inches_of, ticks))
    turned = {"rotation": 90} if (longest + 0.05) * len(ticks) > room else {}
    more = {"ticks": longest + 0.12} if turned else {}
    fig, axes = panels(study, titles, width, "noise rate", height, **more)
    for ax, e in zip(axes, tried, strict=True):
        for config in configs:
            x = rates.index(config.noise_rate) + beside[config.noise]
            point(ax, x, study.sample(config, e), band, study.episodes, colors[config.noise])
        if BASELINE in configs and len(baseline := study.sample(BASELINE, e)):
            ax.axhline(baseline.mean(), color="black", linewidth=0.6, linestyle=":")
        ax.set_xticks(range(len(ticks)), ticks, **turned)
        ax.set_xlim(-0.5, len(ticks) - 0.5)
        style.set_ticks(ax, "y", 4)
    handles = [Line2D([], [], color=color, marker="o", linestyle="") for color in colors.values()]
    style.add_legend(fig, handles, labels)
    return fig


def point(ax, x, sample, band, episodes, color):
    """Draw the mean of a sample with its band, or with its seeds."""
    if len(sample) == 0:
        return
    mean, low, high = band_of(sample[np.newaxis], band, episodes)
    if np.isnan(low) and len(sample) > 1:
        ax.plot(np.full(len(sample), x), sample, ".", markersize=2.5, color=color, alpha=0.6)
    yerr = np.nan_to_num([mean - low, high - mean])
    ax.errorbar(x, mean, yerr, marker="o", markersize=3, linewidth=0.9, color=color)


def write_figure(out, drawing, latex=False, width=style.PAGE):
    """Write {name}.svg for a page and {name}_column.svg for a column, with `latex` also as pdf.

    Without dates, so equal figures are equal files.
    """
    for end, inches in (("", width), (COLUMN_END, style.COLUMN)):
        figure = drawing.draw(inches)
        figure.savefig(out / f"{drawing.name}{end}.svg", metadata={"Date": None})
        if latex:
            figure.savefig(out / f"{drawing.name}{end}.pdf", metadata={"CreationDate": None})
