"""Check that a changed training script still keeps its promises. It takes about a minute.

    python tools/check_script.py my_continuous_noisy.py
    python tools/check_script.py my_continuous_noisy.py --hidden 64    # with an option of its own

Trains short runs on Pendulum-v1, and prints a line for each promise: "ok", or "FAILED" and what to
do. The exit status is 0 if all hold. docs/changing.md has the conventions behind them.
"""

import json
import sys
import tempfile
import textwrap
import traceback
from pathlib import Path
from unittest import mock

import torch
import watched_run
from watched_run import ROOT, BrokenError, Trial, check, noisy

from analysis.formatting import rounded


def trains(trial):
    """It trains."""
    check(trial.run.updates, "nothing was updated: let updater() take the gradients in learn()")
    return "".join(watched_run.remarks(trial.run))


def acts(trial):
    """The policy that acts is the one that learns."""
    with mock.patch.multiple(torch, randn=watched_run.zeros, randn_like=torch.zeros_like):
        run = trial.train("mean_actions", env_id=trial.lopsided)  # no noise in training, either
        check(run.gaps, "no action follows a test within an episode: see TEST in learn()")
        gaps = watched_run.gaps_in_losses(run, run.script.load_policy(run.folder))
    gap, advice = max(run.gaps), "act alike in both (or on purpose not); draw noise by torch.randn"
    check(gap < 1e-4, f"actions in training are {gap:.2g} from those of load_policy(): {advice}")
    check(gaps, "policy.pt has no network that an update learns: give log_test() that one")
    for name, gap in gaps.items():
        advice = "let both call the same method of the network"
        check(gap < 1e-4, f"{name}() learns actions {gap:.2g} from those of the policy: {advice}")


def learns(trial):
    """The learned networks have a gradient, and change."""
    for update in trial.run.updates:
        for name, parameter in update.parameters.items():
            where = f"{name} in {update.name}()"
            check(id(parameter) in trial.run.with_gradient, f"no gradient of {where}: use it there")
            changes = not parameter.equal(update.before[name])
            check(changes, f"{where} never changes: give the optimizer this network's parameters")


def follows(trial):
    """What is in the state changes, and targets follow the networks that learn."""
    problems = "; ".join(watched_run.left_behind(trial.run))
    check(not problems, problems)


def resumes(trial):
    """Stopped and resumed, a run ends with the same bytes."""
    for name in ("eval.csv", "policy.pt"):
        other = watched_run.what_resuming_changes(trial, name)
        missing = "put all that training changes into `state`; draw by torch, rng or env alone"
        check(not other, f"{other}: {missing}")


def tests(trial):
    """Tests do not move training."""
    once = trial.train("one_test", eval_frequency=0)
    same = trial.read(once, "policy.pt") == trial.read(trial.run, "policy.pt")
    check(same, "fewer tests, another policy: play in test_env, and change nothing while testing")


def compiles(trial):
    """Compiled and not, the first updates agree."""
    run = trial.train("compiled", episodes=3, compile=True)
    if "not compiled" in run.said:
        reason = run.said[run.said.index("not compiled") :].partition("\n")[0]
        check("InvalidCxxCompiler" in reason, f"write losses in PyTorch alone: {reason}")
        return " (skipped: no C++ compiler)"
    for update, other in zip(trial.run.updates, run.updates, strict=False):
        for name, value in update.first.items():
            gap = (other.first[name] - value).abs().max() / value.abs().max().clamp(0.1)
            where = f"{name} of {update.name}() by {gap:.2g} of it"
            check(gap < 1e-4, f"{where}: use plain PyTorch; draw random numbers before the loss")


def options(trial):
    """Options survive a resume, and with others it is another run."""
    configs = [json.loads(trial.read(run, "config.json")) for run in (trial.run, trial.resumed)]
    differing = noisy.different_arguments(*configs)
    check(not differing, f"a resume changes {differing}: leave args as they are")
    for name, other in watched_run.other_values(trial.run.args).items():
        refused = trial.refuses(**{name: other})
        check(refused, f"{name} {other} is no other run: leave resumed_run() in Run as it is")


def sweeps(trial):
    """The sweep knows the script."""
    words = ["custom", "--algos", trial.algorithm, "--envs", trial.run.args.env_id, "--seeds", "1"]
    words += ["--total-timesteps", "150", "--runs-dir", trial.folder / "swept", "--dry-run"]
    out = trial.command(ROOT / "benchmark.sh", *words, "--", *trial.own_options)
    check(trial.path.name in out, "benchmark.sh --dry-run shows no command with this script")


def evaluates(trial):
    """evaluate.py plays the run's last test again, with the same returns."""
    words = ["--seed", trial.run.script.TEST_SEED, "--episodes", trial.run.args.eval_episodes]
    out = trial.command(sys.executable, ROOT / "evaluate.py", trial.run.folder, *words).split()
    mean = rounded(json.loads(trial.read(trial.run, "result.json"))["final_return_mean"])
    check(mean == out[-1], f"{out[-1]}, not {mean}: let load_policy() build what config.json says")


def analyses(trial):
    """analyze.py knows the run."""
    out = trial.command(sys.executable, ROOT / "analyze.py", "--runs-dir", trial.run.folder.parent)
    check(trial.algorithm.upper() in out, f"analyze.py does not name it:\n{out}")


PROMISES = [trains, acts, learns, follows, resumes, tests, compiles, options]
PROMISES += [sweeps, evaluates, analyses]


def main(path="", *options):
    """Print a line for each promise; return the exit status."""
    if not (Path(path).name.endswith("_continuous_noisy.py") and Path(path).is_file()):
        wrong = f"error: there is no file {path}, or its name is not NAME_continuous_noisy.py"
        print(__doc__ if path[:1] in ("", "-") else wrong, file=sys.stderr)
        return 2
    kept = True
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial(Path(path).resolve(), options, Path(folder))
        for promise in PROMISES:
            text = promise.__doc__.rstrip(".")
            try:
                print(f"ok      {text}{promise(trial) or ''}", flush=True)
            except Exception as error:
                if not isinstance(error, BrokenError):
                    traceback.print_exc()
                print(f"FAILED  {text}: {textwrap.shorten(str(error), 500)}", flush=True)
                kept = False
                if promise is trains:
                    break
    return int(not kept)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
