"""How results look as text: numbers, and tables in a terminal, in Markdown and in LaTeX."""

import re
import textwrap
import zlib
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from tabulate import tabulate

from analysis.runs import SUCCESS, script_name
from analysis.verdicts import percent
from noisy_wrappers import rate_order, rounded

# Formats of numbers that have no spread. z: no "-0"
TENTH, WHOLE, PLAIN, SHARE, P_VALUE = "z,.1f", "z,.0f", "g", "z.2f", ".2g"


@dataclass(frozen=True)
class Table:
    """A table of results, as analyze.py prints and writes it."""

    name: str  # of its files
    frame: pd.DataFrame  # all columns, as in the csv
    caption: str  # at most two lines
    section: str  # of the report: a key of report.SECTIONS
    formats: dict = field(default_factory=dict)  # column -> format of numbers; others: see text_of
    note: str = ""  # what to know about these rows
    only_csv: tuple = ()  # columns that would make the table wider than a page
    view: pd.DataFrame | None = None  # what people read, if that is not the frame
    rates_beside: bool = False  # a column for each noise rate, with mean, std and n in its cells


def in_metric(text, metric):
    """Write of success rates what was written of returns, if they are the metric of a Study."""
    if metric != SUCCESS:
        return text
    text = text.replace("test return\n(sum of rewards per episode)", "test success rate (%)")
    return text.replace("return", "success rate")


def slug(text):
    """Turn a label or a noise into a part of a file name; a long one is cut and keeps a hash."""
    name = re.sub(r"[^A-Za-z0-9._=+-]+", "_", text).strip("_")
    return name if len(name) <= 150 else f"{name[:140]}_{zlib.crc32(name.encode()):08x}"


# Columns that are shown as one: "mean ± std", "estimate [low, high]" or "ours (the baseline's)".
MERGED = {
    "no noise": ("baseline_mean", "baseline_std"),
    "with noise": ("noisy_mean", "noisy_std"),
    "mean": ("mean", "std"),
    "average improvement %": ("average_improvement_percent", "std_improvement_percent"),
    "IQM": ("iqm", "iqm_low", "iqm_high"),
    "IQM change %": ("iqm_change_percent", "iqm_change_low", "iqm_change_high"),
    "interaction": ("interaction", "interaction_low", "interaction_high"),
    "interaction %": ("interaction_percent", "percent_low", "percent_high"),
    "difference": ("difference", "difference_low", "difference_high"),
    "P(improvement)": ("probability_of_improvement", "probability_low", "probability_high"),
    "luck 95 % (p)": ("luck_95", "p_luck_of_best"),
}
for _name in ("score", "worst_score", "cvar_score"):
    MERGED[f"{_name} % (baseline)"] = (f"{_name}_percent", f"baseline_{_name}_percent")
for _name in ("mean", "average improvement %"):
    MERGED[f"paper: {_name}"] = tuple(f"paper_{column}" for column in MERGED[_name])


def spreads(frame):
    """Return what each number of a table may be off by: column -> Series, where that is known."""
    found = {}
    for name, parts in MERGED.items():
        if parts[-1] in frame and not name.endswith(")"):
            numbers = frame[list(parts)].astype(float)
            spread = numbers[parts[1]]
            if len(parts) == 3:
                spread = (numbers[parts[2]] - numbers[parts[1]]) / 2
            if name == "difference" and "pooled_std" in frame:
                spread = spread.fillna(frame["pooled_std"])
            found |= dict.fromkeys(parts, spread)
    if "difference" in found:
        found["detectable"] = found["difference"]
    if "baseline_std" in found and "noisy_std" in found:
        found["luck_95"] = np.fmax(found["baseline_std"], found["noisy_std"])
    return found


def text_of(name, value, form, spread=None):
    """Return one value of the column `name` as text; a value that does not exist is a dash.

    The paper's numbers have the paper's one decimal, all others the digits that their spread
    deserves.
    """
    if pd.isna(value):
        return "\u2013"
    if isinstance(value, str):
        return value or ("no noise" if name == "noise" else "\u2013")
    if form or name.startswith("paper_"):
        return f"{value:{form or TENTH}}"
    if name.endswith("_percent") and spread is None:
        return percent(value, sign="").removesuffix(" %")
    return rounded(value, spread)


