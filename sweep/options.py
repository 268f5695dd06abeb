"""The arguments of benchmark.sh that name a grid; `./benchmark.sh --help` explains them."""

import argparse
import os
import re
from pathlib import Path

from analysis.errors import fail, with_place
from noisy_wrappers import canonical_env_id, split_noises
from sweep import scripts
from sweep.grid import ENVS, PRESETS, SEEDS

GIVEN_BY_THE_GRID = {  # options of the scripts, and those of the sweep that set them
    "--env-id": "--envs",
    "--seed": "--seeds",
    "--noise": "--noises",
    "--noise-rate": "--noise-rates",
    "--total-timesteps": "--total-timesteps",
    "--runs-dir": "--runs-dir",
}
OF_ANY_CHOICE = {"--algos", "--envs", "--runs-dir"}  # what a status needs to find a choice
MOST_SEEDS = 100_000  # of one option


def whole_number(text):
    """Read "1000000" or "1e6"."""
    try:
        number = float(text) if "e" in text.lower() else int(text)
        if number == int(number):
            return int(number)
    except (ValueError, OverflowError):
        pass
    raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, such as 1000000 or 1e6")


def seeds(text):
    """Read a seed, "3", or a range of seeds, "1-5"."""
    match = re.fullmatch(r"(\d{1,18})(?:-(\d{1,18}))?", text)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
    if last < first:
        reason = f"takes numbers and ranges, separated by spaces: 1 2 3 or 1-3, not {text!r}"
        raise argparse.ArgumentTypeError(reason)
    if last - first >= MOST_SEEDS:
        raise argparse.ArgumentTypeError(f"{text!r} is more than {MOST_SEEDS:,} seeds")
    return range(first, last + 1)


def entry(text):
    """Read an entry of --noises, "A(..)", "A(..)+B(..)" or "A(..)@0.1+B(..)@0.2".

    Returns a list of (noise, rate); the rate is None where --noise-rates will give it.
    """
    pairs = []
    for part in split_noises(text):
        found = re.fullmatch(r"(.*\))\s*@(.*)", part)  # there may be an @ in the brackets, too
        pairs.append((found[1], found[2]) if found else (part, None))
    if len({own is None for _, own in pairs}) > 1:
        reason = f"{text!r}: give each of these noises a rate with @, or none of them"
        raise argparse.ArgumentTypeError(reason)
    return pairs


SEVERAL = {"nargs": "+", "action": "extend"}
OPTIONS = {  # their defaults, and how argparse reads them
    "algos": (list(SEEDS), SEVERAL | {"type": str.lower}),
    "envs": (ENVS, SEVERAL),
    "noises": ([], SEVERAL | {"type": entry}),
    "noise_rates": ([], SEVERAL),
    "seeds": (None, SEVERAL | {"type": seeds}),
    "baseline_seeds": (None, SEVERAL | {"type": seeds}),
    "total_timesteps": (1_000_000, {"type": whole_number}),
    "runs_dir": ("runs", {}),
    "exclude": ([], SEVERAL | {"type": entry}),
    "budget": (None, {"type": whole_number}),
    "confirm": (25, {"type": whole_number}),
    "looks": (None, {"type": whole_number}),
    "metric": ("return", {"choices": ("return", "success_rate")}),
}


def parse_args(view, caller, argv):
    """Return the grid's arguments.

    Also, for each algorithm: `scripts`, its Script; `given_words`, the options after the "--", and
    `extra`, their words for its commands: see scripts.read_words; `exp_names`, of its runs.

    Exits with one line about the first argument that no run could be started with.
    """
    for word in (caller, *argv):
        if re.search("[\udc80-\udcff]", word):  # a byte that Python could not decode
            fail(f"{os.fsencode(word)} is not valid UTF-8")
    given_only = {"argument_default": argparse.SUPPRESS}
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, **given_only)
    parser.error = lambda message: fail(message.removeprefix("argument "))
    for name, (_, how) in OPTIONS.items():
        parser.add_argument(scripts.spelt(name), **how)
    split = argv.index("--") if "--" in argv else len(argv)
    words, extra = argv[:split], argv[split + 1 :]
    preset = words[0] if words and not words[0].startswith("--") else None
    if preset not in PRESETS and not (preset is None and view == "status"):
        named = words[0] if words else ""
        if named.startswith("--"):
            fail(f"a preset comes before {named}: one of {', '.join(PRESETS)}")
        fail(f"unknown preset {named!r}; choose one of {', '.join(PRESETS)}")
    found, unknown = parser.parse_known_args(words[preset is not None :])
    if unknown:
        name = unknown[0].partition("=")[0]
        hint = scripts.did_you_mean(name, map(scripts.spelt, OPTIONS))
        fail(f"unknown option {name} (those of the scripts come at the end, after --){hint}")
    given = {scripts.spelt(name) for name in vars(found)}
    defaults = {"pairs": [], "options": []} | {name: value for name, (value, _) in OPTIONS.items()}
    args = argparse.Namespace(**defaults | PRESETS.get(preset, {}) | vars(found))
    args.preset, args.view, args.caller, args.given = preset, view, caller, given
    args.runs_dir = from_project(caller, args.runs_dir)
    if view == "status" and preset == "choose" and given <= OF_ANY_CHOICE and not extra:
        kept = kept_words(args)
        if kept and kept != words:
            return parse_args(view, caller, kept)
    args.words, args.extra_words = words, [*args.options, *extra]
    args.metric = args.metric.replace("_", " ")
    args.default_noises = "--noises" not in given
    if args.noises == [[("paper", None)]]:
        args.pairs, args.noises = PRESETS["paper"]["pairs"], []
    if preset is None and (given - {"--runs-dir"} or extra):
        fail("what a sweep still has to do depends on its preset: ./benchmark.sh status PRESET ...")
    # a status that names no grid is one of whatever the folder holds
    whole_folder = preset in (None, "custom") and given <= {"--runs-dir"}
    args.names_grid = view != "status" or not whole_folder
    if args.names_grid:
        check(args)
    return args


