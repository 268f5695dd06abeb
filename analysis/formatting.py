"""How results look as text: numbers, and tables in a terminal and in Markdown."""

import math
import re
from dataclasses import dataclass
from itertools import product

import numpy as np
import pandas as pd
from tabulate import tabulate

from analysis.folders import script_name
from analysis.power import LEVEL
from noisy_wrappers import parse_rates

WHOLE_WORDS = {"break_long_words": False, "break_on_hyphens": False}  # when text is wrapped
DASH = "\u2013"  # of what does not exist
_COLUMNS_WITH = {  # a format of numbers that have no spread
    "z,.0f": """n n_baseline n_baseline_most environments conditions conditions_tested
        chosen_from seeds steps_to_baseline percent_of_environments""",
    "z.2f": "probability_of_improvement probability_low probability_high effect_size t",
    "g": "steps_millions",
}
P_VALUES = ["p", "p_adjusted", "p_holm", "p_luck", "smallest_p"]
SELDOM = ["exp_name", "phase", "tested", "without_percent"]  # columns that may be empty as a whole
PERCENTS = ["difference_percent", "percent_low", "percent_high"]
FORMATS = {name: form for form, names in _COLUMNS_WITH.items() for name in names.split()}


# ------------------------------------------------------------------------------ numbers for people


def rounded(value, spread=None):
    """Return a number as text, with two significant digits of its spread.

    ``spread`` is what the number may be off by, in its own units: a standard deviation, or half the
    width of an interval. The whole part is never cut. Without a spread (none, NaN, zero, or within
    the rounding errors of floating point) the text has four significant digits.

    >>> rounded(9512.34, 210.0), rounded(0.8712, 0.0342), rounded(-40.0, 8.165)
    ('9,512', '0.871', '-40.0')
    >>> rounded(0.8712345), rounded(1234567.8), rounded(0.0, 0.0), rounded(3.2e-7, 1.1e-8)
    ('0.8712', '1,234,568', '0', '3.20e-07')
    """
    if not abs(value) < 1e15:  # beyond the precision of floats, infinite, or NaN
        return f"{value:.3e}"
    known = spread is not None and math.isfinite(spread) and spread > 1e-9 * abs(value)
    digits, scale = (2, spread) if known else (4, abs(value))
    if not scale:
        return "0"
    # "e" rounds first: 0.0996 has the two significant digits of 0.10, not of 0.09
    decimals = max(0, digits - 1 - int(f"{scale:.{digits - 1}e}".partition("e")[2]))
    if decimals <= 6:
        return f"{value:z,.{decimals}f}"
    if abs(value) < 0.5 * 10.0**-decimals:
        return "0"
    exponent = int(f"{value:e}".partition("e")[2])
    return f"{value:.{max(0, exponent + decimals)}e}"


def percent(value, sign="+"):
    """Write a percentage: whole from 10 on, with a decimal below, without a sign if that is 0.0."""
    if abs(value) < 0.05:
        return "0.0 %"
    return f"{value:{sign},.{0 if abs(value) >= 9.95 else 1}f} %"


def percent_end(value):
    """Write an end of an interval in percent; what looks like zero and is not gets a digit."""
    text = percent(value, sign="")
    return f"{value:.1g} %" if text == "0.0 %" and abs(value) > 1e-9 else text


def seeds_of(n, n_baseline, most=0):
    """Write the seeds with and without noise: "5", or "5/10" where they differ.

    most: the most without noise, of several environments: "5/10 to 13".
    """
    if most > n_baseline:
        return f"{n:.0f}/{n_baseline:.0f} to {most:.0f}"
    return f"{n:.0f}" if n == n_baseline else f"{n:.0f}/{n_baseline:.0f}"


def seeds_between(n, n_baseline):
    """Write the seeds of several comparisons with one baseline: "n = 5", or "n = 3 to 5/10"."""
    fewest = f"{min(n):.0f} to " if min(n) != max(n) else ""
    return f"n = {fewest}{seeds_of(max(n), n_baseline)}"


def two_digits(p):
    """Write a p-value with two significant digits, with more if it would look like LEVEL."""
    text = f"{p:.2g}"
    return f"{p:.4g}" if float(text) <= LEVEL < p else text


def p_text(p):
    """Write a p-value: "0.04", or "< 0.001"."""
    return two_digits(p) if p >= 0.001 else "< 0.001"


def p_value(p):
    """Write a p-value behind a p: "= 0.04", or "< 0.001"."""
    return p_text(p) if p < 0.001 else f"= {p_text(p)}"


def is_zero(text):
    """Tell whether a number looks like zero as it is written."""
    return not float(text.replace(",", ""))


def not_zero(value, spread):
    """Write a number as `rounded` does, with more digits if it would look like zero and is not."""
    text = rounded(value, spread)
    is_rounding_error = not abs(value) > 1e-9 * spread
    return rounded(value, abs(value)) if is_zero(text) and not is_rounding_error else text


