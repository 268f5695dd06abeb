"""report.html: a page with all verdicts, tables and figures.

Figures that the page shows folded are files beside it; all else is in the page.
"""

import base64
import os
import re
from dataclasses import dataclass
from pathlib import Path

import jinja2
import pandas as pd
from markupsafe import Markup, escape

from analysis.formatting import shown
from analysis.verdicts import clear_first, headlines, tally

SECTIONS = {
    "choice": "Choice of a noise",
    "best": "Best noise tried (may be worse than none)",
    "early_performance": "Learning curves",
    "consistent": "Consistent noise",
    "consistently_worse": "Consistently worse",
    "luck": "Luck",
    "success": "Success",
    "statistics": "Statistics",
    "parameters": "Parameters",
    "interactions": "Two noises combined",
    "robustness": "Robustness",
    "summary": "All results",
    "missing": "Runs left out",
}
FIGURES_OF = {"best_curves": "early_performance", "curves": "early_performance"}
FOLDED = ("curves", "parameters")  # where there are several: one for each noise
MOST_ROWS = 15  # a longer table is folded
DOCS = Path(__file__).parents[1] / "docs/statistics.md"  # how all numbers are computed


@dataclass
class Results:
    """What an analysis has found, as it is printed and written."""

    studies: list
    tables: dict  # name -> Table
    sentences: pd.DataFrame  # see verdicts.in_sentences
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


def source(path):
    """Return a picture as a URL that contains it."""
    return f"data:image/svg+xml;base64,{base64.b64encode(path.read_bytes()).decode()}"


def sections_of(out, results, drawn):
    """Arrange the tables and figures as the page shows them; a section without any is left out.

    drawn: every Drawing. Return the figures of the effects, which are in no section, and a list of
    dicts.
    """
    sections = {
        key: {"id": key, "title": title, "said": [], "tables": [], "figures": [], "folded": []}
        for key, title in SECTIONS.items()
    }
    effects = []
    for table in results.tables.values():
        text = shown(table)
        if len(text):
            text = text.loc[:, (text != "\u2013").any()]  # a column of dashes says nothing
            entry = {"name": table.name, "caption": table.caption, "note": table.note}
            entry |= {"columns": text.columns, "rows": text.values.tolist()}
            sections[table.section]["tables"].append(entry)
    sections["robustness"]["said"] = results.robustness
    kinds = [drawing.kind for drawing in drawn]
    for drawing in drawn:
        section = sections.get(FIGURES_OF.get(drawing.kind, drawing.kind))
        file, caption = f"{drawing.name}.svg", drawing.caption
        if drawing.kind in FOLDED and kinds.count(drawing.kind) > 1:
            section["folded"].append({"src": file, "caption": caption})
            continue
        entry = {"src": source(out / file), "caption": caption}
        if drawing.narrow:
            entry["narrow"] = source(out / f"{drawing.narrow_name}.svg")
        (effects if section is None else section["figures"]).append(entry)
    shown_ones = [s for s in sections.values() if s["tables"] or s["figures"] or s["folded"]]
    return effects, shown_ones


def write_report(out, results, drawn):
    """Write report.html: the effects and the verdicts first, then everything else."""
    pages = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True
    )
    pages.filters["breakable"] = breakable
    effects, sections = sections_of(out, results, drawn)
    first, rest = clear_first(results.sentences)
    html = pages.get_template("report.html.jinja").render(
        results=results,
        effects=effects,
        headlines=headlines(results.tables["statistics"].frame, results.tables["best"].frame),
        first=first.to_dict("records"),
        rest=rest.to_dict("records"),
        rest_tally=tally(rest["verdict"]),
        sections=sections,
        docs=os.path.relpath(DOCS, out),
        most_rows=MOST_ROWS,
    )
    (out / "report.html").write_text(html, "utf-8")
