"""What benchmark.sh asks `python -m sweep`, asked in this process; and what runs leave behind."""

import contextlib
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import stub_run

from noisy_wrappers import __version__
from sweep import choose
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


def finish(folder, steps=1000, more=(), **args):
    """Write what tells that a run of the sweep is finished; more: of config.json, beside args."""
    folder.mkdir(parents=True, exist_ok=True)
    seed = re.search(r"_s(\d+)_", folder.name)
    args = {"seed": int(seed[1]) if seed else 1, "exp_name": folder.name.rpartition("__")[2]} | args
    args = {"env_id": "Hopper-v5", "noise": [], "noise_rate": []} | args
    args |= {"total_timesteps": steps, "eval_episodes": 10}
    versions = {"noisy_wrappers": __version__}
    algorithm = args["exp_name"].partition("_")[0].upper()
    config = {"algorithm": algorithm, "args": args, "versions": versions} | dict(more)
    (folder / "config.json").write_text(json.dumps(config))
    result = {"total_timesteps": steps, "final_return_mean": 1.0}
    (folder / "result.json").write_text(json.dumps(result))


@contextlib.contextmanager
def locked(folder):
    """Hold a run's lock in another process, as its script does."""
    folder.mkdir(parents=True, exist_ok=True)
    code = "import fcntl, sys; lock = open(sys.argv[1], 'w'); fcntl.lockf(lock, fcntl.LOCK_EX); "
    code += "print(flush=True); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code, folder / ".lock"], **pipes) as holder:
        holder.stdout.readline()
        yield
        holder.stdin.close()


def batches(args):
    """Make the runs of choices in this process, until none is due but those that fail.

    Returns the names of their folders, batch by batch.
    """
    found, failed = [], set()
    while True:
        due = [choice.runs[run] for choice in choose.choices(args) for run in choice.state.due]
        if failed.issuperset(run.folder for run in due):
            return found
        found.append({run.folder.name for run in due})
        for run in due:
            try:
                stub_run.train(run.command)
            except SystemExit:
                failed.add(run.folder)


def log_of(folder):
    return folder.parent / "logs" / f"{folder.name}.log"


def attempts(folder):
    """Return the log's lines, one list for each time that the run was started."""
    parts = re.split(r"^# .*_noisy\.py.*\n", log_of(folder).read_text(), flags=re.MULTILINE)
    return [part.splitlines() for part in parts[1:]]
