"""What the pages show: a csv of results/tables as a Markdown table.

A page calls `table` between two marks of cog; `make results` writes what stands between them. This
file reads csv files and nothing else of the project, so a page changes only when its table does.
"""

import csv
import re
from pathlib import Path
from string import Formatter

RATE = re.compile(r"(?<=[`)a-z]), p = ")  # behind a noise, as in older csv files and in the paper
TABLES = Path(__file__).parents[1] / "tables"
COMPARISON = {  # of the columns of compare.comparisons
    "environment": "{environment}",
    "noise": "`{noise}`, rate {rate:g}",
    "n": "{n:.0f} + {n_without:.0f}",
    "with noise": "{mean:,.1f} ± {sd:,.1f}",
    "without": "{mean_without:,.1f} ± {sd_without:,.1f}",
    "change [95 %]": "{difference_percent:+z.0f} % [{low_percent:z.0f}, {high_percent:z.0f}]",
    "effect, sd": "{effect_size:+.2f}",
    "t": "{t:.2f}",
    "p": "{p:.2g}",
    "p needed": "{level:.2g}",
    "Holm": "{holm:.2g}",
    "verdict": "{verdict}",
}
# The columns that a page shows: {title: format of a row}. Other tables are shown as they are.
COLUMNS = {
    "all_runs_batches.csv": {
        "environment": "{environment}",
        "folder": "`{folder}/`",
        "n": "{n:.0f}",
        "of them also above": "{also_elsewhere:.0f}",
        "test return": "{mean:,.1f} ± {sd:,.1f}",
    },
    "baselines_sac_td3.csv": {
        "baseline": "{algorithm} on {environment}",
        "steps": "{steps:,}",
        "ours, v5": "{mean:,.0f} ± {sd:,.0f} ({n})",
        "published (n)": "{theirs:,.0f} ± {their_sd:,.0f} ({their_n:.0f})",
        "by": "{source}",
        "SE": "{se:+.1f}",
        "p": "{p:.2g}",
        "Holm": "{holm:.2g}",
    },
    "consistent_rows.csv": {
        "noise": "`{noise}`, rate {rate:g}",
        "improved": "{improved:.0f} of 5",
        "average [95 %]": "{average_percent:+z.0f} % [{low_percent:z.0f}, {high_percent:z.0f}]",
        "p (Welch)": "{p:.2f}",
        "the paper": "{paper_percent:+z.0f} %",
    },
    "physics_questions.csv": {
        "question": "{question}",
        "seeds": "{seeds}",
        "change [95 %]": "{change_percent:+z.0f} % [{low_percent:z.0f}, {high_percent:z.0f}]",
        "p": "{p:.2g}",
        "Holm": "{holm:.2g}",
        "verdict": "{verdict}",
    },
}


def table(name, **where):
    """Print tables/`name` as a Markdown table, with a dash for an empty cell.

    where: only the rows with these cells, without these columns.
    """
    with (TABLES / name).open(encoding="utf-8", newline="") as file:
        rows = [
            {key: text for key, text in row.items() if key not in where}
            for row in csv.DictReader(file)
            if all(row[key] == text for key, text in where.items())
        ]
    columns = COLUMNS.get(name)
    if "mean_without" in rows[0]:  # a comparison has some of these columns
        columns = {t: form for t, form in COMPARISON.items() if fields(form) <= rows[0].keys()}
    lines = [list(row.values()) for row in rows]
    if columns:
        lines = [[formatted(form, row) for form in columns.values()] for row in rows]
    titles = list(columns or rows[0])
    lines = [[RATE.sub(", rate ", cell) for cell in line] for line in [titles, *lines]]
    lines = [f"| {' | '.join(cell or '–' for cell in line)} |" for line in lines]
    print(lines[0], "|---" * len(titles) + "|", *lines[1:], sep="\n")


def fields(form):
    """Return the names in a format."""
    return {field for _, field, _, _ in Formatter().parse(form) if field}


def formatted(form, row):
    """Return a cell by its format, empty where a value is, but without an interval that is."""
    values = {field: number(row[field]) for field in fields(form)}
    if "" in values.values():
        form = form.partition(" [")[0]
        values = {field: values[field] for field in fields(form)}
    text = "" if "" in values.values() else form.format(**values)
    return text.replace("+0 %", "0 %")  # zero has no sign


def number(text):
    """Return a text as the number that it is, or as it is."""
    try:
        return int(text) if text.isdigit() else float(text)
    except ValueError:
        return text
