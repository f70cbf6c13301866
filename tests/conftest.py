"""What all tests share: seeded hypothesis, the reference data, and no skipping in continuous
integration.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from playwright.sync_api import Browser

REPOSITORY = Path(__file__).resolve().parents[1]
REFERENCE_DATA = REPOSITORY.parent / "shared" / "data"
ABSENT = "reference data absent"  # the one reason for which a test may skip in CI

_CHROMIUM_FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

_LONGEST = tuple(
    f"tests/{name}.py"
    for name in (
        "pipelines/evaluation/test_paper",
        "test_pages",
        "dashboards/test_figures",
        "pipelines/evaluation/test_pose",
        "pipelines/test_correct",
        "estimation/test_model",
        "pipelines/test_doctor",
    )
)

# the processes that tests start import the program again and again: let them keep its bytecode
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

settings.register_profile("suite", derandomize=True, deadline=None, max_examples=50, database=None)
settings.load_profile("suite")


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """The folder of real recordings beside the repository; the test skips where it is not there."""
    if not REFERENCE_DATA.is_dir():
        pytest.skip(ABSENT)
    return REFERENCE_DATA


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """The Chromium of this machine; one is never downloaded. There is one for all tests, since
    Playwright's synchronous interface can be open once in a thread.
    """
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium is installed: apt install chromium")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(
            executable_path=chromium, headless=True, args=_CHROMIUM_FLAGS
        )
        yield started
        started.close()


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist starts its workers
def pytest_sessionstart(session: pytest.Session) -> None:
    """Before a run of all tests, compile the kernels once, on every core."""
    if session.config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        from liex_lab.pipelines.compiling import compile_ahead

        compile_ahead("mouse", "fish", "hand")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files, so that no worker waits for the other at the end."""
    items.sort(key=lambda item: not item.nodeid.startswith(_LONGEST))


def excuse(report: pytest.TestReport | pytest.CollectReport) -> str:
    """Why a test was skipped."""
    return str(report.longrepr[2]) if isinstance(report.longrepr, tuple) else str(report.longrepr)


def refuse_skip(report: pytest.TestReport | pytest.CollectReport) -> None:
    """In CI a skip is a failure: a missing tool is for .ci/run to install, not for a test to look
    away from.
    """
    expected = hasattr(report, "wasxfail") or ABSENT in excuse(report)
    if os.environ.get("CI") and report.skipped and not expected:
        report.outcome = "failed"
        report.longrepr = f"a test may not skip in CI unless '{ABSENT}', but: {excuse(report)}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    refuse_skip(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    refuse_skip(report)
    return report
