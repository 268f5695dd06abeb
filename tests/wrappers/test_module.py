"""The module as a whole."""

import doctest
import re
import subprocess
import sys
from pathlib import Path

import noisy_wrappers
from noisy_wrappers import WRAPPERS, RandomNormalNoisyAction


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


def test_every_public_wrapper_has_a_doctest():
    for wrapper in WRAPPERS.values():
        assert ">>>" in wrapper.__doc__
        ours = wrapper is RandomNormalNoisyAction
        assert ("(section 3." in wrapper.__doc__) == (not ours)
        assert ("Ours, not the paper's." in wrapper.__doc__) == ours


def test_import_needs_no_torch():
    code = "import sys, noisy_wrappers; sys.exit('torch' in sys.modules)"
    root = noisy_wrappers.__file__.rpartition("/")[0]
    assert subprocess.run([sys.executable, "-c", code], cwd=root).returncode == 0
