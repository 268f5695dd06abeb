"""Tables in LaTeX: what they say, and that they fit into a paper."""

import re
import shutil
import subprocess

import pandas as pd
import pytest
from sweeps import run, small_sweep

from analysis.formatting import DASH, Table, shown
from analysis.latex import latex_table

PAPERS = {  # by the inches of their text: ICML, NeurIPS
    6.75: r"\documentclass[twocolumn]{article}\setlength{\textwidth}{6.75in}%s\begin{document}",
    5.5: r"\documentclass{article}\setlength{\textwidth}{5.5in}%s\begin{document}",
}


def table_of(columns, inches=6.75, **more):
    table = Table("t", pd.DataFrame(columns), more.pop("caption", "Caption."), "", **more)
    return latex_table(table, shown(table), inches)


def rows_of(text):
    return [line.removesuffix(r" \\") for line in text.splitlines() if line.endswith(r" \\")][1:]


def test_numbers_meet_at_their_sign_and_have_real_minus_signs():
    columns = {"noise": ["RandomUniformNoisyReward(-0.1, 0.1)", "B"], "mean": [-1234.5, 6.0]}
    columns |= {"std": [12.0, None], "p": [0.00001, 0.04], "verdict": ["worse", DASH]}
    text = table_of(columns)
    assert "r@{~}l" in text and r"\multicolumn{2}{c}{mean}" in text
    first, second = rows_of(text)
    assert "$-$1,234 & $\\pm$ 12" in first and r"\ensuremath{<} 0.001" in first
    assert r"Reward\allowbreak{}($-$0.1, 0.1)" in first and "6.000 & $\\pm$ --" in second


def test_what_rows_share_is_said_once():
    columns = {"algorithm": ["SAC"] * 3, "environment": ["Hopper-v5"] * 2 + ["Ant-v5"]}
    text = table_of(columns | {"noise": ["A", "B", "B"], "n": [5, 5, 5]})
    assert r"\caption{SAC: Caption.}" in text
    assert rows_of(text) == ["Hopper-v5 & A & 5", "Hopper-v5 & B & 5", "Ant-v5 & B & 5"]


def test_a_long_table_goes_on_in_others():
    text = table_of({"noise": [f"Random{i}" for i in range(100)]})
    tables = text.count(r"\begin{table*}")
    assert tables == text.count(r"\end{table*}") > 2 and text.count("(continued)") == tables - 1
    assert len(re.findall(r"Random[0-9]+ \\\\", text)) == 100


@pytest.mark.parametrize("corrected", ["p_adjusted", "p_holm"])
def test_what_a_verdict_needs_is_never_left_out(corrected):
    """In one environment the difference; all together have the effect size instead."""
    columns = {"noise": ["A"], "verdict": ["worse"], "difference": [-1.0], "effect_size": [-3.0]}
    columns |= {"algorithm": ["A"], "p": [0.01], corrected: [0.02], "n": [5]}
    for lacking, left_out in ((None, "effect size, p, n"), ("difference", "p, n")):
        text = table_of(columns | {lacking: [None]} if lacking else columns, 1)
        assert "algorithm & " in text
        assert f"% no room for: {left_out} (see" in text
        assert ("effect" in text.partition("toprule")[2]) == bool(lacking)


def test_captions_and_cells_are_escaped():
    text = r"a~b^c {d} <e> 5 % of $x_1$ & #1 \n"
    lines = table_of({"x": [text]}, caption=text, note=text)
    escaped = r"a\textasciitilde{}b\^{}c \{d\} \ensuremath{<}e\ensuremath{>} 5 \% of \$x\_1\$"
    escaped += r" \& \#1 \textbackslash{}n"
    assert lines.count(escaped) == 3


@pytest.mark.slow
@pytest.mark.parametrize("inches", PAPERS)
def test_tables_and_figures_fit_into_a_paper(inches, tmp_path):
    if not shutil.which("pdflatex"):
        pytest.skip("pdflatex is not installed")
    small_sweep(tmp_path / "runs")
    run(tmp_path, drawn=True, figure_width=inches)
    out = tmp_path / "results"
    document = PAPERS[inches] % r"\usepackage{array,booktabs,graphicx}"
    for path in sorted(out.glob("*.tex")):
        assert path.read_text().isascii()
        document += f"\\input{{{path.name}}}\n"
    for path in sorted(out.glob("*.pdf")):
        kind = "figure" if path.stem.endswith("_column") else "figure*"
        document += f"\\begin{{{kind}}}\\includegraphics{{{path.name}}}\\end{{{kind}}}\n"
    (out / "paper.tex").write_text(document + r"Text.\clearpage\end{document}")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=out, capture_output=True, text=True)
    if "not found" in done.stdout:
        pytest.skip("a package of LaTeX is not installed")
    assert done.returncode == 0, done.stdout[-2000:]
    wide = re.findall(r"Overfull \\hbox \(([0-9.]+)pt", done.stdout)
    assert all(float(points) < 2 for points in wide), wide
