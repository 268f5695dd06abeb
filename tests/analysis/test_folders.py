"""The one reader of run folders: what releases 0.3 and 0.4 wrote, and what is damaged."""

import json
from pathlib import Path

import pytest
from sweeps import SCALE, write_run

from analysis.folders import SUCCESS, DamageError, read_run
from noisy_wrappers import BASELINE, Configuration

DATA = Path(__file__).parents[2] / "results/data"


def change(folder, args=(), **config):
    """Change a run's config.json: its arguments, and what stands beside them."""
    path = folder / "config.json"
    content = json.loads(path.read_text()) | config
    content["args"] |= dict(args)
    path.write_text(json.dumps(content))


def test_a_run_of_the_frozen_release():
    folder = next((DATA / "runs").glob("p1.0_s3_EarlyTermination_50__Pusher*"))
    run = read_run(folder)
    assert (run.algorithm, run.environment, run.seed) == ("PPO", "Pusher-v5", 3)
    assert run.configuration == Configuration.parse("RandomEarlyTermination(50)", 1.0)
    assert (run.release, run.script) == ("0.3", "ppo_continuous_noisy.py")
    assert run.finished and run.tested == "" and run.curve.success_rates is None
    assert run.curve.steps.tolist() == list(range(50_000, 1_000_001, 50_000))
    assert run.curve.returns[-1] == pytest.approx(run.result["final_return_mean"])
    assert read_run(folder, with_curve=False).curve is None


def test_a_run_of_an_algorithm_of_ones_own(tmp_path):
    """With what a researcher adds: text, negative numbers, lists in lists, nothing."""
    more = {"schedule": "cosine", "offset": -1.5, "sizes": [[64, 64], [8]], "path": None}
    folder = write_run(tmp_path, [1.0, 2.0], "REDQ", noise=SCALE, rate=0.1, **more)
    tests = {"test_noise": ["RandomActionDelay(1)"], "test_noise_rate": [0.5]}
    versions = {"noisy_wrappers": "0.4.0"}
    change(folder, tests | {"env_kwargs": ["goal:3"]}, script="my_redq.py", versions=versions)
    run = read_run(folder, "search")
    assert (run.algorithm, run.script, run.release) == ("REDQ", "my_redq.py", "0.4")
    assert run.args["sizes"] == [[64, 64], [8]] and run.phase == "search"
    assert run.tested == "tested under RandomActionDelay(1) at 0.5 with goal:3"


@pytest.mark.parametrize(
    ("header", "cells", "rates"),
    [("", ["", "", "", ""], None), (",success", [",0", ",1", ",1", ",1"], [50, 100])]
    + [(",success", [",", ",", ",", ","], None), (",success", [",", ",", ",1", ","], [0, 50])],
)
def test_success_is_told_or_not(header, cells, rates, tmp_path):
    folder = write_run(tmp_path, [1.0, 2.0])
    first, *lines = (folder / "eval.csv").read_text().splitlines()
    lines = [line + cell for line, cell in zip(lines, cells, strict=True)]
    (folder / "eval.csv").write_text("\n".join([first + header, *lines, ""]))
    curve = read_run(folder).curve
    assert curve.returns.tolist() == [1, 2]
    found = curve.of(SUCCESS)
    assert found is None if rates is None else found.tolist() == rates


def test_of_a_damaged_run_is_known_what_can_be_read(tmp_path):
    folder = write_run(tmp_path, [1.0, 2.0], seed=7)
    (folder / "result.json").write_text("{")
    with pytest.raises(DamageError, match=r"^result.json: ") as raised:
        read_run(folder)
    assert raised.value.run.seed == 7 and raised.value.run.configuration == BASELINE
    (folder / "config.json").write_text("[]")
    with pytest.raises(DamageError, match=r"^config.json is no JSON object") as raised:
        read_run(folder)
    assert raised.value.run is None
