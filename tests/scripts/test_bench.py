"""bench.py: what it counts, who runs when, what it prints. No timings."""

import contextlib
import csv
import json
import sys
from types import SimpleNamespace

import bench
import pytest


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


def test_programs_are_measured_in_turn(tmp_path, monkeypatch):
    speeds = {"ours": [10.0, 20.0, 60.0], "checkout": [10.0, 10.0, 20.0]}
    programs = [SimpleNamespace(name=name, speeds=[], shares=[]) for name in speeds]
    measured = []

    def measure(options, program):
        measured.append(program.name)
        program.speeds.append(speeds[program.name][len(program.speeds)])
        program.shares.append(1.0)

    monkeypatch.setattr(bench, "started", lambda _: contextlib.nullcontext(programs))
    monkeypatch.setattr(bench, "measure", measure)
    blocks = tmp_path / "blocks.csv"
    options = bench.parse(["--pairs", "3", "--blocks", str(blocks)])
    ours, theirs = bench.compare("sac", "Any-v5", options)
    assert measured == ["ours", "checkout", "checkout", "ours", "ours", "checkout"]
    assert (ours["program"], theirs["program"]) == ("ours", "checkout")
    assert theirs["ours / its"] == 2  # the median of 1, 2 and 3
    stored = [row for row in csv.DictReader(blocks.open()) if row["program"] == "checkout"]
    assert [float(row["steps_per_second"]) for row in stored] == speeds["checkout"]


@pytest.mark.slow
def test_a_real_script_is_measured(monkeypatch, capsys):
    words = ["--algos", "td3", "--envs", "Pendulum-v1", "--pairs", "1", "--seconds", "0.1"]
    monkeypatch.setattr(bench, "LEARNING_STARTS", 300)
    bench.main([*words, "--", "--no-compile"])
    script, env_id, program, speed, *_ = capsys.readouterr().out.splitlines()[-1].split()
    assert (script, env_id, program) == ("td3", "Pendulum-v1", "ours") and float(speed) > 0
