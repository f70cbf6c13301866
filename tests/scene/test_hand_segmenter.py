"""The hand that is held out: found in front of people and walls, cut from its arm, seen along the
line of sight.
"""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from liex_lab.body import Skeleton
from liex_lab.errors import EstimationError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.formats.images.nyu import LABEL_CAMERA, NyuReference
from liex_lab.recordings.recording import Recording
from liex_lab.scene import _geodesic_kernels as geodesic_kernels
from liex_lab.scene._blob_kernels import BLOCK
from liex_lab.scene.floor import Floor
from liex_lab.scene.hand_segmenter import HandSegmenter, sight_rotations
from liex_lab.scene.height_maps import view_of
from liex_lab.simulation.hand.simulator import HandSpecies
from liex_lab.simulation.recording import RenderedRecording
from tests.oracles.ends import ends_by_hand

HAND = Skeleton.load("hand")
KINECT = Camera(363.9, 363.9, 255.4, 206.3, 512, 424)


def scene_of(camera: Camera) -> HandSegmenter:
    return HandSegmenter(
        camera, Floor.from_plane(np.array([0.0, 0.0, 1.0]), 1000.0, camera), HAND.view
    )


@cache
def people() -> tuple[RenderedRecording, np.ndarray]:
    """Independent pictures of one person's hand, and their depth."""
    session = HandSpecies(HAND).test_split("clean", n_sessions=1)[0]
    return session, session.depths(0, 20)


def joints_in_view(session: RenderedRecording, crop_cameras: np.ndarray) -> np.ndarray:
    T = view_of(crop_cameras)
    return (
        np.einsum("nij,nkj->nki", T.rotation, session.joints_camera[: len(crop_cameras)])
        + T.translation[:, None]
    )


def test_the_hand_is_what_is_cut_out() -> None:
    session, depths = people()
    scene = scene_of(session.camera)
    crops = scene.extract(depths, session.spine_mm / HAND.length)
    assert crops.found.all()
    joints = joints_in_view(session, scene.crop_cameras(crops))
    off = np.linalg.norm(crops.moments[:, 3:5] - joints.mean(axis=1)[:, :2], axis=1)
    assert (off < 70.0).mean() >= 0.95
    assert np.median(off) < 40.0


def test_the_second_candidate_is_cut_into_rows_of_its_own() -> None:
    session, depths = people()
    scene, size = scene_of(session.camera), session.spine_mm / HAND.length
    first, second = scene.extract_both(depths, size)
    np.testing.assert_array_equal(first.heights, scene.extract(depths, size).heights)
    assert second.found.any()
    np.testing.assert_array_equal(second.found, second.n_blobs > 1)


def drawn_arm(
    wrist: tuple[int, int], elbow: tuple[int, int], hand_mm: float, body: bool
) -> np.ndarray:
    """A picture (480, 640) mm: four fingers and a palm beyond the wrist, a forearm that ends at the
    elbow, a chest.
    """
    depth = np.zeros((480, 640), np.float32)
    if body:
        cv2.ellipse(depth, (320, 330), (150, 200), 0.0, 0.0, 360.0, hand_mm + 120.0, -1)
    cv2.line(depth, elbow, wrist, hand_mm + 25.0, 44)
    along = np.subtract(wrist, elbow) / np.linalg.norm(np.subtract(wrist, elbow))
    palm = np.array(wrist) + 35.0 * along
    cv2.circle(depth, tuple(palm.astype(int).tolist()), 34, hand_mm, -1)
    for turn in np.linspace(-0.6, 0.6, 4):
        way = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ along
        cv2.line(
            depth, palm.astype(int).tolist(), (palm + 85.0 * way).astype(int).tolist(), hand_mm, 11
        )
    return depth


