"""The source itself: style, types, and which part may import which."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(["ruff", "check"], id="ruff"),
        pytest.param(["ruff", "format", "--check", "--diff"], id="format"),
        pytest.param(["lint-imports"], id="layers"),
        pytest.param(["mypy"], id="types", marks=pytest.mark.long),
    ],
)
def test_source_passes(command):
    program = Path(sys.executable).parent / command[0]
    done = subprocess.run([program, *command[1:]], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
