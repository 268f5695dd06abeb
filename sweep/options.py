"""The arguments of benchmark.sh that name a grid; `./benchmark.sh --help` explains them."""

import argparse
import ast
import difflib
import functools
import os
import re
from pathlib import Path

from analysis.errors import fail
from noisy_wrappers import canonical_env_id, check_numbers, safe_name, split_noises
from sweep.grid import ENVS, PRESETS, PROJECT, SEEDS, script_of

EXECUTOR_OPTIONS = ["--dry-run", "--executor", "--jobs", "--sshlogin", "--remote-dir"]
EXECUTOR_OPTIONS += ["--slurm-args", "--wait", "--help"]  # benchmark.sh reads these

GIVEN_BY_THE_GRID = {  # options of the scripts, and those of the sweep that set them
    "--env-id": "--envs",
    "--seed": "--seeds",
    "--noise": "--noises",
    "--noise-rate": "--noise-rates",
    "--total-timesteps": "--total-timesteps",
    "--runs-dir": "--runs-dir",
    "--exp-name": "--runs-dir",  # a sweep's folders are told apart by where they lie
}


def parse_args(view, caller, argv):
    """Return the grid's arguments; `extra` are the words after "--", for the scripts.

    `options` is {algorithm: what script_options makes of them}.

    Exits with one line about the first argument that no run could be started with.
    """
    parser = argparse.ArgumentParser(prog="benchmark.sh", add_help=False, allow_abbrev=False)
    parser.error = lambda message: fail(message.removeprefix("argument "))
    parser.add_argument("preset", nargs="?")
    parser.add_argument("--algos", nargs="+", type=str.lower, default=list(SEEDS))
    parser.add_argument("--envs", nargs="+", default=ENVS)
    parser.add_argument("--noises", nargs="+", type=entry, default=[])
    parser.add_argument("--noise-rates", nargs="+", type=rate, default=[])
    parser.add_argument("--seeds", nargs="+", type=seeds)
    parser.add_argument("--total-timesteps", type=whole_number, default=1_000_000)
    parser.add_argument("--runs-dir", default="runs")
    parser.add_argument("--exclude", nargs="+", action="extend", type=entry, default=[])
    parser.add_argument("--budget", type=whole_number)
    parser.add_argument("--confirm", type=whole_number, default=25)
    parser.add_argument("--metric", choices=("return", "success_rate"), default="return")
    split = argv.index("--") if "--" in argv else len(argv)
    words, extra = argv[:split], argv[split + 1 :]
    preset = words[0] if words and not words[0].startswith("--") else None
    if preset not in PRESETS and not (preset is None and view == "status"):
        named = words[0] if words else ""
        fail(f"unknown preset {named!r}; choose one of {', '.join(PRESETS)}")
    known = flags(parser)
    given = {word.partition("=")[0] for word in words if word.startswith("--")}
    for name in sorted(given.difference(known)):
        fail(unknown_option(name, known))
    parser.set_defaults(**{"pairs": []} | PRESETS.get(preset, {}))
    args = parser.parse_args(words)
    if args.preset != preset:
        fail(f"the preset comes first: {args.preset} --...")
    args.view, args.caller, args.given, args.extra = view, caller, given, extra
    args.jobs, args.elsewhere = machines()
    args.runs_dir = from_project(caller, args.runs_dir)
    args.metric = args.metric.replace("_", " ")
    if args.noises == [[("paper", None)]]:
        args.pairs, args.noises = PRESETS["paper"]["pairs"], []
    # a status that names no grid is one of whatever the folder holds
    whole_folder = preset in (None, "custom") and given <= {"--runs-dir"}
    args.names_grid = view != "status" or not whole_folder
    if args.names_grid:
        check(args)
    return args


def check(args):
    """Exit with one line about an argument that is wrong; give environments their full names."""
    for algorithm in args.algos:
        if algorithm not in SEEDS:
            fail(f"unknown algorithm {algorithm!r}; choose from {', '.join(SEEDS)}")
    try:
        args.envs = list(dict.fromkeys(map(canonical_env_id, args.envs)))
    except ValueError as error:
        fail(f"--envs: {error}")
    if len(set(map(safe_name, args.envs))) < len(args.envs):
        fail("--envs: two of these would have the same folders; rename one, or take them apart")
    for name in ("--exclude", "--budget", "--confirm", "--metric"):
        if name in args.given and args.preset != "choose":
            fail(f"{name} is an option of choose")
    if args.preset == "choose" and not {"--algos", "--envs"} <= args.given:
        fail("choose needs --algos and --envs: it chooses a noise for each of them")
    if args.preset == "choose" and args.seeds:
        fail("choose picks its own seeds: leave out --seeds; see --budget and --confirm")
    args.options = {algorithm: script_options(algorithm, args.extra) for algorithm in args.algos}
    ours = {"total_timesteps": args.total_timesteps, "torch_threads": 1}  # more, elsewhere
    ours["seed"] = max((seeds[-1] for seeds in args.seeds or ()), default=0)
    for options in args.options.values():
        try:
            check_numbers(options | ours)
        except ValueError as error:
            fail(error)


def machines():
    """Return how many runs go on at a time, None if unknown, and whether on other machines.

    benchmark.sh, which reads the executor's options, tells it by environment variables.
    """
    jobs, hosts = os.environ.get("SWEEP_JOBS"), os.environ.get("SWEEP_HOSTS")
    elsewhere = bool(hosts) or os.environ.get("SWEEP_EXECUTOR") == "slurm"
    if jobs:
        return int(jobs) * (hosts.count(",") + 1 if hosts else 1), elsewhere
    return None if elsewhere else len(os.sched_getaffinity(0)), elsewhere


