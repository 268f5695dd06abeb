"""Make the paper's tables and figures from a folder of runs, with statistics fit for few seeds.

    python analyze.py
    python analyze.py --runs-dir runs/demo --out somewhere --smallest-gain 10

The tables, the figures and report.html go to RUNS_DIR/results unless --out says otherwise. Open
report.html first.

The unit of replication is the seed: a run counts with the mean of its tests in the last 15 % of its
steps, and every mean, standard deviation (ddof=1) and interval is taken over runs. Only finished
runs (those with a result.json) count; all others are listed, and the exit status is 1 if one is
damaged. The paper is Khraishi and Okhrati (2023),
https://arxiv.org/abs/2305.02882; IQM and probability of improvement are those of Agarwal et al.
(2021), https://arxiv.org/abs/2108.13264.
"""

import math
import os
import shutil
import sys
import textwrap
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import pandas as pd
import tyro

from analysis.choice import choice_file, read_choice
from analysis.comparisons import are_in, as_chosen, compare_all, runs_in
from analysis.errors import fail, take_over_terminal
from analysis.figures import INTERVAL, figures, write_figure
from analysis.folders import CONFIRMATION, PHASES, RETURN, SUCCESS, is_phase, is_run
from analysis.formatting import WHOLE_WORDS, in_markdown, listed, shown, text_table
from analysis.latex import latex_table
from analysis.report import Results, write_report
from analysis.robustness import analyse_robustness, read_robustness
from analysis.runs import MORE_TO_COME, finished, in_short, left_out, read_runs
from analysis.studies import make_studies, version_notes
from analysis.style import COLUMN, PAGE
from analysis.tables import in_words, lopsided_notes, make_tables, success_table, table_of
from analysis.verdicts import POINTS, clear_first, headlines, in_sentences, tally
from analysis.words import counted

MOST_ROWS = 15  # of the first table in a terminal; the report has all
# Columns that a terminal may have room for, the most important ones first
MISSING_IN_SHORT = ["status", "reason", "seeds", "environment", "noise", "noise_rate", "run"]


@dataclass
class Args:
    """Command-line arguments."""

    runs_dir: Path = Path("runs")
    """the folder that holds the run folders"""
    out: Path | None = None
    """where the tables, the figures and report.html go; by default RUNS_DIR/results"""
    latex: bool = False
    """also write the tables as Markdown and LaTeX, and the figures as pdf; once they are there,
    each analysis into the same folder renews them, at the --figure-width that it is given"""
    figure_width: float = PAGE
    """inches of a paper's text, for which figures and LaTeX tables are made; every figure is also
    made for a column of 3.25 inches. In ICML 6.75, in NeurIPS 5.5, in ACM's sigconf 7"""
    band: Literal["interval", "std"] = INTERVAL
    """what is shaded around a mean curve: the 95 % interval of the mean (with fewer than five seeds
    there is none, and each seed is drawn), or one standard deviation over seeds"""
    metric: Literal["return", "success_rate"] = RETURN
    """what the verdicts judge by: final test returns, or rates of success in percent"""
    smallest_gain: float | None = None
    """the smallest gain that matters, in percent (of success: in percentage points): a noise whose
    interval excludes it has the verdict "no such gain\""""


def verdicts_in_short(results):
    """Yield the tally of each study, then the sentences of clear verdicts."""
    if not results.headlines:
        yield "No comparison has a verdict yet."
    for line in results.headlines:
        counts = ", ".join(f"{count:,} {word}" for word, count in line["counts"])
        yield f"{line['name']}: {line['tried']}: {counts}. {line['luck']}".strip()
    yield from results.clear["sentence"]
    if len(results.clear) and len(results.others):
        yield f"Not shown here, but in the report: {tally(results.others['verdict'])}."
    if len(results.rates):
        yield f"Single rates (secondary, in the report): {tally(results.rates['verdict'])}."
    yield from results.robustness


