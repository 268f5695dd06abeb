"""Training scripts as a sweep sees them: where they are, and what their source says of options.

A script is read with `ast`. Importing it would take seconds, and it may be anybody's: what an
option means, and whether a value is good, the script says itself.
"""

import ast
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


class Option(NamedTuple):
    """A field of a script's Args."""

    kind: str  # its annotation, as text
    default: Any = None
    has_default: bool = False  # is the default known? An expression is not: only the script knows


class Script(NamedTuple):
    """A training script."""

    algorithm: str  # in lower case, as on a command line
    path: str  # as a command names it: relative in the project's folder
    options: dict[str, Option]
    sha256: str  # of its text
    constants: dict[str, int]  # whole numbers that it defines

    @property
    def file(self):
        """Its file name."""
        return os.path.basename(self.path)

    @property
    def exp_name(self):
        """The name of the experiment that it gives its runs by default."""
        option = self.options.get("exp_name", Option(""))
        return option.default if option.has_default else self.file.removesuffix(".py")

    @property
    def defaults(self):
        """The defaults that are known: {argument: value}."""
        known = self.options.items()
        return {name: option.default for name, option in known if option.has_default}


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
    found = {}
    try:
        for path in sorted(folder.glob(f"*{ENDING}")):
            name = path.name.removesuffix(ENDING)
            if re.fullmatch(r"\w+", name):
                found.setdefault(name.lower(), path)
    except OSError:  # a folder that may not be listed
        pass
    return found


@functools.cache
def read(path):
    """Read a script from its source; exits where that is no Python, or has no class Args."""
    content = path.read_bytes()
    try:
        nodes = ast.parse(content).body
    except (SyntaxError, ValueError) as error:
        fail(f"{path}: {error}")
    classes = {node.name: node for node in nodes if isinstance(node, ast.ClassDef)}
    if "Args" not in classes:
        fail(f"{path} has no class Args, whose fields are a script's options")
    inside = path.is_relative_to(PROJECT)
    return Script(
        algorithm=path.name.removesuffix(ENDING).lower(),
        path=str(path.relative_to(PROJECT) if inside else path),
        options=fields(classes, "Args"),
        sha256=hashlib.sha256(content).hexdigest(),
        constants=dict(constants(nodes)),
    )


def fields(classes, name):
    """Return the fields of a dataclass {name: Option}, those of its bases in this file first."""
    found = {}
    for base in classes[name].bases:
        if isinstance(base, ast.Name) and base.id in classes and base.id != name:
            found |= fields(classes, base.id)
    for node in classes[name].body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            kind = ast.unparse(node.annotation).strip("'\"")
            found[node.target.id] = Option(kind, *literal(node.value))
    return found


def literal(node):
    """Return the value of an expression and True, or None and False where it is no literal."""
    try:
        return ast.literal_eval(node), True
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return None, False


def constants(nodes):
    """Yield (name, number) of the whole numbers that a module defines."""
    for node in nodes:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            value, is_known = literal(node.value)
            if is_known and type(value) is int:
                yield node.targets[0].id, value


# ------------------------------------------------------------------------- words of a command line


def read_words(script, words):
    """Read a script's options from the words after "--".

    Returns {argument: value}, with values as config.json has them, and the words for the command,
    with whole numbers such as 1e6 written out. Exits with one line about a name that the script
    does not have: a typing error is not worth 9,100 failed runs.
    """
    values, command = {}, []
    flags = {flag: (name, option) for name, option in script.options.items() for flag in spelt(name, option)}
    groups = []  # of an option and its values
    for word in words:
        if re.match("--[A-Za-z]", word):
            flag, equals, value = word.partition("=")
            groups.append([flag, *([value] if equals else [])])
        elif not groups:
            fail(f"{script.file} has no option {word}: the first word after -- is an option's name")
        else:
            groups[-1].append(word)
    for flag, *given in groups:
        plain = flag.replace("_", "-")
        if plain not in flags:
            near = difflib.get_close_matches(plain, flags, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            fail(f"{script.file} has no option {flag}{hint}")
        name, option = flags[plain]
        if option.kind == "bool" and not given:
            values[name] = not plain.startswith("--no-") or name.startswith("no_")
        else:
            given = [whole(text) if re.search(r"\bint\b", option.kind) else text for text in given]
            values[name] = value_of(option.kind, given)
        command += [plain, *given]
    return values, command


def spelt(name, option):
    """Return how an option is written on a command line."""
    plain = name.replace("_", "-")
    return [f"--{plain}", f"--no-{plain}"] if option.kind == "bool" else [f"--{plain}"]


def whole(text):
    """Write a whole number such as 1e6 with digits; leave other text as it is."""
    try:
        return str(int(float(text))) if "e" in text.lower() and float(text).is_integer() else text
    except (ValueError, OverflowError):
        return text


class Text(str):
    """The words of an option whose kind only the script can read."""


def value_of(kind, words):
    """Return what words mean for an option of this kind, as config.json has it.

    What does not fit, or is of another kind than these, is a Text: only the script knows it.
    """
    kind = kind.removeprefix("typing.")
    for alternative in alternatives(kind):
        container = re.fullmatch(r"(?:[Tt]uple|[Ll]ist|Sequence|set)\[(.*)\]", alternative)
        if container:
            return [value_of(inner, [word]) for inner, word in zip(kinds_of(container[1], len(words)), words, strict=True)]
        if len(words) == 1:
            found, value = single(alternative, words[0])
            if found:
                return value
    return Text(" ".join(words))


def alternatives(kind):
    """Split "int | None" and Optional[int] into their parts."""
    optional = re.fullmatch(r"Optional\[(.*)\]", kind)
    text = f"{optional[1]} | None" if optional else kind
    union = re.fullmatch(r"Union\[(.*)\]", text)
    return split(union[1], ",") if union else split(text, "|")


def split(text, separator):
    """Split text at a separator outside of brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for sign in text:
        if quote or sign in "'\"":
            quote = "" if sign == quote else quote or sign
        depth += (sign in "[(") - (sign in ")]")
        if sign == separator and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += sign
    return [part.strip() for part in parts if part.strip()]


def kinds_of(inner, number):
    """Return the kinds of a container's values: "int, ..." is as many as there are."""
    kinds = [kind for kind in split(inner, ",") if kind != "..."]
    return (kinds + [kinds[-1]] * number)[:number]


def single(kind, word):
    """Return whether a word is of a kind, and its value."""
    try:
        if kind == "None":
            return word == "None", None
        if kind == "bool":
            return word in ("True", "False"), word == "True"
        if kind.startswith("Literal["):
            members = ast.literal_eval(kind.removeprefix("Literal"))
            members = members if isinstance(members, list | tuple) else [members]
            found = [member for member in members if str(member) == word]
            return bool(found), found[0] if found else None
        readers = {"int": int, "float": float, "str": str, "Path": str, "pathlib.Path": str}
        return (True, readers[kind](word)) if kind in readers else (False, None)
    except (ValueError, SyntaxError):
        return False, None
