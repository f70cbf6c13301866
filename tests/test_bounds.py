"""No kernel reads beyond its arrays while the kernels' own tests run: .ci/with-bounds."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.nightly


def test_kernels_stay_within_their_arrays(tmp_path: Path) -> None:
    run = subprocess.run(
        [REPOSITORY / ".ci" / "with-bounds"],
        env=os.environ | {"PYTHON": sys.executable, "NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]
    assert " passed" in run.stdout


def test_without_checked_bounds_the_plugin_refuses_to_run() -> None:
    run = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-n",
            "0",
            "-p",
            "tests.bounds",
            "tests/runtime/test_shapes.py",
        ],
        cwd=REPOSITORY,
        env={name: value for name, value in os.environ.items() if name != "NUMBA_BOUNDSCHECK"},
        capture_output=True,
        text=True,
    )
    assert run.returncode != 0
    assert "NUMBA_BOUNDSCHECK=1" in run.stderr + run.stdout
