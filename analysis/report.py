"""report.html: one self-contained page with all verdicts, tables and figures."""

import base64
import re
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from analysis.formatting import shown
from analysis.runs import STUDY
from analysis.verdicts import tally

SECTIONS = {
    "choice": "Choice of a noise",
    "best": "Best noise tried (may be worse than none)",
    "consistent": "Consistent noise",
    "consistently_worse": "Consistently worse",
    "luck": "Luck",
    "statistics": "Statistics",
    "early_performance": "Learning curves",
    "parameters": "Parameters",
    "interactions": "Two noises together",
    "robustness": "Robustness",
    "summary": "All results",
    "missing": "Runs left out",
}
FIGURES_OF = {"intervals": "best", "heatmap": "consistent", "curves": "early_performance"}


def breakable(text):
    """Mark where a browser may break a cell: a noise between its words, but never a number."""
    if re.match("-?[0-9]", text):
        text = text.replace(" \u00b1 ", "\u00a0\u00b1\u00a0").replace(", ", ",\u00a0")
        parts = [Markup('<span class="number">{}</span>').format(part) for part in text.split(" ")]
        return Markup(" ").join(parts)
    return Markup(re.sub("(?<=[a-z0-9])(?=[A-Z(])", "<wbr>", str(escape(text))))


def write_report(out, verdicts, tables, drawn, overview, problems, notes):
    """Write report.html: one self-contained page with all verdicts, tables and figures."""
    sections = {key: {"id": key, "title": title} for key, title in SECTIONS.items()}
    for section in sections.values():
        section |= {"tables": [], "figures": []}
    for table in tables.values():
        text = shown(table)
        entry = {
            "name": table.name,
            "caption": table.caption,
            "columns": text.columns,
            "rows": text.values.tolist(),
        }
        sections[table.section]["tables"].append(entry)
    for name, caption in drawn:
        kind = name.split("_")[0]
        svg = base64.b64encode((out / f"{name}.svg").read_bytes()).decode()
        entry = {"svg": svg, "caption": caption}
        sections[FIGURES_OF.get(kind, kind)]["figures"].append(entry)
    here = jinja2.FileSystemLoader(Path(__file__).parent)
    pages = jinja2.Environment(loader=here, autoescape=True, trim_blocks=True)
    full = [s for s in sections.values() if s["tables"] or s["figures"]]
    pages.filters["breakable"] = breakable
    page = pages.get_template("report.html.jinja")
    groups = verdicts.groupby([*STUDY, "scope", "environment"], sort=False)
    verdicts = []
    for _, group in groups:
        lines = group[["verdict", "sentence"]].to_dict("records")
        verdicts.append({"lines": lines, "tally": tally(group["verdict"])})
    html = page.render(
        verdicts=verdicts, sections=full, overview=overview, problems=problems, notes=notes
    )
    (out / "report.html").write_text(html)