@pytest.mark.parametrize(
    ("wrist", "elbow", "body"),
    [
        (
            (320, 100),
            (330, 320),
            False,
        ),  # the fingers touch the border of the picture, the elbow hangs free
        ((540, 240), (330, 250), False),
        ((100, 200), (320, 330), False),
        ((320, 260), (400, 479), True),  # before the chest
        ((250, 300), (640, 340), True),
    ],
)
def test_it_is_the_hand_and_no_elbow_and_no_chest(
    wrist: tuple[int, int], elbow: tuple[int, int], body: bool
) -> None:
    depth = drawn_arm(wrist, elbow, 700.0, body)
    scene = scene_of(LABEL_CAMERA)
    crops = scene.extract(depth[None], 1.0)
    rows, columns = np.nonzero(crops.heights[0])
    u, v = (crops.origin[0] + crops.step[0] * np.stack([columns, rows], axis=-1)).T
    along = np.subtract(wrist, elbow) / np.linalg.norm(np.subtract(wrist, elbow))
    beyond = (u - wrist[0]) * along[0] + (v - wrist[1]) * along[1]
    assert beyond.mean() > 20.0  # px: the palm and the fingers
    assert (depth[v, u] <= 725.0).mean() > 0.97


def test_the_hand_is_found_at_a_size_that_is_off() -> None:
    """The size of a person's hand is found later: what is cut meanwhile must be the hand as
    well.
    """
    session, depths = people()
    scene = scene_of(session.camera)
    true = session.spine_mm / HAND.length
    middles = [
        scene.middles(scene.extract(depths, size)) for size in (0.88 * true, true, 1.12 * true)
    ]
    for other in (middles[0], middles[2]):
        assert (np.linalg.norm(other - middles[1], axis=1) < 60.0).mean() >= 0.95


def test_the_long_axis_points_to_the_fingers() -> None:
    session, depths = people()
    scene = scene_of(session.camera)
    crops = scene.extract(depths, session.spine_mm / HAND.length)
    joints = joints_in_view(session, scene.crop_cameras(crops))
    forward = joints[:, 0] - joints[:, 1:3].mean(axis=1)
    axis = crops.moments[:, 5]
    plain = np.linalg.norm(forward[:, :2], axis=1) > 50.0  # hands that do not point at the camera
    along = np.cos(axis) * forward[:, 0] + np.sin(axis) * forward[:, 1]
    assert (along[plain] > 0).mean() > 0.85


@pytest.mark.parametrize("camera_view", [False, True])
def test_heights_are_the_readings_in_the_view_frame(camera_view: bool) -> None:
    """Every height map, taken back through its look, lies on the depth that it was cut from."""
    session, depths = people()
    scene = scene_of(session.camera)
    crops = scene.extract(depths[:10], 1.0, camera_view=camera_view)
    crop_cameras = scene.crop_cameras(crops, camera_view)
    T_camera_view = view_of(crop_cameras).inverse()
    for k in range(10):
        rows, columns = np.nonzero(crops.heights[k])
        uv = crops.origin[k] + crops.step[k] * np.stack([columns, rows], axis=-1)
        seen = session.camera.unproject(uv, depths[k][uv[:, 1], uv[:, 0]])
        view = view_of(crop_cameras[k : k + 1])
        height = (view.rotation[0] @ seen.T).T[:, 2] + view.translation[0, 2]
        read = depths[k][uv[:, 1], uv[:, 0]] > 0
        assert (
            np.median(np.abs(height - crops.heights[k][rows, columns] / 16.0)[read]) < 3.0
        )  # it is smoothed
        centre = T_camera_view.translation[k] / np.linalg.norm(T_camera_view.translation[k])
        if camera_view:
            np.testing.assert_allclose(view.rotation[0], np.diag([1.0, -1.0, -1.0]), atol=1e-12)
        else:  # the view's axis goes through the middle of the crop
            middle = crops.origin[k] + crops.step[k] * 48.0
            ray = session.camera.unproject(middle, 1.0)
            np.testing.assert_allclose(centre, ray / np.linalg.norm(ray), atol=1e-9)


