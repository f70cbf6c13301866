"""Animals that touch are explained by their bodies together."""

from dataclasses import replace

import numpy as np
import pytest
from liex_lab.pipelines.build import build_joint_tracker, build_tracker

from liex_lab.errors import EstimationError
from liex_lab.geometry import SE3
from liex_lab.plan import Plan
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.scenes.catalogue import film
from liex_lab.tracking.covered import covered_stretches, measure_covered
from liex_lab.tracking.identity import identify
from liex_lab.tracking.joint import JointTracker
from liex_lab.tracking.observations import COLUMNS, Observations

TOUCH = slice(50, 58)
ON_TOP = slice(40, 44)
MOUSE = Plan.load("mouse")


@pytest.fixture(scope="module")
def recording() -> RenderedRecording:
    """Two mice, the second beside the first, or on it, and as it stands in some frames."""
    stage = film("two-animals", 3, 60).stage
    first, second = stage.actors
    move = SE3.identity(60)
    side = np.cross([0.0, 0.0, 1.0], first.joints[:, -1] - first.joints[:, 0])
    move.translation[:] = 24.0 * side / np.linalg.norm(side, axis=1, keepdims=True)
    move.translation[ON_TOP] = (0.0, 0.0, 24.0)
    beside = first.pose.moved(move)
    root = SE3(second.pose.root.rotation.copy(), second.pose.root.translation.copy())
    angles = second.pose.angles.copy()
    for rows in (TOUCH, ON_TOP):
        root.rotation[rows] = beside.root.rotation[rows]
        root.translation[rows] = beside.root.translation[rows]
        angles[rows] = beside.angles[rows]
    pose = replace(second.pose, root=root, angles=angles)
    return RenderedRecording("touch", replace(stage, actors=(first, replace(second, pose=pose))))


@pytest.fixture(scope="module")
def joint(recording: RenderedRecording) -> JointTracker:
    return build_joint_tracker(recording, MOUSE, build_tracker(recording, MOUSE), 2)


def errors(recording: RenderedRecording, joint: JointTracker, rows: slice) -> np.ndarray:
    """(2, n, 2) mm between each animal and each component's better direction, NaN if unseen."""
    frames = [recording.frame(k) for k in range(rows.start, rows.stop)]
    return off_mm(recording, joint, rows, joint.observe(frames)[0])


def off_mm(
    recording: RenderedRecording, joint: JointTracker, rows: slice, seen: Observations
) -> np.ndarray:
    """`errors` of the observations of some frames."""
    inverse = recording.stage.scene.T_arena_camera @ joint.scene.floor.T_arena_camera.inverse()
    joints = inverse @ np.stack(
        [seen.joints_as(h, range(seen.skeleton.n_joints)) for h in range(4)], axis=1
    ).astype(float)
    off = np.array(
        [
            np.linalg.norm(joints - actor.joints[rows, None], axis=-1)
            for actor in recording.stage.actors
        ]
    ).mean(axis=-1)
    return np.fmin(off[..., ::2], off[..., 1::2])


def test_both_bodies_lie_where_they_are_apart_and_side_by_side(
    recording: RenderedRecording, joint: JointTracker
) -> None:
    for rows, most_mm in ((slice(46, 50), 5.0), (TOUCH, 10.0)):
        best = errors(recording, joint, rows)
        assert np.isfinite(best).all()
        own = np.minimum(best[0, :, 0] + best[1, :, 1], best[0, :, 1] + best[1, :, 0]) / 2.0
        assert np.median(own) < most_mm


def test_an_animal_on_top_of_another_is_measured_where_it_is(
    recording: RenderedRecording, joint: JointTracker
) -> None:
    upper = errors(recording, joint, ON_TOP)[1]
    assert np.nanmin(upper, axis=1).max() < 12.0


def test_an_animal_that_another_one_covers_is_held_where_it_lay(
    recording: RenderedRecording, joint: JointTracker
) -> None:
    rows = slice(24, 58)
    frames = [recording.frame(k) for k in range(rows.start, rows.stop)]
    seen = joint.observe(frames)
    before = [one.copied(np.empty) for one in seen]
    length_mm = joint.trackers[0].spine_mm
    slots = identify(seen, [tracker.subject for tracker in joint.trackers]).slots
    stretches = covered_stretches(seen, length_mm)
    on_top = np.arange(ON_TOP.start, ON_TOP.stop) - rows.start
    assert np.isin(on_top, np.concatenate([some for some, _ in stretches])).all()
    for some, near in stretches:
        measure_covered(joint, [frames[k] for k in some], some, near, seen, slots)
    best = off_mm(recording, joint, rows, seen[0])[:, on_top]
    assert best[1, :, 0].max() < 12.0  # the upper one
    assert best[0, :, 1].max() < 10.0  # the lower one
    # what is hidden is not evidence
    assert (seen[0].n_px[on_top, 2] < 0.5 * seen[0].n_px[on_top, 0]).all()
    others = np.setdiff1d(np.arange(len(frames)), np.concatenate([some for some, _ in stretches]))
    for name in COLUMNS:
        for one, was in zip(seen, before, strict=True):
            np.testing.assert_array_equal(getattr(one, name)[others], getattr(was, name)[others])


def test_more_animals_than_stand_apart_are_refused(
    recording: RenderedRecording, joint: JointTracker
) -> None:
    with pytest.raises(EstimationError, match=r"animal\.count is 3, but hardly a frame"):
        build_joint_tracker(recording, MOUSE, joint.trackers[0], 3)
