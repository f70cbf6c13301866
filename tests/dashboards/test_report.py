"""The report is one file that needs nothing else, and says what the session says."""

import re
import tarfile
from html import escape
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from liex_lab.dashboards.report.report import (
    beside_average,
    frame_account,
    methods,
    render,
    warnings,
    write_report,
)

from liex_lab.behaviour import measure_session
from liex_lab.behaviour.activity import around_onsets
from liex_lab.body import Skeleton
from liex_lab.exchange import export
from liex_lab.optics.camera import Water
from liex_lab.sessions import Session, SessionWriter
from liex_lab.sessions.verdict import Verdict
from tests.conftest import REPOSITORY
from tests.sessions.walking_mouse import WalkingMouse, steady, write


@pytest.fixture(scope="module")
def session(walker: Session) -> Session:
    return Session.open(walker.path)


@pytest.fixture(scope="module")
def page(walker: Session) -> str:
    return (walker.path / "report.html").read_text(encoding="utf-8")


@pytest.mark.nightly
def test_the_report_is_written_with_the_session_and_can_be_made_again(own, page):
    assert write_report(own.path).read_text(encoding="utf-8") == page


def test_the_report_asks_for_nothing_from_outside(page):
    assert not re.search(r"https?://|<script|<link|@import|url\((?!#)", page)
    sources = [
        source
        for source in re.findall(r'(?:src|href)="([^"]*)"', page)
        if not source.startswith("#")
    ]
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


def test_every_figure_is_well_formed_svg_of_finite_numbers(session, page):
    drawn = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    # the contact sheet, and the figures that lie beside the report as files
    assert len(drawn) == 16 + len(list((session.path / "figures").glob("*.svg")))
    for svg in drawn:
        ElementTree.fromstring(svg)
        assert "nan" not in re.sub(r"base64,[^\"]*", "", svg)


def test_the_numbers_of_the_summary_are_on_the_page(session, page):
    row = session.summary.iloc[0]
    assert f"{row['distance_m']:.2f}" in page
    for name in session.summary.columns[2:]:
        assert escape(name) in page, name
    for column in session.columns["name"]:
        assert escape(column) in page, column


def test_warnings_come_before_everything_else_and_every_frame_is_accounted_for(session, page):
    assert page.index("Read this first") < page.index('class="cards"')
    assert "did not deliver 6 frames, in 1 gap;" in page
    assert sum(share for _, share, _, _ in frame_account(session)) == pytest.approx(1.0)


def test_a_report_with_something_to_say_does_not_say_that_there_is_nothing(session, monkeypatch):
    monkeypatch.setattr("liex_lab.dashboards.report.report.warnings", lambda _: [])
    monkeypatch.setattr("liex_lab.dashboards.report.report.for_the_page", lambda *_: {})
    for caution in ("", "2 animals are in view and one of them is followed"):
        verdict = Verdict(9, 9, 9, 9, 2.0, 1, (), (caution,) if caution else ())
        monkeypatch.setitem(session.metadata, "verdict", verdict.to_dict())
        page = render(session)
        assert ("No warnings" in page) == (not caution)
        assert caution in page
    told = ["the clock jumps", "depth_ts.txt has 3 rows too many.", "is it so?"]
    told += ["2 bouts were left unlabelled (refused_bouts in session.json)."]
    monkeypatch.setattr("liex_lab.dashboards.report.report.warnings", lambda _: told)
    items = re.findall(r"<li>(.*?)</li>", render(session).split("Read this first")[1], re.DOTALL)
    assert items[:4] == [
        "The clock jumps.",
        "depth_ts.txt has 3 rows too many.",
        "Is it so?",
        "2 bouts were left unlabelled (list below).",
    ]


def test_each_warning_is_a_sentence_of_the_numbers_behind_it(session):
    again = Session.open(session.path)
    frames = dict(again.metadata["frames"], n_observed=100)
    frames["flags"] = {"doubtful": 30, "hidden": 1, "not_found": 73}
    again.metadata.update(frames=frames, verdict={"n_animals": 3}, schema_version=7)
    flips = [(1.0, 1.5, 0.9, True), (2.0, 2.25, 0.4, False)]
    exchanged = pd.DataFrame(flips, columns=["start_s", "stop_s", "p_flip", "applied"])
    bouts = again.bouts.assign(contradicts="")
    bouts.loc[0, "contradicts"] = "too slow"
    again.__dict__.update(flips=exchanged.assign(source="model", undone_at=""), bouts=bouts)
    parts = (
        "Dark & <cold>.",
        "nothing is measured of the others. Measure them all with --set animal.count=auto",
        "The camera did not deliver 6 frames, in 1 gap; no speed or distance is measured across",
        "The animal is behind or under something in 1 frame (0.6% of 174), which have no pose; the",
        "73 frames have no pose (42.0% of 174); times and shares are of the rest.",
        "30 frames are doubtful (17.2% of 174): the predicted error is large, or the depth image",
        "Head and tail may have been exchanged in 2 stretches of 0.8 s in all; 1 was corrected.",
        "An earlier version of liex_lab wrote this session and counted lost frames in the time of",
        "1 bout contradicts the definition of the name, which was left as it is; see the list",
    )
    for sentence, part in zip(warnings(again), parts, strict=True):
        assert part in sentence


