"""The figures of analyze.py: what stands where, in which colour, with which n."""

import re
from itertools import product

import numpy as np
import pandas as pd
import pytest
from sweeps import ENDING, NAN, RESULTS, SCALE, drawn_of, small_sweep, write_run

import analysis.effects
import analysis.figures
import analysis.style
from analysis.runs import read_runs
from analysis.studies import make_studies
from noisy_wrappers import BASELINE, Configuration

OTHER = "RandomUniformScaleReward(0.8, 1.2)"


def texts(items):
    return [item.get_text() for item in items]


def test_effects_have_in_every_environment_the_rows_that_were_tried_there(tmp_path):
    """A filled mark in the colour of a clear verdict, a hollow grey one for the others."""
    for seed in range(1, 6):
        write_run(tmp_path, [100 + seed], env="Ant-v5", seed=seed)  # no noise, no panel
        for env, noise, factor in (("Hopper-v5", SCALE, 1.5), ("Walker2d-v5", ENDING, 0.5)):
            write_run(tmp_path, [100 + seed], env=env, seed=seed)
            write_run(tmp_path, [factor * (100 + seed)], env=env, seed=seed, noise=noise, rate=0.1)
            write_run(tmp_path, [100 + seed], env=env, seed=seed, noise=noise, rate=0.2)
    drawing = drawn_of(tmp_path)["effects_SAC"]
    figure = drawing.draw()
    assert [ax.get_title() for ax in figure.axes] == ["Hopper-v5", "Walker2d-v5"]
    labels = [texts(ax.get_yticklabels()) for ax in figure.axes]
    tried = [SCALE.replace("(", "\n("), ENDING]
    assert labels == [[f"{noise}, {rate}" for rate in ("0.10", "0.20")] for noise in tried]
    assert "Filled marks are clear verdicts." in drawing.caption
    looks = []
    for ax in figure.axes:
        marks = [line for line in ax.lines if line.get_marker() == "o"]
        looks.append({line.get_ydata()[0]: line.get_markerfacecolor() for line in marks})
    better, worse = analysis.style.BETTER, analysis.style.WORSE
    assert looks == [{0: better, 1: "white"}, {0: worse, 1: "white"}]
    assert texts(figure.axes[0].texts) == ["5", "5", "n"]


def test_an_infinite_effect_has_the_strongest_colour():
    ax, grid = analysis.effects.Figure().subplots(), pd.DataFrame([[np.inf, 1.0], [NAN, -2.0]])
    image = analysis.effects.heatmap(ax, grid, 2.0, "{:+.1f}".format, grid.isna() & False, 6)
    assert image.get_array().tolist() == [[2.0, 1.0], [None, -2.0]]
    assert texts(ax.texts) == ["+inf", "+1.0", "-2.0"]


def test_the_id_of_an_environment_fits_above_its_panel():
    ax = analysis.effects.Figure(figsize=(3, 3)).subplots()
    analysis.style.set_title(ax, "my_company_robotics.envs:WarehousePickAndPlaceDense-v12", 3)
    assert ax.get_title() == "WarehousePickAndPlaceDense-v12" and ax.title.get_fontsize() == 9
    analysis.style.set_title(ax, "A" * 60, 3)
    assert ax.title.get_fontsize() < 9


def test_effects_of_many_configurations_are_a_heatmap(tmp_path):
    rates = [0.01 * i for i in range(1, analysis.effects.MOST_IN_FOREST + 2)]
    for seed in range(1, 8):
        write_run(tmp_path, [100], seed=seed)
        for i, rate in enumerate(rates):
            effect = {0: 30 + seed, 1: -30 - seed}.get(i, 0)
            write_run(tmp_path, [100 + effect], seed=seed, noise=SCALE, rate=rate)
    drawing = drawn_of(tmp_path)["effects_SAC"]
    figure = drawing.draw()
    [image] = figure.axes[0].images
    assert image.get_array().shape == (1, len(rates)) and image.get_clim() == (-34, 34)
    assert image.cmap(0.5)[:3] == pytest.approx((1, 1, 1), abs=0.01)  # white at zero
    assert "end at \u00b1 34 %" in drawing.caption
    dots = [line.get_xdata()[0] for line in figure.axes[0].lines]
    assert [round(x - 0.36) for x in dots] == [0, 1]  # better, worse


