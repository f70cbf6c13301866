"""What a session keeps of its depth: cut-outs before the still scene, in both replays."""

import shutil
import struct
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import liex_lab.sessions.rrd_scene as depth_of
from liex_lab.body.pose import Pose
from liex_lab.errors import SessionError
from liex_lab.geometry import SE3
from liex_lab.recordings.depth_kernels import to_millimetres, unpack_rvl
from liex_lab.recordings.frame import region_mask
from liex_lab.sessions import Session, SessionWriter, correcting
from liex_lab.sessions.checkpoint import append_rrd
from liex_lab.sessions.cutouts import (
    FILE,
    N_BOXES,
    N_WINDOWS,
    DepthKeeper,
    Kept,
    boxes_around,
    composed,
    open_depth,
    window_around,
    windows,
)
from liex_lab.sessions.evidence import link_to, linked_recording
from liex_lab.sessions.rrd import ReplayWriter
from liex_lab.tracking.observations import Observations
from tests.sessions.test_rrd import columns_of
from tests.sessions.walking_mouse import FLOOR_MM, WalkingMouse, steady

MOUSE = WalkingMouse(steady(2.0))
UNSEEN = 7
BACKGROUND = np.full((MOUSE.camera.height, MOUSE.camera.width), round(FLOOR_MM), np.uint16)


def observed(mouse: WalkingMouse) -> Observations:
    """What single frames say: the mouse where it is, but for one frame in which nothing is."""
    track = mouse.track()
    seen = Observations.empty(mouse.skeleton, mouse.times_ns)
    pose = Pose(SE3(track.root_rotation, track.root_mm), track.angles_rad, track.scale)
    middle = track.joints_mm.mean(axis=1)
    for h in (0, 1):
        seen.put_pose(h, pose)
        seen.score[:, h] = 1.0
        seen.n_px[:, h] = 100
        seen.centroid_mm[:, h] = middle
        seen.centroid_px[:, h] = mouse.camera.project(mouse.T_arena_camera.inverse() @ middle)
    seen.score[UNSEEN] = np.nan
    seen.n_px[UNSEEN] = 0
    return seen


SEEN = observed(MOUSE)
ORIGIN = MOUSE.provenance(background=BACKGROUND)


def written(folder: Path, depth: str, **own: Any) -> Session:
    """A session that keeps so much of the depth; `own` goes to its writer."""
    background = BACKGROUND if depth in ("animal", "arena") else None
    origin = MOUSE.provenance(
        replay_depth=depth,
        background=background,
        plan_toml=f'[replay]\ndepth = "{depth}"\n',
    )
    with SessionWriter(folder, origin, **own) as writer:
        done = 0
        for frames, _ in MOUSE.chunks(20):
            writer.add(frames, SEEN[done : done + len(frames)])
            done += len(frames)
        writer.track = MOUSE.track()
        return writer.close()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return written(tmp_path_factory.mktemp("whole") / "whole.liex", "all")


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return written(tmp_path_factory.mktemp("cut") / "circle.liex", "animal")


def test_a_box_holds_the_joints_and_the_animals_pixels_and_lies_in_the_picture() -> None:
    boxes = boxes_around(SEEN, MOUSE.provenance())
    uv = MOUSE.track().uv_px
    for row in range(len(SEEN)):
        left, top, right, bottom = boxes[row, 0]
        if row == UNSEEN:
            assert not boxes[row].any()
            continue
        assert 0 <= left < right <= MOUSE.camera.width
        assert 0 <= top < bottom <= MOUSE.camera.height
        assert left <= uv[row, :, 0].min() - 4 or left == 0
        assert right > uv[row, :, 0].max() + 4 or right == MOUSE.camera.width
        assert not boxes[row, 1].any(), "there is one thing only"
    assert (boxes[:, 0, 2] - boxes[:, 0, 0]).max() < MOUSE.camera.width / 2
    parts = [boxes_around(SEEN[k : k + 7], MOUSE.provenance()) for k in range(0, len(SEEN), 7)]
    np.testing.assert_array_equal(np.concatenate(parts), boxes)


def test_each_of_three_measured_animals_has_a_box() -> None:
    three = Observations.empty(MOUSE.skeleton, MOUSE.times_ns, 3)
    for name, values in vars(three).items():
        if name != "skeleton" and values.ndim > 1 and name != "objects":
            own = getattr(SEEN, name)
            values[:] = own[:, [0, 1, 0, 1, 0, 1]]
    boxes = boxes_around(three, MOUSE.provenance())
    one = boxes_around(SEEN, MOUSE.provenance())
    np.testing.assert_array_equal(boxes, one[:, [0, 0, 0]])


