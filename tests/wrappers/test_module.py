"""The module as a whole."""

import doctest
import re
import subprocess
import sys
from pathlib import Path

import noisy_wrappers
from noisy_wrappers import WRAPPERS


def test_doctests():
    results = doctest.testmod(noisy_wrappers)
    assert results.failed == 0
    assert results.attempted > 20


def test_public_names():
    version = noisy_wrappers.__version__
    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    root = Path(noisy_wrappers.__file__).parent
    assert f"\nversion: {version}\n" in (root / "CITATION.cff").read_text()
    assert f"\n## [{version}] - " in (root / "CHANGELOG.md").read_text()
    for name in noisy_wrappers.__all__:
        assert getattr(noisy_wrappers, name).__doc__
    assert set(WRAPPERS) < set(noisy_wrappers.__all__)


def test_import_needs_neither_torch_nor_mujoco():
    code = "import sys, noisy_wrappers; sys.exit(bool({'torch', 'mujoco'} & {*sys.modules}))"
    root = noisy_wrappers.__file__.rpartition("/")[0]
    assert subprocess.run([sys.executable, "-c", code], cwd=root).returncode == 0
