"""bench.py: what it counts, where it cuts the training loops, what it prints. No timings."""

import os
import sys
from pathlib import Path

import pytest

import bench

ROOT = Path(__file__).parent.parent


def test_arithmetic_by_hand():
    # HalfCheetah: 17 observations, 6 actions; multiply-adds of one input through one network
    actor, critic = 17 * 256 + 256 * 256 + 256 * 12, 23 * 256 + 256 * 256 + 256
    backward = {  # no gradient with respect to the first layer's input
        "actor": 2 * actor - 17 * 256,
        "critic": 2 * critic - 23 * 256,
        "action": critic - 17 * 256,
    }
    critic_update = actor + 2 * critic + 2 * critic + 2 * backward["critic"]
    actor_update = actor + 2 * critic + 2 * backward["action"] + backward["actor"]
    sac = 2 * (actor + 256 * (critic_update + actor_update + actor))
    assert bench.arithmetic("sac", 17, 6) == sac
    assert round(sac / 1e9, 2) == 0.61

    assert round(bench.arithmetic("td3", 17, 6) / 1e9, 2) == 0.41

    actor, critic = 17 * 64 + 64 * 64 + 64 * 6, 17 * 64 + 64 * 64 + 64
    epoch = 3 * (actor + critic) - 2 * 17 * 64
    assert bench.arithmetic("ppo", 17, 6) == 2 * (2 * actor + critic + 10 * epoch)


@pytest.mark.parametrize("algo", bench.ALGOS)
def test_the_labels_of_the_training_loops(algo):
    source = (ROOT / f"{algo}_continuous_noisy.py").read_text().partition("\ndef train(")[2]
    labelled = bench.label_phases(source)
    compile("def train(" + labelled, algo, "exec")
    expected = {"act", "env", "store", "update"} | ({"sample"} if algo == "ppo" else set())
    assert {phase for phase in bench.PHASES if f'switch("{phase}")' in labelled} == expected


def test_a_clock_counts_all_time_once(monkeypatch):
    clock, now = bench.Clock("wall"), [0.0]
    monkeypatch.setattr(clock, "now", lambda: now[0])

    class Buffer:
        def sample(self):
            now[0] += 3

    clock.around(Buffer, "sample", "sample")
    clock.restart()
    clock.switch("update")
    now[0] += 1
    Buffer().sample()
    now[0] += 1
    clock.switch("env")
    assert clock.seconds == dict.fromkeys(bench.PHASES, 0.0) | {"update": 2, "sample": 3}


def test_speed_comes_from_the_measured_steps():
    options = bench.parse(["--steps", "1000"])
    marks = {1100: (0, 0), 1200: (50, 10), 1700: (52, 11), 2200: (60, 18)}
    assert bench.speed(marks, "sac", options) == (100, 0.8)
    options.clock = "cpu"
    assert bench.speed(marks, "sac", options) == (125, 0.8)
    assert bench.window("ppo", 1500) == (3 * 2048, 13 * 2048)


def test_table():
    rows = [{"script": "sac", "steps/s": [240.4, 231.6], "median": 2.378, "start s": None}]
    assert bench.table(rows).splitlines() == [
        "script  steps/s  median  start s",
        "   sac  240 232    2.38        -",
    ]


def test_a_program_is_measured_and_its_failure_told(capfd, monkeypatch):
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None)  # it would outlast the test
    lines = "\n".join(f"print('SPS: {i}')" for i in range(9))
    marks, result = bench.Program("CleanRL", "sac", [sys.executable, "-c", lines]).run(0, 1500)
    assert list(marks) == [1100, 1200, 1300, 1400, 1500]
    assert result["memory"] > 1 and result["start"] is None

    finish = "print('mark 0'); print('result {\"seconds\": 2}')"
    marks, result = bench.Program("ours", "sac", [sys.executable, "-c", finish]).run(0)
    assert list(marks) == [0] and result["seconds"] == 2 and result["start"] > 0

    with pytest.raises(SystemExit):
        bench.Program("SBX", "td3", [sys.executable, "-c", "import nothing_like_it"]).run(0)
    assert "error: SBX td3: " in capfd.readouterr().err


def test_a_relative_interpreter_is_found_from_the_folder_of_a_run(tmp_path, monkeypatch):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/python").symlink_to(sys.executable)  # as in a virtual environment
    monkeypatch.chdir(tmp_path / "bin")
    options = bench.parse(["--against-sbx", "../bin/python"])
    assert options.against_sbx == str(tmp_path / "bin/python")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--algos dqn", "invalid choice: 'dqn'"),
        ("--steps 10", "--steps must be at least 100, not 10"),
        ("--jobs 1", "--jobs must be at least 2, not 1"),
        ("--core 4096", "--core must be one of"),
        ("--against-cleanrl .", "--against-cleanrl and --cleanrl-python go together"),
        ("--against-cleanrl . --cleanrl-python python3", "--against-cleanrl: there is no"),
        ("--json no-folder/figures.json", "--json: there is no folder no-folder"),
        ("--against-sbx ./no-python", "--against-sbx: ./no-python is not a program"),
    ],
)
def test_bad_arguments(arguments, message, capsys):
    with pytest.raises(SystemExit) as exit_:
        bench.main(arguments.split())
    error = capsys.readouterr().err
    assert exit_.value.code == 2
    assert error.startswith("error: ") and message in error and error.count("\n") == 1
