"""The lock that a run holds, and the log that a sweep keeps of it."""

import fcntl
import math
import os
import re
import struct
import time
from pathlib import Path
from typing import NamedTuple

STOPPED = (129, 130, 138, 143)  # exit statuses of a run that was told to stop, by signal
END = re.compile(r"# .* exit=(\d+)")  # the last line of run_one in sweep/executors.sh
PROGRESS = re.compile(r"step=(\d+)/\d+ sps=(\d+)")  # the line of Run.log in the scripts


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
    frame = [line for line in lines if line.startswith("# ")]
    end = END.fullmatch(frame[-1]) if frame else None  # what a run left behind may print after it
    steps = [found.groups() for found in map(PROGRESS.match, lines) if found]
    step, steps_per_second = map(int, steps[-1]) if steps else (0, 0)
    own = [line for line in lines if re.search(r"\w", line) and not line.startswith("# ")]
    while len(own) > 1 and own[-1].startswith("│") and not own[-2].startswith("╭"):
        own.pop()  # a box, in which tyro tells what is wrong with an argument: its first line
    age = time.time() - status.st_mtime
    last_line = own[-1].strip(" │") if own else ""
    return Log(path, age, step, steps_per_second, int(end[1]) if end else None, last_line)
