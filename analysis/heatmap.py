"""Heatmaps of tests under two noises with one number each: see analysis/matrices.py."""

from functools import partial

import numpy as np

from analysis import style
from analysis.folders import RETURN
from analysis.formatting import rounded
from analysis.matrices import matrices
from analysis.runs import STUDY, study_name
from noisy_wrappers import Configuration


def heatmaps(table, metric=RETURN):
    """Yield label, caption and drawing function for each Matrix that was tested.

    table: the frame of the table `robustness`. Each study and environment has its own.
    """
    for (*study, environment), rows in table.groupby([*STUDY, "environment"]):
        tests = [Configuration.parse(*test) for test in rows[["test_noise", "test_rate"]].values]
        rows = rows.assign(test=tests)
        for matrix in matrices(dict.fromkeys(tests)):
            name = f"{study_name(*study)} on {environment}"
            few, many = rows["n"].min(), rows["n"].max()
            seeds = f"{few}" if few == many else f"{few} to {many}"
            caption = (
                f"{name} (seeds: {seeds}): mean {metric} in tests under {matrix.name}, by "
                "training. All panels have the same colours; lighter is higher."
            )
            draw = partial(heatmaps_figure, matrix, rows, metric)
            yield f"matrix {name} {matrix.name}", caption, draw


def heatmaps_figure(matrix, rows, metric, width):
    """Draw a panel for each configuration of training, with the mean in every cell."""
    titles, frames, texts = [], [], []
    for (noise, rate), tests in rows.groupby(["noise", "noise_rate"], sort=False):
        tests = tests.set_index("test")
        numbers = {test: rounded(row["mean"], row["std"]) for test, row in tests.iterrows()}
        titles.append([f"trained with {noise}, {rate}" if noise else "trained without noise"])
        frames.append(matrix.frame(tests["mean"]).astype(float))
        texts.append(matrix.frame(numbers))
    values = np.concatenate([means.to_numpy().ravel() for means in frames])
    low, high = np.nanmin(values), np.nanmax(values)
    lines, columns = map(list, (texts[0].index, texts[0].columns))
    beside = max(map(style.inches_of, lines)) + 0.12
    cell = max(style.inches_of(str(text)) for frame in texts for text in frame.to_numpy().ravel())
    cell = max(cell, *map(style.inches_of, columns)) + 0.08
    fig, axes = style.panels(
        titles,
        width,
        [0.05 + 1.3 * style.LINE * len(lines)] * len(titles),
        least=beside + cell * len(columns),
        left=0.0,
        beside=beside,
        below=matrix.name,  # the noise of the tests
        legend=0.55,
    )
    for ax, means, numbers in zip(axes, frames, texts, strict=True):
        means = means.to_numpy()
        image = ax.imshow(means, cmap="viridis", vmin=low, vmax=high, aspect="auto")
        for (i, j), mean in np.ndenumerate(means):
            if not np.isnan(mean):
                ink = "black" if mean > low + 0.6 * (high - low) else "white"
                ax.text(j, i, numbers.iat[i, j], ha="center", va="center", color=ink)
        ax.set_xticks(range(len(columns)), columns)
        ax.set_yticks(range(len(lines)), lines)
        ax.tick_params(length=0, pad=3)
        ax.spines[:].set_visible(False)
        ax.set_facecolor("0.93")  # where there was no test
    bar = fig.add_axes([0.25, 0.38 / fig.get_figheight(), 0.5, 0.08 / fig.get_figheight()])
    fig.colorbar(image, cax=bar, orientation="horizontal", label=f"mean {metric}")
    return fig
