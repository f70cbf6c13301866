"""The report is one file that needs nothing else, and says what the session says."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from liex_lab.dashboards import figures
from liex_lab.dashboards.report import methods, render, write_report

from liex_lab.recordings.times import find_gaps, median_step
from liex_lab.recordings.walls import Arena
from liex_lab.recordings.zones import Zone
from liex_lab.sessions import Session
from liex_lab.sessions.rrd import PALETTE
from liex_lab.water import Water
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(np.delete(steady(4.0), slice(40, 46)), rear_s=(2.0, 3.0), lost=(60, 61))


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Session:
    return write(
        tmp_path_factory.mktemp("report") / "circle.liex", MOUSE, report=write_report, problems=["Dark & <cold>."],
        gaps=find_gaps(MOUSE.times_ns, median_step(MOUSE.times_ns)), model={"name": "mouse", "sha256": "ab" * 32},
    )  # fmt: skip


@pytest.fixture(scope="module")
def page(session) -> str:
    return (session.path / "report.html").read_text(encoding="utf-8")


def test_the_report_is_written_with_the_session_and_can_be_made_again(session, page):
    assert render(session) == page
    assert write_report(session.path).read_text(encoding="utf-8") == page


def test_the_report_asks_for_nothing_from_outside(page):
    assert not re.search(r"https?://|<script|<link|@import|url\((?!#)", page)
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert len(page) < 1_500_000


def test_the_page_is_well_formed(page):
    stack: list[str] = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag, attrs):
            if tag not in ("meta", "br"):
                stack.append(tag)

        def handle_startendtag(self, tag, attrs):
            pass

        def handle_endtag(self, tag):
            assert stack.pop() == tag, f"</{tag}>"

    Reader().feed(page)
    assert stack == []


def test_every_figure_is_well_formed_svg_of_finite_numbers(page):
    drawn = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    assert len(drawn) == 4 + 7  # pictures; lanes, three curves, budget, way, histogram
    for svg in drawn:
        ElementTree.fromstring(svg)
        assert "nan" not in re.sub(r"base64,[^\"]*", "", svg)


def test_the_numbers_of_the_summary_are_on_the_page(session, page):
    row = session.summary.iloc[0]
    assert f"{row['distance_m']:.2f}" in page
    for name in session.summary.columns[2:]:
        assert name in page, name
    for column in session.columns["name"]:
        assert column in page, column


def test_text_from_the_recording_cannot_become_markup(page):
    assert "Dark &amp; &lt;cold&gt;." in page
    assert "<cold>" not in page


def test_the_methods_state_what_was_done(session):
    text = " ".join(methods(session))
    for said in ("liex_lab", "model mouse", "abababab", "112 of 114", "6 further frames", "40 mm", "0.33 s"):
        assert said in text, said


def test_walls_zones_and_what_was_undone_are_shown(tmp_path):
    water = Water(450.0, 1.333, ranging="light_field")
    bent = {"model": "kannala_brandt", "coefficients": [0.125, 0.0, 0.0, 0.0]}
    optics = {"distortion": bent, "water": water.to_dict()}
    bowl = Arena("round", (0.0, 0.0), 250.0, None, None, 0.5, 1.0, "wall")
    nest = Zone("nest", polygon_mm=((0.0, 0.0), (50.0, 0.0), (50.0, 50.0)))
    session = write(tmp_path / "c.liex", MOUSE, optics=optics, arena=bowl, zones=(nest,))
    page = render(session)
    assert page.count('<polygon class="outline"') == 2
    for said in ("round, radius 250 mm; zones: nest", "kannala_brandt 0.125", "450 mm below the lens", "<title>nest"):
        assert said in page, said
    assert "ideal camera in air" in " ".join(methods(session))


def test_a_session_without_behaviour_has_a_report_too(tmp_path):
    with Session.create(tmp_path / "bare.liex", MOUSE.provenance(), report=write_report) as writer:
        for frames, track in MOUSE.chunks(20):
            writer.add(frames, track)
        session = writer.close()
    assert "Over time" in (session.path / "report.html").read_text()


def test_a_session_without_any_pose_has_a_report_too(tmp_path):
    session = write(tmp_path / "lost.liex", WalkingMouse(steady(1.0), lost=tuple(range(30))), report=write_report)
    assert "0.0%" in (session.path / "report.html").read_text()


def test_the_replay_and_the_report_give_an_action_the_same_colour():
    for k in range(len(figures.ACTION_COLOURS)):
        assert int(figures.action_colour(k)[1:], 16) == PALETTE[k]
