"""A video shows the session at its own times, and says in a sentence where it cannot."""

import shutil
from contextlib import closing
from pathlib import Path

import av
import numpy as np
import pytest
from liex_lab.dashboards.report.report import write_report
from liex_lab.dashboards.video import video
from liex_lab.dashboards.video.film import Film, Relief, View

from liex_lab.api import export_video
from liex_lab.errors import PlaceError, SessionError
from liex_lab.exchange import export
from liex_lab.exchange.boris import project
from liex_lab.sessions import Session
from tests.sessions.pair import NAMES, write_pair
from tests.sessions.walking_mouse import FLOOR_MM, WalkingMouse, steady, write

GAP = np.delete(steady(2.0), slice(20, 26))
MOUSE = WalkingMouse(GAP, rear_s=(1.0, 1.8))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return write(tmp_path_factory.mktemp("video") / "circle.liex", MOUSE, report=write_report)


@pytest.fixture
def session(written: Session, tmp_path: Path) -> Session:
    return Session.open(shutil.copytree(written.path, tmp_path / "circle.liex"))


def images(path: Path) -> tuple[list[np.ndarray], float]:
    with av.open(str(path)) as box:
        frames = [frame.to_ndarray(format="rgb24") for frame in box.decode(video=0)]
        stream = box.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.average_rate is not None
        return frames, float(stream.average_rate)


def shown_at(path: Path) -> np.ndarray:
    """When each picture of a video is shown, s."""
    with av.open(str(path)) as box:
        return np.array([frame.time for frame in box.decode(video=0)])


