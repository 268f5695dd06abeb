"""benchmark.sh on its real engines: this machine, GNU parallel, ssh and Slurm.

A stub stands for the scripts (stub_run.py).

The engine tests need the Debian packages parallel, openssh-server, rsync, slurm-wlm and munge. They
start an sshd and a one-node cluster of their own and stop them again. Without the packages they
skip; with the environment variable CI they fail.
"""

import json
import os
import pty
import re
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from views import ROOT, attempts, batches, folders, log_of, view

from sweep.options import parse_args

PATH = f"{os.environ['PATH']}:/usr/sbin:/sbin"
ENV = {**os.environ, "PYTHON": sys.executable, "PATH": PATH}

# Three short runs: the baseline, one noise, two noises together.
SCALE = "RandomUniformScaleReward(0.5, 1.5)"
BOTH = "RandomNormalNoisyReward(1.0)+RandomEarlyTermination(1, 100)"
GRID = ["custom", "--algos", "sac", "--envs", "Pendulum-v1", "--seeds", "1"]
GRID += ["--noises", SCALE, BOTH, "--noise-rates", "0.5", "--baseline-seeds", "1"]
SWEEPS = []  # the sweeps of the current test
PATIENCE = 240  # seconds until a test gives up waiting: a busy machine is no failure
FOREVER = ["--total-timesteps", "1e9"]
A = "RandomNormalNoisyReward(1)"


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


def run(*args, code=None, **kwargs):
    """Run a command to its end, which must have this exit status if one is given."""
    process = start(*args, **kwargs)
    out, err = process.communicate(timeout=PATIENCE)
    assert code in (None, process.returncode), out + err
    return SimpleNamespace(code=process.returncode, out=out, err=err)


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
def sshd(stub, tmp_path_factory):
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
        yield stub | {"PARALLEL_SSH": ssh}
    finally:
        server.terminate()
        server.wait()


@pytest.fixture(scope="module")
def slurm(stub, tmp_path_factory):
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
    env = stub | {"SLURM_CONF": str(folder / "slurm.conf")}
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


@pytest.fixture(scope="module")
def stub(tmp_path_factory):
    """An environment in which a stub stands for the training scripts; it needs no PyTorch."""
    python = tmp_path_factory.mktemp("stub") / "python"
    python.write_text(
        f"""#!/bin/sh
case $1 in *_continuous_noisy.py) exec {sys.executable} {ROOT}/tests/stub_run.py "$@" ;; esac
case $2 in "import mujoco, torch, "*) set -- -c "import noisy_wrappers" ;; esac
exec {sys.executable} "$@"
"""
    )
    python.chmod(0o755)
    return ENV | {"PYTHON": str(python)}


@pytest.fixture
def engine(request, stub):
    """The options and the environment of one executor that runs two runs at a time."""
    if request.param == "slurm":
        return ["--executor", "slurm", "--wait"], request.getfixturevalue("slurm")
    if request.param == "ssh":  # one run on the "second machine", one on this one
        hosts = ["--jobs", "1", "--sshlogin", "second,:"]
        return ["--executor", "parallel", *hosts], request.getfixturevalue("sshd")
    if request.param == "parallel":
        need("parallel")
    # of what a user has set up, nothing changes a sweep
    return ["--executor", request.param, "--jobs", "2"], stub | {"PARALLEL": "--dry-run -X"}


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["local", "ssh"], indirect=True)
def test_a_failing_and_a_killed_run(engine, tmp_path):
    executor, env = engine
    grid = [*GRID, "--total-timesteps", "300000", "--runs-dir", tmp_path / "my runs"]
    fails, killed, good = folders(*grid)
    fails.parent.mkdir()
    fails.write_text("a file where the run's folder should be")

    sweep = start(*grid, *executor, env=env)
    wait_for((killed / "checkpoint.pt").exists, what="the first checkpoint")
    os.kill(*processes("--env-id", SCALE, tmp_path), signal.SIGKILL)
    out, err = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 1 and "executors.sh" not in err, err
    assert "3 runs: 1 done, 0 running, 2 failed, 0 to do" in out
    assert re.search(rf"exit 1 +{log_of(fails)} .*FileExistsError", out)
    assert re.search(rf"signal 9 +{log_of(killed)} +step=", out)
    assert (good / "result.json").exists() and not (killed / "result.json").exists()

    fails.unlink()
    finished = (good / "result.json").stat().st_mtime_ns
    again = run(*grid, *executor, env=env, code=0)
    assert "3 runs (1 of them without noise), 2 to do" in again.err
    assert f"analyze.py --runs-dir '{tmp_path}/my runs'\n" in again.out
    assert [len(attempts(f)) for f in (fails, killed, good)] == [2, 2, 1]
    assert (good / "result.json").stat().st_mtime_ns == finished
    assert attempts(killed)[1][0].startswith("resumed at step "), "not resumed"


