"""A stream of skeletons: what is in it, and what is said where no window can be shown."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.dashboards.replay.layouts import live_blueprint
from rerun.chunk import RrdReader
from typer.testing import CliRunner

from liex_lab import api, cli
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3
from liex_lab.optics.camera import KINECT_V2
from liex_lab.plan import Plan
from liex_lab.recordings.frame import DepthFrame
from liex_lab.sessions import viewer
from liex_lab.sessions.rrd import ANIMALS, SKELETON
from liex_lab.sessions.rrd_scene import DEPTH, IMAGE
from liex_lab.sessions.viewer import ERROR
from liex_lab.tracking.track import Track

SOURCE = "synthetic:walk?seed=3&frames=30&sensor=primesense-qvga&spine_mm=70"
SET = ["--set", "animal.spine_mm=70"]


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A replayed walk that was written to a file, and what was printed."""
    file = tmp_path_factory.mktemp("live") / "walk.rrd"
    result = CliRunner().invoke(cli.app, ["live", SOURCE, "--replay", "--to", str(file), *SET])
    assert result.exit_code == 0, result.output
    return file, result.output


def _rows(file: Path, entity: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for chunk in RrdReader(file).stream().filter(content=f"/{entity}"):
        rows.extend(chunk.to_record_batch().to_pylist())
    return rows


def test_every_skeleton_has_its_error_and_every_fifth_frame_its_picture(
    followed: tuple[Path, str],
) -> None:
    errors = [row for row in _rows(followed[0], ERROR) if row.get("frame") is not None]
    bones = [row for row in _rows(followed[0], f"{SKELETON}/bones") if row.get("frame") is not None]
    pictures = [row for row in _rows(followed[0], DEPTH) if row.get("frame") is not None]
    assert len(bones) >= len(errors) >= 24
    assert [row["frame"] for row in pictures] == list(range(0, 30, 5))
    assert _rows(followed[0], IMAGE)


def test_each_of_two_animals_has_a_skeleton_a_name_and_an_error(tmp_path: Path) -> None:
    file = tmp_path / "pair.rrd"
    skeleton = Skeleton.load("mouse")
    names, layout = ("animal1", "animal2"), live_blueprint(0.1)
    view = viewer.LiveView("pair", KINECT_V2, SE3.identity(), skeleton, str(file), layout, names)
    row = Track.empty(skeleton, np.zeros(1, np.int64))
    posed = replace(row, joints_mm=np.ones((1, 5, 3)), predicted_error_mm=np.array([2.0]))
    view.show(DepthFrame(0, 0, np.full((424, 512), 700.0, np.float32)), [row, posed])
    view.close()
    assert not [one for one in _rows(file, ERROR) if one.get("frame") is not None]
    for entity in (f"{SKELETON}/bones", f"{ANIMALS}/animal2/bones", f"{ERROR}/animal2"):
        assert [one["frame"] for one in _rows(file, entity) if "frame" in one] == [0]


def test_the_stream_brings_its_layout(followed: tuple[Path, str]) -> None:
    assert len(RrdReader(followed[0]).blueprints()) == 1


def test_it_is_said_how_to_open_it_and_why_there_is_no_latency(followed: tuple[Path, str]) -> None:
    printed = followed[1]
    assert "no latency" in printed, "30 frames are fewer than what is learned from"
    assert followed[0].name in printed


def test_without_a_screen_it_is_said_before_anything_is_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(viewer, "has_screen", lambda: False)
    with pytest.raises(LiexError, match=r"needs a screen.*--to NAME\.rrd"):
        api.follow_live("there/is/no/such.oni", Plan.load("mouse"))
    with pytest.raises(LiexError, match="needs a screen"):
        viewer.begin_viewer()


def test_a_session_is_opened_from_within_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay = tmp_path / "session.rrd"
    replay.touch()
    monkeypatch.chdir(tmp_path)
    assert viewer.replays_with(Path("session.rrd")) == [Path("session.rrd")]
