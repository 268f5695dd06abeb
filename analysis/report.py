"""report.html: a page with all verdicts, tables and figures.

Figures that the page shows folded are files beside it; all else is in the page.
"""

import base64
import os
import re
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

import jinja2
import pandas as pd
from markupsafe import Markup, escape

from analysis.formatting import DASH, shown
from analysis.verdicts import tally

SECTIONS = {
    "choice": "Choice of a noise",
    "noises": "Does a noise help at all?",
    "best": "Best noise tried (may be worse than none)",
    "early_performance": "Learning curves",
    "consistent": "Consistent noise",
    "consistently_worse": "Consistently worse",
    "success": "Success",
    "statistics": "Single rates (secondary)",
    "parameters": "Parameters",
    "robustness": "Robustness",
    "summary": "All results",
    "missing": "Runs left out",
}
FIGURES_OF = {"best_curves": "early_performance", "curves": "early_performance"}
FOLDED = ("curves", "parameters")  # where there are several: one for each noise
DOCS = Path(__file__).parents[1] / "docs/statistics.md"  # how all numbers are computed


@dataclass
class Results:
    """What an analysis has found, as it is printed and written."""

    studies: list
    tables: dict  # name -> Table
    headlines: list  # see verdicts.headlines
    clear: pd.DataFrame  # of noises with their rates together: see verdicts.clear_first
    others: pd.DataFrame
    rates: pd.DataFrame  # sentences on single rates, which are secondary
    robustness: list  # sentences
    overview: str
    problems: str  # runs that were left out, or ""
    notes: list
    versions: list  # notes on versions of code and libraries, which change no verdict


def breakable(text):
    """Mark where a browser may break a cell: a noise between its words, but never a number."""
    if re.match("[-+]?[0-9]", text):
        text = text.replace(" \u00b1 ", "\u00a0\u00b1\u00a0").replace(", ", ",\u00a0")
        whole = Markup('<span class="whole">{}</span>')  # a browser would break "1e-05"
        parts = [whole.format(part) if "e-" in part else part for part in text.split(" ")]
        return Markup(" ").join(parts)
    return Markup(re.sub("(?<=[a-z0-9])(?=[A-Z(])", "<wbr>", str(escape(text))))


def write_report(out, results, drawn):
    """Write report.html: the effects and the verdicts first, then everything else.

    drawn: every Drawing. A section without tables and figures is left out.
    """
    tables, figures, folded = defaultdict(list), defaultdict(list), defaultdict(list)
    for table in results.tables.values():
        text = shown(table)
        if len(text):
            text = text.loc[:, (text != DASH).any()]  # a column of dashes says nothing
            tables[table.section].append((table, text))
    number = Counter(drawing.kind for drawing in drawn)
    for drawing in drawn:
        several = drawing.kind in FOLDED and number[drawing.kind] > 1
        place = folded if several else figures
        place[FIGURES_OF.get(drawing.kind, drawing.kind)].append(drawing)

    filled = tables.keys() | figures.keys() | folded.keys()

    def source(name):  # a URL that contains the figure
        picture = (out / f"{name}.svg").read_bytes()
        return f"data:image/svg+xml;base64,{base64.b64encode(picture).decode()}"

    pages = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True
    )
    pages.filters |= {"breakable": breakable, "source": source, "tally": tally}
    html = pages.get_template("report.html.jinja").render(
        results=results,
        sections={key: title for key, title in SECTIONS.items() if key in filled},
        tables=tables,
        figures=figures,
        folded=folded,
        docs=os.path.relpath(DOCS, out),
    )
    (out / "report.html").write_text(html, "utf-8")
