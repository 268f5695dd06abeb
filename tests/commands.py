"""Commands in processes forked from a server that has imported PyTorch already.

What takes `python script.py` seconds takes these a moment. They run the file as that would, and can
be told to die, or to be sent a signal, at a chosen moment.
"""

import contextlib
import functools
import itertools
import multiprocessing
import os
import pkgutil
import runpy
import signal
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

from tqdm import tqdm

ROOT = Path(__file__).parents[1]
LIMIT = 600  # seconds that a command may take, also on a busy machine
FORK = multiprocessing.get_context("forkserver")
FORK.set_forkserver_preload(
    ["pytest", "tyro", "tqdm", "gymnasium.envs.mujoco", "torch.utils.tensorboard"]
    + ["torch._dynamo", "tensorboard.backend.event_processing.event_accumulator"]
)


def at(target, number, action):
    """Make the number-th call of `target` in this process (None: every call) act first."""
    owner, _, name = target.rpartition(".")
    owner, calls = pkgutil.resolve_name(owner), itertools.count(1)
    function = getattr(owner, name)

    @functools.wraps(function)
    def patched(*args, **kwargs):
        if next(calls) == number or number is None:
            action(*args, **kwargs)
        return function(*args, **kwargs)

    setattr(owner, name, patched)


def child(path, words, stdout, stderr, cwd, before, moments):
    os.dup2(stdout.fileno(), 1)
    os.dup2(stderr.fileno(), 2)
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", 1, closefd=False)  # noqa: SIM115
    os.chdir(cwd)
    before()
    tqdm.set_lock(threading.RLock())  # a kill would leave the default one's semaphore behind
    for moment in moments:
        at(*moment)
    sys.argv = [str(path), *words]
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except Exception:
        sys.excepthook(*sys.exc_info())  # as Python shows it, and not as multiprocessing does
        sys.exit(1)


def nothing():
    pass


def start(path, words, *moments, cwd=ROOT, before=nothing):
    """Start `python path words...`; each moment is (dotted name, number of the call, action)."""
    (out, stdout), (err, stderr) = FORK.Pipe(duplex=False), FORK.Pipe(duplex=False)
    arguments = (path, [str(word) for word in words], stdout, stderr, cwd, before, moments)
    process = FORK.Process(target=child, args=arguments, daemon=True)
    process.start()
    stdout.close()
    stderr.close()
    process.out, process.err = out, err
    return process


def kill(process):
    """Kill a command; where it has a process group, with all processes of that."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.kill()


def ended(process):
    """Wait for a command; return its exit code (-9 after SIGKILL), stdout and stderr."""
    limit = threading.Timer(LIMIT, kill, [process])  # what hangs is to fail, not to hang the tests
    limit.daemon = True
    limit.start()
    texts = []
    for connection in (process.out, process.err):
        if connection.closed:  # a test has left it
            texts.append("")
            continue
        with open(os.dup(connection.fileno()), errors="replace") as file:
            texts.append(file.read())
    process.join()
    limit.cancel()
    return SimpleNamespace(code=process.exitcode, out=texts[0], err=texts[1])


def run(path, words, *moments, **kwargs):
    return ended(start(path, words, *moments, **kwargs))