def test_a_kept_picture_is_as_read_in_its_box_and_the_still_scene_elsewhere(
    session: Session,
) -> None:
    kept = Kept(session)
    assert kept.boxes is not None
    n_unread = 0
    with open_depth(session) as pictures:
        assert pictures.times_ns.tolist() == MOUSE.times_ns.tolist()
        for row in range(len(MOUSE.times_s)):
            read = to_millimetres(MOUSE.frame(row).depth)
            held = pictures.frame(row).depth.astype(np.uint16)
            left, top, right, bottom = kept.boxes[row, 0]
            inside = np.zeros(read.shape, bool)
            inside[top:bottom, left:right] = True
            np.testing.assert_array_equal(held[inside], read[inside])
            np.testing.assert_array_equal(held[~inside], BACKGROUND[~inside])
            n_unread += int((held[inside] == 0).sum())
            assert inside.all() == (row == UNSEEN), "where nothing was found it is kept whole"
    assert n_unread > 0, "unread pixels stay unread"


def test_in_the_replay_a_cut_out_is_seen_by_a_camera_of_its_own(session: Session) -> None:
    boxes = Kept(session).boxes
    assert boxes is not None
    sizes = windows(replace(ORIGIN, replay_depth="animal"))
    lenses = columns_of(session, f"{depth_of.CUTOUTS}/1")
    places = columns_of(session, f"{depth_of.PLACES}/1")
    assert lenses["frame"] == places["frame"] == list(range(len(SEEN)))
    for row in (0, UNSEEN, 40):
        which, window = window_around(boxes[row, 0].tolist(), sizes)
        left, top, right, bottom = window
        pictures = columns_of(session, depth_of.cutout_entity(0, which))
        at = pictures["frame"].index(row)
        blob = np.asarray(pictures["EncodedDepthImage:blob"][at][0], np.uint8).tobytes()
        width, height = struct.unpack_from("<II", blob, 12)
        assert (width, height) == (right - left, bottom - top) == sizes[which]
        assert lenses["Pinhole:resolution"][row][0] == [right - left, bottom - top]
        cut = unpack_rvl(blob[20:], width, height)
        shown = composed(MOUSE.frame(row).depth, boxes[row], BACKGROUND)
        np.testing.assert_array_equal(cut, shown[top:bottom, left:right])
        lens = np.array(lenses["Pinhole:image_from_camera"][row][0]).reshape(3, 3).T
        point = np.linalg.inv(lens) @ [3.0, 5.0, 1.0]
        np.testing.assert_allclose(
            point, MOUSE.camera.unproject([left + 3.0, top + 5.0], 1.0), atol=1e-6
        )
        assert places["Transform3D:translation"][row][0] == [left, top, 0.0]
        assert places["Transform3D:child_frame"][row] == [depth_of.cutout_frame(0)]
    scene = columns_of(session, depth_of.BACKGROUND)
    assert len(scene["EncodedDepthImage:blob"]) == 1, "the still scene is there once"


@pytest.mark.parametrize("length_mm", [20.0, 70.0, 400.0])
def test_a_cut_out_stands_in_the_smallest_window_that_holds_it(length_mm: float) -> None:
    camera = MOUSE.camera
    sizes = windows(MOUSE.provenance(replay_depth="animal", animal_size={"spine_mm": length_mm}))
    assert len(set(sizes)) == len(sizes) <= N_WINDOWS
    assert sizes[-1] == (camera.width, camera.height)
    rng = np.random.default_rng(3)
    for _ in range(200):
        left, right = np.sort(rng.choice(camera.width + 1, 2, replace=False)).tolist()
        top, bottom = np.sort(rng.choice(camera.height + 1, 2, replace=False)).tolist()
        which, window = window_around((left, top, right, bottom), sizes)
        assert 0 <= window[0] <= left < right <= window[2] <= camera.width
        assert 0 <= window[1] <= top < bottom <= window[3] <= camera.height
        assert sizes[which] == (window[2] - window[0], window[3] - window[1])
        held = [w * h for w, h in sizes if w >= right - left and h >= bottom - top]
        assert sizes[which][0] * sizes[which][1] == min(held)


def test_the_windows_of_an_arena_are_its_region_and_the_whole_picture() -> None:
    corners = ((5.0, 5.0), (60.0, 5.0), (60.0, 40.0), (5.0, 40.0))
    scene = cast("Any", SimpleNamespace(region_px=corners))
    sizes = windows(MOUSE.provenance(replay_depth="arena", scene=scene))
    region = region_mask(corners, MOUSE.camera.width, MOUSE.camera.height)
    assert sizes == [
        (int(region.any(axis=0).sum()), int(region.any(axis=1).sum())),
        (MOUSE.camera.width, MOUSE.camera.height),
    ]


