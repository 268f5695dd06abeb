"""Heatmaps of tests under two noises with one number each: see analysis/matrices.py."""

from functools import partial

import numpy as np
from matplotlib.figure import Figure

from analysis import style
from analysis.folders import RETURN
from analysis.formatting import rounded
from analysis.matrices import matrices
from analysis.runs import STUDY, study_name
from noisy_wrappers import Configuration

ACROSS = 3  # panels in a row


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


def heatmaps_figure(matrix, rows, metric):
    """Draw a panel for each configuration of training, with the mean in every cell."""
    panels = []
    for (noise, rate), tests in rows.groupby(["noise", "noise_rate"], sort=False):
        tests = tests.set_index("test")
        texts = {test: rounded(row["mean"], row["std"]) for test, row in tests.iterrows()}
        trained = f"trained with {noise}, {rate}" if noise else "trained without noise"
        panels.append((trained, matrix.frame(tests["mean"]), matrix.frame(texts)))
    values = np.concatenate([means.to_numpy(float).ravel() for _, means, _ in panels])
    low, high = np.nanmin(values), np.nanmax(values)
    lines, columns = panels[0][1].shape
    across = min(ACROSS, len(panels))
    down = -(-len(panels) // across)
    width, height = max(3.2, 0.9 + 0.55 * columns), 0.9 + 0.3 * lines
    title_size = min(9, 100 * width / max(len(trained) for trained, _, _ in panels))
    fig = Figure(figsize=(across * width + 0.8, down * height + 0.3), layout="constrained")
    axes = fig.subplots(down, across, squeeze=False).ravel()
    for ax, (trained, means, texts) in zip(axes, panels, strict=False):
        means = means.to_numpy(float)
        image = ax.imshow(means, cmap=style.viridis, vmin=low, vmax=high, aspect="auto")
        for (i, j), mean in np.ndenumerate(means):
            if not np.isnan(mean):
                ink = "black" if mean > low + 0.6 * (high - low) else "white"
                ax.text(j, i, texts.iat[i, j], fontsize=7, ha="center", va="center", color=ink)
        ax.set_xticks(range(columns), texts.columns, fontsize=7)
        ax.set_yticks(range(lines), texts.index, fontsize=7)
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        ax.set_facecolor("0.93")  # where there was no test
        ax.set_title(trained, fontsize=title_size)
    for ax in axes[len(panels) :]:
        ax.remove()
    fig.supxlabel(matrix.name, fontsize=8)
    bar = fig.colorbar(image, ax=list(axes[: len(panels)]), label=f"mean {metric}", pad=0.01)
    bar.ax.tick_params(labelsize=7)
    return fig
