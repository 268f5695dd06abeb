"""benchmark.sh with real runs on its real engines: this machine, GNU parallel, ssh and Slurm.

The engine tests need the Debian packages parallel, openssh-server, rsync, slurm-wlm and munge. They
start an sshd and a one-node cluster of their own and stop them again. Without the packages they
skip; with the environment variable CI they fail.
"""

import argparse
import csv
import json
import os
import pty
import random
import re
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
import stub_run
import tyro

from sweep import choose
from sweep.grid import GIVEN_BY_THE_GRID, check, parse_args, script_options

ROOT = Path(__file__).parents[2]
PATH = f"{os.environ['PATH']}:/usr/sbin:/sbin"
ENV = {**os.environ, "PYTHON": sys.executable, "PATH": PATH}
ALGORITHMS = {"sac": 5, "td3": 5, "ppo": 10}  # seeds

# Three short runs: the baseline, one noise, two noises together. SAC that never starts learning
# is the cheapest real run there is, and it checkpoints like any other.
SCALE, BOTH = (
    "RandomUniformScaleReward(0.5, 1.5)",
    "RandomNormalNoisyReward(1.0)+RandomEarlyTermination(1, 100)",
)
GRID = ["custom", "--algos", "sac", "--envs", "Pendulum-v1", "--seeds", "1"]
GRID += ["--noises", SCALE, BOTH, "--noise-rates", "0.5"]
CHEAP = "--no-compile --learning-starts 1000000000 --buffer-size 1000 --eval-episodes 1"
CHEAP = ["--", *CHEAP.split(), "--eval-frequency", "1000", "--checkpoint-frequency", "1000"]
ON_SIGNAL = [*CHEAP[:-1], "1000000000"]  # a checkpoint only when the run is told to stop
SWEEPS = []  # the sweeps of the current test
PATIENCE = 240  # seconds until a test gives up waiting: a busy machine is no failure
FOREVER = ["--total-timesteps", "1e9"]
A = "RandomNormalNoisyReward(1)"
C = "choose --algos ppo --envs Hopper-v5"


