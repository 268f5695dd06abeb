"""Reading a folder of runs: what is in no table is listed with the reason."""

from analysis.runs import left_out, read_runs

BEGUN = "# 2026-01-01 00:00:00 host: python ppo_continuous_noisy.py\n"


def test_a_run_that_failed_before_it_had_a_folder_is_listed(tmp_path):
    (tmp_path / "logs").mkdir()
    for seed, text in (
        (1, "error: scale has 2 numbers\n"),
        (2, "KeyError: 'x'\n(training stopped)\n"),
    ):
        name = f"p0.1_s{seed}_NormalNoisyObservation_0.1_0.2__Pendulum-v1__ppo_continuous_noisy"
        (tmp_path / "logs" / f"{name}.log").write_text(f"{BEGUN}{text}# 2026 host: exit=2\n")
    (tmp_path / "logs" / "joblog.tsv").write_text("nothing of ours")
    table, count = left_out(read_runs(tmp_path))
    assert count == {"failed": 2}
    assert list(table["reason"]) == ["error: scale has 2 numbers", "KeyError: 'x'"]
    assert all(table["run"].str.contains("_NormalNoisyObservation_0.1_0.2__Pendulum-v1"))
    (tmp_path / "a__run").mkdir()
    (tmp_path / "logs" / "a__run.log").write_text(f"{BEGUN}error: no\n")
    assert left_out(read_runs(tmp_path))[1] == {"failed": 2, "corrupt": 1}
