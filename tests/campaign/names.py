"""Hostile names and links against everything that writes: the laws of `test_hostile_writers`."""

import os
from pathlib import Path

import pytest

from tests.campaign.tally import Tally

_LAWS = Path(__file__).parents[1] / "pipelines" / "test_hostile_writers.py"


class _Counting:
    """Counts each example that a law was held to."""

    def __init__(self) -> None:
        self.tally = Tally()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Called by pytest for each phase of a test.

        Args:
            report: of the phase.
        """
        if report.when != "call" and report.passed:
            return
        law = report.nodeid.split("::")[-1].split("[")[0].removeprefix("test_").replace("_", " ")
        wrong = "" if report.passed else report.longreprtext
        self.tally.fault(law, report.duration, wrong=wrong)


def names() -> Tally:
    """Every writer with every name; nothing is written outside of the folder that was named."""
    os.environ["LIEX_ALL_NAMES"] = ""  # every writer meets every name
    counting = _Counting()
    pytest.main(
        ["-q", "--no-header", "-p", "no:cacheprovider", "-m", "", str(_LAWS)], plugins=[counting]
    )
    return counting.tally
