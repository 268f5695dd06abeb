"""A run's folder, lock and log, read without trust: which folders are runs, and what is damaged.

Nothing here waits for pandas, so a sweep of 9,100 runs is listed in a moment.
"""

import fcntl
import json
import math
import os
import re
import shlex
import struct
import time
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from analysis.errors import fail
from noisy_wrappers import MAY_DIFFER_IN_A_TABLE, Configuration

ALGORITHMS = ("SAC", "TD3", "PPO")
SEARCH, CONFIRMATION = PHASES = ("search", "confirmation")  # the folders of a choice
# Arguments that have columns of their own, or may differ; the steps of tests are intersected.
NOT_SETTINGS = {"env_id", "exp_name", "seed", "noise", "noise_rate"} | MAY_DIFFER_IN_A_TABLE
ENV_ID = re.compile(r"(?:\w+(?:\.\w+)*:)?[\w./-]+")  # a module, and what Gymnasium takes for an id
STOPPED = (129, 130, 138, 143)  # exit statuses of a run that was told to stop, by signal
END = re.compile(r"# .* exit=(\d+)")  # the last line of run_one in sweep/executors.sh
PROGRESS = re.compile(r"step=(\d+)/\d+ sps=(\d+)")  # the line of Run.log in the scripts


class DamageError(ValueError):
    """A file of a run cannot be used; the text begins with its name."""


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


def flat_choice(runs_dir):
    """Say how to sort the runs of a choice that an earlier version left side by side."""
    fresh = "*_s1[0-9][0-9][0-9]_*"  # the seeds of its confirmation
    steps = [f"cd {shlex.quote(str(runs_dir))}", f"mkdir {SEARCH} {CONFIRMATION}"]
    steps += [f"mv {fresh} {CONFIRMATION}/"] if any(runs_dir.glob(fresh)) else []
    steps += [f"mv *__*__* {SEARCH}/"]
    return (
        f"{runs_dir} holds the runs of a choice side by side, as earlier versions left them. They "
        f"have two folders now: {' && '.join(steps)}"
    )


# ------------------------------------------------------------------------------------- the contents


