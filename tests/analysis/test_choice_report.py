"""What analyze.py says of noise that was chosen, that changes during training, or that combines."""

import numpy as np
import pandas as pd
import pytest
from sweeps import ENDING, SCALE, row, run, write_run

from analysis.choice import read_choice
from analysis.folders import runs_of
from analysis.runs import read_runs

HEADER = "algorithm,environment,exp_name,tested,phase,round,noise,noise_rate,seeds,score,survives\n"
NAME = "ppo_continuous_noisy"


def write_choice(root, env="Hopper-v5", seeds=range(1001, 1006), gain=30.0, name=NAME):
    """Runs of a search in two rounds, which flatters its winner, and of a confirmation."""

    def write(phase, final, seed, *noise):
        more = {"folder": f"{name}_{env}_{seed}_{noise}", "exp_name": name}
        write_run(root / phase, [final], "PPO", env, *noise, seed=seed, **more)

    for noise, n, final in ((SCALE, 3, 900.0), (ENDING, 1, 100.0)):
        for seed in range(1, n + 1):
            write("search", final + seed, seed, noise, 1.0)
    for seed in seeds:
        write("confirmation", 100.0 + seed - 1000, seed)
        write("confirmation", 100.0 + gain + seed - 1000, seed, SCALE, 1.0)
    study = f"PPO,{env},{name},"
    lines = [
        f'{study},search,1,"{SCALE}",1.0,1,901.0,yes\n',
        f'{study},search,1,"{ENDING}",1.0,1,101.0,no\n',
        f"{study},confirmation,,,0.0,5,103.0,\n",
        f'{study},confirmation,,"{SCALE}",1.0,5,133.0,yes\n',
    ]
    path = root / "choice.csv"
    path.write_text((path.read_text() if path.exists() else HEADER) + "".join(lines))


def test_search_and_confirmation_are_never_mixed(tmp_path, capsys):
    write_choice(tmp_path / "runs")
    tables = run(tmp_path)
    summary = tables["summary_PPO"]
    search, fresh = "search", "confirmation"
    assert row(summary, phase=search, noise=SCALE)[["n", "mean"]].tolist() == [3, 902]
    confirmed = row(summary, phase=fresh, noise=SCALE)
    assert confirmed[["n", "mean", "n_baseline", "baseline_mean"]].tolist() == [5, 133, 5, 103]
    assert np.isnan(row(summary, phase=search, noise=SCALE)["difference_percent"])
    # Only the confirmation is judged: five against five that are all higher.
    for name in ("statistics", "best"):
        assert set(tables[name]["phase"]) == {fresh}
    assert row(tables["statistics"], noise=SCALE)["p"] == pytest.approx(2 / 252)
    printed = capsys.readouterr().out
    found = f"PPO [confirmation] on Hopper-v5 with {SCALE} at rate 1.00 is better than no noise: "
    assert f"{found}+30.0 [27.7, 32.3] (+29 % [" in printed
    assert "no finished baseline" not in printed and tables["missing"].empty
    choice = tables["choice"]
    assert choice["survives"].fillna("").tolist() == ["yes", "no", "", "yes"]
    assert choice["noise_rate"].tolist() == ["1.00", "1.00", "0.00", "1.00"]
    page = (tmp_path / "results/report.html").read_text()
    assert page.index('id="choice"') < page.index('id="noises"')


def test_a_choice_in_a_folder_of_its_own_disturbs_no_other_sweep(tmp_path):
    write_run(tmp_path, [100.0], "PPO")
    write_run(tmp_path, [110.0], "PPO", noise=SCALE, rate=1.0)
    before = runs_of(tmp_path)
    write_choice(tmp_path / "choose")
    assert len(before) == 2 and runs_of(tmp_path) == before
    assert len(read_runs(tmp_path)) == 2 and read_choice(tmp_path) is None


@pytest.mark.parametrize(
    ("gain", "survives", "verdict"),
    [(30.0, "yes", "better"), (30.0, "no", "no clear difference"), (-30.0, "worse", "worse")]
    + [(-30.0, "no", "no clear difference"), (2.0, "yes", "better"), (30.0, None, "")],
)
def test_a_confirmation_has_the_verdict_of_the_choice(gain, survives, verdict, tmp_path):
    """Which looks several times: a plain p would be one look more.

    It is not corrected: it has its share of the level from the command that planned it.
    """
    write_choice(tmp_path / "runs", "Pusher-v5", gain=0.5)
    write_choice(tmp_path / "runs", gain=gain)
    path = tmp_path / "runs/choice.csv"
    lines = path.read_text().splitlines()
    last = lines.pop().rpartition(",")[0]
    if survives:
        lines.append(f"{last},{survives}")
    path.write_text("\n".join(lines) + "\n")
    tables = run(tmp_path)
    said = row(tables["noises"], environment="Hopper-v5")["verdict"]
    assert said == verdict or (pd.isna(said) and not verdict)
    assert list(tables["noises"]["p_adjusted"]) == list(tables["noises"]["p"])
    assert set(tables["noises"]["comparisons"]) == {1} and tables["noises_together"].empty


def test_two_choices_of_one_environment_have_verdicts_of_their_own(tmp_path):
    write_choice(tmp_path / "runs", name="other")
    path = tmp_path / "runs/choice.csv"
    path.write_text(path.read_text().replace("133.0,yes", "133.0,no"))
    write_choice(tmp_path / "runs")
    noises = run(tmp_path)["noises"].set_index("exp_name")["verdict"]
    assert noises.to_dict() == {"other": "no clear difference", NAME: "better"}


def test_a_confirmation_that_is_not_judged_yet_is_drawn(tmp_path):
    write_choice(tmp_path / "runs", gain=0.5)
    (tmp_path / "runs/choice.csv").unlink()
    tables = run(tmp_path, drawn=True, smallest_gain=100.0)
    assert tables["statistics"]["verdict"].isna().all()
    assert (tmp_path / "results/report.html").exists()
