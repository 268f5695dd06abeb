"""Heatmaps of tests under noise: by training and test, and of two noises with a number each."""

from functools import partial

import numpy as np
import pandas as pd

from analysis import style
from analysis.folders import SUCCESS
from analysis.formatting import percent, rounded
from analysis.matrices import matrices
from analysis.runs import STUDY, study_name
from noisy_wrappers import Configuration


def heatmaps(table, metric):
    """Yield label, caption and drawing function of each heatmap; table: that of robustness."""
    for (*study, environment), rows in table.groupby([*STUDY, "environment"]):
        name = f"{study_name(*study)} on {environment}"
        few, many = f"{rows['n'].min():.0f}", f"{rows['n'].max():.0f}"
        about = f"{name} (seeds: {few if few == many else f'{few} to {many}'}): mean {metric}"
        clean = rows[(rows["noise"] == "") & (rows["test_noise"] == "")]["mean"]
        if len(clean) and len(rows) > 1:
            caption, draw = by_training_and_test(name, rows, clean.iloc[0], metric)
            label = f"heatmap {study_name(*study)} {environment}"
            yield label, f"{about} of policies {caption}", draw
        tests = [Configuration.parse(*test) for test in rows[["test_noise", "test_rate"]].values]
        for matrix in matrices(dict.fromkeys(tests)):
            caption = (
                f"{about} in tests under {matrix.name}, by training. All panels have the same "
                "colours; lighter is higher."
            )
            draw = partial(matrix_figure, matrix, rows.assign(test=tests), metric)
            yield f"matrix {name} {matrix.name}", caption, draw


def by_training_and_test(name, rows, clean, metric):
    """Return the caption and the drawing function of training configuration x test condition.

    A cell is 100 (R - C) / |C|, or R - C where the clean return C has no percentages.
    """
    values, unit, form = rows["score_percent"], "percent of that", percent
    limit = np.clip(abs(values).max(), 10, 100)  # small ones are pale
    if values.isna().any():
        values, form = rows["mean"] - clean, rounded
        unit = "percentage points" if metric == SUCCESS else "units of the return"
        limit = abs(values).max() or 1.0
    trained = named(rows["noise"], rows["noise_rate"], "no noise")
    tested = named(rows["test_noise"], rows["test_rate"], "clean")
    texts = [form(value).removesuffix(" %") for value in values]
    cells = pd.DataFrame({"trained with": trained, "tested with": tested, "number": values})
    cells = cells.assign(text=texts, dot=rows["tested_on"] == "the same noise")
    grid = cells.pivot(index="trained with", columns="tested with").loc[trained.unique()]
    grid = {part: grid[part][tested.unique()] for part in ("number", "text", "dot")}
    frames = grid["number"].astype(float), grid["text"], grid["dot"].eq(True)
    caption = (
        f"by training and test, as its difference from the clean {metric} of policies trained "
        f"without noise, in {unit}. A dot marks a test on the noise of training. The colours end "
        f"at \u00b1 {limit:.3g}."
    )
    look = {"cmap": style.DIVERGING, "vmin": -limit, "vmax": limit}
    return caption, partial(heatmap_figure, {name: frames}, look, "tested with")


def named(noises, rates, none):
    """Name configurations; `none` is that without noise."""
    return (noises + ", " + rates).where(noises != "", none)


def matrix_figure(matrix, rows, metric, width):
    """Draw a panel for each configuration of training, with the mean in every cell."""
    panels = {}
    for (noise, rate), tests in rows.groupby(["noise", "noise_rate"], sort=False):
        tests = tests.set_index("test")
        texts = {test: rounded(row["mean"], row["std"]) for test, row in tests.iterrows()}
        title = f"trained with {noise}, {rate}" if noise else "trained without noise"
        numbers = matrix.frame(tests["mean"]).astype(float)
        no_dots = pd.DataFrame(False, numbers.index, numbers.columns)
        panels[title] = numbers, matrix.frame(texts), no_dots
    values = np.concatenate([numbers.to_numpy().ravel() for numbers, *_ in panels.values()])
    look = {"cmap": "viridis", "vmin": np.nanmin(values), "vmax": np.nanmax(values)}
    return heatmap_figure(panels, look, matrix.name, width, f"mean {metric}")


def heatmap_figure(panels, look, below, width=None, bar=""):
    """Draw frames of one shape: {title: (numbers, their texts, where a dot stands)}.

    look: of imshow; bar: the label of a bar of colours. Texts are left out where cells are too
    small. In a column the longer side is down.
    """
    width = width or style.PAGE
    numbers, *_ = next(iter(panels.values()))
    if width <= style.COLUMN and numbers.shape[1] > numbers.shape[0]:
        panels = {title: [frame.T for frame in frames] for title, frames in panels.items()}
        numbers, below = numbers.T, numbers.index.name or below
    lines = [style.fitted(label, min(2.1, 0.5 * width)) for label in numbers.index]
    columns = [style.fitted(label, 1.6) for label in numbers.columns]
    longest = max(map(style.inches_of, columns))
    widest = max(
        style.inches_of(text)
        for _, texts, _ in panels.values()
        for text in texts.to_numpy().ravel()
        if isinstance(text, str)
    )
    beside = max(map(style.inches_of, lines)) + (2 * style.LINE if numbers.index.name else 0.12)
    least = beside + (widest + 0.08) * len(columns)
    _, slot = style.row_of(len(panels), width, least, 0.0)
    cell = (slot - beside) / len(columns) - 0.02
    height = style.LINE * (0.4 + max(label.count("\n") + 1 for label in (*lines, *columns)))
    fig, axes = style.panels(
        [[title] for title in panels],
        width,
        [height * len(lines)] * len(panels),
        least=least,
        left=0.0,
        beside=beside,
        below=below,
        legend=0.55 if bar else 0.0,
        ticks=longest + 0.15 if longest > cell else style.TICKS,
    )
    for ax, (numbers, texts, dots) in zip(axes, panels.values(), strict=True):
        image = ax.imshow(numbers, aspect="auto", **look)
        for (i, j), number in np.ndenumerate(numbers.to_numpy()):
            if not np.isnan(number) and widest <= cell:
                brightness = np.dot(image.cmap(image.norm(number))[:3], (0.3, 0.6, 0.1))
                ink = "black" if brightness > 0.45 else "white"
                ax.text(j, i, texts.iat[i, j], ha="center", va="center", color=ink)
            if dots.iat[i, j]:
                ax.plot(j + 0.36, i - 0.28, "o", color="black", markersize=2)
        ax.set_xticks(range(len(columns)), columns, rotation=90 if longest > cell else 0)
        ax.set_yticks(range(len(lines)), lines)
        ax.tick_params(length=0, pad=3)
        ax.set_facecolor("0.93")  # where there was no test
    if numbers.index.name:
        middle = axes[0].get_position().intervaly.mean()
        fig.text(0.03 / width, middle, numbers.index.name, rotation=90, va="center", ha="left")
    if bar:
        inch = 1 / fig.get_figheight()
        place = fig.add_axes([0.25, 0.38 * inch, 0.5, 0.08 * inch])
        fig.colorbar(image, cax=place, orientation="horizontal", label=bar)
    return fig
