"""Small synthetic sweeps, and analyze.py on them: what the tests of the analysis share."""

import json
from contextlib import nullcontext
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd

import analyze
from analysis.comparisons import compare_all
from analysis.figures import figures
from analysis.runs import read_runs
from analysis.studies import make_studies
from analysis.tables import make_tables

ROOT = Path(analyze.__file__).parent
NAN = float("nan")
SCALE = "RandomUniformScaleReward(0.5, 1.5)"
ENDING = "RandomEarlyTermination(50)"


def write_run(
    root,
    curve,
    algorithm="SAC",
    env="Hopper-v5",
    noise=(),
    rate=(),
    seed=1,
    every=10_000,
    spread=1.0,
    folder=None,
    finished=True,
    config=(),
    **args,
):
    """Write one run folder: `curve` is its mean return at each evaluation (two episodes each).

    config: what stands in config.json beside the arguments.
    """
    noise, rate = ((noise,), (rate,)) if isinstance(noise, str) else (noise, rate)
    steps = every * np.arange(1, len(curve) + 1)
    name = f"{env}__{algorithm}__{'+'.join(map(str, noise + rate)) or 'baseline'}__{seed}"
    folder = Path(root) / (folder or name.replace("/", "-"))
    folder.mkdir(parents=True)
    exp_name = f"{algorithm.lower()}_continuous_noisy"
    settings = {"env_id": env, "exp_name": exp_name, "seed": seed, "noise": noise}
    settings |= {"noise_rate": rate, "total_timesteps": int(steps[-1]), "eval_frequency": every}
    settings |= {"eval_episodes": 2, "runs_dir": str(root), "gamma": 0.99, **args}
    versions = {"torch": "2.13.0", "mujoco": "3.15.0"}
    content = {"algorithm": algorithm, "args": settings, "versions": versions} | dict(config)
    (folder / "config.json").write_text(json.dumps(content))
    lines = ["step,episode,episodic_return,episodic_length\n"]
    for step, value in zip(steps, curve, strict=True):
        for episode, sign in enumerate((-1, 1)):
            lines.append(f"{step},{episode},{float(value) + sign * spread!r},1000\n")
    (folder / "eval.csv").write_text("".join(lines))
    if finished:
        (folder / "result.json").write_text(json.dumps({"final_return_mean": float(curve[-1])}))
    return folder


# Final returns of the sweep that tables are computed from by hand.
FINALS = {
    ("Hopper-v5", "", 0): [100, 110, 120, 130],  # mean 115, std 12.9099
    ("Hopper-v5", SCALE, 0.05): [130, 140, 150, 160],  # mean 145
    ("Hopper-v5", SCALE, 0.2): [90, 100, 115, 155],  # mean 115: matched
    ("Hopper-v5", ENDING, 0.05): [10, 20, 30, 40],  # mean 25
    ("Pusher-v5", "", 0): [-50, -40, -30, -40],  # mean -40, std 8.1650
    ("Pusher-v5", SCALE, 0.05): [-30, -20, -30, -20],  # mean -25
    ("Pusher-v5", SCALE, 0.2): [-60, -50, -60, -50],  # mean -55
    ("Pusher-v5", ENDING, 0.05): [-80, -80, -80, -80],
}


def small_sweep(root, order=1):
    """Write the runs of FINALS: five evaluations at 0.2, 0.4, ... 1.0 times the final return."""
    cells = [(key, seed) for key in FINALS for seed in range(4)][::order]
    for i, ((env, noise, rate), seed) in enumerate(cells):
        final = FINALS[env, noise, rate][seed]
        start = 0 if final > 0 else 2 * final
        curve = [start + (final - start) * part for part in (0.2, 0.4, 0.6, 0.8, 1)]
        folder = f"{order}-{i:03}" if order != 1 else None
        config = {"noise": noise, "rate": rate} if noise else {}
        write_run(root, curve, env=env, seed=seed + 1, folder=folder, **config)


def write_pairs(root, baseline, noisy, noise=SCALE, rate=0.1, **more):
    """Write runs with these final returns, one for each seed, without noise and with."""
    for config, finals in (({}, baseline), ({"noise": noise, "rate": rate}, noisy)):
        for seed, final in enumerate(finals, start=1):
            write_run(root, [final], seed=seed, **config, **more)


def main(args, drawn=False):
    """Run analyze.py's main function, without figures: drawing takes longer than all the rest."""
    with nullcontext() if drawn else mock.patch.object(analyze, "figures", return_value=[]):
        return analyze.main(args)


def run(tmp_path, runs="runs", out="results", drawn=False, **more):
    """Analyse and read the csv tables."""
    main(analyze.Args(tmp_path / runs, tmp_path / out, latex=True, **more), drawn)
    empty = dict.fromkeys(("exp_name", "phase", "tested", "environment", "noise"), "")
    text = dict.fromkeys((*empty, "noise_rate", "test_rate"), str)
    files = sorted((tmp_path / out).glob("*.csv"))
    return {f.stem: pd.read_csv(f, dtype=text).fillna(empty) for f in files}


def row(table, **where):
    """The only row of a table with these values."""
    for name, value in where.items():
        table = table[table[name] == value]
    assert len(table) == 1, table
    return table.iloc[0]


def drawn_of(runs_dir):
    """Return {name: Drawing} of the figures of a folder of runs."""
    studies, _ = make_studies(read_runs(runs_dir))
    drawn = figures(studies, make_tables(studies, compare_all(studies)))
    return {drawing.name: drawing for drawing in drawn}
