"""The figures of analyze.py."""

import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import groupby, product

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from analysis import style
from analysis.effects import effects_caption, effects_figure, heatmap
from analysis.folders import RETURN, SUCCESS
from analysis.formatting import percent, rounded, seeds_of, slug
from analysis.heatmap import heatmaps
from analysis.runs import KEYS, STUDY, rows_of, study_name
from noisy_wrappers import BASELINE, rate_order

ONE_STD = "\u00b1 one standard deviation"
RETURN_LABELS = {RETURN: "test return\n(sum of rewards per episode)"}
RETURN_LABELS[SUCCESS] = "test success rate (%)"


@dataclass
class Drawing:
    """A figure with what the report needs to know of it."""

    kind: str  # effects, best_curves, curves, parameters or robustness
    label: str  # what sets it apart from others of its kind
    caption: str
    draw: Callable[[], Figure]

    @property
    def name(self):
        """The name of its files."""
        return f"{self.kind}_{slug(self.label)}"


def figures(studies, tables):
    """Return a Drawing for every figure, in the order of the report; each has another name."""
    drawings, used = [], set()
    for study in studies:
        drawings += comparison_figures(study, tables["statistics"].frame, tables["best"].frame)
        for noise in study.noises or [""]:
            title = f"{study.name}, {noise or 'no noise'}"
            caption = f"{title}: learning curves, mean over n seeds, shaded {ONE_STD}."
            drawings.append(Drawing("curves", title, caption, partial(curves_figure, study, noise)))
        drawings += ablation_figures(study, tables[f"summary_{slug(study.algorithm)}"].frame)
    if "robustness" in tables:
        drawings += robustness_figures(tables["robustness"].frame, studies[0].metric)
        matrices = heatmaps(tables["robustness"].frame, studies[0].metric)
        drawings += [Drawing("robustness", *matrix) for matrix in matrices]
    for drawing in drawings:
        while drawing.name in used:  # of "lr 1" and "lr_1", say, which are one name of a file
            drawing.label += " again"
        used.add(drawing.name)
    return drawings


def comparison_figures(study, statistics, best):
    """Yield the Drawing of a study's effects, and that of the curves of its best noises."""
    has_comparison = statistics["difference"].notna()
    compared = statistics[rows_of(statistics, study.key) & has_comparison]
    if len(compared):
        draw = partial(effects_figure, compared, study.metric)
        yield Drawing("effects", study.name, effects_caption(study, compared), draw)
    if len(compared) and len(study.finals) > 2:
        caption = (
            f"{study.name}: test {study.metric} without noise (black) and with the best noise of "
            f"each environment, mean over n seeds, shaded {ONE_STD}. "
            "The best of many looks better than it is."
        )
        draw = partial(best_curves_figure, study, best[KEYS].merge(compared))
        yield Drawing("best_curves", study.name, caption, draw)


def span(numbers):
    """Write the numbers of seeds or environments behind a line or a panel: "5", or "3 to 5"."""
    low, high = min(numbers, default=0), max(numbers, default=0)
    return f"{low:.0f}" if low == high else f"{low:.0f} to {high:.0f}"


