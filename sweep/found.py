"""What a sweep finds in the folders of its runs: finished runs, damage, and runs of another kind.

A finished run counts if its arguments are those that the sweep would give it, and its release is
this one. A script that was changed since does not hinder it: that is said.
"""

import os
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from analysis.errors import fail
from analysis.folders import DamageError, Run, logged, read_run, runs_of
from analysis.words import counted
from noisy_wrappers import MAY_DIFFER_IN_A_RUN, __version__, different_arguments, release
from sweep.grid import PlannedRun
from sweep.scripts import PROJECT, is_same, read, scripts_in, spelt

NOW = release({"versions": {"noisy_wrappers": __version__}})
# The name of a folder tells the noises
NOT_COMPARED = MAY_DIFFER_IN_A_RUN | {"noise", "noise_rate", "test_noise", "test_noise_rate"}
ADVICE = "give this sweep another --exp-name, at the end after --, or another --runs-dir"


class Found(NamedTuple):
    """What lies in a run's folder."""

    finished: bool = False  # with the arguments and the release that the sweep wants
    damage: str = ""
    run: Run | None = None
    differences: tuple[str, ...] = ()  # of its arguments from those that the sweep wants
    other_release: str = ""  # that made it
    other_text: bool = False  # of the script made it, or a part of it


def look(planned, with_curve=False):
    """Return what lies in the folder of a run."""
    if planned.damage or not os.path.exists(planned.folder / "config.json"):
        return Found(damage=planned.damage)
    try:
        run = read_run(planned.folder, with_curve=with_curve)
    except DamageError as error:
        return Found(damage=f"{planned.folder}/{error}; move its folder away to run it again")
    if run.release != NOW:
        return Found(run=run, other_release=run.release, finished=run.finished)
    differences = tuple(differences_of(run, planned)) if planned.args is not None else ()
    other_text = bool(planned.script) and run.is_of_another_text(planned.script.sha256)
    finished = run.finished and not differences
    return Found(finished=finished, run=run, differences=differences, other_text=other_text)


def differences_of(run, planned):
    """Yield the arguments in which a run differs from what the sweep would give it, in words."""
    if run.algorithm.lower() != planned.kind[0]:
        yield f"--algos {run.algorithm.lower()}, not {planned.kind[0]}"
    defaults = planned.script.defaults
    wanted = {"args": dict(defaults), "defaults": defaults}
    for name, words in planned.args.items():
        made = run.args.get(name, defaults.get(name))
        is_path = "Path" in planned.script.options.get(name, "")
        wanted["args"][name] = made if is_same(made, words, is_path) else words
    for name, (made, words) in different_arguments(run.config, wanted, NOT_COMPARED).items():
        if name != "eval_frequency" or words is not None:  # without one, a run keeps its own
            said = " ".join(map(str, words)) if isinstance(words, list) else words
            yield f"{spelt(name)} {made}, not {said}"


def remarks(found, place):
    """Return lines about runs that the sweep cannot continue, and lines about others.

    found: of all its runs; place: their folder, for people.
    """
    found, hindrances, notes = list(found), [], []
    others = [one for one in found if one.differences]
    if others:
        counts = Counter(text for one in others for text in one.differences)
        said = ", ".join(text for text, _ in counts.most_common(3))
        said += ", ..." if len(counts) > 3 else ""
        first = others[0].run.folder.name
        what = f"{runs_were(len(others))} made in {place} with other arguments: {said}"
        hindrances.append(f"{what} (as {first}); {ADVICE}")
    releases = Counter(one.other_release for one in found if one.other_release)
    for old, number in sorted(releases.items()):
        text = (
            f"{runs_were(number)} made in {place} by release {old}, and this is {NOW}: runs of "
            f"two releases are two studies. Finish them with {old}, or {ADVICE}"
        )
        whole = number == len(found) and all(one.finished for one in found)
        (notes if whole else hindrances).append(text)
    for script, number in Counter(one.run.script for one in found if one.other_text).items():
        notes.append(
            f"{runs_were(number)} made in {place} by another text of {script} than today's; "
            f"if the change matters, {ADVICE}"
        )
    return hindrances, notes


def runs_were(number):
    """Begin a sentence: "1 run was", "3 runs were"."""
    return f"{counted(number, 'run')} {'was' if number == 1 else 'were'}"


def refuse_others(runs, place):
    """Look at runs before any is started; exit if there are some that cannot be continued.

    Returns what was found, run by run, and notes on it.
    """
    found = list(map(look, runs))
    hindrances, notes = remarks(found, place)
    if hindrances:
        fail("\nerror: ".join(hindrances))
    return found, notes


def runs_in(folder, caller):
    """Return the runs that a folder or its logs tell of, for a status that names no grid."""
    folders = {*runs_of(Path(folder)), *logged(Path(folder))}
    if not folders:
        fail(f"no runs in {folder}; name their folder with --runs-dir")
    places = (Path(caller), PROJECT)
    paths = {path.name: path for place in places for path in scripts_in(place).values()}
    runs = []
    for path in sorted(folders):
        planned = PlannedRun(path, ("", ""), 0, 0, [])  # unknown: it has failed before it began
        if os.path.exists(path / "config.json"):
            try:
                run = read_run(path, with_curve=False)
                kind, steps = (run.exp_name, run.environment), run.total_timesteps
                script = read(paths[run.script]) if run.script in paths else None
                planned = planned._replace(kind=kind, total_timesteps=steps, script=script)
            except DamageError as error:
                planned = planned._replace(damage=f"{path}/{error}")
        runs.append(planned)
    return runs
