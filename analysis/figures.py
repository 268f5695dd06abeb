"""The figures of analyze.py."""

from dataclasses import dataclass
from itertools import product

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text

from analysis.effects import configurations, effects_caption, effects_figure, heatmap
from analysis.formatting import in_metric, slug
from analysis.runs import STUDY, SUCCESS, rows_of, study_name
from analysis.style import (
    COLORS,
    HEIGHT,
    NARROW_WIDTH,
    STYLE,
    UNCLEAR,
    WIDTH,
    WIDTHS,
    broken,
    color_limit,
    line_style,
)
from analysis.verdicts import percent, seeds_of
from noisy_wrappers import BASELINE, rate_order, rounded

matplotlib.rcParams.update(STYLE)


@dataclass
class Drawing:
    """A figure with what the report needs to know of it."""

    kind: str  # effects, best_curves, curves, parameters or robustness
    label: str  # what sets it apart from others of its kind
    figure: Figure
    caption: str
    narrow: Figure | None = None  # the same for narrow windows, where there are many panels

    @property
    def name(self):
        """The name of its files."""
        return f"{self.kind}_{slug(self.label)}"

    @property
    def narrow_name(self):
        """The name of the file of the narrow figure."""
        return f"{self.name}_narrow"


def figures(studies, tables):
    """Yield a Drawing for every figure, in the order of the report."""
    statistics = tables["statistics"].frame
    for study in studies:
        compared = statistics[rows_of(statistics, study.key) & statistics["verdict"].notna()]
        summary = tables[f"summary_{study.algorithm}"].frame
        summary = summary[rows_of(summary, study.key)]
        if len(compared):
            drawing = Drawing("effects", study.name, None, effects_caption(study, compared))
            yield in_both_widths(drawing, compared["environment"], effects_figure, compared)
        best = tables["best"].frame
        best = best[rows_of(best, study.key)]
        noises = sorted({config.noise for config in study.returns if not config.is_baseline})
        if len(best) and len(study.returns) > 2:
            drawing = Drawing("best_curves", study.name, None, best_curves_caption(study))
            what = best_curves_figure, study, best, compared
            yield in_both_widths(drawing, best["environment"], *what)
        for noise in noises or [""]:
            yield curves_figure(study, noise)
        single = [config for config in study.returns if len(config.noises) == 1]
        for wrapper in sorted({config.wrappers[0] for config in single}):
            variants = sorted({config.noise for config in single if config.wrappers == [wrapper]})
            if len(variants) > 1:
                yield ablation_figure(study, summary, wrapper, variants)
    if "robustness" in tables:
        yield from robustness_figures(tables["robustness"].frame, studies[0].metric)


def reword(drawing, metric):
    """Write of success rates, if they are the metric of a Study."""
    drawing.caption = in_metric(drawing.caption, metric)
    for figure in filter(None, (drawing.figure, drawing.narrow)):
        for text in figure.findobj(Text):
            text.set_text(in_metric(text.get_text(), metric))
    return drawing


def in_both_widths(drawing, environments, draw, *what):
    """Complete a Drawing with draw(*what), narrow as well if there are several environments."""
    drawing.figure = draw(*what)
    if environments.nunique() > 1:
        drawing.narrow = draw(*what, narrow=True)
    return drawing


def span(numbers):
    """Write the numbers of seeds or environments behind a line or a panel: "5", or "3 to 5"."""
    low, high = min(numbers, default=0), max(numbers, default=0)
    return f"{low}" if low == high else f"{low} to {high}"


