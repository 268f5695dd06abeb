"""What people see: terminals and files of any kind, whatever a folder of runs says."""

import io
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from sweeps import SCALE, write_run

import analyze
import evaluate
from analysis.errors import Terminal, with_place

NAME = "naïve |<b>$x$ \u00b1"  # of an experiment


def test_no_control_character_reaches_the_terminal():
    buffer = io.BytesIO()
    terminal = Terminal(io.TextIOWrapper(buffer, "latin-1", newline=""))
    print("\x1b[31mré\x9bd\x07\x7f\0 \ud800\u2713\tb\r\n", end="", file=terminal, flush=True)
    assert buffer.getvalue().decode("latin-1") == "?[31mré?d??? ??\tb\r\n"


def test_a_reader_that_leaves_stops_nothing():
    reader, writer = os.pipe()
    with open(writer, "w") as stream:
        terminal = Terminal(stream)
        print("first", file=terminal, flush=True)
        os.close(reader)
        for _ in range(10_000):
            print("more than a pipe holds", file=terminal)
        terminal.flush()


@pytest.mark.parametrize(
    ("caller", "place"),
    [("/my/env.py", r"\(/my/env\.py, line 2"), (evaluate.__file__, "linalg.py")],
)
def test_an_error_is_placed_in_the_code_of_a_user(caller, place, monkeypatch):
    """Where nothing of a user's is on the way, in the package that raised it."""
    with pytest.raises(np.linalg.LinAlgError) as raised:
        exec(compile("import numpy\nnumpy.linalg.inv(numpy.zeros((2, 2)))", caller, "exec"))
    assert re.match(f"LinAlgError: Singular matrix .*{place}", with_place(raised.value))
    monkeypatch.setattr("analysis.errors.LIBRARIES", [""])  # also the project is among them
    assert "linalg.py" in with_place(raised.value)


@pytest.mark.slow
def test_files_are_utf_8_whatever_the_locale(tmp_path):
    """And the terminal gets a replacement for what it cannot show."""
    for seed in (1, 2, 3):
        for noise in ({}, {"noise": SCALE, "rate": 0.1}):
            write_run(tmp_path / "runs", [1.0, 2.0 + seed], seed=seed, exp_name=NAME, **noise)
    locale = {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, analyze.__file__, "--runs-dir", tmp_path / "runs", "--latex"]
    done = subprocess.run(command, capture_output=True, env=os.environ | locale)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"na?ve |<b>$x$ ?" in done.stdout
    texts = {path.suffix: path.read_text("utf-8") for path in tmp_path.rglob("*.[cmth][sdet]*")}
    assert texts.keys() == {".csv", ".md", ".tex", ".html"}
    assert "<b>$x" not in texts[".html"] and "&lt;b&gt;$x" in texts[".html"]
    assert "naïve" in (tmp_path / "runs/results/summary_SAC.csv").read_text("utf-8")
    table = (tmp_path / "runs/results/summary_SAC.md").read_text("utf-8")
    assert r"naïve \|&lt;b>$x$ ±" in table
    pdf = next(tmp_path.rglob("*.pdf"))
    assert b"/FontFile2" in pdf.read_bytes() and b"/Type3" not in pdf.read_bytes()
