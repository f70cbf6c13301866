"""A session is whole or it is not there; what was written can be read back."""

import errno
import json
import re
import resource
import shutil
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from liex_lab.errors import SessionError
from liex_lab.optics.camera import Camera
from liex_lab.plan import Plan
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.timestamps import find_gaps
from liex_lab.scene.floor import Floor
from liex_lab.scene.scene import Arena
from liex_lab.scene.zones import Zone
from liex_lab.sessions import Provenance, Session, SessionWriter
from liex_lab.sessions.provenance import SCHEMA_VERSION
from liex_lab.tracking.track import Track
from tests.conftest import REPOSITORY
from tests.sessions.walking_mouse import SPINE_MM, WalkingMouse, steady, write

MOUSE = WalkingMouse(steady(1.0))
START = "2026-08-21T10:00:00+02:00"


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Session:
    subject = {"subject_id": "m01", "group": "control"}
    return write(
        tmp_path_factory.mktemp("session") / "circle.liex",
        MOUSE,
        subject=subject,
        problems=["It was dark."],
    )


def test_a_session_says_where_it_comes_from(session):
    about = session.metadata
    assert about["schema_version"] == SCHEMA_VERSION
    assert about["versions"]["liex_lab"]
    assert about["versions"]["rerun-sdk"].startswith("0.41")
    assert about["plan"] == {"animal": "mouse", "seed": 7}
    assert session.plan == 'animal = "mouse"\nseed = 7\n'
    assert about["animal"]["spine_mm"] == SPINE_MM
    assert about["problems"] == ["It was dark."]
    assert about["frames"]["n_frames"] == 30
    assert about["frames"]["observed_s"] == pytest.approx(1.0, abs=1e-6)
    assert about["timings_s"]["write"] > 0
    most_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert 20 < about["peak_memory_mb"] <= most_kb / 1024
    assert set(about["actions"]) == {"rear", "groom", "run", "walk", "pause"}
    assert about["rules"]["rear_height_mm"] == 40.0
    row = session.table("sessions").iloc[0]
    assert (row["subject_id"], row["group"], row["cage"]) == ("m01", "control", "")


def test_a_recording_and_a_plan_tell_where_a_session_comes_from():
    recording = Recording(
        name="day1",
        format="synthetic",
        camera=MOUSE.camera,
        times_ns=np.delete(MOUSE.times_ns, [5, 6]),
        read=lambda row: MOUSE.frame(row).depth,
        metadata={
            "subject_id": "m07",
            "session_start_time": START,
            "profile": {"name": "raytrix-u16-10um"},
        },
    )
    plan = Plan().with_settings(["session.group=control"])
    floor = Floor.from_plane(np.array([0.0, 0.0, 1.0]), 700.0, MOUSE.camera)
    origin = Provenance.of(recording, floor, MOUSE.skeleton, plan, model={"name": "mouse"})
    assert origin.subject == {"subject_id": "m07", "group": "control"}
    assert origin.session_start_time == START
    assert [gap.n_frames_missing for gap in origin.gaps] == [2]
    assert len(origin.input_sha256) == 64
    assert origin.document()["input"]["profile"] == {"name": "raytrix-u16-10um"}
    assert origin.document()["plan"]["session"]["group"] == "control"
    np.testing.assert_allclose(
        origin.T_arena_camera.matrix, MOUSE.T_arena_camera.matrix, atol=1e-12
    )


def test_where_in_the_arena_the_animal_is_stands_in_the_tables(tmp_path):
    """The mouse goes round a circle of 150 mm, 50 mm from the wall; a third of the zone's circle
    covers its way.
    """
    bowl = Arena("round", (0.0, 0.0), 200.0, seen_share=1.0, edge="wall")
    half = Zone("upper", polygon_mm=((-300.0, 0.0), (300.0, 0.0), (300.0, 300.0), (-300.0, 300.0)))
    mouse = WalkingMouse(steady(2 * np.pi * 150 / 200), lost=(7,))
    optics = {"distortion": None, "water": {"height_mm": 300.0}}
    session = write(
        tmp_path / "c.liex",
        mouse,
        arena=bowl,
        zones=(half, Zone("middle", (0.0, 0.0, 20.0))),
        optics=optics,
    )
    assert session.arena == bowl
    assert session.zones == [half, Zone("middle", (0.0, 0.0, 20.0))]
    assert session.metadata["camera"]["optics"] == optics
    assert session.camera == mouse.camera
    frames = session.frames
    seen = np.delete(np.arange(len(frames)), 7)
    off = np.hypot(frames["centroid_x_mm"], frames["centroid_y_mm"])
    np.testing.assert_allclose(frames["wall_distance_mm"][seen], 200.0 - off[seen])
    assert np.isnan(frames["wall_distance_mm"][7])
    assert frames["zone"][7] == ""
    expected = np.where(frames["centroid_y_mm"][seen] > 0, "upper", "")
    assert frames["zone"][seen].tolist() == expected.tolist()
    row = session.summary.iloc[0]
    assert row["zone_upper_share"] == pytest.approx(0.5, abs=0.03)
    assert row["zone_upper_s"] == pytest.approx(row["zone_upper_share"] * row["observed_s"])
    assert row["zone_middle_s"] == 0.0
    assert {"zone_upper_s", "zone_middle_share"} <= set(
        session.columns.query("table == 'summary'")["name"]
    )


