"""What benchmark.sh asks `python -m sweep`, asked in this process; and what runs leave behind."""

import contextlib
import io
import os
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

from sweep.__main__ import main

ROOT = Path(__file__).parents[2]


def view(name, *words, caller=ROOT):
    """Call a view as benchmark.sh does; return its exit status, stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(ROOT),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.dict(os.environ, PYTHON=sys.executable),
    ):
        try:
            code = main(name, str(caller), list(map(str, words)))
        except SystemExit as exit_:
            code = exit_.code
    return SimpleNamespace(code=code, out=out.getvalue(), err=err.getvalue())


def folders(*words):
    """Return the run folders of a grid."""
    found = view("list", *words)
    assert found.code == 0, found.err
    return [Path(line.split("\t")[0]) for line in found.out.splitlines()]


def log_of(folder):
    return folder.parent / "logs" / f"{folder.name}.log"


def attempts(folder):
    """Return the log's lines, one list for each time that the run was started."""
    parts = re.split(r"^# .*_noisy\.py.*\n", log_of(folder).read_text(), flags=re.MULTILINE)
    return [part.splitlines() for part in parts[1:]]
