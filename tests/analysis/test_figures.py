"""The figures of analyze.py: what stands where, in which colour, with which n, at which size."""

from itertools import combinations, product

import numpy as np
import pandas as pd
import pytest
from sweeps import ENDING, NAN, SCALE, drawn_of, run, small_sweep, write_pairs, write_run

import analysis.effects
import analysis.figures
import analysis.heatmap
import analysis.style
from analysis.runs import read_runs
from analysis.studies import make_studies
from noisy_wrappers import BASELINE, Configuration

OTHER = "RandomUniformScaleReward(0.8, 1.2)"
ENVS = ["Ant-v5", "Hopper-v5", "my_envs:Warehouseconveyorpicking-v1", "Pusher-v5", "Walker2d-v5"]


def texts(items):
    return [item.get_text() for item in items]


def titles(figure):
    return [ax.get_title() for ax in figure.axes]


@pytest.fixture(scope="module")
def five(tmp_path_factory):
    """Five environments of several scales; one noise of two parameters, and another one."""
    path = tmp_path_factory.mktemp("five")
    levels = dict(zip(ENVS, (12_000, 2900, 0.4, -25, 1e6), strict=True))
    configs = [("", 0.0), *product((SCALE, OTHER, ENDING), (0.05, 0.2, 1.0))]
    for (env, level), (i, (noise, rate)), seed in product(
        levels.items(), enumerate(configs), (1, 2, 3)
    ):
        final = level * (1 + 0.03 * i + 0.1 * np.sin(7 * seed + i))
        more = {"noise": noise, "rate": rate} if noise else {}
        write_run(path, [0.3 * final, final], env=env, seed=seed, every=500_000, **more)
    return drawn_of(path)


def check_room(figure, name):
    """Check that all text has eight points, that no two touch, and that nothing is cut off."""
    figure.draw_without_rendering()
    marks = list(figure.texts)
    for legend in figure.legends:
        marks += [legend.get_title(), *legend.get_texts()]
    for ax in figure.axes:
        marks += [ax.title, *ax.texts, *ax.get_xticklabels(), *ax.get_yticklabels()]
    marks = [text for text in marks if text.get_text() and text.get_visible()]
    assert {text.get_fontsize() for text in marks} == {8}
    boxes = {text: text.get_window_extent() for text in marks}
    for text, box in boxes.items():
        assert box.x0 >= -1 and box.x1 <= figure.bbox.x1 + 1, (name, text)
        assert box.y0 >= -1 and box.y1 <= figure.bbox.y1 + 1, (name, text)
    for one, other in combinations(boxes, 2):
        touches = boxes[one].padded(-1).overlaps(boxes[other].padded(-1))
        assert not touches, (name, one.get_text(), other.get_text())


@pytest.mark.parametrize("width", [3.25, 6.75])
def test_all_text_has_eight_points_and_room(width, five):
    """Five environments stand in one row of a page, and in a column each has a row."""
    assert len(five) == 6
    for name, drawing in five.items():
        figure = drawing.draw(width)
        assert figure.get_figwidth() == width
        check_room(figure, name)
        across = len({round(ax.get_position().x0, 3) for ax in figure.axes})
        assert across == {3.25: 1, 6.75: 5}[width]


@pytest.mark.parametrize("width", [3.25, 6.75])
def test_a_heatmap_has_room(width):
    tested = ["clean", *(f"{noise}, {rate}" for noise in (SCALE, OTHER) for rate in (0.1, 0.5, 1))]
    grid = pd.DataFrame(-12.5, index=["no noise", f"{SCALE}, 1.00"], columns=tested)
    grid = grid.rename_axis(index="trained with", columns="tested with")
    panels = {"PPO": (grid, grid.astype(str), grid > 0)}
    look = {"cmap": "viridis", "vmin": -20, "vmax": 0}
    figure = analysis.heatmap.heatmap_figure(panels, look, "tested with", width)
    check_room(figure, "robustness")
    assert len(figure.axes[0].texts) == 14