def test_lines_of_sight_are_turned_upright() -> None:
    points = np.random.default_rng(0).uniform([-300, -300, 400], [300, 300, 1200], (50, 3))
    rotations = sight_rotations(points)
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, 1, 2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12
    )
    assert np.linalg.det(rotations) == pytest.approx(1.0)
    turned = np.einsum("nij,nj->ni", rotations, points)
    np.testing.assert_allclose(turned[:, :2], 0.0, atol=1e-9)
    assert (turned[:, 2] < 0).all()  # the view's z axis points at the camera
    assert (rotations[:, 0, 0] > 0).all()


def test_a_picture_without_a_hand_holds_none() -> None:
    scene = scene_of(LABEL_CAMERA)
    empty, wall, speck = np.zeros((3, 480, 640), np.float32)
    wall[:] = 2500.0
    speck[100:104, 100:110] = 600.0
    crops = scene.extract(np.stack([empty, wall, speck]), 1.0)
    assert not crops.found.any()
    assert (crops.n_blobs == 0).all()
    blank = Recording(
        name="wall", format="test", camera=LABEL_CAMERA, times_ns=np.arange(3), read=lambda k: wall
    )
    with pytest.raises(EstimationError, match="no hand was found in 3 frames"):
        HandSegmenter.learn(blank, HAND.view)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(6))
def test_ends_agree_with_what_a_reader_would_count(seed: int) -> None:
    """Random blots: their ends and how far each sticks out, by the definition of persistence."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(0.0, 1.0, (15, 20)), (0, 0), 1.2)
    blocks = np.where(noise > 0.02, 800.0 + 20.0 * rng.random((15, 20)), 0.0).astype(np.float32)
    labels, areas = np.empty(blocks.shape, np.int32), np.empty(geodesic_kernels.MAX_SURFACES)
    focal, least_mm = 500.0, 2.0 * BLOCK * 800.0 / 500.0
    n = geodesic_kernels.label_surfaces(blocks, labels, focal * focal, 1.0, areas)
    intrinsics = np.array([focal, focal, 40.0, 30.0])
    for surface in geodesic_kernels.list_surfaces(blocks, labels, n, intrinsics):
        position = np.full(blocks.shape, -1, np.int32)
        order, hops = np.empty((blocks.size, 2), np.int32), np.empty(blocks.size, np.int32)
        size = geodesic_kernels.walk(blocks, labels, surface, position, order, hops)
        assert size == (labels == surface.slot).sum()
        tips = np.zeros((geodesic_kernels.MAX_TIPS, 4))
        found = geodesic_kernels.ends(blocks, order, hops, position, size, focal, least_mm, tips, 0)
        expected = ends_by_hand(order[:size], hops[:size], blocks, focal, least_mm)
        assert {tuple(tip[1:3].astype(int)) for tip in tips[:found]} == expected


def read_picture(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


def test_real_hands_before_real_people_are_found(reference_data: Path) -> None:
    files = sorted((reference_data / "hand_kinect2").glob("*.png"))
    depths = np.stack([read_picture(file) for file in files]).astype(np.float32)
    crops = scene_of(KINECT).extract(depths, 1.0)
    assert crops.found.all()
    assert (
        11_000 < crops.moments[:, 1].min() < crops.moments[:, 1].max() < 21_000
    )  # mm^2: a hand, no person, no arm
    at = crops.origin + crops.step[:, None] * 48.0
    assert (
        np.linalg.norm(np.diff(at, axis=0), axis=1).max() < 40.0
    )  # and it is the same one all along
    picture = read_picture(reference_data / "hand_nyu" / "depth_1_0000001.png")
    depth = (picture[..., 1].astype(np.float32) * 256 + picture[..., 0])[None]
    scene = scene_of(LABEL_CAMERA)
    crops = scene.extract(depth, 1.1)
    view, truth = (
        view_of(scene.crop_cameras(crops)),
        NyuReference.load(reference_data / "hand_nyu").truth[0],
    )
    middle = truth.mean(axis=0) @ view.rotation[0].T + view.translation[0]
    assert np.linalg.norm(crops.moments[0, 3:5] - middle[:2]) < 25.0
