"""Set D of plans.md: does training with changing physics help under other physics?"""

import matplotlib
import pandas as pd
from matplotlib.figure import Figure

from analysis.folders import read_run
from results.study import returns
from results.study.compare import average_change, holm, in_words, joint_p

ENVIRONMENTS = ["HalfCheetah", "Hopper", "Pusher", "Walker2d"]
DYNAMICS = "RandomDynamics(0.8, 1.2)"
CHEAP = ["RandomNormalNoisyObservation(0.001)", "RandomUniformScaleObservation(0.8, 1.2)"]
TRAININGS = ["", DYNAMICS, *CHEAP]
FACTORS = [0.7, 0.85, 1.0, 1.15, 1.3]  # of all masses and frictions
CHANGED = [0.7, 0.85, 1.15, 1.3]
NOISES = {factor: f"RandomDynamics({factor}, {factor})" for factor in CHANGED} | {1.0: ""}
NOISES |= {"delay 1": "RandomActionDelay(1)", "delay 2": "RandomActionDelay(2)"}  # steps
FINAL = "final"  # the last test of the training, in the clean environment
TESTS = [FINAL, *NOISES]
COLORS = ["black", "#0072B2", "#E69F00", "#009E73"]  # Okabe and Ito (2008)


def read_tests():
    """Return mean returns: a row for each environment and seed, a column (training, test) for each.

    Only whole seeds: all trainings have finished in all environments, and evaluate.py has tested
    all policies. One whole seed alone has no deviation: then there are no rows.
    """
    rows = []
    for path in sorted((returns.DATA / "physics").rglob("robustness.csv")):
        trained = read_run(path.parent, with_curve=False)
        if not trained.finished:
            continue
        run = trained.environment.split("-")[0], trained.seed, trained.configuration.noise
        rows.append((*run, FINAL, trained.result["final_return_mean"]))
        episodes = pd.read_csv(path, keep_default_na=False, dtype={"noise_rate": str})
        episodes = episodes[episodes["noise_rate"].isin(["0.0", "1.0"])]
        means = episodes.groupby("noise")["episodic_return"].mean()
        rows += [(*run, test, means.get(noise)) for test, noise in NOISES.items()]
    columns = ["environment", "training", "test"]
    table = pd.DataFrame(rows, columns=["environment", "seed", "training", "test", "return"])
    table = table.pivot(index="seed", columns=columns, values="return")
    every = pd.MultiIndex.from_product([ENVIRONMENTS, TRAININGS, TESTS], names=columns)
    whole = table.reindex(columns=every).dropna()
    if len(whole) == 1:
        whole = whole[:0]
    return whole.stack("environment").swaplevel().sort_index()


def by_training(tests):
    """Return "mean ± sd" over seeds of all returns: a row for each environment and training."""
    rows = []
    for environment, runs in tests.groupby("environment"):
        for training in TRAININGS:
            row = {"environment": environment, "trained with": training or "no noise"}
            row |= {"n": len(runs), "clean": cell(runs[training, FINAL])}
            row |= {f"factor {factor}": cell(runs[training, factor]) for factor in FACTORS}
            row["changed physics"] = cell(runs[training][CHANGED].mean(axis=1))
            row |= {delay: cell(runs[training, delay]) for delay in ("delay 1", "delay 2")}
            rows.append(row)
    return pd.DataFrame(rows)


def cell(values):
    """Return a mean and a standard deviation as text."""
    return f"{values.mean():,.1f} ± {values.std():,.1f}"


def questions(tests):
    """Answer the three questions: a row for each, over all environments.

    The change is the average over environments, in percent of what is on the right of "against",
    with the interval of compare.average_change; p is compare.joint_p, and `holm` corrects it.
    """
    changed = {training: tests[training][CHANGED].mean(axis=1) for training in TRAININGS}
    cheap = sum(changed[training] for training in CHEAP) / len(CHEAP)
    asked = {
        "clean return: RandomDynamics against no noise": (
            tests[DYNAMICS, FINAL],
            tests["", FINAL],
        ),
        "return under changed physics: RandomDynamics against no noise": (
            changed[DYNAMICS],
            changed[""],
        ),
        "return under changed physics: RandomDynamics against two cheap noises": (
            changed[DYNAMICS],
            cheap,
        ),
    }
    rows = []
    for question, sides in asked.items():
        by_environment = [
            [side[environment].to_numpy() for side in sides]
            for environment in tests.index.unique("environment")
        ]
        change, low, high, _ = average_change(by_environment)
        row = {"question": question, "seeds": tests.index.unique("seed").size}
        row |= {"change_percent": change, "low_percent": low, "high_percent": high}
        rows.append(row | {"p": joint_p(by_environment)})
    table = pd.DataFrame(rows)
    table["holm"] = holm(table["p"])
    table["verdict"] = list(map(in_words, table["change_percent"], table["holm"]))
    return table


def tables():
    """Return {name: frame}, empty before there are two whole seeds."""
    tests = read_tests()
    if tests.empty:
        return {}
    return {"physics_returns": by_training(tests), "physics_questions": questions(tests)}


def draw(tests, path):
    """Write the figure, return against factor: a panel an environment, a line a training.

    Mean over seeds ± standard error.
    """
    environments = tests.index.unique("environment")
    with matplotlib.rc_context({"font.size": 9, "svg.hashsalt": "noisy"}):
        figure = Figure(figsize=(10, 3), layout="constrained")
        panels = figure.subplots(1, len(environments), squeeze=False)[0]
        for panel, environment in zip(panels, environments, strict=True):
            runs = tests.loc[environment]
            for training, color in zip(TRAININGS, COLORS, strict=True):
                mean, error = runs[training][FACTORS].mean(), runs[training][FACTORS].sem()
                label = training or "no noise"
                panel.errorbar(FACTORS, mean, error, color=color, label=label, marker=".")
            panel.set(title=environment, xlabel="factor of masses and frictions", xticks=FACTORS)
            panel.spines[["top", "right"]].set_visible(False)
        panels[0].set_ylabel("return")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
        figure.savefig(path, metadata={"Date": None})
