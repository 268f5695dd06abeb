"""The module as a whole."""

import doctest
import re
import subprocess
import sys
from pathlib import Path

import noisy_wrappers


def test_doctests():
    results = doctest.testmod(noisy_wrappers)
    assert results.failed == 0
    assert results.attempted > 8


def test_the_version_is_that_of_the_changelog_and_the_citation():
    version = noisy_wrappers.__version__
    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    root = Path(noisy_wrappers.__file__).parent
    assert f"\nversion: {version}\n" in (root / "CITATION.cff").read_text()
    assert f"\n## [{version}] - " in (root / "CHANGELOG.md").read_text()


def test_import_needs_neither_torch_nor_mujoco():
    code = "import sys, noisy_wrappers; sys.exit(bool({'torch', 'mujoco'} & {*sys.modules}))"
    root = noisy_wrappers.__file__.rpartition("/")[0]
    assert subprocess.run([sys.executable, "-c", code], cwd=root).returncode == 0
