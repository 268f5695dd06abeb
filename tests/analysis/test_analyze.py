"""analyze.py as a command: its options, its errors, what it prints and writes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from sweeps import ENDING, NAN, SCALE, main, run, small_sweep, write_pairs, write_run

import analyze


@pytest.mark.slow
def test_the_same_bytes_again_also_from_shuffled_folders(tmp_path):
    small_sweep(tmp_path / "runs")
    run(tmp_path, drawn=True)
    small_sweep(tmp_path / "shuffled", order=-1)
    env = os.environ | {"PYTHONHASHSEED": "7"}
    words = [sys.executable, analyze.__file__, "--runs-dir", "shuffled", "--out", "copy", "--latex"]
    done = subprocess.run(words, cwd=tmp_path, env=env, check=True, capture_output=True, text=True)
    assert SCALE in done.stdout
    first = sorted((tmp_path / "results").iterdir())
    assert {path.suffix for path in first} == {".csv", ".md", ".tex", ".svg", ".pdf", ".html"}
    for path in first:
        assert path.read_bytes() == (tmp_path / "copy" / path.name).read_bytes(), path.name


@pytest.mark.parametrize("case", ["no folder", "no runs", "unfinished", "no place", "no success"])
def test_nothing_to_read_or_no_place_to_write_is_an_error(case, tmp_path, capsys):
    if case != "no folder":
        (tmp_path / "runs").mkdir()
    if case in ("unfinished", "no place", "no success"):
        write_run(tmp_path / "runs", [1], finished=case != "unfinished")
    if case == "no place":
        (tmp_path / "results").write_text("a file")
    with pytest.raises(SystemExit) as error:
        run(tmp_path, metric="success_rate" if case == "no success" else "return")
    printed = capsys.readouterr()
    assert error.value.code == 2 and not (tmp_path / "results").is_dir()
    assert printed.err.startswith("error: ") and printed.err.count("\n") == 1
    assert ("unfinished" in printed.out) == (case == "unfinished")
    assert ("--metric" in printed.err) == (case == "no success")


def test_results_go_beside_the_runs(tmp_path, monkeypatch):
    write_run(tmp_path / "runs", [1])
    main(analyze.Args(runs_dir=tmp_path / "runs"))
    monkeypatch.chdir(tmp_path)
    for out in (Path("results/../runs"), Path("")):
        with pytest.raises(SystemExit):
            main(analyze.Args(runs_dir=tmp_path / "runs", out=out))
    assert list(tmp_path.rglob("report.html")) == [tmp_path / "runs/results/report.html"]


def test_tables_for_a_paper_never_lag_behind(tmp_path):
    write_pairs(tmp_path / "runs", [1], [2])
    run(tmp_path)
    write_pairs(tmp_path / "runs", [], [3], noise=ENDING)
    main(analyze.Args(tmp_path / "runs", tmp_path / "results"))
    assert ENDING in (tmp_path / "results/noises.md").read_text()


@pytest.mark.parametrize(
    ("option", "value"),
    [("smallest_gain", 0.0), ("smallest_gain", NAN), ("figure_width", 1.0), ("figure_width", NAN)],
)
def test_numbers_that_make_no_sense_are_refused(option, value, tmp_path, capsys):
    write_run(tmp_path / "runs", [1])
    with pytest.raises(SystemExit):
        main(analyze.Args(tmp_path / "runs", **{option: value}))
    assert f"--{option.replace('_', '-')} must be " in capsys.readouterr().err


@pytest.mark.parametrize("width", [70, 80, 140])
def test_what_is_printed_fits_the_terminal(width, tmp_path, capsys, monkeypatch):
    """And the verdicts have room, however long the names of what was compared are."""
    noise = "RandomNormalNoisyObservation(0.1, relative=True)"
    where = {"env": "InvertedPendulum-v5", "exp_name": "my_longer_experiment"}
    write_pairs(tmp_path, [1.0, 2, 3], [1.0, 2, 4], noise, 0.1, **where)
    write_pairs(tmp_path, [], [1.0, 2, 2], noise, 0.5, **where)
    write_run(tmp_path, [5.0], noise=noise, rate=1.0, seed=4, finished=False, **where)
    monkeypatch.setattr(analyze, "terminal_width", lambda: width)
    monkeypatch.chdir(tmp_path)
    main(analyze.Args(runs_dir=Path(".")))
    printed = capsys.readouterr().out
    assert width - 20 < max(map(len, printed.splitlines())) <= width
    _, table = printed.split("against no noise:\n\n")
    assert table.startswith("verdict ") and "\nno clear difference " in table
