"""In CI a test may not look away: a skip for a missing tool fails, absent reference data may be
skipped.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).parent / "conftest.py"
TESTS = """
import pytest
def test_that_runs(): pass
def test_without_its_tool(): pytest.skip("no chromium here")
def test_without_its_recording(reference_data): pass
@pytest.mark.xfail(reason="known")
def test_known_to_fail(): assert False
"""


def outcomes(folder: Path, ci: bool, content: str = TESTS) -> str:
    inner = folder / "repository" / "tests"
    inner.mkdir(parents=True)
    (inner / "conftest.py").write_text(CONFTEST.read_text())
    (inner / "test_some.py").write_text(content)
    environment = {
        name: value
        for name, value in os.environ.items()
        if name != "CI" and not name.startswith("PYTEST")
    }
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(inner)]
    ran = subprocess.run(
        command,
        cwd=folder,
        env=environment | ({"CI": "true"} if ci else {}),
        capture_output=True,
        text=True,
    )
    return ran.stdout.strip().splitlines()[-1]


@pytest.mark.parametrize(
    ("ci", "expected"), [(False, "1 passed, 2 skipped, 1 xfailed"), (True, "1 failed, 1 passed")]
)
def test_a_skip_fails_in_ci_unless_the_reference_data_are_absent(
    tmp_path: Path, ci: bool, expected: str
) -> None:
    assert expected in outcomes(tmp_path, ci)


def test_a_module_that_skips_itself_fails_in_ci(tmp_path: Path) -> None:
    assert "1 error" in outcomes(
        tmp_path, True, 'import pytest\npytest.importorskip("no_such_module")\n'
    )