def merged(name, parts, table, text):
    """Return one column of text for the columns `parts`; a value that does not exist is a dash."""
    columns = [text[name] for name in parts]
    if len(parts) == 3:
        interval = columns[0] + " [" + columns[1] + ", " + columns[2] + "]"
        result = interval.where(table[parts[1]].notna(), columns[0])
    elif name.endswith(")"):
        result = columns[0] + " (" + columns[1] + ")"
    else:
        result = columns[0] + " \u00b1 " + columns[1]
    return result.where(table[parts[0]].notna(), "\u2013")


def title(column):
    """Spell the name of a column for people."""
    for word, spelling in (("_", " "), ("percent", "%"), ("adjusted", "corrected")):
        column = column.replace(word, spelling)
    return column


def shown(table):
    """Return a table as a person reads it: all text, related columns in one.

    The phase and environments without percent are shown where a row has any, and exp_name where one
    is not its script's; a row of all
    environments says so.
    """
    frame = table.frame if table.view is None else table.view
    frame = frame.reset_index(drop=True).drop(columns=list(table.only_csv))
    if "scope" in frame:
        frame["environment"] = frame["environment"].mask(frame.pop("scope") == "all", "all")
    if "exp_name" in frame:
        names = [script_name(str(algorithm)) for algorithm in frame["algorithm"]]
        frame["exp_name"] = frame["exp_name"].mask(frame["exp_name"] == names, "")
    for name in ("exp_name", "phase", "without_percent"):
        if name in frame and (frame[name].isna() | frame[name].eq("")).all():
            frame = frame.drop(columns=name)
    known, cells = spreads(frame), {}
    for name in frame:
        pairs = zip(frame[name], known.get(name, [None] * len(frame)), strict=True)
        form = table.formats.get(name)
        cells[name] = [text_of(name, value, form, spread) for value, spread in pairs]
    text = pd.DataFrame(cells, dtype=object)
    if "n_baseline_most" in text:  # over several environments: "10 to 50"
        most = text.pop("n_baseline_most")
        text["n_baseline"] += (" to " + most).where(most != text["n_baseline"], "")
    for name, parts in MERGED.items():
        if parts[-1] in text:
            text[parts[0]] = merged(name, parts, frame, text)
            text = text.drop(columns=list(parts[1:])).rename(columns={parts[0]: name})
    if table.rates_beside and len(text):
        text["mean"] += " (" + text.pop("n") + ")"
        keys = [name for name in text if name not in ("noise_rate", "mean")]
        text = text.pivot(index=keys, columns="noise_rate", values="mean").fillna("\u2013")
        text = text[sorted(text.columns, key=rate_order)].reset_index()
    return text.rename(columns=title)


def text_table(table, width=0):
    """Format a table for a terminal of this width (0: any), without the last columns if need be."""
    text = shown(table)
    if text.empty:
        return "(empty)"
    while True:
        lines = tabulate(text.values, text.columns, disable_numparse=True)
        if not width or text.shape[1] == 1 or max(map(len, lines.splitlines())) <= width:
            return lines
        text = text.iloc[:, :-1]


def wrapped(text, width=0):
    """Break a paragraph into lines of this width (0: any) between words."""
    if not width:
        return text
    style = {"break_long_words": False, "break_on_hyphens": False, "subsequent_indent": "  "}
    return textwrap.fill(text, width, **style)


def write_table(out, table, latex=False):
    """Write {name}.csv, with all digits; with `latex` also .md and .tex, as people read it."""
    table.frame.to_csv(
        out / f"{table.name}.csv", index=False, float_format="%.10g", lineterminator="\n"
    )
    if not latex:
        return
    text = shown(table)
    cells = text.map(lambda cell: cell.replace("|", r"\|").replace("<", "&lt;"))
    markdown = tabulate(cells.values, text.columns, tablefmt="pipe", disable_numparse=True)
    note = f"\n{table.note}\n" if table.note else ""
    (out / f"{table.name}.md").write_text(f"{table.caption}\n\n{markdown}\n{note}", "utf-8")
    lines = tabulate(text.values, text.columns, tablefmt="latex_longtable", disable_numparse=True)
    escaped = re.sub(r"([%&_#])", r"\\\1", table.caption)
    escaped = escaped.replace("|", r"\textbar{}").replace("\n", " ")
    lines = lines.replace("\n", f"\n\\caption{{{escaped}}}\\\\\n", 1)
    for sign, command in (("\u00b1", r"$\pm$"), ("\u2013", "--"), (" < ", " $<$ ")):
        lines = lines.replace(sign, command)
    (out / f"{table.name}.tex").write_text(lines + "\n", "utf-8")
