"""Run folders, read without trust: which folders are runs, what a run was, and what is damaged.

Everything that reads a run reads it here, once: read_run returns a Run. Nothing here waits for
pandas, so a sweep of 9,100 runs is listed in a moment.
"""

import fcntl
import json
import math
import os
import re
import zlib
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from operator import index
from pathlib import Path
from typing import Any

import numpy as np

from analysis.errors import fail
from noisy_wrappers import BASELINE, MAY_DIFFER_IN_A_RUN, Configuration, release

SEARCH, CONFIRMATION = PHASES = ("search", "confirmation")  # the folders of a choice
RETURN, SUCCESS = "return", "success rate"  # the metrics: what runs are compared by
# Runs with other values of these may stand in one row of a table, too: a GPU rounds otherwise, and
# tests do not touch training. But a run keeps to the ones that it began with.
MAY_DIFFER_IN_A_TABLE = MAY_DIFFER_IN_A_RUN | {"cuda", "eval_frequency"}
# Arguments that have a column of their own in tables, or may differ there
NOT_SETTINGS = {"env_id", "exp_name", "seed", "noise", "noise_rate"} | MAY_DIFFER_IN_A_TABLE
ENV_ID = re.compile(r"(?:\w+(?:\.\w+)*:)?[\w./-]+")  # a module, and what Gymnasium takes for an id
ALGORITHM = re.compile(r"[\w .+()-]+")  # it names files
# What reading a damaged file raises, compressed or not
BAD_FILES = (OSError, ValueError, OverflowError, RecursionError, EOFError, zlib.error)
EVAL_COLUMNS = ["step", "episode", "episodic_return", "episodic_length"]


class DamageError(ValueError):
    """A file of a run cannot be used; the text begins with its name.

    `run` is what could be read of it all the same, or None.
    """

    run = None


@dataclass(frozen=True, eq=False)
class Curve:
    """The tests of a run, in the order of its training."""

    steps: np.ndarray  # at which it was tested
    returns: np.ndarray  # of each test, the mean over its episodes
    success_rates: np.ndarray | None  # in percent of the episodes; None if none tells success

    def of(self, metric):
        """Return what the tests found by a metric; None where that is success and is not told."""
        return self.success_rates if metric == SUCCESS else self.returns


@dataclass(frozen=True, eq=False)
class Run:
    """A run, as its folder tells it."""

    folder: Path
    phase: str  # of a choice, or ""
    config: Mapping[str, Any]  # config.json: "args", "defaults", "versions" and more
    algorithm: str
    script: str  # the name of its file
    environment: str
    exp_name: str
    configuration: Configuration
    tested_under: Configuration  # BASELINE: it was tested without noise
    seed: int
    total_timesteps: int  # as they were planned: a run may end by itself before
    release: str  # of noisy_wrappers, "0.4"
    result: Mapping[str, Any] | None = None  # result.json of a finished run
    curve: Curve | None = None  # of a finished run, if it was asked for

    @property
    def args(self):
        """The arguments that it was started with."""
        return self.config["args"]

    @property
    def finished(self):
        """Whether it has ended well."""
        return self.result is not None

    @property
    def versions(self):
        """What made it: {name: version}, with the first digits of the commit and of the script."""
        commit = str(self.config.get("git_commit"))  # 40 digits, perhaps with "-dirty"
        scripts = str(self.config.get("script_sha256", "unknown")).split(", ")
        more = {"matmul precision": self.config.get("matmul_precision")}
        more["git commit"] = commit[:10] + ("-dirty" if commit.endswith("-dirty") else "")
        more["script"] = ", ".join(script[:10] for script in scripts)
        return {**self.config.get("versions", {}), **more}

    def is_of_another_text(self, sha256):
        """Tell whether another text of its script than this one made it, or a part of it."""
        return self.config.get("script_sha256", sha256) != sha256

    @property
    def idle_noises(self):
        """The names of the noises that changed nothing in the training of a finished run."""
        applied = self.result.get("noise_applied")  # {name: [steps or episodes, of how many]}
        if not isinstance(applied, dict):
            return []
        return [name for name, n in applied.items() if isinstance(n, list) and n[:1] == [0]]

    @property
    def tested(self):
        """Where it was tested, if that is not the clean environment as its id makes it."""
        kwargs = self.args.get("env_kwargs")  # of the training, too
        told = [f"with {', '.join(sorted(kwargs))}"] if kwargs else []
        told += [f"tested under {self.tested_under}"] if self.tested_under != BASELINE else []
        return "; ".join(told)


# --------------------------------------------------------------------------- which folders are runs


def is_run(folder):
    """Tell run folders from others: from those of logs, and from what other programs left."""
    if os.path.isfile(folder / "eval.csv") or os.path.isfile(folder / ".lock"):
        return True
    try:
        return '"args"' in (folder / "config.json").read_text("utf-8", "replace")
    except PermissionError:
        return "__" in folder.name  # as in the names of runs
    except OSError:
        return False


def has_begun(folder):
    """Tell whether a run has written more than its lock; who cannot look will be told so."""
    begun = any(os.path.exists(folder / name) for name in ("config.json", "eval.csv"))
    return begun or (os.path.isdir(folder) and not os.access(folder, os.X_OK))


def is_phase(folder):
    """Tell whether a folder is one of the two of a choice."""
    return folder.name in PHASES and all(os.path.isdir(folder.parent / name) for name in PHASES)


def runs_of(runs_dir):
    """Return the run folders of a folder of runs, those of a choice's two phases included.

    Folders whose names begin with a dot are left out. Exits if a folder cannot be read.
    """
    folders = [runs_dir, *(runs_dir / phase for phase in PHASES)]
    try:
        found = [child for folder in folders if os.path.isdir(folder) for child in folder.iterdir()]
    except OSError as error:
        fail(f"{error.filename}: {error.strerror}")
    return sorted(child for child in found if not child.name.startswith(".") and is_run(child))


