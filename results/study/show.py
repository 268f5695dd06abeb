"""What the pages show: a csv of results/tables as a Markdown table.

A page calls `table` between two marks of cog; `make results` writes what stands between them. This
file reads csv files and nothing else of the project, so a page changes only when its table does.
"""

import csv
from pathlib import Path

TABLES = Path(__file__).parents[1] / "tables"


def table(name, columns=None):
    """Print tables/`name` as a Markdown table, with a dash for an empty cell.

    columns: {title: format of a row}, as in {"return": "{mean:,.0f} ± {std:,.0f}"}; without it the
    table is shown as it is.
    """
    with (TABLES / name).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    if columns is None:
        lines = [rows[0].keys(), *(row.values() for row in rows)]
    else:
        values = [{key: number(text) for key, text in row.items()} for row in rows]
        lines = [columns, *([form.format_map(row) for form in columns.values()] for row in values)]
    header, *lines = [f"| {' | '.join(cell or '–' for cell in line)} |" for line in lines]
    print(header, "|---" * len(columns or rows[0]) + "|", *lines, sep="\n")


def number(text):
    """Return a text as the number that it is, or as it is."""
    try:
        return float(text)
    except ValueError:
        return text