@pytest.mark.slow
def test_a_run_that_is_refused_is_not_started_with_other_seeds(stub, tmp_path):
    """Nor does a noise in an environment that a script refuses hinder any other."""
    grid = ["custom", "--algos", "sac", "--envs", "Pendulum-v1", "MountainCarContinuous-v0"]
    grid += ["--noises", A, "RandomMixupObservation(0.5)", "--noise-rates", "1", "--seeds", "1-3"]
    grid += ["--baseline-seeds", "1", "--total-timesteps", "400", "--jobs", "1"]
    grid += ["--runs-dir", tmp_path]
    (tmp_path / "refuse").write_text("*NormalNoisyReward*Pendulum*")
    result = run(*grid, env=stub)
    said = "sac_continuous_noisy.py refused arguments, so no other seeds of these were started: "
    assert f"{said}error: --gamma must be at most 1, not 2\n" in result.out
    assert result.code == 1 and "14 runs: 11 done, 0 running, 1 failed, 2 to do" in result.out
    assert not list(tmp_path.glob("logs/.refused*"))
    (tmp_path / "refuse").unlink()
    assert "14 runs: 14 done" in run(*grid, env=stub).out


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["ssh", "slurm"], indirect=True)  # local: on a terminal, below
def test_ctrl_c(engine, tmp_path):
    """A sweep of three runs, two at a time, is stopped when both are training."""
    executor, env = engine
    sweep, runs = training(tmp_path, *executor, env=env)
    sweep.send_signal(signal.SIGINT)
    out, err = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 130, err
    assert check_stopped(runs, out) == 2


@pytest.mark.slow
def test_a_second_ctrl_c_does_not_wait_for_the_end_of_episodes(stub, tmp_path):
    sweep, runs = training(tmp_path, "--jobs", "2", env=stub | {"STUB_EPISODE": "600"})
    sweep.send_signal(signal.SIGINT)
    time.sleep(2)
    assert sweep.poll() is None and processes(runs[0].parent)
    sweep.send_signal(signal.SIGINT)
    sweep.communicate(timeout=60)
    assert sweep.returncode == 130 and not processes(runs[0].parent)


def training(tmp_path, *executor, env, number=2):
    """Start a sweep of three runs that do not end by themselves; return when some are training."""
    grid = [*GRID, *FOREVER, "--runs-dir", tmp_path]
    runs = folders(*grid)
    sweep = start(*grid, *executor, env=env)
    wait_for(lambda: sum(map(is_training, runs)) == number, what=f"{number} at a time")
    return sweep, runs


def check_stopped(runs, shown=""):
    """Those runs that were under way, and only they, have a checkpoint."""
    assert not shown or f"{runs[0].parent}: 3 runs: 0 done, 0 running, 0 failed, 3 to do" in shown
    assert not processes(runs[0].parent)
    stopped = [folder for folder in runs if log_of(folder).exists()]
    for folder in stopped:
        assert (folder / "checkpoint.pt").exists()
        assert attempts(folder)[0][-1].endswith("exit=143")
    return len(stopped)


