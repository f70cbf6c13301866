"""The frame tracker: every frame of a recording becomes a row, whatever is in it."""

from dataclasses import fields, replace

import numpy as np
import pytest

from liex_lab.errors import EstimationError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.geometry import so3
from liex_lab.recordings.frame import DepthFrame
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.tracking.own_shape import StatedShape
from liex_lab.tracking.track import Track
from liex_lab.tracking.tracker import FrameTracker
from liex_lab.tracking.trust import single_frames
from tests.estimation.toy import CAMERA, FLOOR, SCENE, Toy, rendered, toy_mice, trained

HOME_MM = 52.8341
NOTHING, BARE = 4, 9  # frames without any depth, and with the floor alone


@pytest.fixture(scope="module")
def toy() -> Toy:
    return toy_mice(24, 31, size=(1.0, 1.0))


@pytest.fixture(scope="module")
def frames(toy: Toy) -> list[DepthFrame]:
    depths = toy.depths.copy()
    depths[NOTHING], depths[BARE] = 0.0, FLOOR.depth(CAMERA.width, CAMERA.height)
    return [DepthFrame(k, 7_000 + 33_333_333 * k, depth) for k, depth in enumerate(depths)]


@pytest.fixture(scope="module")
def scene(toy: Toy) -> BackgroundSubtraction:
    moments = SCENE.extract(toy.depths, 1.0).moments
    return replace(
        SCENE, area_mm2=float(np.median(moments[:, 1])), volume_mm3=float(np.median(moments[:, 2]))
    )


@pytest.fixture(scope="module")
def tracker(toy: Toy, scene: BackgroundSubtraction) -> FrameTracker:
    return FrameTracker.prepare(PoseEstimator(trained("default").model), scene, toy.depths)


def followed(tracker: FrameTracker, frames: list[DepthFrame]) -> Track:
    return single_frames(tracker.subject, tracker.observe(frames))


@pytest.fixture(scope="module")
def track(tracker: FrameTracker, frames: list[DepthFrame]) -> Track:
    return followed(tracker, frames)


def test_every_frame_has_a_row_and_the_empty_ones_say_why(track, frames):
    assert track.n_frames == len(frames)
    np.testing.assert_array_equal(track.times_ns, [frame.time_ns for frame in frames])
    assert np.flatnonzero(~track.observed).tolist() == [NOTHING, BARE]
    assert track.flag[NOTHING] == "no_depth"
    assert track.flag[BARE] == "not_found"
    assert set(track.flag[track.observed]) <= {"", "doubtful"}
    assert track.n_foreground_px[[NOTHING, BARE]].tolist() == [0, 0]


def test_joints_lie_near_the_truth_in_the_arena_frame(track, toy):
    off = np.linalg.norm(track.joints_mm - toy.joints, axis=-1).mean(axis=1)
    assert np.nanmedian(off) < 2.0
    assert np.nanmedian(np.abs(track.spine_mm / toy.skeleton.length - 1.0)) < 0.05


def test_the_columns_of_a_row_agree_with_one_another(track, toy):
    seen = track.observed
    in_camera = FLOOR.T_arena_camera.inverse() @ track.joints_mm[seen]
    np.testing.assert_allclose(track.uv_px[seen], CAMERA.project(in_camera), atol=1e-8)
    np.testing.assert_allclose(track.root_mm[seen], track.joints_mm[seen, 0], atol=1e-9)
    bone = track.root_rotation[seen] @ toy.skeleton.offsets[1] * track.scale[seen, None]
    np.testing.assert_allclose(track.joints_mm[seen, 1] - track.joints_mm[seen, 0], bone, atol=1e-9)
    first = so3.exp(track.angles_rad[seen, 1])
    second = np.einsum("nij,njk,k->ni", track.root_rotation[seen], first, toy.skeleton.offsets[2])
    along = track.joints_mm[seen, 2] - track.joints_mm[seen, 1]
    np.testing.assert_allclose(along, second * track.scale[seen, None], atol=1e-9)


