"""Tables for a paper in LaTeX: over both columns, no wider than its text.

They need the packages array, booktabs and graphicx.
"""

import re
import textwrap
from dataclasses import dataclass

from analysis.formatting import DASH

SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"}
SPECIAL |= {"^": r"\^{}", "~": r"\textasciitilde{}", "\\": r"\textbackslash{}", DASH: "--"}
SPECIAL |= {sign: rf"\ensuremath{{{sign}}}" for sign in "<>"}
SPECIAL |= {"\u00b1": r"$\pm$", "\u2212": "$-$"}
CHARACTER, BETWEEN = 3.7, 7.0  # points at \footnotesize: of a character, and between columns
# Characters in a line of a column of text, which is broken there
MOST_OF_NAMES, MOST_OF_WORDS = 24, 12
KEPT = ("environment", "noise", "noise rate", "steps millions", "algorithm, environment")
CORRECTED = ("p corrected", "p holm")
SECONDARY = ("P(improvement)", "IQM change %", "effect size", "chosen from")  # left out first
MOST_ROWS = 30  # of a table, where a name may take two lines; the others have tables of their own
NUMBER = re.compile(r"((?:< ?)?[-+]?(?:[0-9]|inf)[^ ]*) ?(.*)")
TWO_PARTS = "r@{~}l"
NUMBERS = {"r": 1, TWO_PARTS: 2}  # forms of columns of numbers: how many columns each is
OF_STUDY = ("algorithm", "exp name", "phase", "tested")  # in the caption where all rows share it


@dataclass
class Column:
    """A column of a table in LaTeX."""

    head: str
    form: str  # as in \begin{tabular}{...}
    cells: list
    width: float  # in points, about


def escaped(text):
    """Escape a text, with real minus signs."""
    text = re.sub(r"(?<![\w.)])-(?=[0-9]|inf)", "\u2212", str(text))
    return "".join(SPECIAL.get(character, character) for character in text)


def headed(name, form, cells, characters):
    """Make a Column whose head is broken to be about as wide as its cells."""
    words = textwrap.wrap(name, max(9, characters), break_long_words=False)
    width = CHARACTER * max(characters, *map(len, words)) + BETWEEN
    head = r"\\".join(map(escaped, words))
    if len(words) > 1:
        head = rf"\shortstack{{{head}}}"
    if form in NUMBERS:
        head = rf"\multicolumn{{{NUMBERS[form]}}}{{c}}{{{head}}}"
    return Column(head, form, cells, width)


def number_column(name, values):
    """Make a Column of numbers, which meet at the sign behind them: "115" and "± 13"."""
    found = [NUMBER.fullmatch(value) for value in values]
    pairs = [match.groups() if match else (DASH, "") for match in found]
    first, second = (max(map(len, parts), default=0) for parts in zip(*pairs, strict=True))
    if not second:
        return headed(name, "r", [escaped(number) for number, _ in pairs], first)
    cells = [f"{escaped(number)} & {escaped(rest)}" for number, rest in pairs]
    return headed(name, TWO_PARTS, cells, first + 1 + second)


def text_column(name, values):
    """Make a Column of text, which is broken between the words of a name where it is long."""
    most = MOST_OF_NAMES if name == "noise" or "environment" in name else MOST_OF_WORDS
    longest = max(map(len, values), default=0)
    if longest <= most:
        return headed(name, "l", list(map(escaped, values)), longest)
    pieces = [re.split(r"(?<=[a-z0-9])(?=[A-Z(])", value) for value in values]
    cells = [r"\allowbreak{}".join(map(escaped, parts)) for parts in pieces]
    form = rf">{{\raggedright\arraybackslash}}p{{{CHARACTER * most:.0f}pt}}"
    return headed(name, form, cells, most)


def is_number(name, values):
    """Tell whether a column has nothing but numbers."""
    if name == "noise rate" or not values:
        return False
    return all(value == DASH or NUMBER.fullmatch(value) for value in values)


def fitting(text, points):
    """Return the Columns of a table that have room, and the names of those that have none.

    The secondary ones are left out first, with them p where there is a corrected one, then the last
    ones. What a row is about stays, and what a verdict needs: its size and the corrected p.
    """
    columns = {}
    for name in text:
        values = list(text[name])
        make = number_column if is_number(name, values) else text_column
        columns[name] = make(name, values)
    size = "difference" if "difference" in columns else "effect size"
    kept = (*OF_STUDY, *KEPT, "verdict", size, *CORRECTED)
    secondary = (*SECONDARY, "p") if columns.keys() & set(CORRECTED) else SECONDARY
    out = [name for name in (*secondary, *reversed(columns)) if name in columns]
    out = [name for name in dict.fromkeys(out) if name not in kept and name[0].isalpha()]
    left_out = []
    while out and sum(column.width for column in columns.values()) > points:
        left_out.append(out.pop(0))
        del columns[left_out[-1]]
    return list(columns.values()), left_out


def latex_table(table, text, inches):
    """Write a table in LaTeX that is at most so wide; text: as a person reads it.

    Columns are left out where there is no room for them, and a comment names them. What all rows
    share is said in the caption.
    """
    caption = f"{table.caption} {table.note}".strip()
    shared = [name for name in OF_STUDY if name in text and text[name].nunique() == 1]
    if shared and len(text) > 1:
        caption = f"{', '.join(text.iloc[0][shared])}: {caption}"
        text = text.drop(columns=shared)
    if len(text):
        text = text.loc[:, (text != DASH).any()]  # a column of dashes says nothing
    columns, left_out = fitting(text, 72 * inches)
    rows = [" & ".join(row) + r" \\" for row in zip(*(c.cells for c in columns), strict=True)]
    lines = []
    if left_out:
        lines.append(f"% no room for: {', '.join(left_out)} (see {table.name}.csv)")
    for start in range(0, max(1, len(text)), MOST_ROWS):
        continued = " (continued)" if start else ""
        lines += [
            r"\begin{table*}[t]",
            r"\centering",
            rf"\caption{{{escaped(caption if not start else table.caption)}{continued}}}",
            r"\vspace{3pt}",
            r"\footnotesize\setlength{\tabcolsep}{3pt}",
            r"\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{%",
            rf"\begin{{tabular}}{{@{{}}{''.join(column.form for column in columns)}@{{}}}}",
            r"\toprule",
            " & ".join(column.head for column in columns) + r" \\",
            r"\midrule",
            *rows[start : start + MOST_ROWS],
            r"\bottomrule",
            r"\end{tabular}}",
            r"\end{table*}",
        ]
    return "\n".join(lines) + "\n"
