"""A real browser that is watched: every complaint of a page and every request to another machine is
kept.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest
from playwright.sync_api import Browser, Page, Route, expect

_PATIENCE_MS = 30_000  # of a busy machine


@dataclass
class Watched:
    """A page, what it complained of, and what it asked other machines for (it got nothing)."""

    page: Page
    complaints: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)

    def nothing_went_wrong(self) -> None:
        assert self.complaints == []
        assert self.outside == []


def watch(page: Page) -> Watched:
    watched = Watched(page)

    def pass_on(route: Route) -> None:
        if route.request.url.startswith(("http://127.0.0.1:", "file:", "data:", "blob:")):
            route.continue_()
        else:
            watched.outside.append(route.request.url)
            route.abort()

    page.route("**/*", pass_on)
    page.on(
        "console",
        lambda said: watched.complaints.append(said.text) if said.type == "error" else None,
    )
    page.on("pageerror", lambda error: watched.complaints.append(str(error)))
    return watched


def until(page: Page, true: Callable[[], bool]) -> None:
    """Wait for something that a page's own script may not be asked for, by its policy."""
    end = time.monotonic() + 30.0
    while not true():
        assert time.monotonic() < end
        page.wait_for_timeout(50)


@pytest.fixture
def watched(browser: Browser) -> Iterator[Watched]:
    """A page on a screen of 1400 x 900."""
    expect.set_options(timeout=_PATIENCE_MS)
    page = browser.new_page(viewport={"width": 1400, "height": 900}, accept_downloads=True)
    page.set_default_timeout(_PATIENCE_MS)
    yield watch(page)
    page.close()