def test_a_measure_around_an_onset_is_what_the_frames_say():
    """A speed that steps from 10 to 90 mm/s at each of five onsets."""
    time = np.arange(0, 50, 1 / 30)
    speed = np.where((time % 10) >= 5.0, 90.0, 10.0)
    moved = pd.DataFrame({"time_s": time, "speed_mm_s": speed})
    bouts = pd.DataFrame(
        {"action": ["run"] * 5 + ["walk"], "start_s": [5.0, 15.0, 25.0, 35.0, 45.0, 1.0]}
    )
    found = around_onsets(moved, bouts, "run", "speed_mm_s")
    assert found is not None
    assert found.n == 5
    np.testing.assert_allclose(found.median[found.time_s < -0.05], 10.0)
    np.testing.assert_allclose(found.median[found.time_s > 0.05], 90.0)
    assert around_onsets(moved, bouts, "walk", "speed_mm_s") is None


def test_a_fish_has_a_report_of_its_own(tmp_path):
    """Its curves are the tail's, and what a slow camera cannot measure is said."""
    session = write(
        tmp_path / "fish.liex", WalkingMouse(steady(2.0), skeleton=Skeleton.load("fish"))
    )
    page = render(session)
    assert "Tail beat" in page
    assert "Nose height" not in page
    assert "frames/s these cannot be measured and are empty" in page
    assert "first_bend_s" in page


def test_walls_zones_transitions_and_the_methods_are_on_the_page(session, page):
    for said in (
        "round, radius 220 mm; zones: nest &lt;1&gt;",
        "Transitions, walker, n = 2 transitions",
        ">nest &lt;1&gt;</text>",
    ):
        assert said in page, said
    assert "nest <1>" not in page
    text = " ".join(methods(session))
    for said in (
        "liex_lab",
        "model mouse",
        "abababab",
        "172 of 174",
        "6 further frames",
        "0.33 s",
    ):
        assert said in text, said


def test_the_corrected_optics_are_stated(session):
    water = Water(450.0, 1.333, ranging="light_field")
    bent = {"model": "kannala_brandt", "coefficients": [0.125, 0.0, 0.0, 0.0]}
    again = Session.open(session.path)
    again.metadata["camera"]["optics"] = {"distortion": bent, "water": water.to_dict()}
    text = " ".join(methods(again))
    for said in ("kannala_brandt 0.125", "450 mm below the lens", "ideal camera in air"):
        assert said in text, said


@pytest.mark.parametrize(
    "archive", sorted((REPOSITORY / "tests" / "golden").glob("*.tar.gz")), ids=lambda a: a.stem
)
def test_a_session_of_an_older_version_can_be_measured_and_exported(tmp_path, archive):
    with tarfile.open(archive) as packed:
        packed.extractall(tmp_path, filter="data")
    (found,) = tmp_path.rglob("session.json")
    assert len(measure_session(Session.open(found.parent)).summary) == 1
    for target in ("csv", "sleap"):
        assert export(Session.open(found.parent), target, tmp_path).exists()


def test_a_session_without_behaviour_or_without_any_pose_has_a_report_too(tmp_path):
    mouse = WalkingMouse(steady(1.0), lost=tuple(range(30)))
    with SessionWriter(tmp_path / "bare.liex", mouse.provenance(), report=write_report) as writer:
        for frames, _ in mouse.chunks(20):
            writer.add(frames)
        writer.track = mouse.track()
        session = writer.close()
    assert "Over time" in (session.path / "report.html").read_text()
    lost = write(tmp_path / "lost.liex", mouse)
    assert "0.0%" in render(lost)


def test_no_name_on_the_page_is_given_twice(page):
    names = re.findall(r' id="([^"]*)"', page)
    assert len(names) == len(set(names))
    pointed = set(re.findall(r"url\(#([^)]+)\)", page)) | set(re.findall(r'href="#([^"]+)"', page))
    assert pointed <= set(names)


def test_the_animals_own_shape_stands_beside_the_average_one():
    shape = {
        "kept": True,
        "n_frames": 92,
        "average_residual_mm": 0.412,
        "residual_mm": 0.353,
        "places": [0.1, 0.25],
        "width": [0.8, 1.1],
        "width_sd": [0.05, 0.1],
        "height": [1.2, 0.9],
        "height_sd": [0.1, 0.2],
        "joints_moved": [[0.0, 0.0, 0.0], [0.003, 0.0, -0.004]],
    }
    told = beside_average(shape)
    for part in (
        "fitted to 92 frames",
        "at 10, 25 % of its length",
        "0.80 ± 0.04, 1.10 ± 0.11 times as wide",
        "1.20 ± 0.12, 0.90 ± 0.18 times as high",
        "by up to 0.5 %",
        "0.35 mm from the depth, the average one 0.41 mm",
    ):
        assert part in told
    by = beside_average(shape | {"shared_by": "4 sessions of z1"})
    assert by.startswith("shared by 4 sessions of z1; at 10, 25 %")
    left = beside_average({"kept": False, "n_frames": 12, "why": "12 frames are too few"})
    assert left == "the average animal's: 12 frames are too few"
