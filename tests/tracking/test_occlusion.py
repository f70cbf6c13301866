"""An animal of which a beam hides one end is put where the end that is seen says."""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface, render_meshes
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import Camera
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.floor import Floor
from liex_lab.tracking.observations import reversed_pose
from liex_lab.tracking.residual import OcclusionCorrection
from tests.scene.staged import bare_floor

FISH = Skeleton.load("fish")
CAMERA = Camera(900.0, 900.0, 159.5, 119.5, 320, 240)
FLOOR = Floor.from_plane(np.array([0.0, 0.0, 1.0]), 300.0, CAMERA)
DEEP, BEAM = 200.0, 100.0


def drawn(turn: float, u: float = 0.0) -> tuple[Pose, np.ndarray]:
    """A fish that swims straight, turned in the picture, its middle u px beside the picture's, and
    its picture.
    """
    rotation = so3.exp(np.array([[0.0, 0.0, turn]])) @ np.diag([1.0, -1.0, -1.0])
    pose = Pose(SE3(rotation, np.zeros((1, 3))), np.zeros((1, FISH.n_joints, 3)), np.ones(1))
    middle = pose.joints(FISH)[0][[0, FISH.tip]].mean(axis=0)
    pose.root.translation[0] = np.array([u / CAMERA.fx * DEEP, 0.0, DEEP]) - middle
    surface = Surface.of(FISH)
    still = SE3(np.eye(3)[None], np.zeros((1, 3)))
    intrinsics = np.array([[CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]])
    picture = render_meshes(
        surface.vertices(pose, girth=np.ones(1)),
        surface.faces,
        still,
        intrinsics,
        np.zeros((1, 2)),
        (CAMERA.width, CAMERA.height),
    )[0]
    return pose, np.where(picture > 0, picture, FLOOR.depth(CAMERA.width, CAMERA.height)).astype(
        np.float32
    )


WHOLE, PICTURE = drawn(0.4)
BARE = bare_floor(CAMERA, FLOOR, 3.0)
KNOWN = BackgroundSubtraction(
    CAMERA, FLOOR, BARE.background, BARE.limit, BARE.on_floor, view=FISH.view
)
SCENE = replace(
    KNOWN, area_mm2=float(KNOWN.extract(PICTURE[None], 1.0, camera_view=True).moments[0, 1])
)
ENDS = OcclusionCorrection.fit(
    FISH, SCENE, WHOLE, SCENE.extract(PICTURE[None], 1.0, camera_view=True), PICTURE[None]
)


def found_in(pose: Pose, shift: float) -> Pose:
    """The pose, moved along its axis by this share of its length."""
    joints = pose.joints(FISH)
    way = shift * (joints[:, FISH.tip] - joints[:, 0])
    return replace(pose, root=SE3(pose.root.rotation, pose.root.translation + way))


def off(pose: Pose, picture: np.ndarray, true: Pose = WHOLE) -> float:
    """How far off, in lengths, its joints are once it has slid."""
    crops = SCENE.extract(picture[None], 1.0, camera_view=True)
    assert crops.n_px[0] > 0
    slid = ENDS.slid(pose, crops, picture[None])
    np.testing.assert_array_equal(slid.root.rotation, pose.root.rotation)
    return float(
        np.linalg.norm(slid.joints(FISH) - true.joints(FISH), axis=-1).mean() / FISH.length
    )


def under_a_beam(side: int, share: float) -> np.ndarray:
    """The picture with a beam that hides about this share of the fish at its base (-1) or its tip
    (1).
    """
    ends = CAMERA.project(WHOLE.joints(FISH)[0])[[0, FISH.tip], 0]
    edge = ends[1 if side > 0 else 0] + side * share * (ends[0] - ends[1])
    u, frame = np.arange(CAMERA.width), PICTURE.copy()
    frame[:, (u - edge) * side * np.sign(ends[1] - ends[0]) > 0] = BEAM
    return frame


@pytest.mark.parametrize(("side", "share"), [(-1, 0.2), (-1, 0.35), (1, 0.5), (1, 0.6)])
def test_a_fish_half_under_a_beam_is_put_where_its_free_end_is(side, share):
    picture = under_a_beam(side, share)
    hidden = 1.0 - (np.abs(picture - DEEP) < 50.0).sum() / (np.abs(PICTURE - DEEP) < 50.0).sum()
    guess = found_in(WHOLE, -0.4 * side * hidden)  # toward what is seen of it
    assert 0.2 < hidden < 0.8
    assert off(guess, picture) < 0.4 * (0.4 * hidden)
    assert off(reversed_pose(FISH, guess), picture, reversed_pose(FISH, WHOLE)) < 0.4 * (
        0.4 * hidden
    )


def test_a_fish_that_leaves_the_picture_is_put_where_its_free_end_is():
    true, picture = drawn(0.0, 140.0)
    side = np.sign(
        CAMERA.project(true.joints(FISH)[0])[FISH.tip, 0]
        - CAMERA.project(true.joints(FISH)[0])[0, 0]
    )
    assert off(found_in(true, -0.1 * side), picture, true) < 0.04


def test_what_is_seen_whole_stays_where_it_is_and_what_is_not_found_is_nowhere():
    crops = SCENE.extract(PICTURE[None], 1.0, camera_view=True)
    assert ENDS.slid(WHOLE, crops, PICTURE[None]).root.translation == pytest.approx(
        WHOLE.root.translation
    )
    gone = crops[np.array([0])]
    gone.n_px[:], gone.heights[:] = 0, 0
    nowhere = ENDS.slid(replace(WHOLE, scale=np.full(1, np.nan)), gone, PICTURE[None])
    assert np.isnan(nowhere.joints(FISH)).all()
