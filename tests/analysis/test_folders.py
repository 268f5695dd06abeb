"""The one reader of run folders: what a run tells, and what is damaged."""

import re

import pytest
from sweeps import write_run

from analysis.folders import SUCCESS, DamageError, read_run


def test_a_run_of_an_algorithm_of_ones_own(tmp_path):
    """With what a researcher adds: text, negative numbers, lists in lists, nothing."""
    more = {"schedule": "cosine", "offset": -1.5, "sizes": [[64, 64], [8]], "path": None}
    more |= {"test_noise": ["RandomActionDelay(1)"], "test_noise_rate": [0.5]}
    more |= {"env_kwargs": ["goal:3"]}
    config = {"script": "my_redq.py", "versions": {"noisy_wrappers": "0.4.0"}}
    folder = write_run(tmp_path, [1.0, 2.0], "REDQ", config=config, **more)
    run = read_run(folder, "search")
    assert (run.algorithm, run.script, run.release) == ("REDQ", "my_redq.py", "0.4")
    assert run.args["sizes"] == [[64, 64], [8]] and run.phase == "search"
    assert run.tested == "with goal:3; tested under RandomActionDelay(1) at 0.5"


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


DAMAGED = {
    "a short line": lambda text: text.replace(",1000\n", "\n", 1),
    "nan": lambda text: re.sub(r"(?m)^(10000,0,)[^,]*", r"\1nan", text),
    "a missing episode": lambda text: re.sub(r"(?m)^20000,1,.*\n", "", text),
    "an episode each of two tests": lambda text: re.sub(r"(?m)^(20000,1|30000,0),.*\n", "", text),
    "a missing evaluation at the end": lambda text: re.sub(r"(?m)^50000,.*\n", "", text),
    "steps out of order": lambda text: text.replace("\n30000,", "\n10000,"),
    "no header": lambda text: text.split("\n", 1)[1],
    "a header and an empty line": lambda text: text.split("\n", 1)[0] + "\n\n",
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_evaluations_are_told(name, tmp_path):
    path = write_run(tmp_path, [10, 20, 30, 40, 50.0]) / "eval.csv"
    text = path.read_text()
    path.write_text(DAMAGED[name](text))
    assert path.read_text() != text
    with pytest.raises(DamageError, match="^eval.csv"):
        read_run(path.parent)