def copy_project(folder):
    """Copy what a sweep of SAC needs."""
    folder.mkdir()
    for file in ("benchmark.sh", "noisy_wrappers.py", "sac_continuous_noisy.py"):
        shutil.copy2(ROOT / file, folder)
    for package in ("sweep", "analysis"):
        shutil.copytree(ROOT / package, folder / package)
    return folder


@pytest.mark.slow
def test_machines_without_a_shared_folder(sshd, tmp_path):
    """The run folders travel: an interrupted run can go on elsewhere."""
    here, there = copy_project(tmp_path / "here"), copy_project(tmp_path / "there")
    grid = ["baseline", *GRID[1:7], "--total-timesteps", "1200000"]
    machine = ["--executor", "parallel", "--sshlogin", "second", "--remote-dir", there]
    folder = here / folders(*grid)[0]
    sweep = start(*grid, *machine, env=sshd, cwd=here)
    wait_for(lambda: is_training(folder), what="the first evaluation")
    sweep.send_signal(signal.SIGINT)
    _, err = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 130, err
    assert (folder / "checkpoint.pt").exists(), err

    shutil.rmtree(there / "runs")
    run(*grid, *machine, env=sshd, cwd=here, code=0)
    assert attempts(folder)[1][0].startswith("resumed at step "), "not resumed"
    assert json.loads((folder / "result.json").read_text())["total_timesteps"] == 1_200_000
    assert not (folder / "checkpoint.pt").exists()  # of the first attempt
    shutil.rmtree(folder)  # the copy over there is finished, and old
    grid[-1] = "3000"
    run(*grid, *machine, env=sshd, cwd=here, code=0)
    assert json.loads((folder / "result.json").read_text())["total_timesteps"] == 3_000


@pytest.mark.slow
def test_a_lost_connection(sshd, tmp_path):
    """The run over there saves a checkpoint and ends, and goes on when the machine is back."""
    grid = ["baseline", *GRID[1:7], *FOREVER, "--runs-dir", tmp_path]
    (folder,) = folders(*grid)
    sweep = start(*grid, "--executor", "parallel", "--sshlogin", "second", env=sshd)
    wait_for(lambda: is_training(folder), what="the first evaluation")
    subprocess.run(["pkill", "-KILL", "-f", f"^{sshd['PARALLEL_SSH']} second"], check=True)
    wait_for(lambda: "resumed at step" in log_of(folder).read_text(), what="the second attempt")
    sweep.send_signal(signal.SIGINT)
    out, _ = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 130 and not processes(tmp_path), out
    assert (folder / "checkpoint.pt").exists()


@pytest.mark.slow
def test_a_machine_that_goes_away_leaves_its_runs_to_the_others(tmp_path, stub):
    """Its first run is its last: it refuses each other in a moment, while the others are busy."""
    need("parallel")
    calls = tmp_path / "calls"
    ssh = tmp_path / "ssh"  # ssh HOST -- COMMAND, and SHELL, as sshd sets it: a check, one run
    ssh.write_text(
        f"""#!/bin/sh
echo >>{calls}
[ $(wc -l <{calls}) -le 2 ] || exit 255
shift 2
SHELL=/bin/sh exec sh -c "$*"
"""
    )
    ssh.chmod(0o755)
    grid = ["baseline", *GRID[1:5], "--seeds", "1-6", "--total-timesteps", "200000"]
    grid += ["--runs-dir", tmp_path / "runs", "--jobs", "1"]
    machines = ["--executor", "parallel", "--sshlogin", "second,:"]
    sweep = run(*grid, *machines, env=stub | {"PARALLEL_SSH": str(ssh)})
    assert sweep.code == 0 and "6 runs: 6 done" in sweep.out, sweep.out + sweep.err
    assert len(calls.read_text()) > 2, "the machine that went away was asked for one run only"


