"""In CI a test may not look away: a skip for a missing tool fails, absent reference data may be
skipped.
"""

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


@pytest.mark.nightly
def test_a_skip_fails_in_ci_unless_the_reference_data_are_absent(tmp_path: Path) -> None:
    inner = tmp_path / "repository" / "tests"
    inner.mkdir(parents=True)
    (inner / "conftest.py").write_text(CONFTEST.read_text())
    (inner / "test_some.py").write_text(TESTS)
    (inner / "test_none.py").write_text('import pytest\npytest.importorskip("no_such_module")\n')
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("PYTEST")
    }
    ran = subprocess.run(
        [
            *(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"),
            *("--continue-on-collection-errors", str(inner)),
        ],
        cwd=tmp_path,
        env=environment | {"CI": "true"},
        capture_output=True,
        text=True,
    )
    counts = ran.stdout.strip().splitlines()[-1]
    assert counts.startswith("1 failed, 1 passed, 1 skipped, 1 xfailed")
    assert "1 error" in counts