@functools.cache
def parser_of(algorithm):
    """Return a parser of a script's options, made from its text: importing it takes seconds.

    Options that the grid gives are left out.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.error = lambda message: fail(message.removeprefix("argument "))
    nodes = ast.parse((PROJECT / script_of(algorithm)).read_text("utf-8")).body
    [args] = [node for node in nodes if isinstance(node, ast.ClassDef) and node.name == "Args"]
    for field in args.body[1:]:
        flag, kind = f"--{field.target.id.replace('_', '-')}", ast.unparse(field.annotation)
        if flag in GIVEN_BY_THE_GRID:
            continue
        how = {"type": float if "float" in kind else whole_number}
        if "None" in kind:
            how = {"type": functools.partial(unless_none, how["type"])}
        elif kind == "bool":
            how = {"action": argparse.BooleanOptionalAction}
        elif kind.startswith("Literal"):
            how = {"choices": ast.literal_eval(kind.removeprefix("Literal"))}
        parser.add_argument(flag, default=ast.literal_eval(field.value), **how)
    return parser


def script_options(algorithm, words):
    """Return {argument: value} of a script that is started with these words after the "--".

    Exits with one line about a word that the script would refuse, or that belongs to the grid: a
    typing error is not worth 9,100 failed runs.
    """
    words = [re.sub("^--[^=]+", lambda flag: flag[0].replace("_", "-"), word) for word in words]
    for flag in (word.partition("=")[0] for word in words):
        if flag in GIVEN_BY_THE_GRID:
            fail(f"{flag} is part of the grid: use {GIVEN_BY_THE_GRID[flag]}, before the --")
    options, unknown = parser_of(algorithm).parse_known_args(words)
    if unknown:
        near = difflib.get_close_matches(unknown[0], flags(parser_of(algorithm)), n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        fail(f"{script_of(algorithm)} has no option {unknown[0]}{hint}")
    if options.overwrite:
        fail("--overwrite would start interrupted runs afresh: delete their folders instead")
    return vars(options)


def flags(parser):
    """Return the options of a parser."""
    return [f"--{name.replace('_', '-')}" for name in vars(parser.parse_args([]))]


def unknown_option(name, known):
    """Say what to write instead of an option that the grid does not have."""
    of_scripts = {flag for algorithm in SEEDS for flag in flags(parser_of(algorithm))}
    if name in of_scripts:
        return f"{name} is an option of the scripts: put it at the end, after --"
    if name in EXECUTOR_OPTIONS:  # benchmark.sh reads it, unless it is written with a value
        return f"{name} takes no value"
    near = difflib.get_close_matches(name, [*known, *EXECUTOR_OPTIONS, *of_scripts], n=1)
    if not near:
        return f"unknown option {name}; ./benchmark.sh --help lists them"
    after = ", an option of the scripts, at the end after --" if near[0] in of_scripts else ""
    return f"unknown option {name}; did you mean {near[0]}{after}?"


def from_project(caller, text):
    """Return a path that counts from the caller's folder as one that counts from the project's.

    A relative one stays so where it lies in the project: it means the same on other machines.
    """
    if not text:
        fail("--runs-dir must name a folder")
    path = os.path.normpath(os.path.join(caller, os.path.expanduser(text)))
    if not os.path.isabs(text) and Path(path).is_relative_to(os.getcwd()):
        path = os.path.relpath(path)
    if not re.fullmatch(r"[^-\t\n][^\t\n]*", path):
        fail("--runs-dir must be a path without tabs and newlines that begins with no dash")
    try:
        os.stat(path)
    except FileNotFoundError:
        pass
    except OSError as error:
        fail(f"--runs-dir: {path}: {error.strerror}")
    return path


def from_caller(args, path):
    """Return a path that counts from the project's folder as the caller can paste it."""
    return str(path) if args.caller == os.getcwd() else os.path.abspath(path)


def whole_number(text):
    """Read "1000000" or "1e6"."""
    try:
        number = float(text) if "e" in text.lower() else int(text)
        if number == int(number):
            return int(number)
    except (ValueError, OverflowError):
        pass
    raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, such as 1000000 or 1e6")


def unless_none(read, text):
    """Read "None", or what `read` reads."""
    try:
        return None if text == "None" else read(text)
    except ValueError:  # without a message of its own
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def seeds(text):
    """Read a seed, "3", or a range of seeds, "1-5"."""
    match = re.fullmatch(r"(\d+)(?:-(\d+))?", text)
    values = range(int(match[1]), int(match[2] or match[1]) + 1) if match else ()
    if not values:
        fail(f"--seeds takes numbers and ranges, separated by spaces: 1 2 3 or 1-3, not {text!r}")
    return values


def rate(text):
    """Read a noise rate: a number, or text such as "1.0:0.0", which Configuration.read reads."""
    try:
        return float(text)
    except ValueError:
        return text


def entry(text):
    """Read an entry of --noises, "A(..)", "A(..)+B(..)" or "A(..)@0.1+B(..)@0.2".

    Returns a list of (noise, rate); the rate is None where --noise-rates will give it.
    """
    pairs = []
    for part in split_noises(text):
        found = re.fullmatch(r"(.*\))\s*@(.*)", part)  # there may be an @ in the brackets, too
        pairs.append((found[1], rate(found[2])) if found else (part, None))
    if len({own is None for _, own in pairs}) > 1:
        reason = f"{text!r}: give each of these noises a rate with @, or none of them"
        raise argparse.ArgumentTypeError(reason)
    return pairs