@pytest.mark.slow
def test_slurm_requeues_before_the_time_limit(slurm, tmp_path):
    """The last task of an array has the array's id, and is requeued alone."""
    grid = ["baseline", *GRID[1:5], "--seeds", "1-2", "--total-timesteps", "500000"]
    grid += ["--runs-dir", tmp_path / "50%A"]
    runs = folders(*grid)
    arguments = ["--executor", "slurm", '--slurm-args=--nice=7\n--comment="hello world"']
    submitted = run(*grid, *arguments, env=slurm, code=0)
    (job,) = re.findall(r"scancel (\d+)$", submitted.err.strip())
    shown = output(["scontrol", "show", "job", job], slurm)
    assert "Comment=hello world" in shown and "Nice=7" in shown and "Requeue=1" in shown
    wait_for(lambda: all(map(is_training, runs)), what="the first evaluations")
    tasks = output(["squeue", "--noheader", "--array", "--format=%A %K"], slurm).splitlines()
    (last,) = [line.split()[1] for line in tasks if line.split()[0] == job]
    # What --signal=B:USR1@180 has Slurm do three minutes before the limit.
    signal_it = ["scancel", "--batch", "--signal=USR1", f"{job}_{last}"]
    subprocess.run(signal_it, env=slurm, check=True)
    wait_for(lambda: all((run / "result.json").exists() for run in runs), "the second attempt")
    first, second = attempts(runs[int(last)])
    assert first[-1].endswith("exit=143")
    assert second[0].startswith("resumed at step "), "not resumed"
    assert len(attempts(runs[1 - int(last)])) == 1, "the other task was requeued, too"


@pytest.fixture
def no_slurm(tmp_path, stub):
    """A Slurm that only writes down what it was asked: its environment, and that file."""
    tools, asked = tmp_path / "bin", tmp_path / "asked"
    tools.mkdir()
    said = {
        "sbatch": "echo 'Welcome to the cluster'; echo '12;big'; echo 'quota: 7 of 9'",
        "scontrol": "echo 'MaxArraySize = 5'",
        "squeue": f"echo 'CLUSTER: big'; grep -c squeue {asked} | grep -qx 1 && echo 12 || true",
        "scancel": "",
    }
    for name, command in said.items():
        told = f'echo {name} "$@" $SLURM_CLUSTERS $SQUEUE_STATES >>{asked}'
        (tools / name).write_text(f"#!/bin/sh\n{told}\n{command}\n")
        (tools / name).chmod(0o755)
    return stub | {"PATH": f"{tools}:{PATH}"}, asked


@pytest.mark.slow
def test_slurm_with_several_clusters(no_slurm, tmp_path):
    """Its programs are told which one; what a site prints beside an id is no part of it."""
    env, asked = no_slurm
    env["SQUEUE_STATES"] = "RUNNING"  # a user's own, which would hide the jobs that wait
    grid = ["baseline", *GRID[1:5], "--seeds", "1-6", "--runs-dir", tmp_path / "runs"]
    grid += ["--executor", "slurm", "--wait", "--slurm-args", "-M big,small"]
    result = run(*grid, env=env)
    cancel = "scancel --clusters=big 12"
    assert result.code == 1 and f"submitted; to stop: {cancel}; {cancel}\n" in result.err
    lines = asked.read_text().splitlines()
    arrays = [re.search(r"--array=\S+", line)[0] for line in lines if "sbatch" in line]
    assert arrays == ["--array=0-4", "--array=0-0"]
    queues = [line for line in lines if line.startswith("squeue")]
    assert len(queues) == 3  # 12 was there once
    assert all(re.match("squeue --clusters=big .* --format=%F$", line) for line in queues)


