"""report.html: a page with all verdicts, tables and figures.

Figures that the page shows folded are files beside it; all else is in the page.
"""

import base64
import re
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from analysis.formatting import shown
from analysis.runs import STUDY, rows_of, study_name
from analysis.verdicts import LEVEL, VERDICTS, counted, tally

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
FIGURES_OF = {"best": "early_performance", "curves": "early_performance"}
SENTENCES = 10  # of clear verdicts, before the others are folded


def breakable(text):
    """Mark where a browser may break a cell: a noise between its words, but never a number."""
    if re.match("-?[0-9]", text):
        text = text.replace(" \u00b1 ", "\u00a0\u00b1\u00a0").replace(", ", ",\u00a0")
        parts = [Markup('<span class="number">{}</span>').format(part) for part in text.split(" ")]
        return Markup(" ").join(parts)
    return Markup(re.sub("(?<=[a-z0-9])(?=[A-Z(])", "<wbr>", str(escape(text))))


def headlines(verdicts, best):
    """Return for each study its name, its comparisons in words, its counts of verdicts, its luck.

    Counted are the verdicts of single environments.
    """
    lines = []
    alone = verdicts[verdicts["scope"] == "environment"]
    for key, rows in alone.groupby(STUDY, sort=False):
        number = f"{counted(len(rows), 'comparison')} in "
        number += counted(rows["environment"].nunique(), "environment")
        counts = [(word, (rows["verdict"] == word).sum()) for word in VERDICTS]
        p_luck = best[rows_of(best, key)]["p_luck"].dropna()
        luck = ""
        if len(p_luck) and (p_luck > LEVEL).all():
            luck = (
                "The best noise of each environment looks no better than luck alone would make it."
            )
        shown = [(word, n) for word, n in counts if n or word in VERDICTS[:2]]
        lines.append({"name": study_name(*key), "number": number, "counts": shown, "luck": luck})
    return lines


def write_report(out, verdicts, tables, drawn, overview, problems, notes):
    """Write report.html: the effects and the verdicts first, then everything else."""
    sections = {key: {"id": key, "title": title} for key, title in SECTIONS.items()}
    effects = []
    for section in sections.values():
        section |= {"tables": [], "figures": [], "folded": []}
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
        section = sections.get(FIGURES_OF.get(kind, kind))
        entry = {"src": f"{name}.svg", "caption": caption}
        if kind == "curves" and len(drawn) > 1:
            section["folded"].append(entry)
            continue
        svg = base64.b64encode((out / f"{name}.svg").read_bytes()).decode()
        entry["src"] = f"data:image/svg+xml;base64,{svg}"
        (effects if section is None else section["figures"]).append(entry)
    here = jinja2.FileSystemLoader(Path(__file__).parent)
    pages = jinja2.Environment(loader=here, autoescape=True, trim_blocks=True)
    full = [s for s in sections.values() if s["tables"] or s["figures"] or s["folded"]]
    pages.filters["breakable"] = breakable
    page = pages.get_template("report.html.jinja")
    clear = verdicts[verdicts["verdict"].isin(VERDICTS[:2])].sort_values("verdict", kind="stable")
    first = clear[:SENTENCES]
    rest = verdicts.drop(first.index)
    html = page.render(
        effects=effects,
        headlines=headlines(verdicts, tables["best"].frame),
        first=first.to_dict("records"),
        rest=rest.to_dict("records"),
        rest_tally=tally(rest["verdict"]),
        sections=full,
        overview=overview,
        problems=problems,
        notes=notes,
    )
    (out / "report.html").write_text(html)
