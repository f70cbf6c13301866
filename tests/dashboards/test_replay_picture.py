"""The replay as a picture: what Rerun's own viewer, without a screen, draws at two moments."""

from __future__ import annotations

import ctypes.util
import importlib.util
import shutil
import socket
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from liex_lab.dashboards.replay.rerun_blueprint import replay_blueprint

from liex_lab.api import correct_session
from liex_lab.sessions import Session
from liex_lab.sessions.correcting import joint_move
from tests.sessions.test_cutouts import written
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(steady(2.0), speed_mm_s=220.0)
MOMENTS = (5, 50)
Picture = np.ndarray
NEAR_VIEW = np.s_[70:325, 965:1915]  # where the depth is that of cut-outs; whole pictures below
DEPTH_VIEW = np.s_[
    70:620, 965:1915
]  # of a picture of 1920 x 1080 in our layout; Rerun's own crop of a view panics


def drivers() -> bool:
    """Whether there is anything that draws: Vulkan's loader and a driver for it."""
    found = [
        Path(place) / "vulkan" / "icd.d" for place in ("/usr/share", "/etc", "/usr/local/share")
    ]
    return ctypes.util.find_library("vulkan") is not None and any(
        list(place.glob("*.json")) for place in found
    )


pytestmark = pytest.mark.skipif(
    not drivers(), reason="needs Vulkan: apt install libvulkan1 mesa-vulkan-drivers"
)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return write(tmp_path_factory.mktemp("seen") / "circle.liex", MOUSE, blueprint=replay_blueprint)


@pytest.fixture(scope="module")
def pictures(session: Session) -> dict[int, Picture]:
    """The picture of the depth view, RGB, at each moment."""
    return {moment: whole[DEPTH_VIEW] for moment, whole in looked_at(session).items()}


def looked_at(session: Session) -> dict[int, Picture]:
    """What the viewer shows at each moment, RGB; no view complains of anything."""
    from rerun.experimental import ViewerClient

    found = importlib.util.find_spec("rerun_cli")
    assert found is not None
    assert found.origin is not None
    program = (
        Path(found.origin).parent / "rerun"
    )  # the one that the package brings, wherever PATH leads
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    taken = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RERUN_ANALYTICS", "0")
        with ViewerClient.spawn(
            headless=True, port=port, hide_welcome_screen=True, executable_path=str(program)
        ) as viewer:
            viewer.open(str(session.path / "session.rrd"))
            for moment in MOMENTS:
                for _ in range(4):  # chunks load on demand: the first pictures may be incomplete
                    viewer.set_time("frame", sequence=moment, play_state="paused")
                    png = viewer.take_screenshot()
                    time.sleep(0.5)
                whole = np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))
                taken[moment] = whole[..., ::-1]
            complaints = [report for view in viewer.get_state().views for report in view.reports]
    assert not complaints
    return taken


def joints_in(picture: Picture) -> np.ndarray:
    """(H, W) where the joints' colour is."""
    red, green, blue = (picture[..., k].astype(int) for k in range(3))
    return (red > 200) & (green > 40) & (green < 130) & (blue < 110)


def test_where_depth_is_cut_out_around_the_animal_it_is_zoomed_and_followed(tmp_path: Path) -> None:
    session = written(tmp_path / "cut.liex", "animal", blueprint=replay_blueprint)
    shown = looked_at(session)
    for moment in MOMENTS:
        near = joints_in(shown[moment][NEAR_VIEW])
        assert near.sum() > 100
        middle = np.argwhere(near).mean(axis=0) / near.shape
        assert np.abs(middle - 0.5).max() < 0.2, "wherever it goes, it is in the middle"


def test_the_two_moments_differ_where_the_animal_moved_and_the_skeleton_lies_on_it(
    pictures,
) -> None:
    first, second = (pictures[moment] for moment in MOMENTS)
    changed = np.abs(first.astype(int) - second.astype(int)).max(axis=-1) > 70
    body = (
        cv2.morphologyEx(changed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((13, 13), np.uint8)) > 0
    )
    assert 0.002 < body.mean() < 0.12, "only the animal moved"
    near = cv2.dilate(body.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    for picture in (first, second):
        joints = joints_in(picture)
        assert joints.sum() > 40
        assert near[joints].mean() > 0.95
    assert not (joints_in(first) & joints_in(second)).any()


def test_the_skeleton_moved_as_the_track_says(pictures, session: Session) -> None:
    at = [np.argwhere(joints_in(pictures[moment])).mean(axis=0)[::-1] for moment in MOMENTS]
    uv = session.poses[["u_px", "v_px"]].to_numpy(float).reshape(-1, 5, 2).mean(axis=1)
    seen, told = at[1] - at[0], uv[MOMENTS[1]] - uv[MOMENTS[0]]
    cosine = seen @ told / np.linalg.norm(seen) / np.linalg.norm(told)
    assert cosine > 0.995
    assert np.linalg.norm(seen) > 60.0


def test_what_was_corrected_is_shown_in_place_of_what_was_measured(
    session: Session, tmp_path: Path
) -> None:
    from liex_lab.sessions.viewer import show_replay

    folder = Path(shutil.copytree(session.path, tmp_path / session.path.name))
    place = session.poses.loc[MOMENTS[0] * 5 + 4, ["x_mm", "y_mm", "z_mm"]].to_numpy(
        float
    ) + np.array([0, 0, 30.0])
    correct_session(folder, [joint_move(session, MOMENTS[0], "nose", place)])
    shown = show_replay(folder / "session.rrd", MOMENTS[0] / 30, headless=True)
    try:
        ends, origins = time.monotonic() + 20.0, set[str]()
        while time.monotonic() < ends and "/corrected/kinematics/speed_mm_s" not in origins:
            time.sleep(0.5)
            views = shown.client.get_state().views
            origins = {view.origin for view in views}
        assert {"/corrected/ethogram", "/corrected/kinematics/speed_mm_s"} <= origins
        assert not [report for view in views for report in view.reports]
        (recording,) = shown.client.get_state().recordings
        assert recording.timelines, "both files are one recording"
    finally:
        shown.close()