def overview_of(studies):
    """Say in words what was analysed."""
    numbers = [runs_in(study, study.finals).sum() for study in studies]
    parts = [f"Runs that count: {sum(numbers):,}."]
    parts += [
        f"{study.name}: {counted(number, 'run')} of {study.steps[-1]:,} steps, seeds: "
        f"{len(study.seeds)}, environments: {len(study.environments)}, noise configurations: "
        f"{len(study.finals) - 1}."
        for study, number in zip(studies, numbers, strict=True)
    ]
    return " ".join(parts)


def write_table(out, table, latex, inches):
    """Write {name}.csv, with all digits; with `latex` also .md and .tex, as people read it."""
    csv = out / f"{table.name}.csv"
    table.frame.to_csv(csv, index=False, float_format="%.10g", lineterminator="\n")
    if latex:
        text = shown(table)
        csv.with_suffix(".md").write_text(in_markdown(table, text), "utf-8")
        csv.with_suffix(".tex").write_text(latex_table(table, text, inches), "utf-8")


def write_results(out, results, args):
    """Write all tables, all figures and the report."""
    out.mkdir(parents=True, exist_ok=True)
    latex = args.latex or (out / "noises.tex").exists()  # old ones would contradict the new report
    for table in results.tables.values():
        write_table(out, table, latex, args.figure_width)
    drawn = figures(results.studies, results.tables, args.band)
    for drawing in drawn:
        write_figure(out, drawing, latex, args.figure_width)
    write_report(out, results, drawn)


