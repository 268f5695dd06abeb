"""The pages show the committed tables, and every table is described."""

import re
import subprocess
import sys
from pathlib import Path

import pandas as pd

from results.study import picture, show

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


def shown(text, folder, monkeypatch, capsys, **where):
    (folder / "t.csv").write_text(text)
    monkeypatch.setattr(show, "TABLES", folder)
    show.table("t.csv", **where)
    return capsys.readouterr().out


def test_a_table_is_shown_as_it_is(tmp_path, monkeypatch, capsys):
    out = shown("a [95 %],b\n1.50,\nx,2\n", tmp_path, monkeypatch, capsys)
    assert out == "| a [95 %] | b |\n|---|---|\n| 1.50 | – |\n| x | 2 |\n"
    out = shown("page,b\np,1\nq,2\n", tmp_path, monkeypatch, capsys, page="q")
    assert out == "| b |\n|---|\n| 2 |\n"


def test_a_comparison_has_formats(tmp_path, monkeypatch, capsys):
    text = "n,mean,sd,n_without,mean_without,sd_without,p\n3,1234.56,2,4,-9,1,0.0123\n,,,,,,0.5\n"
    out = shown(text, tmp_path, monkeypatch, capsys).splitlines()
    assert out[0] == "| n | with noise | without | p |"
    assert out[2] == "| 3 + 4 | 1,234.6 ± 2.0 | -9.0 ± 1.0 | 0.012 |"
    assert out[3] == "| – | – | – | 0.5 |"
    assert show.formatted("{a:+z.0f}", {"a": "-0.2"}) == "+0"


def test_the_first_page_says_what_the_claims_say():
    text = " ".join((RESULTS.parent / "README.md").read_text().split())
    claims = pd.read_csv(show.TABLES / "claims.csv")
    claims.columns = ["claim", "paper", "ours", "covered", "verdict", "runs"]
    for environment, row in picture.best_noises(claims).items():
        change, low, high = re.match(picture.OURS, row.ours).groups()
        gain = f"{change.lstrip('+')} % [{low}, {high}]"
        assert (gain if row.verdict == "confirmed" else f"{high} % on {environment}") in text
