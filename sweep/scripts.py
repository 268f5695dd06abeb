"""Training scripts as a sweep sees them: where they are, and what their source says of options.

A script is read with `ast`. Importing it would take seconds, and it may be anybody's: what an
option means, and whether a value is good, the script says itself.
"""

import ast
import contextlib
import difflib
import functools
import hashlib
import os
import re
from pathlib import Path
from typing import Any, NamedTuple

from analysis.errors import fail

PROJECT = Path(__file__).resolve().parent.parent
ENDING = "_continuous_noisy.py"  # of a script's file name; what stands before it is the algorithm


class Script(NamedTuple):
    """A training script."""

    path: str  # as a command names it: relative in the project's folder
    options: dict[str, str]  # the fields of its Args, each with its annotation
    defaults: dict[str, Any]  # those that are known: an expression, only the script knows
    sha256: str  # of its text
    eval_frequency: int | None  # steps between tests where a run names none, if it tells

    @property
    def file(self):
        """Its file name."""
        return os.path.basename(self.path)

    @property
    def exp_name(self):
        """The name of the experiment that it gives its runs by default."""
        return self.defaults.get("exp_name", self.file.removesuffix(".py"))


def find(algorithm, caller):
    """Return an algorithm's script from the project's folder or the caller's; exits without one."""
    places = [folder for folder in (PROJECT, Path(caller)) if algorithm in scripts_in(folder)]
    found = [read(scripts_in(folder)[algorithm]) for folder in dict.fromkeys(places)]
    if not found:
        known = sorted({*scripts_in(PROJECT), *scripts_in(Path(caller))})
        where = PROJECT if Path(caller) == PROJECT else f"{PROJECT} or {caller}"
        fail(
            f"unknown algorithm {algorithm!r}: there is no {algorithm}{ENDING} in {where}; "
            f"choose from {', '.join(known)}"
        )
    if len({script.sha256 for script in found}) > 1:
        paths = " and ".join(script.path for script in found)
        fail(f"{paths} differ: give one of them another name, because both are {algorithm!r}")
    return found[0]


@functools.cache
def scripts_in(folder):
    """Return the training scripts of a folder: {algorithm: path}."""
    paths = sorted(folder.glob(f"*{ENDING}"))
    return {path.name.removesuffix(ENDING).lower(): path for path in paths}


@functools.cache
def read(path):
    """Read a script from its source; exits where that cannot be read, or has no class Args."""
    try:
        content = path.read_bytes()
        nodes = ast.parse(content).body
    except (OSError, SyntaxError, ValueError) as error:
        fail(f"{path}: {error}")
    classes = {node.name: node for node in nodes if isinstance(node, ast.ClassDef)}
    if "Args" not in classes:
        fail(f"{path} has no class Args, whose fields are a script's options")
    fields = [node for node in classes["Args"].body if isinstance(node, ast.AnnAssign)]
    constants = [node for node in nodes if isinstance(node, ast.Assign)]
    frequency = known({node.targets[0]: node.value for node in constants}).get("EVAL_FREQUENCY")
    inside = path.is_relative_to(PROJECT)
    return Script(
        path=str(path.relative_to(PROJECT) if inside else path),
        options={field.target.id: ast.unparse(field.annotation).strip("'\"") for field in fields},
        defaults=known({field.target: field.value for field in fields}),
        sha256=hashlib.sha256(content).hexdigest(),
        eval_frequency=frequency if type(frequency) is int else None,
    )


def known(assignments):
    """Return {name: value} of those assignments {target: expression} that have a literal."""
    values = {}
    for target, expression in assignments.items():
        with contextlib.suppress(ValueError, TypeError, SyntaxError):
            values[ast.unparse(target)] = ast.literal_eval(expression)
    return values


# ------------------------------------------------------------------------- words of a command line


def read_words(script, words):
    """Read a script's options from the words after "--".

    Returns {argument: its words, or True or False of a switch}, and the words for the command.
    Exits with one line about a name that the script does not have: a typing error is not worth
    9,100 failed runs.
    """
    given, command = {}, []
    switches = {name for name, kind in script.options.items() if kind == "bool"}
    flags = {spelt(name): name for name in script.options}
    flags |= {f"--no-{spelt(name)[2:]}": name for name in switches}
    for word in words:
        if re.match("--[A-Za-z]", word):
            flag, equals, value = word.partition("=")
            flag = flag.replace("_", "-")
            if flag not in flags:
                fail(f"{script.file} has no option {flag}{did_you_mean(flag, flags)}")
            name = flags[flag]
            given[name] = flag == spelt(name) if name in switches else []
            command.append(flag)
            if equals:
                given[name] = [value]
                command[-1] += f"={value}"
        elif not given:
            fail(f"{script.file} has no option {word}; after -- comes the name of an option")
        else:
            given[name] = [*given[name], word] if isinstance(given[name], list) else [word]
            command.append(word)
    return given, command


def did_you_mean(flag, flags):
    """Name the most similar flag, or nothing."""
    near = difflib.get_close_matches(flag, flags, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def spelt(name):
    """Return how an argument is written on a command line."""
    return f"--{name.replace('_', '-')}"


def is_same(value, words, is_path=False):
    """Tell whether a value of config.json is what an option's words say.

    words: text, a list of text, or True or False; what they mean only the script knows for certain.
    is_path: the option is one or several, of which "a/" and "./a" are the same.
    """
    if isinstance(words, list):
        values = value if isinstance(value, list | tuple) else [value]
        if len(values) != len(words):
            return False
        return all(is_same(*pair, is_path) for pair in zip(values, words, strict=True))
    if value is None or isinstance(value, bool | dict):
        return str(value) == str(words)
    if isinstance(value, int | float):
        return value == number(words)
    if is_path and value == str(Path(words)):
        return True
    return value == words or str(value).endswith(f".{words}")  # as of an enumeration


def number(words, otherwise=None):
    """Return the number that an option's words are, if they are one."""
    text = words[0] if isinstance(words, list) and len(words) == 1 else words
    for read_as in (int, float):
        with contextlib.suppress(ValueError, TypeError):
            return read_as(str(text))
    return otherwise