def test_effects_are_rows_with_filled_marks_where_verdicts_are_clear(tmp_path):
    """Each panel has the marks of what was tried there; an environment without noise has none."""
    for seed in range(1, 6):
        write_run(tmp_path, [100 + seed], env="Ant-v5", seed=seed)
        for env, noise, factor in (("Hopper-v5", SCALE, 1.5), ("Walker2d-v5", ENDING, 0.5)):
            write_run(tmp_path, [100 + seed], env=env, seed=seed)
            write_run(tmp_path, [factor * (100 + seed)], env=env, seed=seed, noise=noise, rate=0.1)
            write_run(tmp_path, [100 + seed], env=env, seed=seed, noise=noise, rate=0.2)
    figure = drawn_of(tmp_path)["effects_SAC"].draw()
    assert titles(figure) == ["Hopper-v5\nn = 5", "Walker2d-v5\nn = 5"]
    first = figure.axes[0]
    assert texts(first.get_yticklabels()) == ["0.10", "0.20", "0.10", "0.20"]
    places, looks = list(first.get_yticks()), []
    for ax in figure.axes:
        marks = [line for line in ax.lines if line.get_marker() == "o"]
        found = {places.index(line.get_ydata()[0]): line.get_markerfacecolor() for line in marks}
        looks.append(found)
    better, worse = analysis.style.BETTER, analysis.style.WORSE
    assert looks == [{2: better, 3: "white"}, {0: worse, 1: "white"}]


def test_a_band_is_the_interval_of_the_mean_from_five_runs_on_or_a_deviation():
    runs = np.array([[2.0, 4, 6, 8, 10], [2.0, 4, 6, 8, NAN]])
    mean, low, high = analysis.figures.band_of(runs, "interval")
    half = 2.776445 * np.sqrt(10 / 5)  # Student's t of four degrees of freedom
    assert mean.tolist() == [6, 5] and np.isnan([low, high]).tolist() == 2 * [[False, True]]
    assert high[0] == pytest.approx(6 + half)
    _, low, high = analysis.figures.band_of(runs, "std")
    assert (high - low).tolist() == pytest.approx([2 * np.sqrt(10), 2 * np.sqrt(20 / 3)])
    # it has a width where all succeed
    _, low, high = analysis.figures.band_of(np.full((1, 5), 100.0), "interval", episodes=10)
    rate = 51 / 52  # of fifty episodes, with a success and a failure more
    half = 2.776445 * 100 * np.sqrt(rate * (1 - rate) / 52)
    assert high.tolist() == [100] and low.tolist() == pytest.approx([100 - half])


@pytest.mark.parametrize("seeds", [3, 4, 5])
def test_few_seeds_are_shown_with_what_could_be_found(seeds, tmp_path):
    """As the column detectable has it; three against three find nothing, however large."""
    noisy, baseline = 20.0 * np.arange(seeds), 10.0 * np.arange(7 if seeds == 4 else seeds)
    write_pairs(tmp_path / "runs", baseline, noisy)
    found = run(tmp_path)["noises"]["detectable"].item()
    [ax] = drawn_of(tmp_path / "runs")["effects_SAC"].draw().axes
    dots = [line.get_xdata().tolist() for line in ax.lines if line.get_marker() == "."]
    bars = [bar.get_segments()[0][:, 0] for bar in ax.collections]
    whole = [line for line in ax.lines if line.get_linewidth() == 6]
    assert np.isnan(found) == (len(whole) == 1) == (seeds == 3)
    shown = [values - baseline.mean() for values in (baseline, noisy) if len(values) < 5]
    assert dots == [pytest.approx(values) for values in shown]
    if seeds == 4:
        assert bars == [pytest.approx([-found, found])]
        low, high = ax.get_xlim()
        assert low < -found and high > found


def test_effects_of_many_configurations_have_a_line_a_noise(tmp_path):
    rates = [0.01 * i for i in range(1, analysis.effects.MOST_RATES + 2)]
    for seed in range(1, 8):
        write_run(tmp_path, [100 + seed], seed=seed)
    for seed, rate in enumerate(rates):
        write_run(tmp_path, [150 + seed % 7], seed=seed, noise=SCALE, rate=rate)
    [ax] = drawn_of(tmp_path)["effects_SAC"].draw().axes
    assert texts(ax.get_yticklabels()) == [f"{len(rates)} rates"]
    [mark] = [line for line in ax.lines if line.get_marker() == "o"]
    assert mark.get_xdata()[0] == pytest.approx(49, abs=0.5)
    assert mark.get_markerfacecolor() == analysis.style.BETTER