def test_poses_come_back_and_project_onto_their_pixels(session):
    track = MOUSE.track()
    xyz = session.poses[["x_mm", "y_mm", "z_mm"]].to_numpy().reshape(30, 5, 3)
    np.testing.assert_array_equal(xyz, track.joints_mm)
    uv = session.camera.project(session.T_arena_camera.inverse() @ xyz)
    np.testing.assert_allclose(
        session.poses[["u_px", "v_px"]].to_numpy().reshape(30, 5, 2), uv, atol=1e-9
    )
    assert list(session.poses["joint"].unique()) == list(MOUSE.skeleton.names)
    assert session.poses["score"].between(0, 1).all()


def test_an_unfinished_session_leaves_nothing_behind(tmp_path, monkeypatch):
    frames, track = next(MOUSE.chunks(10))

    def broken(*_):
        raise OSError("the disk is gone")

    def breaks_in_between(writer):
        writer.add(frames, track)
        assert [path.name for path in tmp_path.iterdir()] == ["circle.liex.part"]
        broken()

    def breaks_at_the_end(writer):
        writer.add(frames)
        writer.track = track
        monkeypatch.setattr(writer._replay, "finish", broken)
        writer.close()

    def of_other_frames(writer):
        writer.add(frames)
        writer.track = track[1:10]

    for work, said in (
        (breaks_in_between, "the disk is gone"),
        (breaks_at_the_end, "the disk is gone"),
        (lambda writer: writer.add(frames, track), r"call close\(\)"),
        (lambda writer: writer.close(), "no frame"),
        (of_other_frames, "one row for every frame"),
    ):
        with pytest.raises((OSError, SessionError), match=said):  # noqa: SIM117
            with SessionWriter(tmp_path / "circle.liex", MOUSE.provenance()) as writer:
                work(writer)
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(ZeroDivisionError):
        SessionWriter(tmp_path / "circle.liex", MOUSE.provenance(), blueprint=lambda _: 1 / 0)
    assert list(tmp_path.iterdir()) == []


def test_a_session_is_replaced_only_when_asked_and_only_by_a_whole_one(tmp_path):
    place = tmp_path / "circle.liex"
    write(place, MOUSE, name="first")
    with pytest.raises(SessionError, match="exists already"):
        write(place, MOUSE)
    with pytest.raises(KeyboardInterrupt):  # noqa: SIM117
        with SessionWriter(place, MOUSE.provenance(), overwrite=True):
            raise KeyboardInterrupt
    assert Session.open(place).name == "first"
    assert write(place, MOUSE, name="second", overwrite=True).name == "second"
    assert list(tmp_path.iterdir()) == [place]


def test_a_folder_that_is_not_a_session_is_never_touched(tmp_path):
    place = tmp_path / "thesis"
    place.mkdir()
    (place / "chapter1.txt").write_text("years of work")
    with pytest.raises(SessionError, match="not a session"):
        SessionWriter(place, MOUSE.provenance(), overwrite=True)
    assert (place / "chapter1.txt").read_text() == "years of work"
    assert list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("no ink"), "no ink"),
        (OSError(errno.ENOSPC, "No space left", "report.html"), "is full .* liex report"),
    ],
)
def test_a_report_that_fails_does_not_take_the_session_with_it(tmp_path, error, said):
    def broken(folder: Path) -> None:
        assert (folder / "session.json").is_file()
        raise error

    with pytest.raises((ValueError, SessionError), match=said):
        write(tmp_path / "circle.liex", MOUSE, report=broken)
    assert len(Session.open(tmp_path / "circle.liex").frames) == 30
    assert [path.name for path in tmp_path.iterdir()] == ["circle.liex"]


def test_a_recording_in_which_nothing_is_found_is_a_session_all_the_same(tmp_path):
    with SessionWriter(tmp_path / "empty.liex", MOUSE.provenance()) as writer:
        for frames, _ in MOUSE.chunks(10):
            writer.add(frames)
        writer.track = Track.empty(MOUSE.skeleton, MOUSE.times_ns, "no_depth")
        session = writer.close()
    assert session.metadata["frames"]["n_observed"] == 0
    assert list(session.gaps["reason"]) == ["no_depth"]
    assert session.metadata["thumbnails"] == []