def start(*args, env=ENV, cwd=ROOT, script="./benchmark.sh", prefix=(), **streams):
    command = [*prefix, script, *map(str, args)]
    streams = streams or {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # This test may ignore SIGINT, if a shell has started it in the background, and SIGHUP, if nohup
    # has. What it starts would inherit that, and bash cannot trap what it ignored from the start.
    streams["preexec_fn"] = lambda: [
        signal.signal(number, signal.SIG_DFL) for number in (signal.SIGINT, signal.SIGHUP)
    ]
    SWEEPS.append(subprocess.Popen(command, env=env, cwd=cwd, **streams))
    return SWEEPS[-1]


@pytest.fixture(autouse=True)
def no_sweep_outlives_its_test():
    yield
    for sweep in SWEEPS:
        if sweep.poll() is None:
            sweep.terminate()
            sweep.wait(timeout=PATIENCE)
    SWEEPS.clear()


def run(*args, **kwargs):
    process = start(*args, **kwargs)
    out, err = process.communicate(timeout=PATIENCE)
    return SimpleNamespace(code=process.returncode, out=out, err=err)


def dry_run(*args):
    """Return the grid's lines, each with its text and its options."""
    result = run(*args, "--dry-run")
    assert result.code == 0, result.err
    lines = result.out.splitlines()
    assert result.err.startswith(f"{len(lines)} runs")
    parser = argparse.ArgumentParser()
    parser.add_argument("python", choices=[sys.executable])
    parser.add_argument("script", choices=[f"{name}_continuous_noisy.py" for name in ALGORITHMS])
    for option in ("--env-id", "--runs-dir"):
        parser.add_argument(option, required=True)
    for option in ("--seed", "--total-timesteps"):
        parser.add_argument(option, required=True, type=int)
    parser.add_argument("--noise", nargs="+", default=[])
    parser.add_argument("--noise-rate", nargs="+", default=[])
    return [parser.parse_args(shlex.split(line), argparse.Namespace(text=line)) for line in lines]


def folders(*args):
    """Return the run folders of a grid, by python -m sweep, which benchmark.sh asks too."""
    command = [sys.executable, "-m", "sweep", "list", str(ROOT), *map(str, args)]
    out = subprocess.run(command, env=ENV, cwd=ROOT, check=True, capture_output=True, text=True)
    return [Path(line.split("\t")[0]) for line in out.stdout.splitlines()]


def log_of(folder):
    return folder.parent / "logs" / f"{folder.name}.log"


def attempts(folder):
    """Return the log's lines, one list for each time that the run was started."""
    parts = re.split(r"^# .*_noisy\.py.*\n", log_of(folder).read_text(), flags=re.MULTILINE)
    return [part.splitlines() for part in parts[1:]]


def wait_for(condition, what=""):
    deadline = time.monotonic() + PATIENCE
    while not (value := condition()):
        assert time.monotonic() < deadline, f"timed out: {what}"
        time.sleep(0.05)
    return value


def is_training(folder):
    return log_of(folder).exists() and "step=" in log_of(folder).read_text()


def processes(*words):
    """Return the ids of the training processes with these words on their command line."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = path.read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        if line[0] == sys.executable and all(any(w in a for a in line) for w in map(str, words)):
            found.append(int(path.parent.name))
    return found


# ENGINES


def need(*programs):
    missing = [program for program in programs if not shutil.which(program, path=PATH)]
    if missing:
        explain = pytest.fail if os.environ.get("CI") else pytest.skip
        explain(f"not installed: {', '.join(missing)}")


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@pytest.fixture(scope="module")
def sshd(tmp_path_factory):
    """An sshd of our own on this machine, which ssh reaches as "second"."""
    need("sshd", "ssh", "ssh-keygen", "rsync", "parallel")
    folder, port = tmp_path_factory.mktemp("sshd"), free_port()
    for key in ("host", "user"):
        subprocess.run(
            ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / key], check=True
        )
    if os.geteuid() == 0:
        Path("/run/sshd").mkdir(exist_ok=True)
    (folder / "sshd_config").write_text(
        f"Port {port}\nListenAddress 127.0.0.1\nHostKey {folder}/host\nStrictModes no\nUsePAM no\n"
        f"AuthorizedKeysFile {folder}/user.pub\nPidFile none\nPermitRootLogin yes\n"
    )
    (folder / "ssh_config").write_text(
        f"Host second\nHostName 127.0.0.1\nPort {port}\nIdentityFile {folder}/user\nBatchMode yes\n"
        "StrictHostKeyChecking no\nUserKnownHostsFile /dev/null\nLogLevel ERROR\n"
    )
    command = [shutil.which("sshd", path=PATH), "-D", "-e", "-f", folder / "sshd_config"]
    with open(folder / "log", "w") as log:
        server = subprocess.Popen(command, stderr=log)
    ssh = f"ssh -F {folder}/ssh_config"
    try:
        hello = [*ssh.split(), "second", "true"]
        wait_for(lambda: subprocess.run(hello, capture_output=True).returncode == 0, "sshd")
        yield {**ENV, "PARALLEL_SSH": ssh}
    finally:
        server.terminate()
        server.wait()


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    """A cluster of one node with two cores; arrays have two elements at most."""
    need("munged", "slurmctld", "slurmd", "sbatch")
    if os.geteuid() != 0:
        pytest.skip("a cluster of our own needs root")
    folder, host = tmp_path_factory.mktemp("slurm"), socket.gethostname().partition(".")[0]
    (folder / "key").write_bytes(os.urandom(1024))
    (folder / "key").chmod(0o600)
    (folder / "slurm.conf").write_text(
        f"""ClusterName=test
SlurmctldHost={host}(127.0.0.1)
NodeName={host} NodeAddr=127.0.0.1 CPUs=2
PartitionName=main Nodes=ALL Default=YES
SlurmctldPort={free_port()}
SlurmdPort={free_port()}
SlurmUser=root
SlurmdUser=root
AuthInfo=socket={folder}/munge.socket,cred_expire=5
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=2,batch_sched_delay=0
MailProg=/bin/true
MaxArraySize=2
MinJobAge=2
ReturnToService=2
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
"""
    )
    (folder / "state").mkdir()
    env = {**ENV, "SLURM_CONF": str(folder / "slurm.conf")}
    munged = f"munged -F -f --key-file={folder}/key --socket={folder}/munge.socket"
    munged += f" --pid-file={folder}/munge.pid --seed-file={folder}/seed --log-file={folder}/log"
    daemons = []
    try:
        for command in (munged, "slurmctld -D", "slurmd -D"):
            with open(folder / f"{command.split()[0]}.log", "w") as log:
                daemon = subprocess.Popen(command.split(), env=env, stdout=log, stderr=log)
            daemons.append(daemon)
            wait_for((folder / "munge.socket").exists, "munged")
        idle = ["sinfo", "--noheader", "--format=%t"]
        wait_for(lambda: "idle" in output(idle, env), f"cluster: {folder}")
        yield env
    finally:
        subprocess.run(["scancel", "--user=root"], env=env)
        wait_for(lambda: not output(["squeue", "--noheader"], env), "scancel")
        for daemon in reversed(daemons):
            daemon.terminate()
            daemon.wait()


def output(command, env):
    return subprocess.run(command, env=env, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def stub(tmp_path_factory):
    """An environment in which a stub stands for the training scripts."""
    python = tmp_path_factory.mktemp("stub") / "python"
    python.write_text(
        f"""#!/bin/sh
case $1 in *_continuous_noisy.py) exec {sys.executable} {ROOT}/tests/stub_run.py "$@" ;; esac
exec {sys.executable} "$@"
"""
    )
    python.chmod(0o755)
    return ENV | {"PYTHON": str(python)}


@pytest.fixture
def engine(request):
    """The options and the environment of one executor that runs two runs at a time."""
    if request.param == "slurm":
        return ["--executor", "slurm", "--wait"], request.getfixturevalue("slurm")
    if request.param == "ssh":  # one run on the "second machine", one on this one
        hosts = ["--jobs", "1", "--sshlogin", "second,:"]
        return ["--executor", "parallel", *hosts], request.getfixturevalue("sshd")
    if request.param == "parallel":
        need("parallel")
    return ["--executor", request.param, "--jobs", "2"], ENV


@pytest.mark.parametrize("engine", ["local", "ssh", "slurm"], indirect=True)
def test_a_failing_and_a_killed_run(engine, tmp_path):
    executor, env = engine
    grid = [*GRID, "--total-timesteps", "30000", "--runs-dir", tmp_path / "my runs"]
    fails, killed, good = folders(*grid)
    fails.parent.mkdir()
    fails.write_text("a file where the run's folder should be")

    sweep = start(*grid, *executor, *CHEAP, env=env)
    wait_for((killed / "checkpoint.pt").exists, what="the first checkpoint")
    os.kill(*processes("--noise", SCALE, tmp_path), signal.SIGKILL)
    out, err = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 1, err
    assert "3 runs: 1 done, 0 running, 2 failed, 0 to do" in out
    rows = {line.split("  ")[1]: line for line in out.splitlines() if ".log" in line}
    assert set(rows) == {"exit 2", "signal 9"}
    assert str(log_of(fails)) in rows["exit 2"] and "error: --runs-dir" in rows["exit 2"]
    assert str(log_of(killed)) in rows["signal 9"] and "step=" in rows["signal 9"]
    assert (good / "result.json").exists() and not (killed / "result.json").exists()

    fails.unlink()
    finished = (good / "result.json").stat().st_mtime_ns
    again = run(*grid, *executor, *CHEAP, env=env)
    assert again.code == 0, again.out + again.err
    assert "3 runs, 2 to do" in again.err
    assert [len(attempts(f)) for f in (fails, killed, good)] == [2, 2, 1]
    assert (good / "result.json").stat().st_mtime_ns == finished
    assert not attempts(killed)[1][0].startswith("step=1000/"), "not resumed"

    logs = {folder: log_of(folder).read_text() for folder in (fails, killed, good)}
    assert run(*grid, *executor, *CHEAP, env=env).code == 0
    assert logs == {folder: log_of(folder).read_text() for folder in logs}


@pytest.mark.parametrize("engine", ["parallel", "ssh", "slurm"], indirect=True)
def test_ctrl_c(engine, tmp_path):
    executor, env = engine
    grid = [*GRID, *FOREVER, "--runs-dir", tmp_path]
    runs = folders(*grid)
    sweep = start(*grid, *executor, *ON_SIGNAL, env=env)
    wait_for(lambda: sum(map(is_training, runs)) == 2, what="two runs at a time")
    sweep.send_signal(signal.SIGINT)
    out, err = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 130, err
    check_stopped(runs, out)


def test_ctrl_c_on_a_terminal_and_the_progress_line(tmp_path):
    grid = [*GRID, *FOREVER, "--runs-dir", tmp_path]
    runs = folders(*grid)
    controller, terminal = pty.openpty()
    streams = {"stdin": terminal, "stdout": terminal, "stderr": terminal}
    sweep = start(*grid, "--jobs", "2", *ON_SIGNAL, prefix=["setsid", "--ctty"], **streams)
    shown = ""

    def read():
        nonlocal shown
        while select.select([controller], [], [], 0)[0]:
            shown += os.read(controller, 10_000).decode()
        return shown

    wait_for(lambda: "2 running" in read() and sum(map(is_training, runs)) == 2, what="progress")
    os.write(controller, b"\x03")
    wait_for(lambda: read() and sweep.poll() is not None, what="the sweep's end")
    read()
    assert sweep.returncode == 130
    assert "\r3 runs: 0 done, 2 running, 0 failed, 1 to do" in shown
    check_stopped(runs, shown)


def check_stopped(runs, shown):
    """Two of three runs were under way: they, and only they, have a checkpoint."""
    assert f"{runs[0].parent}: 3 runs: 0 done, 0 running, 0 failed, 3 to do" in shown
    assert not processes(runs[0].parent)
    stopped = [folder for folder in runs if log_of(folder).exists()]
    assert len(stopped) == 2, "another run was started"
    for folder in stopped:
        assert (folder / "checkpoint.pt").exists()
        assert attempts(folder)[0][-1].endswith("exit=143")


def copy_project(folder):
    """Copy what a sweep of SAC needs."""
    folder.mkdir()
    for file in ("benchmark.sh", "noisy_wrappers.py", "sac_continuous_noisy.py"):
        shutil.copy2(ROOT / file, folder)
    shutil.copytree(ROOT / "sweep", folder / "sweep")
    return folder


def test_machines_without_a_shared_folder(sshd, tmp_path):
    """The run folders travel: an interrupted run can go on elsewhere."""
    here, there = copy_project(tmp_path / "here"), copy_project(tmp_path / "there")
    grid = ["baseline", *GRID[1:7], "--total-timesteps", "200000"]
    machine = ["--executor", "parallel", "--sshlogin", "second", "--remote-dir", there]
    folder = here / folders(*grid)[0]
    sweep = start(*grid, *machine, *ON_SIGNAL, env=sshd, cwd=here)
    wait_for(lambda: is_training(folder), what="the first evaluation")
    sweep.send_signal(signal.SIGINT)
    _, err = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 130, err
    assert (folder / "checkpoint.pt").exists(), err

    shutil.rmtree(there / "runs")
    again = run(*grid, *machine, *ON_SIGNAL, env=sshd, cwd=here)
    assert again.code == 0, again.out + again.err
    assert not attempts(folder)[1][0].startswith("step=1000/"), "not resumed"
    assert json.loads((folder / "result.json").read_text())["total_timesteps"] == 200_000


def test_a_lost_connection(sshd, tmp_path):
    grid = ["baseline", *GRID[1:7], *FOREVER, "--runs-dir", tmp_path]
    grid += ["--executor", "parallel", "--sshlogin", "second"]
    (folder,) = folders(*grid[:-4])
    talkative = [*ON_SIGNAL, "--eval-frequency", "100"]  # it must not die of its output either
    sweep = start(*grid, *talkative, env=sshd)
    wait_for(lambda: is_training(folder), what="the first evaluation")
    subprocess.run(["pkill", "-KILL", "-f", f"^{sshd['PARALLEL_SSH']} second"], check=True)
    out, _ = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 1
    assert re.search(rf"lost +{log_of(folder)} +step=", out)
    wait_for(lambda: not processes(tmp_path), what="the run over there")
    assert (folder / "checkpoint.pt").exists()


def test_a_machine_without_the_project(sshd, tmp_path):
    here = copy_project(tmp_path / "here")
    machine = ["--executor", "parallel", "--sshlogin", "second", "--remote-dir", tmp_path]
    result = run(*GRID, *machine, *CHEAP, env=sshd, cwd=here)
    assert result.code == 2 and "error: a machine of --sshlogin" in result.err
    assert not list(here.glob("runs/*/*.log"))


def test_slurm_requeues_before_the_time_limit(slurm, tmp_path):
    grid = ["baseline", *GRID[1:7], "--total-timesteps", "40000", "--runs-dir", tmp_path]
    (folder,) = folders(*grid)
    submitted = run(
        *grid, "--executor", "slurm", "--slurm-args=--comment=hello", *ON_SIGNAL, env=slurm
    )
    assert submitted.code == 0, submitted.err
    (job,) = re.findall(r"scancel (\d+)$", submitted.err.strip())
    shown = output(["scontrol", "show", "job", job], slurm)
    assert "Comment=hello" in shown and "Requeue=1" in shown
    wait_for(lambda: is_training(folder), what="the first evaluation")
    # What --signal=B:USR1@180 has Slurm do three minutes before the limit.
    subprocess.run(["scancel", "--batch", "--signal=USR1", job], env=slurm, check=True)
    wait_for((folder / "result.json").exists, "the second attempt")
    first, second = attempts(folder)
    assert first[-1].endswith("exit=143")
    assert not second[0].startswith("step=1000/"), "not resumed"


@pytest.mark.parametrize("program", ["scontrol", "sbatch"])
def test_ctrl_c_while_arrays_are_submitted(program, slurm, tmp_path):
    """On a terminal Ctrl-C reaches Slurm's programs, too: here the second call of one."""
    wanted = 2 if program == "sbatch" else 1
    (tmp_path / program).write_text(
        f"#!/bin/sh\necho >>{tmp_path}/calls\n"
        f"[ $(wc -l <{tmp_path}/calls) -lt {wanted} ] || sleep 100\n"
        f'exec {shutil.which(program, path=PATH)} "$@"\n'
    )
    (tmp_path / program).chmod(0o755)
    grid = [*GRID, "--runs-dir", tmp_path / "runs", "--executor", "slurm", *FOREVER, *ON_SIGNAL]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    env = slurm | {"PATH": f"{tmp_path}:{PATH}"}
    sweep = start(*grid, env=env, start_new_session=True, **streams)
    calls = tmp_path / "calls"
    wait_for(lambda: calls.exists() and calls.read_text().count("\n") == wanted, program)
    os.killpg(sweep.pid, signal.SIGINT)
    _, err = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 130 and "submitted" not in err and "error" not in err
    wait_for(lambda: not output(["squeue", "--noheader"], slurm), "the first array's end")