def test_curves_have_the_noise_units_and_n(tmp_path):
    small_sweep(tmp_path)
    drawings = drawn_of(tmp_path)
    figure = drawings["curves_SAC_RandomUniformScaleReward_0.5_1.5"].draw()
    lines = ["no noise", "rate 0.05", "rate 0.20"]
    assert texts(figure.legends[0].get_texts()) == lines
    assert titles(figure) == ["Hopper-v5\nn = 4", "Pusher-v5\nn = 4"]
    hopper = [line for line in figure.axes[0].lines if line.get_linewidth() > 1]
    assert len(figure.axes[0].lines) == 3 + 12  # with four seeds a thin line for each
    assert hopper[1].get_ydata().tolist() == pytest.approx([29, 58, 87, 116, 145])
    assert len({line.get_color() for line in hopper}) == 3
    best = drawings["best_curves_SAC"].draw()
    assert f"{SCALE} at rate 0.05" in texts(best.legends[0].get_texts())


def test_curves_have_only_what_was_run(tmp_path):
    """No panel where a noise was not tried, and nothing of the baseline that a search lacks."""
    small_sweep(tmp_path)
    [study], _ = make_studies(read_runs(tmp_path))
    for config in study.finals:
        study.finals[config][:, 0] = NAN if config.noise == ENDING else 1.0
    assert titles(analysis.figures.noise_figure(study, ENDING)) == ["Pusher-v5\nn = 4"]
    study.finals[Configuration.parse(SCALE, 0.05)][:, 0] = NAN
    study.finals[BASELINE][:] = NAN
    figure = analysis.figures.noise_figure(study, SCALE)
    assert texts(figure.legends[0].get_texts()) == ["rate 0.05", "rate 0.20"]
    assert len(figure.axes) == 2
    scaled = [config for config in study.finals if config.noise == SCALE]
    figure = analysis.figures.parameters_figure(study, scaled)
    assert texts(figure.legends[0].get_texts()) == [SCALE]
    assert texts(figure.axes[0].get_xticklabels()) == ["0.05", "0.20"]


def test_parameters_are_points_side_by_side(tmp_path):
    finals = {(): 10, (SCALE, 0.05): 20, (OTHER, 0.05): 30, (OTHER, 0.5): 40}
    for config, seed in product(finals, range(1, 6)):
        more = dict(zip(("noise", "rate"), config, strict=False))
        write_run(tmp_path, [finals[config] * seed], seed=seed, **more)
    drawings = drawn_of(tmp_path)
    [ax] = drawings["curves_SAC_RandomUniformScaleReward_0.5_1.5"].draw().axes
    assert len(ax.collections) == 2  # shaded: with five seeds there are intervals
    figure = drawings["parameters_SAC_RandomUniformScaleReward"].draw()
    [ax] = figure.axes
    points = {c.lines[0].get_xdata()[0]: c.lines[0].get_ydata()[0] for c in ax.containers}
    assert list(points.values()) == [30, 60, 90, 120]
    assert list(points) == pytest.approx([0, 1 - 0.175, 1 + 0.175, 2 + 0.175])
    half = 2.7764 * np.std([20, 40, 60, 80, 100], ddof=1) / np.sqrt(5)
    whisker = ax.containers[1].lines[2][0].get_segments()[0][:, 1]
    assert whisker == pytest.approx([60 - half, 60 + half], rel=1e-4)
    assert texts(ax.get_xticklabels()) == ["none", "0.05", "0.50"]
    assert texts(figure.legends[0].get_texts()) == ["no noise", SCALE, OTHER]


def test_figures_of_experiments_with_similar_names_have_names_of_their_own(tmp_path):
    """Names that are one as a file's, and one that is longer than a file's may be."""
    for name in ("lr 1", "lr_1", 30 * "a_long_name_"):
        write_run(tmp_path, [10], folder=name[:9], exp_name=name)
        write_run(tmp_path, [9], folder=f"{name[:9]}-p", noise=SCALE, rate=0.1, exp_name=name)
    names = drawn_of(tmp_path).keys()
    assert {"effects_SAC_lr_1", "effects_SAC_lr_1_again"} <= names
    assert max(map(len, names)) < 200