def test_curves_have_labels_units_and_n(tmp_path):
    small_sweep(tmp_path)
    drawings = drawn_of(tmp_path)
    assert set(drawings) == {
        *("effects_SAC", "best_curves_SAC", "curves_SAC_RandomEarlyTermination_50"),
        "curves_SAC_RandomUniformScaleReward_0.5_1.5",
    }
    curves = drawings["curves_SAC_RandomUniformScaleReward_0.5_1.5"].draw()
    lines = ["no noise (n = 4)", "rate 0.05 (n = 4)", "rate 0.20 (n = 4)"]
    assert texts(curves.legends[0].get_texts()) == lines
    hopper, pusher = curves.axes
    assert hopper.get_title() == "Hopper-v5" and hopper.get_xlabel() == "training steps (thousands)"
    assert "return" in hopper.get_ylabel()
    assert hopper.lines[1].get_ydata().tolist() == pytest.approx([29, 58, 87, 116, 145])
    assert len({(line.get_linestyle(), line.get_marker()) for line in hopper.lines}) == 3
    band = pusher.collections[0].get_paths()[0].vertices[:, 1]
    assert band.min() == pytest.approx(-40 * 1.8 - 1.8 * np.sqrt(200 / 3))  # one sample std

    [study], _ = make_studies(read_runs(tmp_path))
    for config in study.finals:  # an environment without this noise has no panel
        study.finals[config][:, 0] = NAN if config.noise == ENDING else 1.0
    fig = analysis.figures.curves_figure(study, ENDING)
    assert [ax.get_title() for ax in fig.axes] == ["Pusher-v5"]
    # nor has a rate that was not tried, or the baseline of a search, a line
    study.finals[Configuration.parse(SCALE, 0.05)][:, 0] = NAN
    study.finals[BASELINE][:] = NAN
    fig = analysis.figures.curves_figure(study, SCALE)
    assert texts(fig.legends[0].get_texts()) == lines[1:] and len(fig.axes) == 2
    fig.axes[0].set_ylim(-12_000, -11_000)
    fig.draw_without_rendering()
    assert fig.axes[0].yaxis.label.get_window_extent().x0 >= 0


def test_ablation_bars_stand_side_by_side(tmp_path):
    finals = {(): 10, (SCALE, 0.05): 20, (OTHER, 0.05): 30, (OTHER, 0.5): 40}
    for config, seed in product(finals, (1, 2)):
        more = dict(zip(("noise", "rate"), config, strict=False))
        write_run(tmp_path, [finals[config] * seed], seed=seed, **more)
    figure = drawn_of(tmp_path)["parameters_SAC_RandomUniformScaleReward"].draw()
    (ax,) = figure.axes
    np.testing.assert_equal([bar.get_height() for bar in ax.patches], [15, 30, NAN, 45, 60])
    assert texts(ax.get_xticklabels()) == ["none", "0.05", "0.50"]
    legend = texts(figure.legends[0].get_texts())
    assert legend == ["no noise (n = 2)", f"{SCALE} (n = 2)", f"{OTHER} (n = 2)"]


def test_ablation_bars_of_a_search_show_no_baseline(tmp_path):
    """Also of a module of one's own that begins with an underscore."""
    noises = ["_mine:Foo(1)", "_mine:Foo(2)"]
    for noise, seed in product(noises, (1, 2)):
        write_run(tmp_path, [10 * seed], seed=seed, noise=noise, rate=0.5)
    drawing = drawn_of(tmp_path)["parameters_SAC__mine_Foo"]
    figure = drawing.draw()
    (ax,) = figure.axes
    assert texts(ax.get_xticklabels()) == ["0.50"] and len(ax.patches) == 2
    assert texts(figure.legends[0].get_texts()) == [f"{noise} (n = 2)" for noise in noises]
    assert "dotted" not in drawing.caption


def test_figures_of_experiments_with_similar_names_have_names_of_their_own(tmp_path):
    for name, seed in product(("lr 1", "lr_1"), (1, 2)):
        more = {"seed": seed, "exp_name": name}
        write_run(tmp_path, [10], folder=f"{name}-{seed}", **more)
        write_run(tmp_path, [9], folder=f"{name}-{seed}-p", noise=SCALE, rate=0.1, **more)
    assert {"effects_SAC_lr_1", "effects_SAC_lr_1_again"} <= drawn_of(tmp_path).keys()


def test_changing_rates_and_combinations_have_lines(tmp_path):
    for rate in (1.0, "1.0:0.0"):
        write_run(tmp_path, [11], noise=SCALE, rate=rate)
    write_run(tmp_path, [10])
    write_run(tmp_path, [20], noise=(ENDING, SCALE), rate=(0.5, "1.0:0.0"))
    drawn = drawn_of(tmp_path)
    lines = texts(drawn["effects_SAC"].draw().axes[0].get_yticklabels())
    lines = [line.replace("\n(", "(") for line in lines]  # broken where there is little room
    assert f"{ENDING} +\n{SCALE}, 0.50 +\n1.00 to 0.00" in lines
    legend = drawn["curves_SAC_RandomUniformScaleReward_0.5_1.5"].draw().legends[0].get_texts()
    named = [text.partition(" (")[0] for text in texts(legend)]
    assert named == ["no noise", "rate 1.00 to 0.00", "rate 1.00"]


def test_committed_figures_are_those_that_a_page_shows():
    pages = [RESULTS.parent / "README.md", *RESULTS.glob("*.md"), *RESULTS.parent.glob("docs/*.md")]
    shown = re.findall(r"!\[[^]]*\]\([^)]*figures/([^)]*)\)", "".join(p.read_text() for p in pages))
    assert {path.name for path in (RESULTS / "figures").iterdir()} == set(shown)