@pytest.mark.parametrize("left", ["checkpoint.pt", "eval.csv"])
def test_a_task_is_requeued_alone_if_it_left_a_checkpoint(left, no_slurm, tmp_path):
    """Without one, as of a script that SIGTERM ends at once, it would begin anew for ever."""
    env, asked = no_slurm
    folder, lines = tmp_path / "run", tmp_path / "logs/lines-host-1-2.tsv"
    lines.parent.mkdir()
    command = f"sleep 0.2; mkdir {folder}; touch {folder}/{left}; exec sleep 1000"
    lines.write_text(f"another run\tfalse\n{folder}\tbash -c '{command}'\n")
    env |= {"SLURM_JOB_ID": "7", "SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "1"}
    env["SLURM_CLUSTERS"] = "where,submitted"
    task = start("slurm-task", lines, "0", env=env)
    wait_for((folder / left).exists, "the run")
    task.send_signal(signal.SIGUSR1)
    task.communicate(timeout=PATIENCE)
    said = asked.read_text() if asked.exists() else ""
    assert task.returncode == 143
    assert said == ("scontrol requeue 7_1\n" if left == "checkpoint.pt" else "")


# CHOOSE

CHOOSE = ["choose", "--algos", "ppo", "--envs", "Pendulum-v1", "--noise-rates", "1", "--confirm"]
CHOOSE += ["4", "--budget", "6", "--total-timesteps", "4000", "--noises", A]
CHOOSE += ["RandomDropoutObservation(0.9)", "RandomMixupObservation(0.5)"]


def chosen(folder, out):
    """Return what a choice leaves behind: its lines, the names of its runs, its verdicts."""
    names = {path.parent.relative_to(folder) for path in folder.glob("*/*/config.json")}
    verdicts = re.findall("^[A-Z0-9]+ on .*", out, flags=re.MULTILINE)
    return (folder / "choice.csv").read_bytes(), names, verdicts


def undisturbed(folder, *command):
    """What a choice leaves behind, and says, if its runs are made in this process."""
    batches(parse_args("status", "/", [*command, "--runs-dir", str(folder)]))
    said = view("report", *command, "--runs-dir", folder).out  # writes choice.csv
    return chosen(folder, said)


@pytest.mark.slow
def test_choose_submits_one_batch_after_another(slurm, tmp_path):
    command = [*CHOOSE[:-1], "--budget", "2"]  # a batch of 2 runs, and one of 8
    executor = ["--executor", "slurm"]
    result = run(*command, "--runs-dir", tmp_path / "runs", *executor, env=slurm, code=0)
    assert result.err.count("the verdict are stored in") == 2, result.err  # once a batch
    found = chosen(tmp_path / "runs", result.out)
    assert found == undisturbed(tmp_path / "expected", *command) and len(found[1]) == 10


@pytest.mark.slow
def test_choose_survives_being_killed(stub, tmp_path):
    """Between two looks at its confirmation."""
    command = [*CHOOSE[:-1], "--budget", "2", "--confirm", "6", "--looks", "2"]
    sweep = start(*command, "--runs-dir", tmp_path / "a", "--jobs", "2", env=stub)
    wait_for(lambda: len(list(tmp_path.glob("a/*/*/config.json"))) >= 9, what="the second look")
    sweep.kill()
    sweep.communicate(timeout=PATIENCE)
    last = run(*command, "--runs-dir", tmp_path / "a", env=stub, code=0)
    assert chosen(tmp_path / "a", last.out) == undisturbed(tmp_path / "b", *command)
    logs = {path.name: path.read_text() for path in tmp_path.glob("a/*/logs/*__*.log")}
    again = run(*command, "--runs-dir", tmp_path / "a", env=stub)
    assert (again.code, again.out, again.err) == (0, last.out, "")
    assert logs == {path.name: path.read_text() for path in tmp_path.glob("a/*/logs/*__*.log")}


@pytest.mark.slow
def test_results_that_are_seen_late_are_waited_for(stub, tmp_path):
    """As those of another machine on a network's file system."""
    env = stub | {"STUB_HIDES": "3"}
    result = run(*GRID, "--total-timesteps", "400", "--runs-dir", tmp_path, env=env)
    assert result.code == 0 and "3 runs: 3 done" in result.out, result.out + result.err


# REPORTS AND ERRORS


def test_the_end_of_a_run_is_a_line_of_its_own(tmp_path):
    """What a killed program printed may have ended within one; a log may have no folder."""
    empty = view("status", "--runs-dir", tmp_path)
    assert empty.code == 2 and f"error: no runs in {tmp_path}" in empty.err
    folder, words = tmp_path / "a__b__c", "sh -c 'printf 45%%; kill -9 $$'"
    command = ["bash", ROOT / "benchmark.sh", "run-one", "x", folder, words]
    one = subprocess.run(command, env=ENV, capture_output=True, text=True)
    log_of(folder).write_text(one.stdout)
    [failed] = re.findall("  signal 9 .*", view("status", "--runs-dir", tmp_path).out)
    assert failed.endswith(" 45%")
    log_of(folder).write_text("# now host: exit=255\n")  # of sys.exit(-1)
    assert "  exit 255 " in view("status", "--runs-dir", tmp_path).out


@pytest.mark.slow
def test_a_process_that_a_run_leaves_behind_holds_up_no_sweep(tmp_path, stub):
    env = stub | {"STUB_LEAVES": "import time; time.sleep(61.25)"}
    result = run(*GRID, "--total-timesteps", "400", "--runs-dir", tmp_path, env=env)
    left = processes("time.sleep(61.25)")
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert result.code == 0 and "3 done" in result.out and len(left) == 3


@pytest.mark.slow
def test_a_sweep_whose_reader_has_left_still_stops_its_runs(tmp_path, stub):
    sweep, runs = training(tmp_path, "--jobs", "2", env=stub)
    sweep.stdout.close()
    sweep.stderr.close()  # as a closed terminal
    sweep.send_signal(signal.SIGHUP)
    sweep.wait(timeout=PATIENCE)
    assert check_stopped(runs) == 2


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["local", "parallel"], indirect=True)
def test_a_killed_sweep_stops_its_runs(engine, tmp_path):
    executor, env = engine
    sweep, runs = training(tmp_path, *executor, "--jobs", "1", env=env, number=1)
    sweep.kill()
    sweep.wait()
    wait_for(lambda: not processes(tmp_path), what="the run's end")
    wait_for(lambda: attempts(runs[0])[0][-1].endswith("exit=143"), what="the log's end")
    assert check_stopped(runs) == 1


