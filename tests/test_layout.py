"""What the packages promise: imports that run one way, and short files."""

import ast

import pytest
from commands import ROOT

PACKAGES = ["analysis", "sweep"]
FILES = [path for package in PACKAGES for path in sorted((ROOT / package).glob("*.py"))]
# A module imports only from those before it: by package, and within a package by name.
ORDER = ["noisy_wrappers", "analysis", "evaluate", "analyze", "sweep", "tools", "results"]


def imported(path):
    """The project's modules that a file imports, at any place, with the names from each."""
    found = {}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name: [] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names = [alias.name for alias in node.names]
            if node.module in PACKAGES:
                found |= {f"{node.module}.{name}": [] for name in names}
            else:
                found.setdefault(node.module, []).extend(names)
    return {name: names for name, names in found.items() if name.partition(".")[0] in ORDER}


def module(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def test_no_imports_in_a_circle():
    waiting = {module(path): set(imported(path)) for path in FILES}
    while waiting:
        free = [name for name, needs in waiting.items() if not needs & waiting.keys()]
        assert free, f"these import each other: {waiting}"
        for name in free:
            del waiting[name]


@pytest.mark.parametrize("path", [*FILES, ROOT / "analyze.py", ROOT / "evaluate.py"], ids=module)
def test_imports_run_one_way_and_take_no_private_name(path):
    place = ORDER.index(module(path).partition(".")[0])
    for name, names in imported(path).items():
        assert ORDER.index(name.partition(".")[0]) <= place, f"{path.name} imports {name}"
        parts = {*name.split("."), *names} - {"__version__"}
        private = [part for part in parts if part.startswith("_")]
        assert not private, f"{path.name} takes {private} of {name}"


@pytest.mark.parametrize("path", FILES, ids=module)
def test_no_file_is_too_long(path):
    assert path.read_text().count("\n") <= 400
