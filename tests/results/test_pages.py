"""The pages show the committed tables, and every table is described."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from results.study import show

RESULTS = Path(show.__file__).parents[1]
PAGES = [*sorted(RESULTS.glob("*.md")), RESULTS / "data/README.md", RESULTS / "tables/README.md"]


def test_pages_show_the_committed_tables():
    command = [sys.executable, "-m", "cogapp", "--check", "--diff", "-P", "-I", str(RESULTS.parent)]
    command += ["-p", "from results.study.show import table", *map(str, PAGES)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_table_is_described():
    text = (RESULTS / "tables/README.md").read_text()
    described = set(re.findall(r"`([\w/]+\.csv)`", text))
    files = {str(path.relative_to(show.TABLES)) for path in show.TABLES.rglob("*.csv")}
    assert described == files


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (None, "| a [95 %] | b |\n|---|---|\n| 1.50 | – |\n| x | 2 |\n"),
        ({"b": "{b:,.0f}"}, "| b |\n|---|\n| 2,000 |\n"),
    ],
)
def test_a_table_by_hand(columns, expected, tmp_path, monkeypatch, capsys):
    rows = "1.50,\nx,2\n" if columns is None else "1.50,2000\n"
    (tmp_path / "t.csv").write_text(f"a [95 %],b\n{rows}")
    monkeypatch.setattr(show, "TABLES", tmp_path)
    show.table("t.csv", columns)
    assert capsys.readouterr().out == expected
