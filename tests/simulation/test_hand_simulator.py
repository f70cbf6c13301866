"""The world of the hand: pictures from a seed, with the truth in them."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from liex_lab.body import Skeleton
from liex_lab.errors import LiexError
from liex_lab.recordings.formats.images.nyu import N_FIRST_PERSON, NyuReference
from liex_lab.runtime.processes import threads
from liex_lab.simulation.hand.simulator import HandSpecies, find_reference
from liex_lab.simulation.training_patches import PER_SESSION, TrainingPatches

HAND = Skeleton.load("hand")


@cache
def block() -> TrainingPatches:
    (windows,) = HandSpecies(HAND).training_blocks(5, 1)
    return windows


def test_blocks_are_the_same_bits_on_one_core_and_on_two_and_in_any_order() -> None:
    world = HandSpecies(HAND)
    with threads(False):
        first, second = world.training_blocks(5, 2)
    (again,) = world.training_blocks(5, 1, first=1)
    for name in ("depth", "joints_mm", "angles", "origin"):
        np.testing.assert_array_equal(getattr(first, name), getattr(block(), name))
        np.testing.assert_array_equal(getattr(second, name), getattr(again, name))
    assert (first.depth != second.depth).any()


def test_a_joint_lies_behind_the_skin_that_is_seen_there() -> None:
    windows = block()
    size = windows.depth.shape[1]
    p = windows.joints_mm
    uv = p[..., :2] / p[..., 2:] * windows.intrinsics[:, None, :2] + windows.intrinsics[:, None, 2:]
    at = np.round(uv - windows.origin[:, None]).astype(int)
    inside = ((at >= 0) & (at < size)).all(axis=-1)
    assert inside.mean() > 0.9
    k = np.broadcast_to(np.arange(len(p))[:, None], inside.shape)[inside]
    read = windows.depth[k, at[inside][:, 1], at[inside][:, 0]].astype(float)
    behind = (p[..., 2][inside] - read)[read > 0]
    assert (behind > -30.0).mean() > 0.9  # not in front of the skin, noise and outlines apart
    assert 0.0 < np.median(behind) < 25.0


def test_poses_and_joints_are_of_one_hand() -> None:
    windows = block()
    palm = windows.joints_mm[:, 0]
    np.testing.assert_allclose(windows.root.translation, palm, atol=1e-9)
    own = np.linalg.norm(windows.joints_mm[:, 1:] - windows.joints_mm[:, HAND.parents[1:]], axis=-1)
    home = np.linalg.norm(HAND.offsets[1:], axis=-1) * windows.scale[:, None]
    assert np.abs(np.log(own / home)).max() < 0.45  # people differ, but not without bounds
    for start in range(0, len(windows), PER_SESSION):
        rows = slice(start, start + PER_SESSION)
        assert np.ptp(windows.spine_mm[rows]) == 0.0
        bones = own[rows] / windows.scale[rows][:, None]
        assert (np.ptp(bones, axis=0) < 1e-9).all()


def test_splits_are_fixed_and_their_people_differ() -> None:
    world = HandSpecies(HAND)
    clean, again = (world.test_split("clean", n_sessions=2) for _ in range(2))
    np.testing.assert_array_equal(clean[1].joints_camera, again[1].joints_camera)
    np.testing.assert_array_equal(clean[0].depths(3, 5), again[0].depths(3, 5))
    assert clean[0].spine_mm != clean[1].spine_mm
    (hard,) = world.test_split("hard", spine_mm=150.0, n_sessions=1)
    assert (hard.stage.objects[1].moment >= 0).any()
    assert hard.spine_mm == pytest.approx(150.0)
    with pytest.raises(LiexError, match="known are clean, hard, other-body"):
        world.test_split("soft")


def test_with_the_reference_test_postures_are_the_second_persons(
    reference_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in (reference_data / "hand_nyu", tmp_path):
        monkeypatch.setenv("LIEX_NYU", str(folder))
        if folder != tmp_path:
            assert find_reference() == folder
    with pytest.raises(LiexError, match=r"LIEX_NYU should name a folder with nyu_test_14joints"):
        find_reference()
    world = HandSpecies(HAND, reference=reference_data / "hand_nyu")
    assert f"from {N_FIRST_PERSON + 1} on" in world.protocol
    assert "anatomy" in HandSpecies(HAND).protocol
    session = world.test_split("clean", n_sessions=1)[0]
    truth = NyuReference.load(reference_data / "hand_nyu").truth[N_FIRST_PERSON:]
    mine = session.joints_camera - session.joints_camera[:, :1]
    tips = [
        HAND.names.index(f"{finger}_tip")
        for finger in ("little", "ring", "middle", "index", "thumb")
    ]
    theirs = (truth - truth[:, 13:])[:, [0, 2, 4, 6, 8]]
    shape = np.linalg.norm(mine[:, tips][:, :, None] - mine[:, tips][:, None], axis=-1)
    known = np.linalg.norm(theirs[:, :, None] - theirs[:, None], axis=-1)
    scaled = known * session.spine_mm / HAND.length / 0.91
    off = np.abs(shape[:, None] - scaled[None]).mean(axis=(2, 3)).min(axis=1)
    assert np.median(off) < 6.0  # each has its model among the labelled frames


def test_gestures_flow() -> None:
    session = HandSpecies(HAND).motion(3, 60)
    step = np.linalg.norm(np.diff(session.joints_camera, axis=0), axis=-1)
    assert step.max() < 60.0  # mm a frame at 30 frames/s: quick, but no jump
    assert (
        np.linalg.norm(session.joints_camera[0] - session.joints_camera[-1], axis=-1).max() > 30.0
    )
    np.testing.assert_array_equal(session.frame(7).depth, session.depths(7, 8)[0])
