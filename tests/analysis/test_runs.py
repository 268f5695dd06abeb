"""Reading a folder of runs: what is in no table is listed with the reason."""

from test_analyze import SCALE, run, write_run

from analysis.runs import left_out, make_studies, read_runs

BEGUN = "# 2026-01-01 00:00:00 host: python ppo_continuous_noisy.py\n"


def test_a_run_that_failed_before_it_had_a_folder_is_listed(tmp_path):
    (tmp_path / "logs").mkdir()
    for seed, text in (
        (1, "error: scale has 2 numbers\n"),
        (2, "KeyError: 'x'\n(training stopped)\n"),
    ):
        name = f"p0.1_s{seed}_NormalNoisyObservation_0.1_0.2__Pendulum-v1__ppo_continuous_noisy"
        (tmp_path / "logs" / f"{name}.log").write_text(f"{BEGUN}{text}# 2026 host: exit=2\n")
    for code in (0, 130, 143):  # finished or stopped; its folder was moved or deleted afterwards
        (tmp_path / "logs" / f"a__{code}.log").write_text(f"{BEGUN}x\n# now host: exit={code}\n")
    (tmp_path / "logs" / "a__run.log").write_text(f"{BEGUN}compiling ...\n")  # it is starting
    (tmp_path / "logs" / "joblog.tsv").write_text("nothing of ours")
    table, count = left_out(read_runs(tmp_path))
    assert count == {"failed": 2}
    assert list(table["reason"]) == ["error: scale has 2 numbers", "KeyError: 'x'"]
    assert all(table["run"].str.contains("_NormalNoisyObservation_0.1_0.2__Pendulum-v1"))


def test_a_run_of_a_choice_that_failed_before_it_had_a_folder_is_listed(tmp_path):
    for phase in ("search", "confirmation"):
        (tmp_path / phase / "logs").mkdir(parents=True)
        log = tmp_path / phase / "logs" / "a__run.log"
        log.write_text(f"{BEGUN}error: no\n# 2026 host: exit=2\n")
    table, count = left_out(read_runs(tmp_path))
    assert count == {"failed": 2}
    assert list(table["run"]) == ["search/a__run", "confirmation/a__run"]


def test_an_unfinished_run_of_an_older_version_lacks_no_others(tmp_path):
    for seed in (1, 2):
        for env in ("Hopper-v4", "Hopper-v5"):
            last = env == "Hopper-v4" and seed == 2
            write_run(tmp_path, [10], env=env, seed=seed)
            write_run(tmp_path, [9], env=env, seed=seed, noise=SCALE, rate=0.1, finished=not last)
    _, count = left_out(read_runs(tmp_path))
    assert count == {"unfinished": 1}


def reasons(runs):
    """Return what is said of each run that differs from its study, by its seed."""
    different = runs[runs["status"] == "different"]
    return dict(zip(different["seed"], different["reason"], strict=True))


def test_a_study_has_arguments_that_some_of_its_runs_have(tmp_path):
    for seed in range(1, 11):
        gamma, values = (0.99, [10, 20]) if seed <= 4 else (0.9, [5] if seed <= 7 else [5, 6, 7])
        write_run(tmp_path / "runs", values, seed=seed, gamma=gamma)
    runs = read_runs(tmp_path / "runs")
    assert set(runs.loc[runs["status"] == "finished", "seed"]) == {1, 2, 3, 4}


def test_the_most_frequent_arguments_of_an_exp_name_are_its_study(tmp_path, capsys):
    for seed in (1, 2, 3):
        write_run(tmp_path / "runs", [10, 20], seed=seed)
        write_run(tmp_path / "runs", [20, 30], seed=seed, noise=SCALE, rate=0.1)
    write_run(tmp_path / "runs", [5], seed=4, gamma=0.9, env="Pusher-v5")  # a short trial
    write_run(tmp_path / "runs", [5], seed=5, gamma=0.9, exp_name="trial")
    write_run(tmp_path / "runs", [5], seed=6, gamma=0.9, finished=False)
    runs = read_runs(tmp_path / "runs")
    [reason] = reasons(runs).values()
    assert reason == (
        "gamma is 0.9, not 0.99, total_timesteps is 10000, not 20000 as in the runs of "
        "sac_continuous_noisy that count: give such runs another --exp-name"
    )
    studies, _ = make_studies(runs)
    assert [study.name for study in studies] == ["SAC", "SAC [trial]"]
    assert studies[0].environments == ["Hopper-v5"] and studies[0].steps.tolist() == [10000, 20000]
    tables = run(tmp_path)
    assert reason in set(tables["missing"]["reason"])
    assert set(tables["missing"]["environment"]) == {"Hopper-v5", "Pusher-v5"}  # no baseline there
    assert "1 different" in capsys.readouterr().out


def test_an_argument_that_a_run_lacks_is_no_difference(tmp_path):
    """Older versions lack some; the most frequent arguments may be those of no version alone."""
    for seed, more in enumerate(
        [{}, {}, {}, {"new": 1}, {"new": 1}, {"new": 2}, {"newer": None, "new": 1}, {"newer": 3}]
    ):
        write_run(tmp_path, [10], seed=seed, **more)
    assert {seed: text.split(" as")[0] for seed, text in reasons(read_runs(tmp_path)).items()} == {
        5: "new is 2, not 1",
        7: "newer is 3, not None",
    }


def test_of_equally_frequent_arguments_those_of_the_longest_runs_are_the_study(tmp_path):
    write_run(tmp_path, [10, 20, 30], seed=1)
    write_run(tmp_path, [10], seed=2)
    assert list(reasons(read_runs(tmp_path))) == [2]


def test_averages_over_environments_take_the_newest_version_of_each_and_say_so(tmp_path):
    for seed in (1, 2):
        for env in ("Hopper-v4", "Hopper-v5", "Walker2d-v4"):
            write_run(tmp_path / "runs", [10 if env == "Hopper-v4" else 100], env=env, seed=seed)
            level = 1 if env == "Hopper-v4" else 110
            write_run(tmp_path / "runs", [level], env=env, seed=seed, noise=SCALE, rate=0.1)
    statistics = run(tmp_path)["statistics"]
    average = statistics[statistics["scope"] == "all"]
    assert list(average["environments"]) == [2] and average["difference_percent"].item() == 10
    _, notes = make_studies(read_runs(tmp_path / "runs"))
    assert notes == [
        "SAC [environments v4] is apart, because averages over environments take the newest "
        "version of each: Hopper-v4"
    ]