def test_a_newer_session_asks_for_an_upgrade(session, tmp_path):
    (tmp_path / "session.json").write_text(
        json.dumps({**session.metadata, "schema_version": SCHEMA_VERSION + 1})
    )
    with pytest.raises(SessionError, match="upgrade"):
        Session.open(tmp_path)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "holds no session.json"),
        ("{", "damaged"),
        ("[]", "damaged"),
        ('{"schema_version": 1}', "session_id"),
    ],
)
def test_what_is_not_a_session_is_refused_with_a_sentence(tmp_path, content, says):
    if content is not None:
        (tmp_path / "session.json").write_text(content)
    with pytest.raises(SessionError, match=says):
        Session.open(tmp_path)
    with pytest.raises(SessionError, match="is not a folder"):
        Session.open(tmp_path / "nowhere")


def test_thumbnails_hold_the_depth_around_the_animal(session):
    import cv2

    shown = session.metadata["thumbnails"]
    assert len(shown) == 16
    for entry in shown:
        picture = cv2.imread(str(session.path / entry["file"]), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        assert picture.dtype == np.uint16
        assert picture.shape == (entry["height_px"], entry["width_px"])
        depth = MOUSE.frame(entry["frame_index"]).depth
        x0, y0 = max(entry["left_px"], 0), max(entry["top_px"], 0)
        inside = picture[y0 - entry["top_px"] :, x0 - entry["left_px"] :]
        inside = inside[: depth.shape[0] - y0, : depth.shape[1] - x0]
        np.testing.assert_array_equal(
            inside, depth[y0 : y0 + inside.shape[0], x0 : x0 + inside.shape[1]]
        )


@pytest.mark.nightly
def test_memory_of_some_more_frames_is_that_of_some(tmp_path):
    mouse = WalkingMouse(steady(5.0), camera=Camera(287.0, 287.0, 159.5, 119.5, 320, 240))
    depth = mouse.frame(0).depth

    def peak_of(n: int) -> int:
        with SessionWriter(tmp_path / f"{n}.liex", mouse.provenance()) as writer:
            tracemalloc.start()
            for start in range(0, n, 16):
                rows = range(start, start + 16)
                stamps = mouse.times_ns[start : start + 16].tolist()
                frames = [
                    DepthFrame(row, stamp, depth.copy())
                    for row, stamp in zip(rows, stamps, strict=True)
                ]
                writer.add(frames)
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            writer.track = mouse.track()[:n]
            writer.close()
        return peak

    peak_of(16)
    assert peak_of(144) - peak_of(80) < 0.5 * 64 * depth.nbytes


def test_the_recipe_for_neural_data_finds_the_true_pulse_of_every_frame(tmp_path, monkeypatch):
    rng = np.random.default_rng(5)
    pulse = np.delete(np.arange(150), [1, 2, 3, 40, 90, 91])  # lost at the start and in between
    stamps = pulse / 30 + np.append(0.0, rng.uniform(-0.006, 0.006, len(pulse) - 1))
    write(
        tmp_path / "results" / "recording.liex",
        WalkingMouse(stamps, rear_s=(1.0, 2.0)),
        gaps=find_gaps((stamps * 1e9).astype(np.int64) + MOUSE.times_ns[0], 33_333_333),
    )
    page = (REPOSITORY / "docs" / "howto" / "ephys.md").read_text()
    (recipe,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {}
    exec(recipe, found)
    np.testing.assert_allclose(found["on_your_clock"], pulse / 30, atol=1e-9)
    heights = found["session"].kinematics.nose_height_mm.to_numpy()
    at = np.interp([1.05, 1.5], found["on_your_clock"], heights)
    np.testing.assert_allclose(at, np.interp([1.05, 1.5], stamps, heights), rtol=0.2)


def test_a_session_of_an_earlier_version_numbers_its_pulses_too(session, tmp_path):
    import pyarrow.parquet as pq

    old = tmp_path / "old.liex"
    shutil.copytree(session.path, old)
    frames = session.frames.drop(columns="pulse_index").assign(gap_before=0)
    frames.loc[[4, 9], "gap_before"] = [2, 3]
    frames.to_parquet(old / "frames.parquet")
    columns = json.loads((old / "columns.json").read_text())
    (old / "columns.json").write_text(
        json.dumps([one for one in columns if one["name"] != "pulse_index"])
    )
    again = Session.open(old)
    assert "pulse_index" not in pq.read_schema(old / "frames.parquet").names
    assert again.frames["pulse_index"].tolist() == [*range(4), *range(6, 11), *range(14, 35)]
    assert again.table("frames", frame_index=[9, 10])["pulse_index"].tolist() == [14, 15]
    assert (again.columns["name"] == "pulse_index").sum() == 1