@contextmanager
def naming(path):
    """Turn what reading a file raises into a DamageError that begins with the file's name."""
    try:
        yield
    except (OSError, ValueError, OverflowError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else " ".join(str(error).split())
        raise DamageError(f"{path.name}: {reason}") from None


def read_json(path):
    """Read an object from a file. Raises DamageError."""

    def refuse(constant):
        raise ValueError(f"{constant} is no number of JSON")

    with naming(path):
        value = json.loads(path.read_text("utf-8"), parse_constant=refuse)
    if not isinstance(value, dict):
        raise DamageError(f"{path.name} is no JSON object")
    return value


def read_config(folder):
    """Read config.json: what identifies a run. Raises DamageError.

    The result has the arguments under "args"; "algorithm", "environment", "configuration" (a
    Configuration), "exp_name", "seed", "episodes" (of a test), "total" (steps), "settings" (the
    arguments that a study shares) and "versions".
    """
    config = read_json(folder / "config.json")

    def get(values, name, is_good, default=None):
        value = values.get(name, default)
        if not is_good(value):
            raise DamageError(f"config.json: {name} is {shortened(value)}")
        return value

    def number(least):
        return lambda value: type(value) is int and value >= least

    def text(is_good):
        return lambda value: isinstance(value, str) and is_good(value)

    args = get(config, "args", lambda value: isinstance(value, dict))
    versions = get(config, "versions", lambda value: isinstance(value, dict), default={})
    for name in args:
        get(args, name, is_flat)
    get(args, "max_episode_steps", lambda value: value is None or number(1)(value))
    noises, rates = args.get("noise"), args.get("noise_rate")
    try:
        configuration = Configuration.read(noises, rates, stored=True)
    except (ValueError, TypeError, KeyError) as error:
        reason = str(error).partition("\n")[0]
        named = f"noise {shortened(noises)} at {shortened(rates)}"
        raise DamageError(f"config.json: {named}: {reason}") from None
    commit = str(config.get("git_commit"))  # 40 digits, perhaps with "-dirty"
    more = {"matmul precision": config.get("matmul_precision")}
    more["git commit"] = commit[:10] + commit[40:]
    return {
        "algorithm": get(config, "algorithm", ALGORITHMS.__contains__),
        "environment": get(args, "env_id", text(ENV_ID.fullmatch)),
        "exp_name": get(args, "exp_name", text(str.isprintable)),
        "configuration": configuration,
        "seed": get(args, "seed", number(0)),
        "episodes": get(args, "eval_episodes", number(1)),
        "total": get(args, "total_timesteps", number(1)),
        "args": args,
        "settings": {name: args[name] for name in args if name not in NOT_SETTINGS},
        "versions": versions | more,
    }


def read_result(folder, config):
    """Read result.json of a finished run, or return None where there is none.

    config: from read_config. Raises DamageError.
    """
    if not os.path.exists(folder / "result.json"):
        return None
    result = read_json(folder / "result.json")
    mean = result.get("final_return_mean")
    with naming(folder / "result.json"):  # an integer may be too large
        if type(mean) not in (int, float) or not math.isfinite(mean):
            raise DamageError(f"result.json: final_return_mean is {shortened(mean)}")
    steps = result.get("total_timesteps", config["total"])
    if steps != config["total"]:
        said = f"total_timesteps is {shortened(steps)}, in config.json {config['total']}"
        raise DamageError(f"result.json: {said}")
    return result


def is_flat(value):
    """Tell whether a value is what an argument may be: a single value, or a list of such."""
    items = value if isinstance(value, list) else [value]
    return not any(isinstance(item, list | dict) for item in items)


def shortened(value):
    """Return a value of a damaged file as a part of a line."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def difference(settings, reference):
    """Return the names of the settings that both have, with different values, in order."""
    shared = sorted(settings.keys() & reference.keys())
    return [name for name in shared if settings[name] != reference[name]]


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


# -------------------------------------------------------------------------------- the lock, the log


def is_locked(folder):
    """Tell whether a process holds a run's lock, as a script does from its start to its end.

    F_GETLK only asks. To take the lock, even for a moment, would end a run that starts just then.
    """
    layout = "hhqqi"  # of Linux; the type comes first
    question = struct.pack(layout, fcntl.F_RDLCK, 0, 0, 0, 0)
    try:
        with open(os.open(folder / ".lock", os.O_RDONLY | os.O_NONBLOCK), "rb") as lock:
            answer = fcntl.fcntl(lock, fcntl.F_GETLK, question)
    except OSError:  # there is none, or the file system has no locks
        return False
    return struct.unpack(layout, answer)[0] != fcntl.F_UNLCK


class Log(NamedTuple):
    """What the end of a run's log says."""

    path: Path
    age: float  # seconds since the last line, infinite where there is no log
    step: int
    steps_per_second: int
    exit_status: int | None  # None while the run is not over, or where there is no log
    last_line: str  # of what the run itself wrote


def read_log(folder):
    """Read the end of the log that a sweep keeps of a run."""
    path = folder.parent / "logs" / f"{folder.name}.log"
    try:
        with open(path, "rb") as file:
            status = os.fstat(file.fileno())
            file.seek(max(0, status.st_size - 8192))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:  # there is none, or it is somebody else's
        return Log(path, math.inf, 0, 0, None, "")
    end = END.fullmatch(lines[-1]) if lines else None
    steps = [found.groups() for found in map(PROGRESS.match, lines) if found]
    step, steps_per_second = map(int, steps[-1]) if steps else (0, 0)
    # "(" begins the notes that the scripts leave below a traceback
    own = [line for line in lines if re.search(r"\w", line) and not line.startswith(("# ", "("))]
    age = time.time() - status.st_mtime
    last_line = own[-1].strip() if own else ""
    return Log(path, age, step, steps_per_second, int(end[1]) if end else None, last_line)