# THE GRID


def test_paper_grid():
    lines = dry_run("paper")
    assert len(lines) == len({line.text for line in lines}) == 9100
    assert len(set(folders("paper"))) == 9100
    tables = (ROOT / "results" / "paper").glob("*.csv")
    noises = {row["noise_as_run"] for path in tables for row in csv.DictReader(path.open())}
    assert len(noises) == 15
    assert Counter(line.script[:3] for line in lines) == {"sac": 2275, "td3": 2275, "ppo": 4550}
    assert Counter(line.env_id for line in lines) == {
        f"{env}-v5": 1820 for env in ("HalfCheetah", "Hopper", "Humanoid", "Pusher", "Walker2d")
    }
    noisy = [line for line in lines if line.noise]
    assert len(noisy) == 9000
    assert Counter(*zip(*(x.noise for x in noisy), strict=True)) == dict.fromkeys(noises, 600)
    rates = ["0.01", "0.05", "0.1", "0.2", "0.5", "1.0"]
    assert Counter(*zip(*(x.noise_rate for x in noisy), strict=True)) == dict.fromkeys(rates, 1500)
    for algorithm, seeds in ALGORITHMS.items():
        of = Counter(line.seed for line in lines if line.script.startswith(algorithm))
        assert of == {seed: 455 for seed in range(1, seeds + 1)}
    assert {line.total_timesteps for line in lines} == {1_000_000}
    assert [line.seed for line in lines] == sorted(line.seed for line in lines)
    # Seeds differ in their number only, so the first seed stands for all in the next test.
    for seed in range(2, 11):
        first = [x.text.replace("--seed 1 ", f"--seed {seed} ") for x in lines if x.seed == 1]
        assert {line.text for line in lines if line.seed == seed} <= set(first)