def test_the_centroid_is_that_of_the_pixels_that_show_the_animal(track, toy):
    seen = track.observed
    bare = FLOOR.depth(CAMERA.width, CAMERA.height)
    shown = rendered(toy.skeleton, toy.pose) < bare - 7.0
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    middle = np.array([[columns[s].mean(), rows[s].mean()] for s in shown])
    assert np.abs(track.centroid_px[seen] - middle[seen]).max() < 1.5
    off = track.centroid_mm[seen, :2] - toy.joints[seen].mean(axis=1)[:, :2]
    assert np.linalg.norm(off, axis=1).max() < 10.0
    assert np.ptp(track.n_foreground_px[seen] / shown.sum(axis=(1, 2))[seen]) < 0.5


def test_the_true_body_is_not_far_from_the_observed_surface(track, tracker):
    assert np.nanmedian(track.residual_mm) < 2.0
    assert tracker.body.girth == pytest.approx(1.0, abs=0.1)


def test_rows_do_not_depend_on_how_the_frames_are_dealt_out(tracker, frames, track):
    for size in (1, 7):
        joined = Track.join(
            [followed(tracker, frames[k : k + size]) for k in range(0, len(frames), size)]
        )
        for field in fields(Track):
            if field.name != "skeleton":
                np.testing.assert_array_equal(
                    getattr(joined, field.name), getattr(track, field.name)
                )


def test_the_first_hypothesis_is_the_frames_own_answer_and_the_second_points_the_other_way(
    tracker, frames
):
    seen = tracker.observe(frames)
    alone = tracker.estimator.estimate(
        np.stack([f.depth for f in frames]), tracker.scene, tracker.size
    )
    np.testing.assert_array_equal(seen.known[:, 0], alone.found)
    np.testing.assert_array_equal(seen.error_mm[:, 0], alone.chosen.error_mm.astype(np.float32))
    pose = alone.chosen.pose.moved(tracker.scene.floor.T_arena_camera)
    np.testing.assert_array_equal(seen.place[:, 0], pose.root.translation.astype(np.float32))
    both = seen.known[:, 0] & seen.known[:, 1]
    ends = seen.joints([0, tracker.estimator.skeleton.tip])[both]
    along = ends[:, :, 1] - ends[:, :, 0]
    assert both.sum() > 5
    assert (np.einsum("nd,nd->n", along[:, 0], along[:, 1]) < 0).all()


def test_the_size_is_measured_or_taken_from_the_plan(tracker, toy, scene):
    assert tracker.size_origin == "recording"
    assert tracker.spine_mm == pytest.approx(toy.skeleton.length, rel=0.05)
    estimator = PoseEstimator(trained("default").model)
    stated = FrameTracker.prepare(estimator, scene, toy.depths, spine_mm=55.0)
    assert stated.size_origin == "plan"
    assert stated.spine_mm == pytest.approx(55.0)
    assert stated.size == pytest.approx(55.0 / HOME_MM, rel=1e-4)
    shape = StatedShape(None, 0.8, "2 sessions of m07")
    shared = FrameTracker.prepare(estimator, scene, toy.depths, 55.0, stated=shape)
    assert (shared.spine_mm, shared.body.girth) == (stated.spine_mm, 0.8)


def test_a_frame_is_doubtful_where_more_error_is_expected_than_allowed(toy, scene, frames, track):
    estimator = PoseEstimator(trained("default").model)
    limit = float(np.nanmedian(track.predicted_error_mm))
    strict = followed(FrameTracker.prepare(estimator, scene, toy.depths, doubtful_mm=limit), frames)
    seen = strict.observed
    np.testing.assert_array_equal(
        strict.flag[seen] == "doubtful", strict.predicted_error_mm[seen] > limit
    )
    assert 5 < (strict.flag == "doubtful").sum() < 20
    assert strict.flag[[NOTHING, BARE]].tolist() == ["no_depth", "not_found"]


@pytest.mark.parametrize("spine_mm", [None, 55.0])
def test_a_sample_without_an_animal_is_refused_in_one_sentence(toy, scene, spine_mm):
    bare = np.stack([FLOOR.depth(CAMERA.width, CAMERA.height)] * 5)
    with pytest.raises(EstimationError, match="no animal was found in the sampled frames") as error:
        FrameTracker.prepare(
            PoseEstimator(trained("default").model), scene, bare, spine_mm=spine_mm
        )
    assert "\n" not in str(error.value)