def irregular(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.cumsum(
        rng.choice([0.008, 0.0333, 0.0334, 0.1, 1.7], 20, p=[0.2, 0.3, 0.3, 0.15, 0.05])
    )


@pytest.mark.parametrize(
    "times",
    [
        GAP,
        steady(0.5) + np.append(0.0, np.random.default_rng(1).uniform(-0.008, 0.008, 14)),
        irregular(2) - irregular(2)[0],
        np.zeros(1),
    ],
    ids=["gap", "jitter", "irregular", "single frame"],
)
def test_a_video_has_one_picture_per_row_each_at_its_own_time(tmp_path, times):
    session = write(tmp_path / "circle.liex", WalkingMouse(times))
    path = export_video(session.path)
    assert path == session.path / "circle.mp4"
    np.testing.assert_allclose(shown_at(path), session.frames["time_s"], atol=1e-4)
    assert not list(session.path.glob(".*part*"))


def test_the_same_session_gives_the_same_bytes(session, tmp_path):
    one = export_video(session.path, tmp_path / "a").read_bytes()
    assert export_video(session.path, tmp_path / "b").read_bytes() == one


def test_the_nose_is_drawn_where_the_table_says(session):
    with closing(Film(session, 80.0)) as film:
        view = film.whole_view()
        shown = film.image(0.5, view, (4 * view.width, 4 * view.height), "")
        u, v = film.uv[0][film.row_at(0.5)][-1]
    place = 4.0 * (np.array([u, v]) + 0.5 - [view.left, view.top])
    red = (shown.astype(int) - [238, 102, 119]).__abs__().sum(axis=-1) < 60
    y, x = np.nonzero(red)
    assert np.hypot(x.mean() + 0.5 - place[0], y.mean() + 0.5 - place[1]) < 3.0


def test_animals_of_one_arena_are_shown_over_one_depth_image_in_their_colours(tmp_path):
    pair = write_pair(tmp_path, 1.0)
    with closing(Film(pair[0], 80.0, pair[1:])) as film:
        view = film.whole_view()
        shown = film.image(0.5, view, (6 * view.width, 6 * view.height), "").astype(int)
        at = [6.0 * (uv[15].mean(axis=0) + 0.5 - [view.left, view.top]) for uv in film.uv]
        events = pair[0].interactions.query("target != ''")
        assert len(events)
        for event in events.to_dict("records"):
            said = (event["agent"], event["target"], event["action"])
            assert said in film.interactions_at(event["start_s"])
            assert said not in film.interactions_at(event["stop_s"])
    for name, colour, (x, y) in zip(NAMES, ((238, 119, 51), (51, 187, 238)), at, strict=True):
        near = shown[int(y) - 12 : int(y) + 12, int(x) - 12 : int(x) + 12]
        assert (abs(near - colour).sum(axis=-1) < 40).any(), name
    paths = [one.path for one in pair]
    video = export_video(paths)
    assert video == tmp_path / "pair.mp4"
    np.testing.assert_allclose(shown_at(video), pair[0].frames["time_s"], atol=1e-4)
    assert export_video(paths, start_s=0.2, stop_s=0.3).name == "pair_from_0.20s_to_0.30s.mp4"
    alone = write(tmp_path / "circle.liex", WalkingMouse(steady(1.0)))
    assert export_video([*paths, alone.path], tmp_path).name == "sessions.mp4"


def test_heights_are_counted_from_the_floor(session):
    relief = Relief(session, 80.0)
    depth = np.full((session.camera.height, session.camera.width), round(FLOOR_MM), np.uint16)
    depth[10, 10] = round(FLOOR_MM) - 30
    depth[0, 0] = 0
    heights = relief.heights(depth)
    assert heights[10, 10] == pytest.approx(30.0, abs=0.1)
    assert heights[40, 60] == pytest.approx(0.0, abs=0.1)
    assert np.isnan(heights[0, 0])


@pytest.mark.parametrize("share", [1.0, 0.03])
def test_the_bar_of_length_is_a_round_number_of_millimetres_on_the_floor(session, share):
    camera = session.camera
    view = View(0, 0, round(share * camera.width), round(share * camera.height))
    with closing(Film(session, 80.0)) as film:
        row = (film.image(0.0, view, (636, 480), "")[480 - 5 * 18 // 2 - 1] == 240).all(axis=1)
    length_px = np.flatnonzero(~row[: 636 - 18 // 2][::-1])[0]  # left of it stands the text
    floor_mm = float(session.T_arena_camera.translation[2])  # seen at right angles
    length_mm = length_px * view.width / 636 * floor_mm / camera.fx
    digits = float(f"{length_mm:e}".split("e")[0])
    assert min(abs(digits - k) / k for k in (1, 2, 5, 10)) < 1.5 / length_px
    assert 636 / 5 / 2.5 - 1 <= length_px <= 636 / 5


def test_the_frame_that_is_shown_is_the_last_one_until_then(session):
    with closing(Film(session, 80.0)) as film:
        assert film.row_at(0.0) == 0
        assert film.row_at(19.5 / 30.0) == 19
        assert film.row_at(25.5 / 30.0) == 19  # in the gap the last image stands
        assert film.row_at(26.0 / 30.0) == 20
        assert film.row_at(99.0) == len(session.frames) - 1
        rears = session.bouts[session.bouts["action"].str.startswith("rear")]
        bout = next(rears.itertuples())
        assert film.words_at(0.5 * (bout.start_s + bout.stop_s)) == [bout.action]


def test_groups_stand_beside_each_other_on_one_scale(tmp_path):
    mouse = WalkingMouse(steady(1.2), rear_s=(0.3, 1.0))
    for name, group in (("a", "control"), ("b", "drug"), ("c", "drug")):
        write(tmp_path / f"{name}.liex", mouse, name=name, subject={"group": group})
    path = export_video([tmp_path], tmp_path, actions=["rear"])
    assert path.name == "sessions_rear.mp4"
    frames, _ = images(path)
    alone = export_video([tmp_path], tmp_path, actions=["rear"], groups=["control"])
    single, _ = images(alone)
    assert frames[0].shape[1] > single[0].shape[1]
    with pytest.raises(SessionError, match="their groups are control, drug"):
        export_video([tmp_path], tmp_path, groups=["placebo"])


def test_the_report_links_to_the_clips_that_were_made(session):
    export_video(session.path, actions=["rear"])
    page = (session.path / "report.html").read_text(encoding="utf-8")
    assert '<a href="circle_rear.mp4">video</a>' in page


def test_the_project_for_boris_names_the_video_that_was_made(session, tmp_path):
    def media(found: dict) -> str:
        (observation,) = found["observations"].values()
        (name,) = observation["file"]["1"]
        assert set(observation["media_info"]["length"]) == {name}
        assert set(observation["media_info"]["fps"]) == {name}
        return str(name)

    assert media(project(session, tmp_path)) == session.metadata["input"]["name"]
    video = export_video(session.path)
    # beside the project by its name, so that the folder can be moved; else by its whole path
    assert media(project(session, session.path)) == "circle.mp4"
    assert Path(media(project(session, tmp_path / "elsewhere"))) == video.resolve()
    export(session, "boris")
    assert '"circle.mp4"' in (session.path / "circle.boris").read_text(encoding="utf-8")


def test_without_an_encoder_there_is_a_sentence_and_no_file(session, monkeypatch):
    monkeypatch.setattr(video, "_CODECS", ("no_such_codec", "nor_this"))
    with pytest.raises(SessionError, match="neither no_such_codec nor nor_this"):
        export_video(session.path)
    assert not list(session.path.glob("*.mp4"))


def test_a_session_without_depth_is_a_sentence(session):
    (session.path / "session.mcap").unlink()
    with pytest.raises(SessionError, match=r"lacks session\.mcap|keeps no depth"):
        export_video(session.path)
    for said in (False, "none"):
        session.metadata["plan"] = {"replay": {"depth": said}}
        with pytest.raises(SessionError, match="without --no-depth"):
            Film(session, 80.0)


def test_a_session_without_any_pose_is_a_video_all_the_same(tmp_path):
    lost = write(tmp_path / "lost.liex", WalkingMouse(steady(0.5), lost=tuple(range(15))))
    frames, _ = images(export_video(lost.path))
    assert len(frames) == 15
    with pytest.raises(SessionError, match="no bout is named rear in 1 session; named are none"):
        export_video(lost.path, actions=["rear"])


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"actions": ["swim"]}, "no bout is named swim"),
        ({"start_s": 90.0}, "is no part of it"),
        ({"slower": 0.0}, "above 0"),
        ({"start_s": 1.0, "actions": ["rear"]}, "without actions"),
    ],
)
def test_what_cannot_be_shown_is_a_sentence_and_leaves_nothing(session, asked, said):
    with pytest.raises(SessionError, match=said):
        export_video(session.path, **asked)
    assert not list(session.path.glob("*.mp4*"))


def test_a_stretch_is_as_long_as_it_is_times_how_slow(session):
    path = export_video(session.path, start_s=0.1, stop_s=0.6, slower=2.0)
    assert path.name == "circle_from_0.10s_to_0.60s.mp4"
    np.testing.assert_allclose(shown_at(path), np.arange(15) / 15, atol=1e-3)
    with pytest.raises(SessionError, match="exists already"):
        export_video(session.path, start_s=0.1, stop_s=0.6)


def test_a_link_in_the_place_of_a_video_is_not_written_through(session, tmp_path):
    theirs = tmp_path / "theirs.mp4"
    theirs.write_bytes(b"theirs")
    (session.path / "circle.mp4").symlink_to(theirs)
    with pytest.raises(PlaceError, match="symbolic link"):
        export_video(session.path, overwrite=True)
    assert theirs.read_bytes() == b"theirs"


def test_a_video_that_breaks_off_leaves_nothing(tmp_path):
    def breaks() -> None:
        with video.video_file(tmp_path / "v.mp4", 30.0) as add:
            add(np.zeros((64, 64, 3), np.uint8), 0.0)
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError):
        breaks()
    assert list(tmp_path.iterdir()) == []