def kept_words(args):
    """Return the words of the choice that a status without further options is about, or None."""
    from sweep import memory  # and with it SciPy: nothing else should wait for that

    algos = args.algos if "--algos" in args.given else []
    envs = args.envs if "--envs" in args.given else []
    kept = memory.words_of_choice(args.runs_dir, algos, envs)
    if not kept:
        return None
    words, extra = kept
    words = [*words, "--runs-dir", os.path.abspath(args.runs_dir)]
    return [*words, "--", *extra] if extra else words


def check(args):
    """Exit with one line about an argument that is wrong; give environments their full names."""
    args.algos = list(dict.fromkeys(args.algos))
    args.scripts = {name: scripts.find(name, args.caller) for name in args.algos}
    try:
        args.envs = list(dict.fromkeys(map(canonical_env_id, args.envs)))
    except (Exception, SystemExit) as error:  # a module of the user's may raise anything
        fail(f"--envs: {with_place(error, (ValueError, SyntaxError))}")
    for name in ("--exclude", "--budget", "--confirm", "--looks", "--metric"):
        if name in args.given and args.preset != "choose":
            fail(f"{name} is an option of choose")
    if args.preset == "demo" and args.algos != ["ppo"]:
        fail("demo has options of PPO: for another algorithm use custom")
    if args.preset == "choose" and not {"--algos", "--envs"} <= args.given:
        fail("choose needs --algos and --envs: it chooses a noise for each of them")
    for name in args.given & {"--seeds", "--baseline-seeds"}:
        if args.preset == "choose":
            fail(f"choose picks its own seeds: leave out {name}; see --budget and --confirm")
    if args.total_timesteps < 1:
        fail(f"--total-timesteps must be at least 1, not {args.total_timesteps}")
    check_words(args)


def check_words(args):
    """Read the words after the "--"; exit about those that belong to the grid, or to no script."""
    for word in args.extra_words:
        if re.search(r"[\t\n]", word):
            fail(f"{word!r}: a command is one line, so its words have no tabs and ends of lines")
        flag = word.partition("=")[0].replace("_", "-")
        if flag in GIVEN_BY_THE_GRID:
            fail(f"{flag} is part of the grid: use {GIVEN_BY_THE_GRID[flag]}, before the --")
        if flag == "--overwrite":
            fail("--overwrite would start interrupted runs afresh: delete their folders instead")
    read = {
        name: scripts.read_words(script, args.extra_words) for name, script in args.scripts.items()
    }
    args.extra = {name: command for name, (_, command) in read.items()}
    args.given_words = {name: given for name, (given, _) in read.items()}
    args.exp_names = {
        name: " ".join(args.given_words[name].get("exp_name", [script.exp_name]))
        for name, script in args.scripts.items()
    }
    if len(set(args.exp_names.values())) < len(args.algos):
        fail(
            "--exp-name: several algorithms would write into the same folders: name one algorithm "
            "with --algos, or leave --exp-name out and use another --runs-dir"
        )


def from_project(caller, text):
    """Return a path that counts from the caller's folder as one that counts from the project's.

    A relative one stays so where it lies in the project: it means the same on other machines.
    """
    path = os.path.normpath(os.path.join(caller, os.path.expanduser(text)))
    if not os.path.isabs(text) and Path(path).is_relative_to(os.getcwd()):
        path = os.path.relpath(path)
    if not text or not re.fullmatch(r"[^-\t\n][^\t\n]*", path):
        fail("--runs-dir must be a path without tabs and newlines that begins with no dash")
    return path


def from_caller(args, path):
    """Return a path that counts from the project's folder as the caller can paste it."""
    return str(path) if args.caller == os.getcwd() else os.path.abspath(path)
