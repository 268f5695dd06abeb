"""The runs that may be compared, arranged by configuration, seed and environment."""

from collections import Counter, defaultdict
from dataclasses import dataclass

import numpy as np

from analysis.folders import RETURN, SEARCH, SUCCESS
from analysis.runs import by_study, finished, study_name
from analysis.statistics import are_different, final_value
from analysis.words import counted
from noisy_wrappers import BASELINE


@dataclass
class Study:
    """The finished runs that may be compared: those of one algorithm and one exp_name."""

    algorithm: str
    exp_name: str
    phase: str  # of a choice, or ""
    tested: str  # as in Run
    environments: list
    seeds: list
    steps: np.ndarray  # of the tests that its curves have
    curves: dict  # Configuration, the baseline first -> (steps x seeds x envs), NaN without a test
    finals: dict  # Configuration -> (seeds x envs): what the runs count with, NaN without a run
    metric: str = RETURN  # or SUCCESS: then all values are rates in percent
    episodes: int | None = None  # of a test, if the values are rates of success

    @property
    def key(self):
        """What tells it from other studies, as the columns STUDY do."""
        return self.algorithm, self.exp_name, self.phase, self.tested

    @property
    def name(self):
        """Its name for people."""
        return study_name(*self.key)

    def all_equal(self):
        """Return the environments where all tests of two or more runs are equal."""
        found = []
        for e, env in enumerate(self.environments):
            runs = sum(np.isfinite(finals[:, e]).sum() for finals in self.finals.values())
            parts = [*self.curves.values(), *self.finals.values()]
            tests = np.concatenate([values[..., e].ravel() for values in parts])
            if runs > 1 and not are_different(tests):
                found.append(env)
        return found

    def sample(self, config, e):
        """Return the final values (seeds,) in one environment, of the runs that exist."""
        values = self.finals[config][:, e]
        return values[np.isfinite(values)]

    @property
    def noises(self):
        """The noises, in order, without the baseline's."""
        return sorted({config.noise for config in self.finals} - {""})


def make_studies(entries, metric=RETURN):
    """Arrange the finished runs into a list of Study, and list in words what to know of them.

    metric: what is compared; of success, only environments that tell it. A run there that never
    does was never successful, and a note says so.
    """
    runs, notes = finished(entries), []
    values = {run: run.curve.of(metric) for run in runs}
    telling = {run.environment for run in runs if values[run] is not None}
    silent = Counter(run.environment for run in runs if values[run] is None)
    for environment in sorted(silent.keys() & telling):
        notes.append(
            f"runs on {environment} that never tell success, as others do, count as 0 %: "
            f"{silent[environment]}"
        )
    for run in runs:
        if values[run] is None:
            values[run] = np.zeros(len(run.curve.steps))
    studies = []
    for key, group in by_study(run for run in runs if run.environment in telling).items():
        study = make_study(key, group, values, metric)
        studies.append(study)
        notes += notes_on(study, group)
    return studies, notes


def make_study(key, runs, values, metric):
    """Arrange the runs of one study; values: {Run: what its tests found}."""
    environments = sorted({run.environment for run in runs})
    seeds = sorted({run.seed for run in runs})
    configs = sorted({run.configuration for run in runs} | {BASELINE})
    steps = shared_steps(runs)
    shape = len(seeds), len(environments)
    curves = {config: np.full((len(steps), *shape), np.nan) for config in configs}
    finals = {config: np.full(shape, np.nan) for config in configs}
    for run in runs:
        place = seeds.index(run.seed), environments.index(run.environment)
        finals[run.configuration][place] = final_value(run.curve.steps, values[run])
        tested, at = np.isin(steps, run.curve.steps), np.isin(run.curve.steps, steps)
        curves[run.configuration][:, *place][tested] = values[run][at]
    episodes = min(run.args["eval_episodes"] for run in runs) if metric == SUCCESS else None
    return Study(*key, environments, seeds, steps, curves, finals, metric, episodes)


def shared_steps(runs):
    """Return the steps at which all runs were tested that had not ended before."""
    all_steps = np.unique(np.concatenate([run.curve.steps for run in runs]))
    tested, alive = np.zeros(len(all_steps), int), np.zeros(len(all_steps), int)
    for run in runs:
        tested += np.isin(all_steps, run.curve.steps)
        alive += all_steps <= run.curve.steps[-1]
    shared = all_steps[tested == alive]
    return shared if len(shared) else all_steps


def notes_on(study, runs):
    """Say what to know of a study: runs that were cut, noises that never acted, what it lacks."""
    notes = []
    for e, env in enumerate(study.environments):
        here = [run for run in runs if run.environment == env]
        ended = [run for run in here if run.curve.steps[-1] < run.total_timesteps]
        if ended:
            last = [run.curve.steps[-1] for run in ended]
            steps = " to ".join(f"{step:,}" for step in sorted({min(last), max(last)}))
            notes.append(
                f"{study.name} on {env}: runs that ended by themselves before their "
                f"{runs[0].total_timesteps:,} steps: {len(ended)} of {len(here)}, at step {steps}; "
                "they count with their own last tests"
            )
        idle = Counter(name for run in here for name in run.idle_noises)
        for noise, number in sorted(idle.items()):
            notes.append(
                f"{study.name} on {env}: {noise} changed nothing in {counted(number, 'run')}, "
                "trained as if without it (noise_applied in result.json)"
            )
        if study.phase != SEARCH and len(study.sample(BASELINE, e)) == 0:
            notes.append(f"{study.name}: no finished baseline on {env}, so no comparison there")
    versions = defaultdict(list)
    for env in study.environments:
        name, _, version = env.rpartition("-v")
        versions[name if version.isdecimal() and name else env].append(env)
    for found in versions.values():
        if len(found) > 1:
            notes.append(
                f"{study.name}: {' and '.join(found)} count as environments of their own, also in "
                "averages: give the runs of one version another --exp-name"
            )
    return notes


def version_notes(entries):
    """Say in words where runs of one study differ in versions of code or libraries."""
    notes = []
    for key, runs in by_study(finished(entries)).items():
        versions = {run: run.versions for run in runs}
        for library in sorted(set().union(*versions.values())):
            used = defaultdict(Counter)  # environment -> how many runs have a version
            for run in runs:
                used[run.environment][str(versions[run].get(library) or "unknown")] += 1
            mixed = [counts for counts in used.values() if len(counts) > 1]
            if mixed:
                counts = sum(mixed, Counter())
                told = ", ".join(f"{version} (n = {n})" for version, n in sorted(counts.items()))
                advice = "; give a changed script another --exp-name" if library == "script" else ""
                rows = f"{study_name(*key)}: some rows average runs with different {library}"
                notes.append(f"{rows}: {told}{advice}")
    return notes