@pytest.mark.parametrize("arguments", ["paper --dry-run --runs-dir {}", "--help"])
def test_a_reader_that_leaves_starts_no_sweep(arguments, tmp_path):
    command = f"set -o pipefail; ./benchmark.sh {arguments.format(tmp_path / 'runs')} | head -n 1"
    process = subprocess.run(
        ["bash", "-c", command], cwd=ROOT, env=ENV, capture_output=True, text=True, timeout=PATIENCE
    )
    assert process.returncode == 0 and process.stdout.count("\n") == 1
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_scripts_accept_every_line(algorithm):
    script = import_module(f"{algorithm}_continuous_noisy")
    for line in dry_run("paper", "--algos", algorithm, "--seeds", "1"):
        args = tyro.cli(script.Args, args=shlex.split(line.text)[2:])
        assert list(args.noise) == line.noise
        assert [args.env_id, args.seed] == [line.env_id, 1]
        assert list(map(str, args.noise_rate)) == line.noise_rate


def test_other_presets():
    best = {(x.script[:3], x.env_id, *x.noise, *x.noise_rate) for x in dry_run("best")}
    with open(ROOT / "results" / "paper" / "best.csv") as file:
        for row in csv.DictReader(file):
            cell = (row["algorithm"].lower(), row["environment"].replace("-v2", "-v5"))
            best -= {cell, (*cell, row["noise_as_run"], str(float(row["noise_rate"])))}
    assert not best
    assert len(dry_run("best")) == 2 * len(dry_run("baseline")) == 200
    ablation = dry_run("ablation")
    assert len(ablation) == 5 * 10 * (1 + 5 + 5)
    for line in ablation:
        if line.noise:
            name, low, high = re.fullmatch(r"(\w+)\((.+), (.+)\)", *line.noise).groups()
            scale = name == "RandomUniformScaleReward"
            assert float(low) == pytest.approx(2 - float(high) if scale else -float(high))
            assert line.noise_rate == (["0.05"] if scale else ["1.0"])
    assert {(x.script[:3], x.env_id, x.runs_dir) for x in dry_run("demo")} == {
        ("ppo", "Pusher-v5", "runs/demo")
    }
    chosen = run(*C.split(), "--dry-run")
    assert all(line.endswith("--runs-dir runs/choose") for line in chosen.out.splitlines())
    assert run("status", *C.split()).out.startswith("runs/choose: ")
    assert [(x.seed, x.noise, x.total_timesteps) for x in dry_run("demo")] == [
        (seed, noise, 100_000)
        for seed in range(1, 6)
        for noise in ([], ["RandomEarlyTermination(50)"])
    ]


def test_spellings_and_rate_zero_are_one_run():
    noises = ["RandomUniformScaleReward(.5, 1.5)", "RandomUniformScaleReward(0.50, high=1.5)"]
    grid = ["--algos=SAC", "--envs", "Hopper-v5", "Hopper-v5", "--seeds", "3", "3-4"]
    lines = dry_run("custom", *grid, "--noises", *noises, "--noise-rates", "0.10", "0", ".1")
    assert [(line.seed, line.noise) for line in lines] == [
        (seed, noise) for seed in (3, 4) for noise in ([], [SCALE])
    ]


def test_rates_of_ones_own_and_pairs():
    cells = ["--noises", f"{A}@0.1+RandomEarlyTermination(50)@1:0", "RandomDropoutObservation(0.9)"]
    lines = dry_run("custom", *GRID[1:7], *cells, "--noise-rates", "0.5", "1.0:0", "--combine")
    early, reward, drop = (
        "RandomEarlyTermination(50)",
        "RandomNormalNoisyReward(1.0)",
        "RandomDropoutObservation(0.9)",
    )
    assert [list(zip(line.noise, line.noise_rate, strict=True)) for line in lines] == [
        [],
        [(early, "1.0:0.0"), (reward, "0.1")],
        [(drop, "0.5")],
        [(drop, "1.0:0.0")],
        [(early, "1.0:0.0"), (reward, "0.1"), (drop, "0.5")],
        [(early, "1.0:0.0"), (reward, "0.1"), (drop, "1.0:0.0")],
    ]
    lines = dry_run("custom", *GRID[1:7], "--noises", f"{A}@0.1")
    assert [line.noise_rate for line in lines] == [[], ["0.1"]]
    three = ["--noises", A, "RandomEarlyTermination(50)", "RandomDropoutObservation(0.9)"]
    lines = dry_run("custom", *GRID[1:7], *three, "--noise-rates", "0.5", "--combine")
    assert [len(line.noise) for line in lines] == [0, 1, 1, 1, 2, 2, 2]
    assert {rate for line in lines for rate in line.noise_rate} == {"0.5"}
    assert {x.total_timesteps for x in dry_run("demo", "--total-timesteps", "2.5e3")} == {2500}


def test_an_environment_and_runs_in_the_callers_folder(tmp_path):
    (tmp_path / "my_envs.py").write_text(
        "import gymnasium\n"
        "gymnasium.register('Mine-v0', 'gymnasium.envs.classic_control:PendulumEnv', "
        "max_episode_steps=100)\n"
    )
    grid = ["baseline", "--algos", "sac", "--envs", "my_envs:Mine", "--seeds", "1"]
    grid += ["--total-timesteps", "400", "--runs-dir", "mine", *CHEAP]
    shown = run(*grid, "--dry-run", cwd=tmp_path, script=ROOT / "benchmark.sh")
    assert shown.code == 2 and "--dry-run" in shown.err  # it stood after the --
    grid.insert(1, "--dry-run")
    shown = run(*grid, cwd=tmp_path, script=ROOT / "benchmark.sh")
    line = shown.out.strip()
    assert "--env-id my_envs:Mine-v0" in line and f"--runs-dir {tmp_path}/mine" in line
    del grid[1]
    swept = run(*grid, cwd=tmp_path, script=ROOT / "benchmark.sh")
    assert swept.code == 0, swept.out + swept.err
    [folder] = (tmp_path / "mine").glob("*/result.json")
    shutil.rmtree(tmp_path / "mine")
    subprocess.run(line, shell=True, check=True, cwd=ROOT)  # pasted into a shell
    assert folder.exists()
    # In the project, the path stays relative.
    inside = run("demo", "--dry-run", cwd=ROOT / "docs", script=ROOT / "benchmark.sh")
    assert inside.out.splitlines()[0].endswith("--runs-dir docs/runs/demo")


