"""report.html: a page with all verdicts, tables and figures.

Figures that the page shows folded are files beside it; all else is in the page.
"""

import base64
import re
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

import jinja2
import pandas as pd

from analysis.comparisons import are_in
from analysis.figures import COLUMN_END
from analysis.formatting import DASH, shown, title
from analysis.power import CONFIDENCE, LEVEL
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
# What the columns of tables say, and the words of verdicts; for people who have only the report
TERMS = {
    "better": f"""The final mean is higher than without noise; p corrected is at most {LEVEL}. (For
        a confirmation of `./benchmark.sh choose`: by the rule of that.)""",
    "worse": "The final mean is lower than without noise; otherwise as better.",
    "no clear difference": f"""p corrected is above {LEVEL}: the noise may help a little, harm a
        little, or do nothing. The interval says how much of either is excluded. Also where averages
        over environments differ in their direction. (For a confirmation: by the rule of that.)""",
    "no such gain": "The interval excludes a gain as large as --smallest-gain asked for.",
    "too few seeds": "One side has fewer than two seeds, so nothing can be tested.",
    "all equal": "All tests of all runs have the same result, so nothing can be compared.",
    "noise rate": "The probability with which the noise acts, at each step or in each episode.",
    "difference": f"""The final mean with noise minus that without, and its {CONFIDENCE} interval
        (Welch's), which needs five seeds on both sides.""",
    "difference %": """The same in percent of the mean without noise, where that is clearly not
        zero; its interval is Fieller's.""",
    "effect size": """The difference in standard deviations over seeds; over several environments
        the median.""",
    "p": """How often chance alone makes a difference as large, in either direction: a permutation
        test with Welch's t.""",
    "p corrected": """p, corrected (Benjamini and Hochberg) for all noises of the study in that
        environment, or over all; that of a single rate for all rates of noises that have several.
        The p of a confirmation needs no correction.""",
    "n": """The number of seeds, or with rates together of runs; with / without noise where they
        differ.""",
    "n baseline": "The number of seeds without noise.",
    "detectable": "The difference that these seeds find in 80 % of cases, before the correction.",
    "luck 95 % (p)": """If no noise did anything, the best of as many configurations would still
        look better than no noise: in 5 % of such sweeps by more than this. In brackets: how often
        by at least what was observed.""",
    "steps to baseline": """The first step at which the mean over seeds reaches the final mean
        without noise.""",
    "IQM": f"Interquartile mean over seeds, with its {CONFIDENCE} interval.",
    "IQM change %": "The change of the interquartile mean, in percent of that without noise.",
    "P(improvement)": "The probability that a run with noise returns more than one without.",
    "average improvement %": """Mean and standard deviation over environments of the difference in
        percent.""",
    "% of environments": "In how many environments the mean is at least that without noise.",
    "score % (baseline)": """How far the mean return over the test conditions that count is from the
        clean return of policies that were trained without noise, in percent of that. In brackets:
        the same of those policies.""",
}
TERMS = {name: " ".join(text.split()) for name, text in TERMS.items()}


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

    @property
    def repeated(self):
        """The names of tables that say nothing but what the first one says, too."""
        noises, rates = (self.tables[name].frame for name in ("noises", "statistics"))
        rates = rates[rates["difference"].notna()]
        is_same = are_in(rates, noises).all()  # every noise has one rate
        names = {"statistics", "statistics_together"} if is_same else set()
        return names if (self.tables["best"].frame["chosen_from"] > 1).any() else names | {"best"}


def is_number(text):
    """Tell whether a cell begins with a number."""
    return bool(re.match("(< )?[-+]?([0-9]|inf)", text))


def write_report(out, results, drawn):
    """Write report.html: the effects and the verdicts first, then everything else.

    drawn: every Drawing. A section without tables and figures is left out.
    """
    tables, figures, folded = defaultdict(list), defaultdict(list), defaultdict(list)
    for table in results.tables.values():
        text = shown(table)
        if len(text) and table.name not in results.repeated:
            text = text.loc[:, (text != DASH).any()]  # a column of dashes says nothing
            tables[table.section].append((table, text))
    number = Counter(drawing.kind for drawing in drawn)
    for drawing in drawn:
        several = drawing.kind in FOLDED and number[drawing.kind] > 1
        place = folded if several else figures
        place[FIGURES_OF.get(drawing.kind, drawing.kind)].append(drawing)

    filled = tables.keys() | figures.keys() | folded.keys()

    def embedded(file):  # a URL that contains the figure
        picture = (out / file).read_bytes()
        return f"data:image/svg+xml;base64,{base64.b64encode(picture).decode()}"

    pages = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True
    )
    pages.filters |= {"embedded": embedded, "tally": tally}
    pages.tests["numeric"] = is_number
    used = {name for texts in tables.values() for _, text in texts for name in text}
    used |= {title(name) for table in results.tables.values() for name in table.frame}
    for frame in (results.clear, results.others, results.rates):
        used |= set(frame["verdict"])
    html = pages.get_template("report.html.jinja").render(
        results=results,
        sections={key: title for key, title in SECTIONS.items() if key in filled},
        tables=tables,
        figures=figures,
        folded=folded,
        column_end=COLUMN_END,
        level=LEVEL,
        terms={name: text for name, text in TERMS.items() if name in used},
    )
    (out / "report.html").write_text(html, "utf-8")
