"""The replay as a picture: what Rerun's own viewer, without a screen, draws at two moments."""

import ctypes.util
import importlib.util
import os
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from liex_lab.dashboards.replay.layouts import replay_blueprint

from liex_lab.api import correct_session
from liex_lab.sessions import Session
from liex_lab.sessions.correcting import joint_move
from tests.sessions.test_cutouts import written
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(steady(2.0), speed_mm_s=220.0)
MOMENTS = (5, 50)
FPS = 30.0
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


pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(
        not drivers(), reason="needs Vulkan: apt install libvulkan1 mesa-vulkan-drivers"
    ),
]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return write(tmp_path_factory.mktemp("seen") / "circle.liex", MOUSE, blueprint=replay_blueprint)


@pytest.fixture(scope="module")
def pictures(session: Session) -> dict[int, Picture]:
    """The picture of the depth view, RGB, at each moment."""
    return {moment: whole[DEPTH_VIEW] for moment, whole in looked_at(session).items()}


@contextmanager
def viewing(files: Sequence[Path], log: Path) -> Iterator[Any]:
    """Rerun's viewer, without a screen, of one replay's files; what it says goes to a log."""
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
    command = [str(program), "--headless", "--hide-welcome-screen", "--bind", "127.0.0.1"]
    with log.open("wb") as out:
        viewer = subprocess.Popen(
            [*command, "--port", str(port)],
            env={**os.environ, "RERUN_ANALYTICS": "0", "RUST_LOG": "info"},
            stdout=out,
            stderr=out,
        )
        try:
            client = connected(viewer, port, ViewerClient)
            for file in files:
                client.open(str(file))
            yield client
        finally:
            viewer.terminate()
            viewer.wait(10)


def connected(viewer: subprocess.Popen[bytes], port: int, client: Any) -> Any:
    """The client of a viewer, once that is up."""
    ends = time.monotonic() + 30.0
    while True:
        assert viewer.poll() is None
        try:
            return client.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        except Exception:  # not up yet; what it raises then is not documented
            assert time.monotonic() < ends
            time.sleep(0.2)


def complaints_in(log: Path) -> list[str]:
    """What a viewer complained of, but for the screen that it has not."""
    told = re.sub(r"\x1b\[[0-9;]*m", "", log.read_text(encoding="utf-8")).splitlines()
    assert any("rasterizer" in line or " INFO " in line for line in told), "it logs something"
    return [
        line
        for line in told
        if (" ERROR " in line or (" WARN " in line and "re_viewer_context" in line))
    ]


def pictures_of(client: Any) -> dict[int, Picture]:
    """What a viewer shows at each moment, RGB."""
    taken = {}
    for moment in MOMENTS:
        for _ in range(4):  # chunks load on demand: the first pictures may be incomplete
            client.set_time("time", duration=moment / FPS, play_state="paused")
            png = client.take_screenshot()
            time.sleep(0.5)
        whole = np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))
        taken[moment] = whole[..., ::-1]
    return taken


def looked_at(session: Session, *more: Path) -> dict[int, Picture]:
    """What the viewer shows at each moment, RGB; neither a view nor its log complains."""
    from liex_lab.sessions.viewer import replays_with

    log = session.path.with_suffix(".log")
    with viewing(replays_with(session.path / "session.rrd", more), log) as client:
        taken = pictures_of(client)
        told = [report for view in client.get_state().views for report in view.reports]
    assert not told
    assert not complaints_in(log)
    return taken


def joints_in(picture: Picture) -> np.ndarray:
    """(H, W) where the joints' colour is."""
    red, green, blue = (picture[..., k].astype(int) for k in range(3))
    return (red > 200) & (green > 40) & (green < 130) & (blue < 110)


@pytest.mark.parametrize("depth", ["arena", "none"])
def test_the_viewer_complains_of_nothing_however_much_depth_is_kept(
    tmp_path: Path, depth: str
) -> None:
    looked_at(written(tmp_path / "kept.liex", depth, blueprint=replay_blueprint))


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


def test_what_was_corrected_is_shown_in_place_of_what_was_measured(
    session: Session, tmp_path: Path
) -> None:
    from liex_lab.sessions.viewer import end_viewer, show_replay

    folder = Path(shutil.copytree(session.path, tmp_path / session.path.name))
    place = session.poses.loc[MOMENTS[0] * 5 + 4, ["x_mm", "y_mm", "z_mm"]].to_numpy(
        float
    ) + np.array([0, 0, 30.0])
    correct_session(folder, [joint_move(session, MOMENTS[0], "nose", place)])
    process, client = show_replay(folder / "session.rrd", MOMENTS[0] / 30, headless=True)
    try:
        ends, origins = time.monotonic() + 20.0, set[str]()
        while time.monotonic() < ends and "/corrected/kinematics/speed_cm_s" not in origins:
            time.sleep(0.5)
            views = client.get_state().views
            origins = {view.origin for view in views}
        assert {"/corrected/ethogram", "/corrected/kinematics/speed_cm_s"} <= origins
        assert not [report for view in views for report in view.reports]
        (recording,) = client.get_state().recordings
        assert recording.timelines, "both files are one recording"
    finally:
        end_viewer(process)