def test_a_line_runs_when_pasted_into_a_shell(tmp_path):
    grid = ["best", "--algos", "ppo", "--envs", "Hopper-v5", "--seeds", "1"]
    small = ["--total-timesteps", "2048", "--runs-dir", tmp_path / "my runs"]
    _, folder = folders(*grid, *small)
    result = run(*grid, *small, "--dry-run", "--", "--no-compile", "--eval-episodes", "1")
    subprocess.run(result.out.splitlines()[1], shell=True, check=True, cwd=ROOT)
    assert (folder / "result.json").exists()


# CHOOSE

CHOOSE = ["choose", "--algos", "ppo", "--envs", "Pendulum-v1", "--noise-rates", "1", "--confirm"]
CHOOSE += ["4", "--budget", "6", "--total-timesteps", "4000", "--noises", A]
CHOOSE += ["RandomDropoutObservation(0.9)", "RandomMixupObservation(0.5)"]


def chosen(folder):
    """Return what a choice leaves behind: its lines, and the names of its runs."""
    names = {path.parent.name for path in folder.glob("*/config.json")}
    return (folder / "choice.csv").read_bytes(), names


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The choice that the sweeps below should make, from run folders made in this process."""
    folder = tmp_path_factory.mktemp("undisturbed")
    args = parse_args("list", "/", [*CHOOSE, "--runs-dir", str(folder)])
    check(args)
    for _ in range(3):  # two rounds and the confirmation
        for choice in choose.choices(args):
            for key in choice.state.due:
                stub_run.train([choice.runs[key].script, *choice.runs[key].arguments])
    [sentence] = choose.conclusion(choose.choices(args), folder)
    return *chosen(folder), sentence


@pytest.mark.parametrize("engine", ["local", "parallel", "slurm"], indirect=True)
def test_choose_survives_being_killed(engine, tmp_path, stub, undisturbed):
    executor, env = engine
    command = [*CHOOSE, "--runs-dir", tmp_path, *executor]
    env = env | {"PYTHON": stub["PYTHON"], "STUB_SECONDS": "0.2"}
    dice = random.Random(1)

    def begun():
        return len(list(tmp_path.glob("*/config.json")))

    for number in (signal.SIGINT, signal.SIGKILL, signal.SIGINT):
        wanted = begun() + dice.randint(1, 4)
        sweep = start(*command, env=env)
        wait_for(lambda wanted=wanted: begun() >= wanted, what="runs")
        sweep.send_signal(number)
        sweep.communicate(timeout=PATIENCE)
        assert sweep.returncode == (130 if number == signal.SIGINT else -signal.SIGKILL)
    last = run(*command, env=env)
    assert last.code == 0, last.out + last.err
    assert (*chosen(tmp_path), last.out.splitlines()[-1]) == undisturbed
    logs = {path.name: path.read_text() for path in tmp_path.glob("logs/*__*.log")}
    again = run(*command, env=env)
    assert again.code == 0 and again.out == last.out and not again.err
    assert logs == {path.name: path.read_text() for path in tmp_path.glob("logs/*__*.log")}


def test_a_failing_run_stops_its_choice_and_no_other(tmp_path, stub):
    command = [*CHOOSE, "--algos", "ppo", "sac", "--confirm", "5", "--runs-dir", tmp_path]
    result = run(*command, env=stub | {"STUB_FAILS": "*ppo*Dropout*"})
    assert result.code == 1 and "exit 1" in result.out and "error: this one fails" in result.out
    assert "PPO on Pendulum-v1, round 1 of 2: 3 of 3 noises, seed 1; runs to do: 1" in result.out
    assert '--exclude "RandomDropoutObservation(0.9)@1.0"' in result.out
    assert result.out.splitlines()[-1] == "SAC on Pendulum-v1: all runs are done"
    assert not (tmp_path / "choice.csv").exists()
    status = run("status", *command)
    assert status.code == 0 and "1 failed" in status.out
    without = run(*command, "--exclude", "RandomDropoutObservation(0.90)@1", env=stub)
    assert without.code == 0, without.out + without.err
    ppo, sac = without.out.splitlines()[-2:]
    assert ppo.startswith("PPO on Pendulum-v1: ") and sac.startswith("SAC on Pendulum-v1: ")
    assert "Dropout" not in (tmp_path / "choice.csv").read_text()


def test_a_dry_run_of_choose_prints_the_batch_that_is_due(tmp_path, stub):
    command = [*CHOOSE, "--runs-dir", tmp_path]
    first = run(*command, "--dry-run")
    assert (
        first.out.count("\n") == 3 and "13 runs in all, 5 to search and 8 to confirm" in first.err
    )
    # 13 runs of 1000 steps at 5,700 steps per second, and 10 seconds to start: 132 s
    assert "0 are done, about 0.037 core-hours are left" in first.err
    for line in first.out.splitlines():
        subprocess.run(line.replace(sys.executable, stub["PYTHON"]), shell=True, check=True)
    second = run(*command, "--dry-run")
    assert [" --seed 2 " in line for line in second.out.splitlines()] == [True, True]
    assert "round 2 of 2: 2 of 3 noises, seeds 1 to 2; runs to do: 2" in second.err
    # The three finished runs say that they have taken 36 seconds each; ten are left.
    assert "3 are done, about 0.1 core-hours are left" in second.err


def test_a_choice_never_mixes_runs_with_other_options(tmp_path, stub):
    command = [*CHOOSE, "--runs-dir", tmp_path]
    first = run(*command, env=stub)
    assert first.code == 0, first.out + first.err
    for words in (command, [*command, "--confirm", "5"]):
        other = run(*words, "--", "--gamma", "0.5", env=stub)
        assert other.code == 2 and not other.out and other.err.count("\n") == 1
        assert "holds a finished run with --gamma 0.99, not 0.5; choose another" in other.err
    assert run(*command, "--", "--no-compile", "--gamma", "0.990", env=stub).out == first.out
    config = next(tmp_path.glob("p*__*/config.json"))
    config.write_text(config.read_text().replace('"eval_frequency": 100', '"eval_frequency": 50'))
    mixed = run(*command, env=stub)
    assert mixed.code == 2 and mixed.err.count("\n") == 1
    assert "was tested every " in mixed.err and "choose another --runs-dir" in mixed.err
    whole = run(*CHOOSE, "--runs-dir", tmp_path / "other", "--", "--gamma", "0.5", env=stub)
    assert whole.code == 0 and "p = " in whole.out, whole.out + whole.err


# REPORTS AND ERRORS


def test_status_arithmetic(tmp_path):
    grid = ["baseline", "--algos", "ppo", "--envs", "Hopper-v5", "--seeds", "1-6"]
    grid += ["--total-timesteps", "1000", "--runs-dir", tmp_path]
    done, running, slow, failed, stopped, lost = folders(*grid)
    (tmp_path / "logs").mkdir()
    done.mkdir()
    (done / "result.json").write_text('{"total_timesteps": 1000}')
    (done / "config.json").write_text('{"args": {}}')
    for folder, text in {
        done: "step=1000/1000 sps=200 eval_return=1.0\n# now host: exit=0\n",
        running: "step=100/1000 sps=100 eta=0:00:09\nstep=200/1000 sps=100 eta=0:00:08\n",
        slow: "step=200/1000 sps=10 eta=0:01:20\n",
        failed: "step=600/1000 sps=100\nTraceback\n  x\nValueError: broken\n"
        "(training stopped)\n# now host: exit=1\n",
        stopped: "step=500/1000 sps=100\n# now host: exit=143\n",
        lost: "step=500/1000 sps=100\n",
    }.items():
        log_of(folder).write_text("# now host: python ppo_continuous_noisy.py --seed 1\n" + text)
    os.utime(log_of(lost), (time.time() - 300,) * 2)
    result = run("status", *grid)
    assert result.code == 0
    # 800 + 800 + 400 + 500 + 500 steps are left. At 200, 100, 10, 100, 100 and 100 steps per second
    # the mean time of a step is 0.145 / 6 seconds, and two runs run at a time: 36.25 seconds.
    state = "6 runs: 1 done, 2 running, 1 failed, 2 to do; 110 steps/s now, about 0:00:36 left"
    assert state in result.out
    assert re.search(rf"exit 1 +{log_of(failed)} +ValueError: broken\n", result.out)
    slowest = result.out.partition("slowest")[2].splitlines()[1:]
    assert [line.split() for line in slowest] == [
        ["0:01:20", "10/s", "200", str(slow)],
        ["0:00:08", "100/s", "200", str(running)],
    ]


def test_status_without_a_grid_reads_the_folder(tmp_path, stub):
    grid = ["baseline", *GRID[1:5], "--seeds", "1-2", "--total-timesteps", "1000"]
    assert run(*grid, "--runs-dir", tmp_path, env=stub).code == 0
    (tmp_path / "Hopper-v5__ppo__baseline__1").mkdir()
    config = '{"args": {"total_timesteps": 500}}'
    (tmp_path / "Hopper-v5__ppo__baseline__1" / "config.json").write_text(config)
    log = "# now host: python x.py\nerror: bad\n# now host: exit=2\n"
    (tmp_path / "logs" / "Hopper-v5__ppo__baseline__2.log").write_text(log)  # it has no folder
    for words in (["status"], ["status", "custom"]):
        result = run(*words, "--runs-dir", tmp_path)
        assert result.code == 0, result.err
        assert "4 runs: 2 done, 0 running, 1 failed, 1 to do" in result.out
        assert re.search(r"exit 2 .*baseline__2.log +error: bad\n", result.out)
    empty = run("status", "--runs-dir", tmp_path / "none")
    assert empty.code == 2 and f"error: no runs in {tmp_path}/none" in empty.err


def test_a_finished_run_of_another_length_is_not_taken_for_done(tmp_path):
    grid = ["baseline", "--algos", "ppo", "--envs", "Hopper-v5", "--seeds", "1"]
    grid += ["--total-timesteps", "1000", "--runs-dir", tmp_path]
    [folder] = folders(*grid)
    folder.mkdir()
    (folder / "result.json").write_text('{"total_timesteps": 20}')
    (folder / "config.json").write_text('{"args": {}}')
    result = run(*grid)
    assert result.code == 2 and "holds a finished run of 20 steps" in result.err
    assert not (tmp_path / "logs").exists()


def test_a_finished_run_with_other_options_is_not_taken_for_done(tmp_path):
    grid = ["baseline", "--algos", "sac", "--envs", "Hopper-v5", "--seeds", "1"]
    grid += ["--total-timesteps", "1000", "--runs-dir", tmp_path]
    [folder] = folders(*grid)
    folder.mkdir()
    (folder / "result.json").write_text('{"total_timesteps": 1000}')

    def made_with(**args):
        (folder / "config.json").write_text(json.dumps({"args": args}))

    made_with(gamma=0.99, autotune=True, learning_starts=10, torch_threads=8, compile=False)
    refused = run(*grid, "--", "--gamma", "0.5", "--learning_starts=10", "--no-autotune")
    assert (
        refused.code == 2
        and not refused.out
        and refused.err
        == (
            f"error: {folder} holds a finished run with --gamma 0.99, not 0.5 and --autotune True, "
            "not False; choose another --runs-dir, or the same options after the --\n"
        )
    )
    assert "with --learning-starts 10, not 5000; choose" in run("status", *grid).err
    for same in ("--learning-starts 10", "--learning_starts=10 --no-compile --torch-threads 2"):
        result = run(*grid, "--", *same.split())
        assert result.code == 0 and "1 runs: 1 done" in result.out, result.err
    # An older version had an option that is gone, and did not have one of today's
    made_with(gamma=0.99, capture_video=True)
    assert "1 runs: 1 done" in run("status", *grid).out
    assert "--max-episode-steps None, not 50" in run(*grid, "--", "--max-episode-steps", "50").err


def test_misspelt_options_are_refused_where_nothing_is_to_do(tmp_path, stub):
    grid = ["baseline", *GRID[1:7], "--total-timesteps", "1000", "--runs-dir", tmp_path]
    assert run(*grid, env=stub).code == 0
    for words, message in {
        "--gama 0.99": "sac_continuous_noisy.py has no option --gama; did you mean --gamma?",
        "--gamma=0.99 1": "'1' after the -- belongs to no option of sac_continuous_noisy.py",
        "--gamma --no-compile": "--gamma needs a value",
        "--gamma": "--gamma needs a value",
        "--compile=False": "--compile takes no value: write --compile or --no-compile",
    }.items():
        result = run(*grid, "--", *words.split())
        assert (result.code, result.out, result.err) == (2, "", f"error: {message}\n")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_grid_reads_options_as_the_scripts_do(algorithm):
    script = import_module(f"{algorithm}_continuous_noisy")
    for words in (
        "",
        "--gamma 0.5 --eval_episodes=3 --no-compile --matmul_precision high",
        "--gamma=.5 --gamma 1 --cuda --no_overwrite --max-episode-steps 1_000",
        "--max-episode-steps None --gamma -inf --torch-threads=2",
    ):
        read = vars(tyro.cli(script.Args, args=words.split()))
        wanted = {name.replace("_", "-"): value for name, value in read.items()}
        wanted = {name: wanted[name] for name in wanted.keys() - GIVEN_BY_THE_GRID.keys()}
        assert script_options(f"{algorithm}_continuous_noisy.py", tuple(words.split())) == wanted


@pytest.mark.parametrize("damaged", ["", "{}", "[]"])
@pytest.mark.parametrize("file", ["result.json", "config.json"])
def test_a_damaged_result_fails_its_run_and_stops_no_other(file, damaged, tmp_path, stub):
    grid = ["baseline", "--algos", "ppo", "--envs", "Hopper-v5", "--seeds", "1-2"]
    grid += ["--total-timesteps", "1000", "--runs-dir", tmp_path]
    bad, good = folders(*grid)
    bad.mkdir()
    (bad / "result.json").write_text('{"total_timesteps": 1000}')
    (bad / file).write_text(damaged)
    advice = f"{bad}/{file} cannot be read ("
    status = run("status", *grid)
    assert status.code == 0 and re.search(
        rf"damaged +{log_of(bad)} +{re.escape(advice)}", status.out
    )
    sweep = run(*grid, env=stub)
    assert sweep.code == 1 and f"warning: {advice}" in sweep.err and "2 runs, 1 to do" in sweep.err
    assert (bad / file).read_text() == damaged and (good / "result.json").exists()
    assert "2 runs: 1 done, 0 running, 1 failed, 0 to do" in sweep.out
    assert "delete the run's folder to run it again" in sweep.out


def test_runs_may_be_in_the_projects_own_folder(tmp_path):
    project = tmp_path / "project"
    project.mkdir()
    for path in [*ROOT.glob("*.py"), ROOT / "sweep"]:
        (project / path.name).symlink_to(path)
    shutil.copy(ROOT / "benchmark.sh", project)  # it works in the folder that it is in
    grid = [*GRID, "--total-timesteps", "400", "--runs-dir", ".", *CHEAP]
    result = run(*grid, cwd=project)
    assert result.code == 0, result.out + result.err
    assert "3 done" in result.out and len(list(project.glob("*/result.json"))) == 3
    assert len(list(project.glob("logs/*.log"))) == 3


def test_openmps_threads_do_not_limit_the_number_of_runs(tmp_path, stub):
    grid = ["baseline", *GRID[1:5], "--seeds", "1-99", "--runs-dir", tmp_path]
    start(*grid, env=stub | {"OMP_NUM_THREADS": "1", "STUB_SECONDS": "1000"})
    cores = len(os.sched_getaffinity(0))
    wait_for(lambda: len(processes("stub_run.py", tmp_path)) == cores, what="a run on every core")


def test_a_sweep_whose_reader_has_left_still_stops_its_runs(tmp_path):
    grid = [*FOREVER, "--runs-dir", tmp_path, *ON_SIGNAL]
    runs = folders(*GRID, *grid)
    sweep = start(*GRID, "--jobs", "2", *grid)
    wait_for(lambda: is_training(runs[0]) and is_training(runs[1]))
    sweep.stdout.close()
    sweep.stderr.close()  # as a closed terminal
    sweep.send_signal(signal.SIGHUP)
    sweep.wait(timeout=PATIENCE)
    assert not processes(tmp_path)
    assert all((folder / "checkpoint.pt").exists() for folder in runs[:2])
    assert not runs[2].exists()


@pytest.mark.parametrize("engine", ["local", "parallel"], indirect=True)
def test_a_killed_sweep_stops_its_runs(engine, tmp_path):
    executor, env = engine
    grid = [*FOREVER, "--runs-dir", tmp_path, *ON_SIGNAL]
    runs = folders(*GRID, *grid)
    sweep = start(*GRID, *executor, "--jobs", "1", *grid, env=env)
    wait_for(lambda: is_training(runs[0]))
    sweep.kill()
    sweep.wait()
    wait_for(lambda: not processes(tmp_path), what="the run's end")
    wait_for(lambda: attempts(runs[0])[0][-1].endswith("exit=143"), what="the log's end")
    assert (runs[0] / "checkpoint.pt").exists() and not runs[1].exists()


def test_a_killed_shell_around_a_run_stops_no_other(tmp_path, stub):
    grid = ["baseline", *GRID[1:5], "--seeds", "1-4", "--jobs", "1", "--runs-dir", tmp_path]
    runs = folders(*grid[:-4], *grid[-2:])
    sweep = start(*grid, env=stub | {"STUB_SECONDS": "2"})
    [pid] = wait_for(lambda: processes("stub_run.py", tmp_path), what="the first run")
    shell = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1]
    os.kill(int(shell), signal.SIGKILL)
    out, err = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 0, out + err  # its run went on to its end
    assert all((folder / "result.json").exists() for folder in runs)


def test_a_second_sweep_waits_for_the_runs_of_the_first(tmp_path, stub):
    grid = ["baseline", *GRID[1:5], "--seeds", "1", "--runs-dir", tmp_path]
    [folder] = folders(*grid)
    first = start(*grid, env=stub | {"STUB_SECONDS": "4"})
    wait_for(lambda: processes("stub_run.py", tmp_path), what="the run")
    second = run(*grid, env=stub)
    assert second.code == 0 and f"{folder} is running already: waiting for it" in second.err
    assert first.wait(timeout=PATIENCE) == 0
    assert len(attempts(folder)) == 1 and "running already" not in log_of(folder).read_text()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("nope", "unknown preset 'nope'; choose one of demo, baseline, best"),
        ("best --algos dqn", "unknown algorithm 'dqn'; choose from sac, td3, ppo"),
        ("custom --noises Foo(1) --noise-rates 1", "bad noise 'Foo(1)': unknown name; valid are"),
        ("paper --noise-rates 1.5", "1.5"),
        (
            "custom --noises RandomNormalNoisyReward(1)",
            '--noises needs --noise-rates, or a rate with each noise, as in "NOISE@0.1"',
        ),
        ("best --envs Ant-v5", "the paper has no best noise for sac on Ant-v5"),
        ("custom --noise-rates 1", "--noise-rates needs --noises that have no rate of their own"),
        (
            f"custom --noises {A}@1 --noise-rates 1",
            "--noise-rates needs --noises that have no rate",
        ),
        (f"custom --noises {A}@1+{A}", "give each of these noises a rate with @, or none"),
        (
            f"custom --noises {A}@x",
            "'x' is no rate: give a number from 0 to 1, or two as in 1.0:0.0",
        ),
        (f"custom --noises {A}@1:2", "got '1:2'"),
        (f"custom --noises {A} --noise-rates 0.5:", "got '0.5:'"),
        ("paper --noise-rates a:b", "got 'a:b'"),
        ("paper --combine", "--combine belongs to custom"),
        ("paper --budget 5", "--budget belongs to choose"),
        ("choose --algos ppo", "choose needs --algos and --envs"),
        ("choose --envs Hopper-v5", "choose needs --algos and --envs"),
        (f"{C} --seeds 1-3", "leave out --seeds"),
        (
            f"{C} --noises paper --budget 89",
            "--budget must be at least 90, a run for each noise, not 89",
        ),
        (f"{C} --budget 100000", "--budget 100000 is too large: the best noises would run with"),
        (f"{C} --confirm 3", "--confirm must be at least 4, not 3: with fewer seeds no difference"),
        (f"{C} --envs Hopper Pusher-v5 --confirm 4", "--confirm must be at least 5, not 4: "),
        (f"{C} --noises {A} --noise-rates 0", "there is no noise to choose from"),
        (f"{C} --noises {A} --noise-rates 1 --exclude {A}@1", "there is no noise to choose from"),
        (f"{C} --exclude {A}@0.3", "--exclude: RandomNormalNoisyReward(1.0) at 0.3 is not among"),
        (f"{C} --exclude {A}", '--exclude needs a rate with each noise, as in "NOISE@0.1"'),
        (f"{C} --noise-rates 0.5:", "got '0.5:'"),
        ("demo --envs Nope-v5", "--envs: there is no environment 'Nope-v5': "),
        ("demo --envs nope:Env-v0", "--envs: there is no environment 'nope:Env-v0': No module"),
        (
            "demo --seeds 1 2-1",
            "--seeds takes numbers and ranges, separated by spaces: 1 2 3 or 1-3",
        ),
        ("demo --seeds 1,2,3", "separated by spaces: 1 2 3 or 1-3, not '1,2,3'"),
        ("demo --seeds 1-", "not '1-'"),
        ("demo --total-timesteps 1.5", "'1.5' is not a whole number, such as 1000000 or 1e6"),
        ("demo --total-timesteps inf", "'inf' is not a whole number"),
        ("demo --seed 1", "unknown option --seed; did you mean --seeds?"),
        ("demo --env-id Hopper-v5", "unknown option --env-id; did you mean --envs?"),
        ("demo --exectuor local", "unknown option --exectuor; did you mean --executor?"),
        ("demo --gamma 0.9", "--gamma is an option of the scripts: put it at the end, after --"),
        ("demo --gama 0.9", "did you mean --gamma, an option of the scripts, at the end after --?"),
        ("demo --xyzzy 1", "unknown option --xyzzy; ./benchmark.sh --help lists them"),
        (
            "demo --remote-dir x --executor parallel",
            "--remote-dir needs a --runs-dir in the project",
        ),
        ("demo --runs-dir=-x", "--runs-dir must be a path"),
        ("demo --slurm-args --time=1:00", "--slurm-args and --wait belong to --executor slurm"),
        ("demo --wait", "--slurm-args and --wait belong to --executor slurm"),
        ("demo -- --overwrite", "--overwrite would start interrupted runs afresh"),
        ("demo --algos", "--algos: expected at least one argument"),
        ("demo --total-timesteps 0", "--total-timesteps must be greater than 0, not 0"),
        ("demo --executor cloud", "unknown executor 'cloud'; choose local, parallel or slurm"),
        ("demo --jobs 0", "--jobs must be a number greater than 0, not '0'"),
        ("demo --jobs", "--jobs needs a value"),
        ("demo --dry-run=1", "--dry-run takes no value"),
        (
            "demo --total-timesteps 2e3",
            "--total-timesteps must be at least 2048 for PPO (its --num-steps), not 2000",
        ),
        ("demo --sshlogin host", "--sshlogin and --remote-dir belong to --executor parallel"),
        ("demo -- --help", "--help after the -- would start nothing"),
        ("demo -- --seed 2", "--seed is part of the grid: use --seeds, before the --"),
        ("demo -- --exp-name my_ppo", "--exp-name is part of the grid: use --runs-dir, before"),
        ("best --algos sac -- --nope", "sac_continuous_noisy.py has no option --nope"),
        ("best --algos sac ppo -- --tau 0.1", "ppo_continuous_noisy.py has no option --tau"),
        (
            "best --algos sac -- --tau abc",
            "sac_continuous_noisy.py: Error parsing --tau: could not",
        ),
    ],
)
def test_bad_input(args, message, tmp_path):
    first, *words = args.split()
    result = run(first, "--runs-dir", tmp_path / "runs", *words)
    assert result.code == 2, result.out + result.err
    errors = [line for line in result.err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and message in errors[0]
    lines = [line for line in result.err.splitlines() if not line.endswith("to do")]
    assert len(lines) == (11 if "unknown name" in message else 1)
    assert not result.out and not list(tmp_path.iterdir())


def test_what_an_interpreter_lacks_is_named(tmp_path):
    (tmp_path / "tyro.py").touch()
    python = tmp_path / "python"  # without the packages that are installed beside it, but for tyro
    python.write_text(f'#!/bin/sh\nPYTHONPATH={tmp_path} exec {sys.executable} -S "$@"\n')
    python.chmod(0o755)
    for interpreter, message in {
        python: f"'{python}' lacks gymnasium, mujoco, torch, tensorboard: set PYTHON, or",
        tmp_path / "nothing": f"'{tmp_path}/nothing' is no Python 3: set PYTHON, or",
    }.items():
        result = run(
            "demo", "--runs-dir", tmp_path / "runs", env=ENV | {"PYTHON": str(interpreter)}
        )
        assert (result.code, result.out) == (2, "")
        assert result.err == f"error: {message} install requirements.txt into .venv\n"


@pytest.mark.parametrize(("executor", "program"), [("parallel", "parallel"), ("slurm", "sbatch")])
def test_missing_engine(executor, program, tmp_path):
    tools, used = tmp_path / "bin", "env bash dirname awk grep wc cut flock"
    tools.mkdir()
    for tool in used.split():
        (tools / tool).symlink_to(shutil.which(tool))
    env = {**ENV, "PATH": str(tools)}
    result = run("demo", "--runs-dir", tmp_path / "runs", "--executor", executor, env=env)
    assert result.code == 2
    assert f"needs {'GNU ' * (program == 'parallel')}{program}" in result.err
    assert not (tmp_path / "runs").exists()


def test_help():
    shown = run("--help")
    assert shown.code == 0 and not shown.err
    examples = re.findall(r"^  \./benchmark\.sh (.*)", shown.out, flags=re.MULTILINE)
    assert len(examples) >= 5
    for example in examples:
        words = shlex.split(example.partition("|")[0])
        if words[0] not in ("status", "paper"):  # the paper's grid has its own test
            assert run(*words, "--dry-run").code == 0