@pytest.mark.slow
def test_a_sweep_that_waits_for_another_can_be_stopped(tmp_path, stub):
    need("parallel")
    grid = ["baseline", *GRID[1:7], *FOREVER, "--runs-dir", tmp_path]
    first = start(*grid, env=stub)
    wait_for(lambda: processes("stub_run.py", tmp_path), what="the run")
    second = start(*grid, "--executor", "parallel", env=stub)
    waiting = ["pgrep", "-fx", "flock 9"]
    wait_for(lambda: not subprocess.run(waiting).returncode, what="a sweep that waits")
    second.send_signal(signal.SIGINT)
    assert second.wait(timeout=PATIENCE) == 130 and first.poll() is None


@pytest.mark.slow
def test_a_second_sweep_waits_for_the_runs_of_the_first(tmp_path, stub):
    grid = ["baseline", *GRID[1:7], "--total-timesteps", "300000", "--runs-dir", tmp_path]
    [folder] = folders(*grid)
    first = start(*grid, env=stub)
    wait_for(lambda: processes("stub_run.py", tmp_path), what="the run")
    second = run(*grid, env=stub)
    assert second.code == 0 and f"{folder} is running already: waiting for it" in second.err
    assert first.wait(timeout=PATIENCE) == 0 and len(attempts(folder)) == 1


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("demo --wait", "--slurm-args and --wait belong to --executor slurm"),
        ("demo --jobs 0", "--jobs must be a number greater than 0, not '0'"),
        ("demo --sshlogin host", "--sshlogin and --remote-dir belong to --executor parallel"),
        ("demo --remote-dir x --executor parallel", "--remote-dir needs a relative --runs-dir"),
    ],
)
def test_bad_input(args, message, tmp_path):
    """What the grid refuses is tested in test_grid.py."""
    result = run(*args.split(), "--runs-dir", tmp_path / "runs")
    assert (result.code, result.out) == (2, "") and f"error: {message}" in result.err
    assert not list(tmp_path.iterdir())


