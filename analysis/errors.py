"""How analyze.py, evaluate.py and the sweep write to a terminal, and end on bad input."""

import os
import re
import sys
import sysconfig
import traceback
from pathlib import Path

CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")  # all but tab and the ends of lines

PROJECT = Path(__file__).resolve().parents[1]
# These call what users write, and are not the place of its errors
PROGRAMS = {PROJECT / name for name in ("evaluate.py", "noisy_wrappers.py", "sweep/environment.py")}
PROGRAMS |= set(PROJECT.glob("*_continuous_noisy.py"))
LIBRARIES = ("site-packages", "dist-packages", sysconfig.get_path("stdlib"))


def fail(message, code=2):
    """Exit with one line that says what to do."""
    print("error:", message, file=sys.stderr, flush=True)
    sys.exit(code)


def in_words(error):
    """Return an exception as one line: its type, and its text if it has one."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def with_place(error, plain=()):
    """Return an exception as one line; of any type but `plain`, with the place that raised it.

    That is the last place in the code of a user, if there is one.
    """
    if isinstance(error, plain):
        return " ".join(str(error).split()) or type(error).__name__
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not any(part in frame.filename for part in LIBRARIES)]
    own = own or frames  # where the project itself is installed among the libraries
    place = frames[-1] if Path(own[-1].filename).resolve() in PROGRAMS else own[-1]
    return f"{in_words(error)} ({place.filename}, line {place.lineno})"


class Terminal:
    """A stream of sys that takes any text and outlives its reader, as in `... | head`.

    Logs, config.json and names of folders are other people's: a control character, which could
    be part of an escape sequence, and a character that the terminal lacks are replaced.
    """

    def __init__(self, stream):
        """Take over a stream."""
        stream.reconfigure(errors="replace")
        self._stream = stream

    def __getattr__(self, name):
        """Be the stream in everything else."""
        return getattr(self._stream, name)

    def write(self, text):
        """Write text; once the reader has left, into nothing."""
        self._outlive_reader(self._stream.write, CONTROL.sub("?", text))
        return len(text)

    def flush(self):
        """Pass on what is buffered."""
        self._outlive_reader(self._stream.flush)

    def _outlive_reader(self, action, *args):
        try:
            action(*args)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


def take_over_terminal():
    """Let everything that is printed from now on pass through a Terminal."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name):  # None where it was closed, as with `>&-`
            setattr(sys, name, Terminal(getattr(sys, name)))
