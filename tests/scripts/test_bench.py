"""bench.py: what it counts, who runs when, what it prints. No timings."""

import csv
import itertools
import json
import os
import sys
from statistics import median
from types import SimpleNamespace

import bench
import pytest

# Stands for a script of the project: it says in a file whenever it runs, and logs as they do.
SCRIPT = """
import time
from torch.utils.tensorboard import SummaryWriter

writer = SummaryWriter("runs")
for step in range(100, 1_000_000, 100):
    with open("{log}", "a") as log:
        log.write("{name}\\n")
    time.sleep(0.01)
    writer.add_scalar("losses/actor_loss", 1.0, step)
    writer.add_scalar("losses/critic_loss", 1.0, step)
"""
# Stands for TensorBoard's writer, which would import PyTorch.
WRITER = """
class SummaryWriter:
    def __init__(self, folder):
        pass

    def add_scalar(self, *args):
        pass
"""


def checkout(folder, text):
    """Make a checkout of a project with one script."""
    (folder / "torch" / "utils").mkdir(parents=True)
    (folder / "torch" / "utils" / "tensorboard.py").write_text(WRITER)
    (folder / "torch" / "__init__.py").touch()
    (folder / "sac_continuous_noisy.py").write_text(text)
    return folder


def test_waiting_is_not_counted(monkeypatch, capsys):
    now = SimpleNamespace(wall=0.0, cpu=0.0)

    def wait():
        now.wall += 100
        now.cpu += 1
        return "go on\n"

    monkeypatch.setattr(bench.time, "perf_counter", lambda: now.wall)
    monkeypatch.setattr(bench.time, "process_time", lambda: now.cpu)
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(readline=wait))
    marks = bench.Marks()
    for step in (100, 200):
        now.wall += 3
        now.cpu += 2
        marks.mark(step)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("mark ")]
    assert [json.loads(line[5:]) for line in lines] == [[100, 3, 2], [200, 6, 4]]


@pytest.mark.parametrize(("clock", "speed"), [("wall", 50), ("cpu", 200)])
def test_a_block_lasts_long_enough_and_counts_from_its_start(clock, speed, monkeypatch):
    def advance(program):
        program.step += 100
        program.wall += 2
        program.cpu += 0.5

    monkeypatch.setattr(bench, "advance", advance)
    program = SimpleNamespace(step=5000, wall=70.0, cpu=9.0, speeds=[], shares=[])
    bench.measure(SimpleNamespace(seconds=5, clock=clock), program)
    assert program.step == 5300
    assert (program.speeds, program.shares) == ([speed], [0.25])


@pytest.mark.slow
def test_programs_run_in_turn(tmp_path, monkeypatch):
    log = tmp_path / "log"
    folders = [checkout(tmp_path / name, SCRIPT.format(log=log, name=name)) for name in "ab"]
    monkeypatch.setattr(bench, "PROJECT", folders[0])
    measure, speeds = bench.measure, {}

    def watched(options, program):
        measure(options, program)
        speeds[program.name] = program.speeds

    monkeypatch.setattr(bench, "measure", watched)
    blocks = tmp_path / "blocks.csv"
    words = ["--against-checkout", str(folders[1]), "--pairs", "3", "--seconds", "0.1"]
    words += ["--blocks", str(blocks)]
    ours, theirs = bench.compare("sac", "Any-v5", bench.parse(words))

    ran = [(name, len(list(group))) for name, group in itertools.groupby(log.read_text().split())]
    assert [name for name, _ in ran] == ["a", "b", "a", "b", "a", "b"]  # b b and a a of ABBA join
    assert ran[0] == ("a", 3) and ran[1] == ("b", 3)  # warming up, one mark for each step
    assert (ours["program"], theirs["program"]) == ("ours", "checkout")
    ratios = [a / b for a, b in zip(speeds["ours"], speeds["checkout"], strict=True)]
    assert len(ratios) == 3 and theirs["ours / its"] == median(ratios)
    stored = [row for row in csv.DictReader(blocks.open()) if row["program"] == "checkout"]
    stored_speeds = [float(row["steps_per_second"]) for row in stored]
    assert stored_speeds == pytest.approx(speeds["checkout"], rel=1e-3)


@pytest.mark.slow
def test_a_real_script_is_measured(monkeypatch, capsys):
    words = ["--algos", "td3", "--envs", "Pendulum-v1", "--pairs", "1", "--seconds", "0.1"]
    monkeypatch.setattr(bench, "LEARNING_STARTS", 300)
    bench.main([*words, "--", "--no-compile"])
    *_, row = capsys.readouterr().out.splitlines()
    script, env_id, program, speed, *_ = row.split()
    assert (script, env_id, program) == ("td3", "Pendulum-v1", "ours") and float(speed) > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--algos dqn", "invalid choice: 'dqn'"),
        ("--seconds nan", "--seconds must be at least 0.1, not nan"),
        ("--against-checkout .github", "--against-checkout: there is no .github/sac_continuous"),
        ("--against-cleanrl .", "--against-cleanrl and --cleanrl-python need each other"),
        ("--against-sbx ./no-python", "./no-python is not a program"),
        ("--jobs 2 --against-checkout .", "--jobs compares runs of this version only"),
    ],
)
def test_bad_arguments(arguments, message, monkeypatch, capsys):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1})
    with pytest.raises(SystemExit) as exit_:
        bench.main(arguments.split())
    error = capsys.readouterr().err
    assert exit_.value.code == 2
    assert error.startswith("error: ") and message in error and error.count("\n") == 1