def shown_at(folder: Path, rows: Sequence[int]) -> list[dict[int, tuple[int, int]]]:
    """Sizes of the cut-outs that a viewer shows in frames, the last that each entity was given."""
    found: list[dict[int, tuple[int, int]]] = [{} for _ in rows]
    replay = cast("Session", SimpleNamespace(path=folder))
    for k, which in product(range(N_BOXES), range(N_WINDOWS)):
        columns = columns_of(replay, depth_of.cutout_entity(k, which))
        frames = np.array(columns.get("frame", []))
        for sizes, row in zip(found, rows, strict=True):
            before = np.flatnonzero(frames <= row)
            blob = columns["EncodedDepthImage:blob"][before[-1]] if len(before) else None
            if blob:
                assert k not in sizes, "one cut-out is shown in one window"
                sizes[k] = struct.unpack_from("<II", np.asarray(blob[0], np.uint8).tobytes(), 12)
    return found


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_of_every_cut_out_one_window_is_shown_at_a_time_also_where_a_run_went_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(depth_of, "_TOGETHER", 64)
    origin = replace(ORIGIN, replay_depth="animal")
    sizes = windows(origin)
    rng = np.random.default_rng(4)
    boxes = np.zeros((150, N_BOXES, 4), np.int16)
    for row in range(150):
        width, height = sizes[rng.integers(len(sizes))]
        boxes[row, 0] = (0, 0, width, height)
    boxes[60:64, 1] = (8, 8, 20, 20)  # the second one goes where one message ends
    for number, part in enumerate((slice(0, 80), slice(80, 150))):
        path = tmp_path / f"{number}.rrd"
        replay = ReplayWriter(path, origin)
        if number:
            replay.resume(0)
        frames = list(range(150)[part])
        replay.add(
            frames, [k * 33_000_000 for k in frames], [BACKGROUND] * len(frames), boxes[part]
        )
        replay.flushed()
        replay.abandon()
        append_rrd(path, tmp_path / "session.rrd")
    rows = (0, 1, 40, 60, 63, 64, 79, 80, 81, 149)
    for row, found in zip(rows, shown_at(tmp_path, rows), strict=True):
        there = [(k, box) for k, box in enumerate(boxes[row].tolist()) if box[2]]
        assert found == {k: sizes[window_around(box, sizes)[0]] for k, box in there}


def test_a_session_with_cut_outs_is_a_fraction_of_one_with_whole_images(
    session: Session, whole: Session, tmp_path: Path
) -> None:
    assert Kept(whole).boxes is None
    assert not (whole.path / FILE).exists()
    for name in ("session.mcap", "session.rrd"):
        assert (session.path / name).stat().st_size < 0.75 * (whole.path / name).stat().st_size
    boxes = Kept(written(tmp_path / "arena.liex", "arena")).boxes
    assert boxes is not None
    assert (boxes[:, 0] == [0, 0, MOUSE.camera.width, MOUSE.camera.height]).all()


def test_without_depth_neither_replay_holds_any_and_it_is_said_why(tmp_path: Path) -> None:
    session = written(tmp_path / "none.liex", "none")
    with pytest.raises(SessionError, match="keeps no depth images, for its plan states replay"):
        open_depth(session)
    with pytest.raises(SessionError, match="keeps no depth images"):
        correcting.joint_move_at_pixel(session, 3, "neck", 40.0, 30.0)


def test_damaged_boxes_are_told_in_a_sentence(session: Session, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(session.path, tmp_path / "copy.liex"))
    for content in (b"nothing", b""):
        (copy / FILE).write_bytes(content)
        with pytest.raises(SessionError, match=r"cutouts\.npz is damaged and cannot be read"):
            Kept(Session.open(copy))
    np.savez(copy / FILE, boxes=np.zeros((3, 2, 4), np.int16))
    with pytest.raises(SessionError, match="not those of every frame"):
        Kept(Session.open(copy))


def test_without_observations_whole_images_are_kept() -> None:
    keeper = DepthKeeper(MOUSE.provenance(replay_depth="animal", background=BACKGROUND))
    depth = MOUSE.frame(0).depth
    np.testing.assert_array_equal(
        keeper.keep([depth], keeper.boxes(None))[0], to_millimetres(depth)
    )


def test_a_session_says_where_its_recording_is_also_when_both_were_moved(
    session: Session, tmp_path: Path
) -> None:
    folder = tmp_path / "here" / "out" / "a.liex"
    recording = tmp_path / "here" / "raw" / "a.mcap"
    link = link_to(recording, folder)
    assert link == {"path": "../../raw/a.mcap"}
    moved = Session(tmp_path / "there" / "out" / "a.liex", {**session.metadata, "input": link})
    assert linked_recording(moved) == str(tmp_path / "there" / "raw" / "a.mcap")
    assert linked_recording(session) is None, "sessions of earlier versions do not say"
    virtual = {**session.metadata, "input": link_to("synthetic:walk?seed=3", folder)}
    assert linked_recording(Session(folder, virtual)) == "synthetic:walk?seed=3"