def terminal_width():
    """Return the number of columns of the terminal; a file or a pipe has no end."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize


def print_left_out(missing, width):
    """Print the first of the runs that were left out."""
    print(text_table(replace(missing, view=missing.view[MISSING_IN_SHORT][:20]), width))


def print_results(out, results):
    """Print the verdicts, what to know about them, and where the report is."""
    width, tables = terminal_width(), results.tables
    of_success = results.studies[0].metric == SUCCESS
    unit = " (rates of success in percent, differences in percentage points)" if of_success else ""

    def say(text):
        print(textwrap.fill(text, width, subsequent_indent="  ", **WHOLE_WORDS))

    for line in verdicts_in_short(results):
        say(line)
    print()
    first = tables["noises"]
    if 0 < len(first.frame) <= MOST_ROWS:
        say(f"Does a noise help at all? Its rates together, against no noise{unit}:")
        first = replace(first, view=in_words(first.frame, "noises"))
        print(f"\n{text_table(first, width)}\n")
    if len(tables["best"].frame) and "best" not in results.repeated:
        say(f"The best noise in each environment, which may still be worse than no noise{unit}:")
        print(f"\n{text_table(tables['best'], width)}\n")
    say(results.overview)
    for note in results.notes + results.versions:
        say(f"note: {note}")
    if results.problems:
        print()
        say(f"WARNING: {results.problems}")
        print_left_out(tables["missing"], width)
        print(f"All of them: {out / 'missing.csv'}")
    print(f"\nOpen {out / 'report.html'}")


def analyse(args, entries, choice):
    """Compute everything that is told of the runs of a folder (read_runs); see main."""
    metric = args.metric
    left = left_out(entries)
    missing = table_of("missing", left, view=in_short(left))
    studies, notes = make_studies(entries, metric)
    if not studies and finished(entries):
        fail("--metric success_rate: no environment here tells it, in `is_success` or `success`")
    if not studies:
        if len(missing.frame):
            print_left_out(missing, terminal_width())
        fail(f"no finished run in {args.runs_dir}: name the folder of your runs with --runs-dir")
    compared = as_chosen(compare_all(studies, args.smallest_gain), choice)
    tests, unreadable = read_robustness(finished(entries), metric)
    robustness_tables, robustness = analyse_robustness(tests, metric)
    tables = make_tables(studies, compared) | robustness_tables
    if metric == SUCCESS:
        told = {environment for study in studies for environment in study.environments}
        silent = [run.environment for run in finished(entries) if run.environment not in told]
        if silent:
            notes.append(
                f"not judged, because their environments never tell success: "
                f"{counted(len(silent), 'run')} on {listed(sorted(set(silent)))}"
            )
        for name, table in tables.items():
            tables[name] = replace(table, caption=table.caption.replace("return", metric))
    else:
        of_success, notes_on_success = make_studies(entries, SUCCESS)
        tables |= success_table(of_success)
        notes += [note for note in notes_on_success if note not in notes]
    tables["missing"] = missing
    if choice is not None:
        tables["choice"] = table_of("choice", choice)
    if any(study.phase == CONFIRMATION for study in studies):
        notes.append(
            "verdicts on confirmations are those of ./benchmark.sh choose, which looks several "
            f"times, at levels of its own; one that {choice_file(metric)} does not name has none"
        )
    unit = POINTS if metric == SUCCESS else ""

    def said(*parts):
        found = [in_sentences(rows, unit, args.smallest_gain) for rows in parts]
        return pd.concat(found, ignore_index=True)

    clear, others = clear_first(said(compared.noises_together, compared.noises))
    number = left["status"].value_counts(sort=False)
    counts = ", ".join(f"{n:,} {status}" for status, n in number.items())
    return Results(
        studies=studies,
        tables=tables,
        headlines=headlines(
            pd.concat([compared.noises_together, compared.noises]), tables["best"].frame
        ),
        clear=clear,
        others=others,
        rates=said(
            compared.rates_together[~are_in(compared.rates_together, compared.noises_together)],
            compared.rates[~are_in(compared.rates, compared.noises)],
        ),
        robustness=robustness,
        overview=overview_of(studies),
        problems=f"Runs left out: {number.sum():,} ({counts})." if len(number) else "",
        notes=[*incomplete_note(left, compared), *lopsided_notes(compared), *notes, *unreadable],
        versions=version_notes(entries),
    )


def incomplete_note(left, compared):
    """Yield a note where a sweep with noise is not complete.

    left: the runs left out. Those of a choice, which looks as it has planned, do not matter.
    """
    top_folder = left["run"].map(lambda run: run.partition("/")[0])  # some runs tell no phase
    due = left[left["status"].isin(MORE_TO_COME) & ~top_folder.isin(PHASES)]
    if len(due) and not compared.noises.empty:
        number = due["status"].value_counts(sort=False)
        counts = ", ".join(f"{n:,} {status}" for status, n in number.items())
        yield (
            f"this sweep is not complete ({counts}): more runs are due, and a verdict now is an "
            "extra look at the data, which makes false claims more frequent than 5 %"
        )


def main(args):
    """Read the runs, write tables, figures and report, and print verdicts and main table.

    Return the exit status: 1 where a run's files are damaged.
    """
    args = replace(
        args,
        runs_dir=Path(os.path.expanduser(args.runs_dir)),
        metric=args.metric.replace("_", " "),
    )
    if args.smallest_gain is not None and not 0 < args.smallest_gain < math.inf:
        fail(f"--smallest-gain must be above 0, not {args.smallest_gain}")
    if not COLUMN <= args.figure_width <= 20:
        fail(f"--figure-width must be between {COLUMN} and 20 inches, not {args.figure_width}")
    if not args.runs_dir.is_dir():
        fail(f"no folder {args.runs_dir}")
    if is_phase(args.runs_dir.resolve()):  # alone it would be corrected for too few comparisons
        whole = f"--runs-dir {args.runs_dir.resolve().parent}"
        fail(f"{args.runs_dir} is one phase of a choice: analyse all of it with {whole}")
    try:
        choice = read_choice(args.runs_dir, args.metric)
    except ValueError as error:
        fail(error)
    out = Path(os.path.expanduser(args.out or args.runs_dir / "results"))
    others = (args.runs_dir.resolve(), Path.cwd())
    if out.resolve() in others or is_run(out) or is_phase(out):  # where other tables may be
        fail("--out must be a folder of its own, not the current one or one with runs")
    entries = read_runs(args.runs_dir)
    results = analyse(args, entries, choice)
    try:
        write_results(out, results, args)
    except OSError as error:
        fail(f"--out: {error}")
    print_results(out, results)
    return int(any(entry.status == "corrupt" for entry in entries))


if __name__ == "__main__":
    take_over_terminal()
    sys.exit(main(tyro.cli(Args, description=__doc__)))