def logged(runs_dir):
    """Return the run folders that the logs of sweeps tell of, whether they exist or not."""
    places = [runs_dir / phase for phase in ("", *PHASES)]
    return [place / log.stem for place in places for log in sorted(place.glob("logs/*__*.log"))]


# ----------------------------------------------------------------------------------- their contents


@contextmanager
def naming(path):
    """Turn what reading a file raises into a DamageError that begins with the file's name."""
    try:
        yield
    except BAD_FILES as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise DamageError(f"{path.name}: {reason}") from None


def read_json(path):
    """Read an object from a file. Raises DamageError."""
    with naming(path):
        value = json.loads(path.read_text("utf-8"))
    if not isinstance(value, dict):
        raise DamageError(f"{path.name} is no JSON object")
    return value


def read_run(folder, phase="", *, with_curve=True):
    """Read a run folder that has begun; a Run. Raises DamageError.

    with_curve: read eval.csv of a finished run, too.
    """
    run = read_identity(folder, phase)
    try:
        run = replace(run, result=read_result_of(run))
        return replace(run, curve=read_curve(run)) if run.finished and with_curve else run
    except DamageError as error:
        error.run = run
        raise


def read_identity(folder, phase=""):
    """Read config.json: what a run is, finished or not. Raises DamageError."""
    config = read_json(folder / "config.json")
    try:
        args, algorithm = config["args"], config["algorithm"]
        noise, test_noise = (
            Configuration.read(args.get(name, none), args.get(f"{name}_rate", none), stored=True)
            for name, none in (("noise", None), ("test_noise", []))
        )
        run = Run(
            folder=folder,
            phase=phase,
            config=config,
            algorithm=algorithm,
            script=config.get("script", f"{script_name(algorithm)}.py"),
            environment=args["env_id"],
            exp_name=args["exp_name"],
            configuration=noise,
            tested_under=test_noise,
            seed=index(args["seed"]),
            total_timesteps=index(args["total_timesteps"]),
            release=release(config),
        )
        index(args["eval_episodes"])
        if not isinstance(config.get("defaults", {}), dict):
            raise TypeError("defaults is no object")
        names = algorithm, run.environment, run.script, run.exp_name, run.tested
        are_names = ALGORITHM.fullmatch(algorithm) and ENV_ID.fullmatch(run.environment)
        if not are_names or not all(map(str.isprintable, names)):
            raise ValueError(f"not all of {names} are names")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise DamageError(f"config.json: {type(error).__name__}: {reason}") from None
    return run


def script_name(algorithm):
    """Return the name of an algorithm's script: the exp_name that it gives its runs by default."""
    return f"{algorithm.lower()}_continuous_noisy"


def read_result_of(run):
    """Read result.json of a finished run, or return None where there is none."""
    path = run.folder / "result.json"
    if not os.path.exists(path):
        return None
    result = read_json(path)
    mean = result.get("final_return_mean")
    with naming(path):  # an integer may be too large
        if type(mean) not in (int, float) or not math.isfinite(mean):
            raise ValueError(f"final_return_mean is {mean!r}")
    return result


def read_curve(run):
    """Read eval.csv of a finished run. Raises DamageError unless every test is whole, in order.

    The last one must have the return of result.json. It may be earlier than was planned, and tests
    may be at any steps: then the run ended by itself, or was tested more often.
    """
    episodes = run.args["eval_episodes"]
    path = run.folder / "eval.csv"
    with naming(path):
        text = path.read_text("utf-8")
        header, *lines = text.splitlines()
        names = header.split(",")
        if names not in (EVAL_COLUMNS, [*EVAL_COLUMNS, "success"]) or not any(lines):
            raise ValueError("unexpected header, or no evaluation")
        if not text.endswith("\n"):
            raise ValueError("the last line is half-written")
        # the cell of success is empty where the environment tells nothing
        lines = [f"{line}nan" if line.endswith(",") else line for line in lines]
        numbers = np.loadtxt(lines, delimiter=",", ndmin=2, comments=None)
        tests = numbers.reshape(-1, episodes, len(names))
        step, episode, returns = tests[..., 0], tests[..., 1], tests[..., 2]
        is_whole = (episode == np.arange(episodes)).all() and (step == step[:, :1]).all()
        is_whole &= np.isfinite(tests[..., :4]).all()
        if not is_whole or (np.diff(step[:, 0]) <= 0).any():
            raise ValueError("an evaluation is incomplete or not in its place")
    returns = returns.mean(axis=1)
    last = run.result["final_return_mean"]
    if not math.isclose(returns[-1], last, rel_tol=1e-3, abs_tol=1e-3):
        raise DamageError("eval.csv and result.json disagree on the final return")
    rates = None
    if len(names) > 4 and not np.isnan(tests[..., 4]).all():
        rates = 100 * np.nan_to_num(tests[..., 4]).mean(axis=1)  # what is not told was no success
    return Curve(step[:, 0].astype(int), returns, rates)


@contextmanager
def rewritten(path):
    """Yield a file that replaces `path` in the end, whole or not at all; one process at a time."""
    new = path.with_name(f".{path.stem}.{os.getpid()}")  # not *.tmp, which training again deletes
    with open(path.with_name(f".{path.stem}.lock"), "a", encoding="utf-8") as lock:
        fcntl.lockf(lock, fcntl.LOCK_EX)  # until it is closed
        try:
            with open(new, "w", newline="", encoding="utf-8") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(new, path)
        finally:
            new.unlink(missing_ok=True)
