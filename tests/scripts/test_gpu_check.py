"""tools/gpu_check.sh: a rehearsal on the CPU, with the fewest steps that take every branch."""

import os
import re
import subprocess
import sys

import pytest
import torch
from commands import ROOT


def rehearse(folder, **variables):
    variables |= {"PYTHON": sys.executable, "RUNS_DIR": str(folder), "STEPS": "320"}
    command = [ROOT / "tools" / "gpu_check.sh", "--rehearse"]
    result = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True)
    print(result.stdout, result.stderr)
    return result


all_changes = pytest.mark.skipif("CHANGES" not in os.environ, reason="`make changes` does it")


@all_changes
def test_a_rehearsal_passes(tmp_path):
    """That of SAC; the others take minutes each."""
    result = rehearse(tmp_path, ALGORITHMS="sac", ENVIRONMENTS="Pendulum-v1")
    assert (result.returncode, result.stderr) == (0, "")
    assert "FAILED" not in result.stdout
    title, *parts = result.stdout.split("\n## ")
    assert title.startswith("rehearsed on the CPU, ")
    updates, runs, speeds = (re.findall(r"^\| .+", part, re.MULTILINE)[1:] for part in parts)
    assert len(updates) == 2  # eager and compiled
    _, _, resumed = runs
    assert resumed.endswith("eval.csv as without a stop |")
    assert "resumed at step 192" in (tmp_path / "sac-Pendulum-v1-resumed.log").read_text()
    processor = torch.cpu.get_capabilities()
    has_bf16 = any(processor.get(x) for x in ("avx512_bf16", "amx_bf16", "bf16", "sve_bf16"))
    assert len(speeds) == 5 + has_bf16
    assert all(float(row.split("|")[2].replace(",", "")) > 0 for row in speeds)


@all_changes
def test_what_fails_is_told(tmp_path):
    result = rehearse(tmp_path, ALGORITHMS="td3", ENVIRONMENTS="NoSuch-v0")
    assert result.returncode == 1 and result.stdout.count("| FAILED: see ") == 3
    assert "\nFAILED in " in result.stdout