def test_what_an_interpreter_lacks_is_named(tmp_path):
    python = tmp_path / "python"  # without the packages that are installed beside it
    python.write_text(f'#!/bin/sh\nexec {sys.executable} -S "$@"\n')
    python.chmod(0o755)
    for name, message in {"python": "lacks gymnasium, mujoco, torch", "no": "is not a Py"}.items():
        result = run("demo", env=ENV | {"PYTHON": f"{tmp_path}/{name}"})
        assert (result.code, result.out) == (2, "") and f"/{name}' {message}" in result.err


def test_a_slurm_that_does_not_answer_leaves_nothing_behind(no_slurm, tmp_path):
    (tmp_path / "bin/scontrol").write_text("#!/bin/sh\nexit 1\n")
    runs = tmp_path / "runs"
    result = run("baseline", "--runs-dir", runs, "--executor", "slurm", env=no_slurm[0])
    assert result.code == 2 and "error: Slurm does not answer" in result.err and not runs.exists()


def test_help():
    shown = run("--help")
    assert shown.code == 0 and not shown.err
    examples = re.findall(r"^  \./benchmark\.sh (.*)", shown.out, flags=re.MULTILINE)
    assert len(examples) >= 5
    for words in map(shlex.split, examples):
        if words[0] not in ("status", "paper"):  # the paper's grid has its own test
            assert view("status", *words).code == 0, words


@pytest.mark.slow
def test_ctrl_c_on_a_terminal_and_the_progress_line(tmp_path, stub):
    grid = [*GRID, *FOREVER, "--runs-dir", tmp_path]
    runs = folders(*grid)
    controller, terminal = pty.openpty()
    streams = {"stdin": terminal, "stdout": terminal, "stderr": terminal}
    sweep = start(*grid, "--jobs", "2", env=stub, prefix=["setsid", "--ctty"], **streams)
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
    assert check_stopped(runs, shown) == 2


@pytest.mark.slow
def test_a_script_and_an_environment_in_the_callers_folder(tmp_path):
    """They are found in the sweep, and where a line of the dry run is pasted into a shell.

    Also through a link to benchmark.sh, and in a folder whose name needs quotes.
    """
    (tmp_path / "bench").symlink_to(ROOT / "benchmark.sh")
    text = "gymnasium.register('Mine-v0', 'gymnasium.envs.classic_control:PendulumEnv')\n"
    (tmp_path / "my_envs.py").write_text(f"import gymnasium\n{text}")
    text = "import my_envs, noisy_wrappers\nclass Args: pass\nprint('found them')\nexit(3)\n"
    (tmp_path / "redq_continuous_noisy.py").write_text(text)
    (tmp_path / "env").symlink_to(Path(sys.executable).parents[1])  # PYTHON may be relative, too
    python = Path("env/bin", Path(sys.executable).name)
    here = {"cwd": tmp_path, "script": tmp_path / "bench", "env": ENV | {"PYTHON": str(python)}}
    own = ["baseline", "--algos", "redq", "--envs", "my_envs:Mine", "--seeds", "1"]
    own += ["--runs-dir", "my 'café' \x1b[31m"]
    swept = run(*own, **here)
    assert swept.code == 1 and re.search("exit 3 .*__redq_.*.log +found them", swept.out)
    assert "\x1b" not in swept.out and list(tmp_path.glob("my 'café'*/logs/*.log"))
    line = run(*own, "--dry-run", **here).out
    assert f" {tmp_path / python} " in line and "--env-id my_envs:Mine-v0" in line
    pasted = subprocess.run(line, shell=True, cwd=ROOT, capture_output=True, text=True)
    assert (pasted.returncode, pasted.stdout) == (3, "found them\n")
    # without a module of one's own, a file in the folder hides none of Python's
    (tmp_path / "random.py").write_text("exit('hidden')")
    assert run("demo", "--dry-run", **here).code == 0
