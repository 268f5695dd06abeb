"""The figures of analyze.py."""

from dataclasses import dataclass
from itertools import product

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text

from analysis.effects import effects_caption, effects_figure
from analysis.formatting import in_metric, slug
from analysis.runs import STUDY, rows_of, study_name
from analysis.style import (
    COLORS,
    DIVERGING,
    HEIGHT,
    NARROW_WIDTH,
    STYLE,
    UNCLEAR,
    WIDTH,
    WIDTHS,
    broken,
    color_limit,
    ink_on,
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
        yield from robustness_figures(tables["robustness"].frame)


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
    """Spell the numbers of seeds or environments behind a line or a panel: "5", or "3 to 5"."""
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
            low, high = mean - std, mean + std
            ax.fill_between(study.steps / unit, low, high, color=color, alpha=0.12, linewidth=0)
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
        ax.fill_between(x, mean - std, mean + std, color=color, alpha=0.07, linewidth=0)
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


def heatmap(grid, label, form, framed=None, below=0.9):
    """Draw numbers (rows x columns), each in its cell as form(number): return figure, axes, limit.

    The colours fit the data and end at \u00b1 `limit`, which for percent is at most 100; `label`
    names their unit. `framed` marks cells (as `grid`, of bool); `below` is the space in inches for
    the names of the columns.
    """
    limit = color_limit(grid, 100 if label == "percent" else np.inf)
    rows, columns = ([broken(name) for name in names] for names in (grid.index, grid.columns))
    lines = max(name.count("\n") for name in rows) + 1
    longest = max(len(line) for name in rows for line in name.split("\n"))
    left = 0.4 + 0.075 * longest
    wide = min(1.2 * len(columns), WIDTH - left - 1.5)
    high = max(0.5, 0.17 * lines) * len(rows)
    height = 0.5 + high + below
    fig = Figure(figsize=(WIDTH, height))
    ax = fig.add_axes([left / WIDTH, below / height, wide / WIDTH, high / height])
    image = ax.imshow(grid, cmap=DIVERGING, vmin=-limit, vmax=limit, aspect="auto")
    for (i, j), value in np.ndenumerate(grid.to_numpy()):
        if np.isfinite(value):
            ink = ink_on(value, limit)
            ax.text(j, i, form(value), ha="center", va="center", color=ink, fontsize=8)
        if framed is not None and framed.iat[i, j]:
            box = Rectangle((j - 0.46, i - 0.46), 0.92, 0.92, fill=False, edgecolor="black", lw=1.5)
            ax.add_patch(box)
    ax.set_xticks(range(len(columns)), columns)
    ax.set_yticks(range(len(rows)), rows)
    bar = fig.add_axes([(left + wide + 0.2) / WIDTH, below / height, 0.15 / WIDTH, high / height])
    clipped = np.nanmax(np.abs(grid.to_numpy())) > limit
    fig.colorbar(image, cax=bar, extend="both" if clipped else "neither", label=label)
    return fig, ax, limit


def robustness_figures(table):
    """Yield a Drawing for every figure of robustness: heatmaps, then curves."""
    for (*study, environment), rows in table.groupby([*STUDY, "environment"]):
        clean = rows[(rows["noise"] == "") & (rows["test_noise"] == "")]["mean"]
        if len(clean) and len(rows) > 1:
            yield robustness_heatmap(study_name(*study), environment, rows, clean.iloc[0])
    for (*study, noise), rows in table.groupby([*STUDY, "test_noise"]):
        of_one_noise = pd.to_numeric(rows["test_rate"], errors="coerce").notna().all()
        if noise and of_one_noise and rows["test_rate"].nunique() >= 3:
            clean = rows_of(table, study) & (table["test_noise"] == "")
            yield robustness_curves(study_name(*study), noise, pd.concat([table[clean], rows]))


def robustness_heatmap(algorithm, environment, rows, clean):
    """Draw training configuration x test condition: the score of every cell.

    That is 100 (R - C) / |C|, or R - C where the clean return C has no percentages.
    """
    trained = rows["noise"].where(rows["noise"] != "", "no noise") + ", " + rows["noise_rate"]
    tested = rows["test_noise"].where(rows["test_noise"] != "", "clean") + ", " + rows["test_rate"]
    in_percent = rows["score_percent"].notna().all()
    cells = rows.assign(
        trained=trained.str.replace("no noise, 0.00", "no noise"),
        tested=tested.str.replace("clean, 0.00", "clean"),
        score=rows["score_percent"] if in_percent else rows["mean"] - clean,
        same=rows["tested_on"] == "the same noise",
    )
    # Rows and columns stand in the order of the table, which is that of noises and rates.
    order = {"index": cells["trained"].unique(), "columns": cells["tested"].unique()}
    axes = {"index": "trained", "columns": "tested"}
    grid = cells.pivot(**axes, values="score").reindex(**order)
    same = cells.pivot(**axes, values="same").reindex(**order).eq(True)
    label, form = "difference in return", rounded
    if in_percent:
        label, form = "percent", lambda value: percent(value).removesuffix(" %")
    longest = max(map(len, grid.columns))
    fig, ax, limit = heatmap(grid, label, form, same, below=0.7 + 0.05 * longest)
    ax.tick_params(axis="x", rotation=35)
    for text in ax.get_xticklabels():
        text.set(ha="right", rotation_mode="anchor")
    ax.set_title(f"{algorithm} on {environment}: trained with (rows), tested with (columns)")
    caption = (
        f"{algorithm} on {environment} (seeds: {span(rows['n'])}): mean return under the noise "
    )
    caption += "of the column, of policies trained with the noise of the row, as its difference "
    caption += "from the clean return of policies trained without noise"
    caption += (
        ", in percent of that. " if in_percent else ", which is not clearly unequal to zero. "
    )
    caption += f"Framed: tested on the noise of training. The colours end at \u00b1 {limit:.3g}."
    return Drawing("robustness", f"heatmap {algorithm} {environment}", fig, caption)


def robustness_curves(algorithm, noise, rows):
    """Draw the return against the rate of a test noise: one line per training configuration."""
    configs = list(dict.fromkeys(zip(rows["noise"], rows["noise_rate"], strict=True)))
    configs.sort(key=lambda config: (config[0], rate_order(config[1])))
    labels = [f"{noise}, {rate}" if noise else "no noise" for noise, rate in configs]
    environments = sorted(set(rows[rows["test_noise"] == noise]["environment"]))
    fig, axes, add_legend = panels(environments, labels)
    for (ax, environment), (i, config) in product(
        zip(axes, environments, strict=True), enumerate(configs)
    ):
        mine = (rows["noise"] == config[0]) & (rows["noise_rate"] == config[1])
        line = rows[mine & (rows["environment"] == environment)]
        line = line.assign(rate=line["test_rate"].astype(float)).sort_values("rate")
        color, dashes, marker = line_style(i, len(configs))
        std = line["std"].astype(float).fillna(0)
        look = {"color": color, "marker": marker or ".", "label": labels[i]}
        ax.plot(line["rate"], line["mean"], dashes, **look)
        ax.fill_between(
            line["rate"], line["mean"] - std, line["mean"] + std, color=color, alpha=0.07, lw=0
        )
        ax.set_xlabel("rate of the noise in the test (0: clean)")
    add_legend()
    caption = f"{algorithm}, tested with {noise}: mean return over seeds against the rate, shaded "
    caption += "\u00b1 one standard deviation; one line for each noise in training."
    return Drawing("robustness", f"curves {algorithm} {noise}", fig, caption)


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