def listed(names):
    """Join names for a sentence: "A, B and C"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


# ------------------------------------------------------------------------------------------ tables


@dataclass(frozen=True)
class Table:
    """A table of results, as analyze.py prints and writes it."""

    name: str  # of its files
    frame: pd.DataFrame  # all columns, as in the csv
    caption: str  # at most two lines
    section: str  # of the report: a key of report.SECTIONS
    note: str = ""  # what to know about these rows
    only_csv: tuple = ()  # columns that would make the table wider than a page
    view: pd.DataFrame | None = None  # what people read, if that is not the frame
    rates_beside: bool = False  # a column for each noise rate, with mean, std and n in its cells


# Columns that are shown as one, which begins with the number: its spread is the standard deviation
# behind ±, or half of the interval.
MERGED = {
    "no noise": "{baseline_mean} ± {baseline_std}",
    "with noise": "{noisy_mean} ± {noisy_std}",
    "mean": "{mean} ± {std}",
    "average improvement %": "{average_improvement_percent} ± {std_improvement_percent}",
    "IQM": "{iqm} [{iqm_low}, {iqm_high}]",
    "IQM change %": "{iqm_change_percent} [{iqm_change_low}, {iqm_change_high}]",
    "difference": "{difference} [{difference_low}, {difference_high}]",
    "difference %": "{difference_percent} [{percent_low}, {percent_high}]",
    "P(improvement)": "{probability_of_improvement} [{probability_low}, {probability_high}]",
    "luck 95 % (p)": "{luck_95} ({p_luck})",
    "score % (baseline)": "{score_percent} ({baseline_score_percent})",
}


def spreads(frame):
    """Return what each number of a table may be off by: column -> Series, where that is known."""
    found = {}
    for name, template in MERGED.items():
        parts = re.findall(r"\w+", template)
        if parts[-1] not in frame or "(" in template:
            continue
        numbers = frame[parts].astype(float)
        spread = numbers[parts[1]]
        if "[" in template:
            spread = (numbers[parts[2]] - numbers[parts[1]]) / 2
        if name == "difference" and "pooled_std" in frame:
            spread = spread.fillna(frame["pooled_std"])
        found |= dict.fromkeys(parts, spread)
    if "std" in found:
        found.setdefault("difference", found["std"])
    if "difference" in found:
        found["detectable"] = found["difference"]
    if "baseline_std" in found and "noisy_std" in found:
        found["luck_95"] = np.fmax(found["baseline_std"], found["noisy_std"])
    return found


def text_of(name, value, spread=None):
    """Return one value of the column `name` as text; a value that does not exist is a dash.

    Numbers have the digits that their spread deserves.
    """
    if pd.isna(value):
        return DASH
    if isinstance(value, str):
        return value or ("no noise" if name == "noise" else DASH)
    if name in P_VALUES:
        return p_text(value)
    if name in ("difference_low", "difference_high") and spread is not None:
        return not_zero(value, spread)
    if name in FORMATS:
        return f"{value:{FORMATS[name]}}"
    if name in PERCENTS or (name.endswith("_percent") and spread is None):
        is_end = name in ("percent_low", "percent_high")
        return (percent_end(value) if is_end else percent(value, sign="")).removesuffix(" %")
    return rounded(value, spread)


def merged(template, cells):
    """Fill in a template of MERGED; a number that does not exist is a dash, without any interval.

    cells: the text of each of its columns.
    """
    number, other, *_ = cells.values()
    if number == DASH or ("[" in template and other == DASH):
        return number
    return template.format(**cells)


def title(column):
    """Spell the name of a column for people."""
    return column.replace("_", " ").replace("percent", "%").replace("adjusted", "corrected")


def shown(table):
    """Return a table as a person reads it: all text, related columns in one.

    Columns that only some tables need are shown where a row has something there, exp_name where one
    is not its script's.
    """
    frame = (table.frame if table.view is None else table.view).reset_index(drop=True)
    known = spreads(frame)
    frame = frame.drop(columns=list(table.only_csv), errors="ignore")
    if "exp_name" in frame:
        names = [script_name(str(algorithm)) for algorithm in frame["algorithm"]]
        frame["exp_name"] = frame["exp_name"].mask(frame["exp_name"] == names, "")
    empty = frame.columns[(frame.isna() | frame.eq("")).all()]
    frame = frame.drop(columns=empty.intersection(SELDOM))
    cells = {}
    for name in frame:
        pairs = zip(frame[name], known.get(name, [None] * len(frame)), strict=True)
        cells[name] = [text_of(name, value, spread) for value, spread in pairs]
    text = pd.DataFrame(cells, dtype=object)
    if "n_baseline_most" in text:  # over several environments: "10 to 50"
        most = text.pop("n_baseline_most")
        text["n_baseline"] += (" to " + most).where(most != text["n_baseline"], "")
    for name, template in MERGED.items():
        first, *others = parts = re.findall(r"\w+", template)
        if parts[-1] in text:
            text[first] = [merged(template, cells) for cells in text[parts].to_dict("records")]
            text = text.drop(columns=others).rename(columns={first: name})
    if table.rates_beside and len(text):
        text["mean"] += " (" + text.pop("n") + ")"
        keys = [name for name in text if name not in ("noise_rate", "mean")]
        order = pd.MultiIndex.from_frame(text[keys].drop_duplicates())  # pivot() would sort texts
        text = text.pivot(index=keys, columns="noise_rate", values="mean").reindex(order)
        text = text[sorted(text.columns, key=parse_rates)].fillna(DASH).reset_index()
    return text.rename(columns=title)


def text_table(table, width):
    """Format a table for a terminal of this width.

    Wide cells are wrapped if need be; the last columns are left out if that is not enough.
    """
    text = shown(table)
    for columns, wrap in product(range(text.shape[1], 0, -1), (None, 30, 20)):
        cells = text.iloc[:, :columns]
        wrapped = {"maxcolwidths": wrap, "maxheadercolwidths": wrap} | WHOLE_WORDS
        lines = tabulate(cells.values, list(cells), disable_numparse=True, **wrapped)
        if max(map(len, lines.splitlines())) <= width:
            break
    return lines


def in_markdown(table, text):
    """Write a table in Markdown; text: as a person reads it."""
    cells = text.map(lambda cell: cell.replace("|", r"\|").replace("<", "&lt;"))
    lines = tabulate(cells.values, text.columns, tablefmt="pipe", disable_numparse=True)
    note = f"\n{table.note}\n" if table.note else ""
    return f"{table.caption}\n\n{lines}\n{note}"
