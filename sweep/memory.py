"""What a folder of choices keeps in choice.json: the commands, and what was fixed beforehand.

{"commands": [{"algos": [...], "envs": [...], "words": [...], "extra_words": [...]}, ...],
 "plans": {"ENVIRONMENT__EXP_NAME by METRIC": {"looks": [...], "level": ...}}}
"""

import json
from pathlib import Path

from analysis.errors import fail, in_words
from analysis.folders import rewritten
from noisy_wrappers import BASELINE
from sweep.grid import name_of
from sweep.looks import Plan


def load(runs_dir):
    """Return what a folder keeps; exits where that cannot be read: it must not be decided anew."""
    path = Path(runs_dir, "choice.json")
    empty = {"commands": [], "plans": {}}
    try:
        kept = empty | json.loads(path.read_text("utf-8"))
        plans = kept["plans"].items()
        plans = {key: Plan(tuple(one["looks"]), one["level"]) for key, one in plans}
        return {"commands": list(kept["commands"]), "plans": plans}
    except FileNotFoundError:
        return empty
    except (OSError, ValueError, TypeError, AttributeError, KeyError) as error:
        return fail(f"cannot read {path} ({in_words(error)}), which keeps the plan of a choice")


def choice_key(args, algorithm, env_id):
    """Name a choice in choice.json: by what its folders have in common, and its metric."""
    _, _, name = name_of(args, algorithm, env_id, BASELINE, 0).partition("__")
    return f"{name} by {args.metric}"


def plan_of(args, algorithm, env_id):
    """Return the Plan that a choice began its confirmation with, or None."""
    return load(args.runs_dir)["plans"].get(choice_key(args, algorithm, env_id))


def keep_plans(args, plans):
    """Keep the plans of confirmations that begin now, {key: Plan}, and the command."""
    command = {name: getattr(args, name) for name in ("algos", "envs", "words", "extra_words")}
    path = Path(args.runs_dir, "choice.json")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with rewritten(path) as file:  # another command may write at the same time
            kept = load(args.runs_dir)
            others = [one for one in kept["commands"] if one != command]
            kept_plans = {key: plan._asdict() for key, plan in (plans | kept["plans"]).items()}
            json.dump({"commands": [*others, command], "plans": kept_plans}, file, indent=1)
    except OSError as error:
        fail(f"--runs-dir: cannot write {path}: {error.strerror}")


def words_of_choice(runs_dir, algos, envs):
    """Return the words of the last command that chose for these, as (words, extra), or None.

    algos, envs: those that it must have.
    """
    for command in reversed(load(runs_dir)["commands"]):
        has_envs = all(
            any(own == env or own.startswith(f"{env}-v") for own in command["envs"]) for env in envs
        )
        if has_envs and set(algos) <= set(command["algos"]):
            return command["words"], command["extra_words"]
    return None