def panels(environments, labels, narrow=False):
    """Make one panel per environment, three in a row, above a legend with as many labels.

    A narrow figure, for a telephone, has one panel in a row.
    """
    across = 1 if narrow else min(3, len(environments))
    width = NARROW_WIDTH if narrow else WIDTHS[across - 1]
    down = -(-len(environments) // across)
    columns = max(1, min(4, int(13 * width / max(map(len, labels)))))
    legend = 0.2 + 0.2 * -(-len(labels) // columns)
    height = max(HEIGHT, 2.4 * down + legend)
    fig = Figure(figsize=(width, height))
    # Placed by hand: matplotlib's automatic layouts take as long as the drawing itself.
    bottom, top = (legend + 0.45) / height, 1 - 0.3 / height
    fig.subplots_adjust(0.9 / width, bottom, 1 - 0.3 / width, top, wspace=0.25, hspace=0.45)
    axes = fig.subplots(down, across, squeeze=False).ravel()
    for ax in axes[len(environments) :]:
        ax.remove()
    for ax, env in zip(axes, environments, strict=False):
        ax.set_title(env)
        ax.yaxis.get_major_locator().set_params(nbins=5)
        if ax.get_subplotspec().is_first_col():
            ax.set_ylabel("test return\n(sum of rewards per episode)")
    axes = axes[: len(environments)]

    def add_legend():
        handles = axes[0].get_legend_handles_labels()[0]
        fig.legend(handles, labels, loc="lower center", ncols=columns, frameon=False)

    return fig, axes, add_legend


def best_curves_caption(study):
    """Say what best_curves_figure shows."""
    return (
        f"{study.name}: test return without noise (black) and with the best noise of each "
        "environment, mean over n seeds, shaded \u00b1 one standard deviation. "
        "The best of many looks better than it is."
    )


def best_curves_figure(study, best, statistics, narrow=False):
    """Draw no noise against the best noise of each environment: means and standard deviations."""
    labels = ["no noise", "best noise, in the colour of its verdict"]
    environments = list(best["environment"])
    fig, axes, _ = panels(environments, labels, narrow)
    # Three lines of title above each panel
    fig.subplots_adjust(top=1 - 0.6 / fig.get_figheight(), hspace=0.75)
    unit, word = time_unit(study)
    configs = {(config.noise, config.noise_rate): config for config in study.returns}
    verdicts = statistics[statistics["scope"] == "environment"]
    verdicts = verdicts.set_index(["environment", "noise", "noise_rate"])["verdict"]
    for ax, row in zip(axes, best.itertuples(), strict=True):
        e = study.environments.index(row.environment)
        verdict = verdicts.get((row.environment, row.noise, row.noise_rate), "")
        pair = {"black": BASELINE, COLORS.get(verdict, UNCLEAR): configs[row.noise, row.noise_rate]}
        for color, config in pair.items():
            mean, std = mean_and_std(study.returns[config][:, :, e])
            ax.plot(study.steps / unit, mean, color=color, linewidth=1.6)
            shade(ax, study.steps / unit, mean, std, color, 0.12)
        noise = row.noise if len(row.noise) < 50 else f"{row.noise[:47]}..."
        lines = f"{noise}, {row.noise_rate}\n{verdict} (n = {seeds_of(row.n, row.n_baseline)})"
        ax.set_title(f"{row.environment}\n{lines}", fontsize=7.5)
        ax.set_xlabel(f"training steps ({word})")
    handles = [axes[0].lines[0], Rectangle((0, 0), 1, 1, color=UNCLEAR)]
    for handle, label in zip(handles, labels, strict=True):
        handle.set_label(label)
    fig.legend(handles, labels, loc="lower center", ncols=1 if narrow else 2, frameon=False)
    return fig


def time_unit(study):
    """Return the unit of the axis of training steps, and its name."""
    return (1e6, "millions") if study.steps[-1] >= 1e6 else (1e3, "thousands")


def mean_and_std(curves):
    """Return mean and sample standard deviation (steps,) of the runs there are (steps x seeds)."""
    curves = curves[:, np.isfinite(curves[-1])]
    mean = curves.mean(axis=1) if curves.size else np.full(len(curves), np.nan)
    return mean, curves.std(axis=1, ddof=1) if curves.shape[1] > 1 else 0


def shade(ax, x, mean, std, color, alpha=0.07):
    """Shade one standard deviation around a line."""
    ax.fill_between(x, mean - std, mean + std, color=color, alpha=alpha, linewidth=0)


def curves_figure(study, noise):
    """Draw learning curves: mean over seeds, one line per noise rate, shaded standard deviation.

    There is a panel for each environment in which this noise was tried.
    """
    configs = [config for config in study.returns if config.noise in ("", noise)]
    noisy = [config.noise == noise for config in configs]
    counts = np.stack([np.isfinite(study.final(config)).sum(axis=0) for config in configs])
    tried = np.flatnonzero(counts[noisy].any(axis=0))
    labels = []
    for config, n in zip(configs, counts[:, tried], strict=True):
        name = "no noise" if config.is_baseline else f"rate {config.noise_rate}"
        labels.append(f"{name} (n = {span(n[n > 0])})")  # in the panels that have the line
    fig, axes, add_legend = panels([study.environments[e] for e in tried], labels)
    unit, word = time_unit(study)
    x, every = study.steps / unit, max(1, len(study.steps) // 8)
    for (e, ax), (i, config) in product(zip(tried, axes, strict=True), enumerate(configs)):
        mean, std = mean_and_std(study.returns[config][:, :, e])
        color, line, marker = line_style(i, len(configs))
        width = 1.8 if config == BASELINE else 1.1
        marks = {"marker": marker, "markevery": (min(i, every - 1), every), "markersize": 4.5}
        ax.plot(x, mean, line, color=color, linewidth=width, label=config.noise_rate, **marks)
        shade(ax, x, mean, std, color)
        ax.set_xlabel(f"training steps ({word})")
    add_legend()
    title = f"{study.name}, {noise or 'no noise'}"
    caption = f"{title}: learning curves, mean over n seeds, shaded \u00b1 one standard deviation."
    return Drawing("curves", title, fig, caption)


def ablation_figure(study, summary, wrapper, noises):
    """Draw bars of the final return: a wrapper's parameters side by side, grouped by noise rate."""
    baseline = summary[summary["noise"] == ""]
    groups = [summary[summary["noise"] == noise] for noise in noises]
    rates = sorted({rate for group in groups for rate in group["noise_rate"]}, key=rate_order)
    labels = [f"no noise (n = {span(baseline['n'])})"]
    for noise, group in zip(noises, groups, strict=True):
        labels.append(f"{noise} (n = {span(group['n'])})")
    tried = set().union(*(group["environment"] for group in groups))
    environments = [env for env in study.environments if env in tried]
    fig, axes, add_legend = panels(environments, labels)
    width = 0.8 / len(noises)
    for ax, env in zip(axes, environments, strict=True):
        rows = baseline[baseline["environment"] == env].set_index("noise_rate")
        rows = rows.reindex([BASELINE.noise_rate])
        bars(ax, [-1], rows, 0.6, color="white", label=labels[0])
        ax.axhline(rows["mean"].iloc[0], color="black", linewidth=0.6, linestyle=":")
        ax.axhline(0, color="black", linewidth=0.6)
        for i, group in enumerate(groups):
            rows = group[group["environment"] == env].set_index("noise_rate").reindex(rates)
            place = np.arange(len(rates)) + width * (i - (len(noises) - 1) / 2)
            color, _, _ = line_style(i + 1, len(labels))
            bars(ax, place, rows, width, color=color, label=labels[i + 1])
        ax.set_xticks([-1, *range(len(rates))], ["none", *rates])
        ax.set_xlabel("noise rate")
    add_legend()
    caption = f"{study.name}, {wrapper}: final test return by parameters and noise rate. "
    caption += "Bars: mean over n seeds, whiskers \u00b1 one standard deviation; dotted: no noise."
    return Drawing("parameters", f"{study.name} {wrapper}", fig, caption)


def bars(ax, place, rows, width, **look):
    """Draw bars of the means with whiskers of one standard deviation."""
    whiskers = {"yerr": rows["std"].fillna(0), "capsize": 2, "error_kw": {"elinewidth": 0.8}}
    ax.bar(place, rows["mean"], width, edgecolor="black", linewidth=0.6, **whiskers, **look)


def robustness_figures(table, metric="return"):
    """Yield a Drawing for every figure of robustness: heatmaps, then curves."""
    for (*study, environment), rows in table.groupby([*STUDY, "environment"]):
        clean = rows[(rows["noise"] == "") & (rows["test_noise"] == "")]["mean"]
        if len(clean) and len(rows) > 1:
            yield robustness_heatmap(study_name(*study), environment, rows, clean.iloc[0], metric)
    for (*study, noise), rows in table.groupby([*STUDY, "test_noise"]):
        of_one_noise = pd.to_numeric(rows["test_rate"], errors="coerce").notna().all()
        if noise and of_one_noise and rows["test_rate"].nunique() >= 3:
            clean = rows_of(table, study) & (table["test_noise"] == "")
            both = pd.concat([table[clean], rows])
            text = f"{study_name(*study)}, tested with {noise}: mean return over seeds against the "
            text += "rate, shaded \u00b1 one standard deviation; a line for each noise in training."
            drawing = Drawing("robustness", f"curves {study_name(*study)} {noise}", None, text)
            yield in_both_widths(drawing, rows["environment"], robustness_curves, both, noise)


def robustness_heatmap(algorithm, environment, rows, clean, metric):
    """Draw training configuration x test condition: the score of every cell.

    That is 100 (R - C) / |C|, or R - C where the clean return C has no percentages.
    """
    in_percent = rows["score_percent"].notna().all()
    unit = "percent of that"
    if not in_percent:
        unit = "percentage points" if metric == SUCCESS else "units of the return"
    grid = by_condition(rows, rows["score_percent"] if in_percent else rows["mean"] - clean)
    limit = color_limit(grid, 100 if in_percent else np.inf)
    name = f"{algorithm} on {environment}"
    caption = (
        f"{name} (seeds: {span(rows['n'])}): mean return of policies by training and test, as its "
        f"difference from the clean return of policies trained without noise, in {unit}. "
        f"A dot marks a test on the noise of training. The colours end at \u00b1 {limit:.3g}."
    )
    same = by_condition(rows, rows["tested_on"] == "the same noise").eq(True)
    form = (lambda value: percent(value).removesuffix(" %")) if in_percent else rounded
    drawing = Drawing("robustness", f"heatmap {algorithm} {environment}", None, caption)
    drawing.figure = heatmap_figure(grid, limit, form, same, name)
    drawing.narrow = heatmap_figure(grid.T, limit, form, same.T, name, narrow=True)
    return drawing


def by_condition(rows, values):
    """Arrange values of rows of robustness as a frame: training x test, in the rows' order."""
    trained = rows["noise"].where(rows["noise"] != "", "no noise") + ", " + rows["noise_rate"]
    tested = rows["test_noise"].where(rows["test_noise"] != "", "clean") + ", " + rows["test_rate"]
    trained = trained.str.replace("no noise, 0.00", "no noise")
    tested = tested.str.replace("clean, 0.00", "clean")
    table = pd.DataFrame({"trained with": trained, "tested with": tested, "value": values})
    table = table.pivot(index="trained with", columns="tested with", values="value")
    return table.reindex(index=trained.unique(), columns=tested.unique())


def heatmap_figure(grid, limit, form, dots, name, narrow=False):
    """Draw a figure of one heatmap; see effects.heatmap."""
    size = 6 if narrow else 8
    lines, columns = ([broken(label) for label in labels] for labels in (grid.index, grid.columns))
    high = 0.25 * sum(line.count("\n") + 1 for line in lines) + 0.05 * max(map(len, columns))
    width = NARROW_WIDTH if narrow else min(WIDTH, 4 + 0.9 * len(columns))
    fig = Figure(figsize=(width, 1.2 + high), layout="constrained")
    ax = fig.subplots()
    heatmap(ax, grid, limit, form, dots, size)
    ax.set_xticks(range(len(columns)), columns, fontsize=size, rotation=35, ha="right")
    ax.set_yticks(range(len(lines)), lines, fontsize=size)
    for text in ax.get_xticklabels():
        text.set_rotation_mode("anchor")
    ax.set(xlabel=grid.columns.name, ylabel=grid.index.name)
    ax.set_title(name, fontsize=9)
    return fig


def robustness_curves(rows, noise, narrow=False):
    """Draw the return against the rate of a test noise: one line per training configuration."""
    configs = configurations(rows)
    labels = [f"{name}, {rate}" if name else "no noise" for name, rate in configs]
    environments = sorted(set(rows[rows["test_noise"] == noise]["environment"]))
    fig, axes, add_legend = panels(environments, labels, narrow)
    for (ax, environment), (i, config) in product(
        zip(axes, environments, strict=True), enumerate(configs)
    ):
        mine = (rows["noise"] == config[0]) & (rows["noise_rate"] == config[1])
        line = rows[mine & (rows["environment"] == environment)]
        line = line.assign(rate=line["test_rate"].astype(float)).sort_values("rate")
        color, dashes, marker = line_style(i, len(configs))
        look = {"color": color, "marker": marker or ".", "label": labels[i]}
        ax.plot(line["rate"], line["mean"], dashes, **look)
        shade(ax, line["rate"], line["mean"], line["std"].astype(float).fillna(0), color)
        ax.set_xlabel("rate of the noise in the test (0: clean)")
    add_legend()
    return fig


def write_figure(out, drawing, latex=False):
    """Write {name}.svg, with `latex` also .pdf; without dates, so equal figures are equal files.

    A narrow figure is for the report only, so it is no .pdf.
    """
    fig = drawing.figure
    fig.savefig(out / f"{drawing.name}.svg", metadata={"Date": None})
    if latex:
        fig.set_layout_engine("none")  # the layout is done
        fig.savefig(out / f"{drawing.name}.pdf", metadata={"CreationDate": None})
    if drawing.narrow:
        drawing.narrow.savefig(out / f"{drawing.narrow_name}.svg", metadata={"Date": None})