def panels(environments, labels, metric, below):
    """Make one panel per environment, three in a row, above a legend with as many labels.

    below: the label of all x axes.
    """
    across = min(3, len(environments))
    width = style.WIDTHS[across - 1]
    down = -(-len(environments) // across)
    columns = max(1, min(4, int(13 * width / max(map(len, labels)))))
    legend = 0.2 + 0.2 * -(-len(labels) // columns)
    height = max(style.HEIGHT, 2.4 * down + legend)
    fig = Figure(figsize=(width, height))
    # Placed by hand: matplotlib's automatic layouts take as long as the drawing itself.
    bottom, top = (legend + 0.45) / height, 1 - 0.3 / height
    fig.subplots_adjust(1.1 / width, bottom, 1 - 0.3 / width, top, wspace=0.25, hspace=0.45)
    axes = [fig.add_subplot(down, across, i + 1) for i in range(len(environments))]
    for ax, env in zip(axes, environments, strict=True):
        style.set_title(ax, env, width / across)
        ax.set(xlabel=below)
        ax.yaxis.get_major_locator().set_params(nbins=5)
        if ax.get_subplotspec().is_first_col():
            ax.set_ylabel(RETURN_LABELS[metric])

    def add_legend():
        handles = axes[0].get_legend_handles_labels()[0]
        fig.legend(handles, labels, loc="lower center", ncols=columns, frameon=False)

    return fig, axes, add_legend


def best_curves_figure(study, best):
    """Draw no noise against the best noise of each environment: means and standard deviations.

    best: the rows of statistics of these noises.
    """
    labels = ["no noise", "best noise, in the colour of its verdict"]
    steps, below = training_steps(study)
    fig, axes, _ = panels(list(best["environment"]), labels, study.metric, below)
    # Three lines of title above each panel
    fig.subplots_adjust(top=1 - 0.6 / fig.get_figheight(), hspace=0.75)
    configs = {(config.noise, config.noise_rate): config for config in study.finals}
    for ax, row in zip(axes, best.itertuples(), strict=True):
        e = study.environments.index(row.environment)
        color = style.COLORS.get(row.verdict, style.UNCLEAR)
        pairs = (BASELINE, "black"), (configs[row.noise, row.noise_rate], color)
        for config, look in pairs:
            curve(ax, steps, study.curves[config][:, :, e], 0.12, color=look, linewidth=1.6)
        noise = row.noise if len(row.noise) < 50 else f"{row.noise[:47]}..."
        verdict = row.verdict if isinstance(row.verdict, str) else "not judged"
        lines = f"{noise}, {row.noise_rate}\n{verdict} (n = {seeds_of(row.n, row.n_baseline)})"
        style.set_title(ax, row.environment, style.WIDTH / 3, f"\n{lines}")
    handles = [axes[0].lines[0], Rectangle((0, 0), 1, 1, color=style.UNCLEAR)]
    fig.legend(handles, labels, loc="lower center", ncols=2, frameon=False)
    return fig


def training_steps(study):
    """Return the steps of the tests in thousands or millions, and the label of their axis."""
    unit, word = (1e6, "millions") if study.steps[-1] >= 1e6 else (1e3, "thousands")
    return study.steps / unit, f"training steps ({word})"


def curve(ax, x, runs, alpha=0.07, **look):
    """Draw the mean of runs (steps x seeds), and shade one sample standard deviation around it."""
    runs = pd.DataFrame(runs)
    mean, std = runs.mean(axis=1), runs.std(axis=1).fillna(0)
    ax.plot(x, mean, **look)
    ax.fill_between(x, mean - std, mean + std, color=look["color"], alpha=alpha, linewidth=0)


def curves_figure(study, noise):
    """Draw learning curves: mean over seeds, one line per noise rate, shaded standard deviation.

    There is a panel for each environment in which this noise was tried.
    """
    configs = [config for config in study.finals if config.noise in ("", noise)]
    noisy = [config.noise == noise for config in configs]
    counts = np.stack([np.isfinite(study.finals[config]).sum(axis=0) for config in configs])
    tried = np.flatnonzero(counts[noisy].any(axis=0))
    labels = {}  # by the number of the configuration
    for i, n in enumerate(counts[:, tried]):
        name = "no noise" if configs[i] == BASELINE else f"rate {configs[i].noise_rate}"
        if n.any():  # a search has no baseline
            labels[i] = f"{name} (n = {span(n[n > 0])})"  # in the panels that have the line
    environments = [study.environments[e] for e in tried]
    steps, below = training_steps(study)
    texts = list(labels.values())
    fig, axes, add_legend = panels(environments, texts, study.metric, below)
    every = max(1, len(steps) // 8)
    for (e, ax), (i, label) in product(zip(tried, axes, strict=True), labels.items()):
        look = style.line_style(i, len(configs)) | {"linewidth": 1.1 if i else 1.8}
        look |= {"markevery": (min(i, every - 1), every), "markersize": 4.5, "label": label}
        curve(ax, steps, study.curves[configs[i]][:, :, e], **look)
    add_legend()
    return fig


def ablation_figures(study, summary):
    """Yield a Drawing for every wrapper that a study has with several parameters."""
    summary = summary[rows_of(summary, study.key)]
    has_baseline = (summary["noise"] == "").any()  # a search has none
    dotted = "; dotted: no noise" if has_baseline else ""
    single = [config for config in study.finals if len(config.noises) == 1]  # sorted by noise
    for wrapper, configs in groupby(single, lambda config: config.wrappers[0]):
        noises = sorted({config.noise for config in configs})
        if len(noises) > 1:
            caption = (
                f"{study.name}, {wrapper}: final test {study.metric} by parameters and noise rate. "
                f"Bars: mean over n seeds, whiskers {ONE_STD}{dotted}."
            )
            draw = partial(ablation_figure, study, summary, noises, has_baseline)
            yield Drawing("parameters", f"{study.name} {wrapper}", caption, draw)


def ablation_figure(study, summary, noises, has_baseline):
    """Draw bars of the final return: a wrapper's parameters side by side, grouped by noise rate."""
    labels = {}
    for noise in ["", *noises] if has_baseline else noises:
        n = summary.loc[summary["noise"] == noise, "n"]
        labels[noise] = f"{noise or 'no noise'} (n = {span(n)})"
    noisy = summary[summary["noise"].isin(noises)]
    rates = sorted(set(noisy["noise_rate"]), key=rate_order)
    environments = list(noisy["environment"].unique())
    finals = summary.set_index(["environment", "noise", "noise_rate"])[["mean", "std"]]
    texts = list(labels.values())
    fig, axes, add_legend = panels(environments, texts, study.metric, "noise rate")
    width = 0.8 / len(noises)
    for ax, env in zip(axes, environments, strict=True):
        if has_baseline:
            baseline = finals.reindex([(env, BASELINE.noise, BASELINE.noise_rate)])
            bars(ax, [-1], baseline, 0.6, color="white")
            ax.axhline(baseline["mean"].iloc[0], color="black", linewidth=0.6, linestyle=":")
        ax.axhline(0, color="black", linewidth=0.6)
        for i, noise in enumerate(noises):
            rows = finals.reindex([(env, noise, rate) for rate in rates])
            place = np.arange(len(rates)) + width * (i - (len(noises) - 1) / 2)
            color = style.line_style(i + 1, 1 + len(noises))["color"]
            bars(ax, place, rows, width, color=color)
        marks = ({-1: "none"} if has_baseline else {}) | dict(enumerate(rates))
        ax.set_xticks(list(marks), marks.values())
    add_legend()
    return fig


def bars(ax, place, rows, width, **look):
    """Draw bars of the means with whiskers of one standard deviation."""
    whiskers = {"yerr": rows["std"].fillna(0), "capsize": 2, "error_kw": {"elinewidth": 0.8}}
    look |= {"edgecolor": "black", "linewidth": 0.6, "label": "bars"}  # labelled: for the legend
    ax.bar(place, rows["mean"], width, **whiskers, **look)


def robustness_figures(table, metric=RETURN):
    """Yield a heatmap of robustness for every environment of a study."""
    for (*study, environment), rows in table.groupby([*STUDY, "environment"]):
        clean = rows[(rows["noise"] == "") & (rows["test_noise"] == "")]["mean"]
        if len(clean) and len(rows) > 1:
            yield robustness_heatmap(study_name(*study), environment, rows, clean.iloc[0], metric)


def robustness_heatmap(algorithm, environment, rows, clean, metric):
    """Draw training configuration x test condition: the score of every cell.

    That is 100 (R - C) / |C|, or R - C where the clean return C has no percentages.
    """
    in_percent = rows["score_percent"].notna().all()
    unit = "percent of that"
    if not in_percent:
        unit = "percentage points" if metric == SUCCESS else "units of the return"
    values = rows["score_percent"] if in_percent else rows["mean"] - clean
    trained = names_of(rows["noise"], rows["noise_rate"], "no noise")
    tested = names_of(rows["test_noise"], rows["test_rate"], "clean")
    grid = pd.DataFrame({"trained with": trained, "tested with": tested, "value": values})
    grid["dot"] = rows["tested_on"] == "the same noise"
    grid = grid.pivot(index="trained with", columns="tested with").loc[trained.unique()]
    values, dots = (grid[name][tested.unique()] for name in ("value", "dot"))
    limit = style.color_limit(values, 100 if in_percent else np.inf)
    name = f"{algorithm} on {environment}"
    caption = (
        f"{name} (seeds: {span(rows['n'])}): mean {metric} of policies by training and test, as "
        f"its difference from the clean {metric} of policies trained without noise, in {unit}. "
        f"A dot marks a test on the noise of training. The colours end at \u00b1 {limit:.3g}."
    )
    form = (lambda value: percent(value).removesuffix(" %")) if in_percent else rounded
    draw = partial(heatmap_figure, name, values.astype(float), dots.eq(True), limit, form)
    return Drawing("robustness", f"heatmap {algorithm} {environment}", caption, draw)


def names_of(noises, rates, none):
    """Name configurations in training, or conditions of a test; `none` is that without noise."""
    return (noises + ", " + rates).where(noises != "", none)


def heatmap_figure(name, grid, dots, limit, form):
    """Draw a figure of one heatmap: see effects.heatmap."""
    lines, columns = (list(map(style.broken, labels)) for labels in (grid.index, grid.columns))
    high = 0.25 * sum(line.count("\n") + 1 for line in lines) + 0.05 * max(map(len, columns))
    width = min(style.WIDTH, 4 + 0.9 * len(columns))
    fig = Figure(figsize=(width, 1.2 + high), layout="constrained")
    ax = fig.subplots()
    heatmap(ax, grid, limit, form, dots, 8)
    place = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"}
    ax.set_xticks(range(len(columns)), columns, fontsize=8, **place)
    ax.set_yticks(range(len(lines)), lines, fontsize=8)
    ax.set(xlabel=grid.columns.name, ylabel=grid.index.name)
    ax.set_title(textwrap.fill(name, 60), fontsize=9)
    return fig


def write_figure(out, drawing, latex=False):
    """Write {name}.svg, with `latex` also .pdf; without dates, so equal figures are equal files."""
    figure = drawing.draw()
    figure.savefig(out / f"{drawing.name}.svg", metadata={"Date": None})
    if latex:
        figure.set_layout_engine("none")  # the layout is done
        figure.savefig(out / f"{drawing.name}.pdf", metadata={"CreationDate": None})
