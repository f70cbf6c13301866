"""Rectified on reading: a bent lens and a water surface are gone, and everything else about the
recording stays.
"""

from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest

from liex_lab.optics.camera import RANGINGS, Camera, Distortion, Water
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.rectify import (
    ideal_camera,
    lookup_table,
    rectified,
    rectifier,
    share_lost,
    straight_camera,
)
from tests.oracles.plate import Plate
from tests.oracles.refraction import true_points

CAMERA = Camera(150.0, 152.0, 79.5, 61.0, 160, 120)
BARREL = replace(CAMERA, distortion=Distortion.of("plumb_bob", [-0.25, 0.06, 0.002, -0.001]))
FISHEYE = replace(CAMERA, distortion=Distortion.of("equidistant", [-0.05, 0.01]))
WATER = Water(400.0)
rng = np.random.default_rng(5)
STORED = rng.uniform(300, 800, (9, 120, 160)).astype(np.float32)
STORED[rng.random(STORED.shape) < 0.05] = 0


def recording(camera: Camera = CAMERA) -> Recording:
    return Recording(
        name="r",
        format="images",
        camera=camera,
        times_ns=np.cumsum([5, 30, 31, 90, 30, 30, 29, 30, 30]) * 1_000_000,
        read=lambda k: STORED[k].copy(),
        problems=["odd"],
        truncated=True,
        whole=np.arange(9) != 4,
        metadata={"subject_id": "m01"},
    )


def carried_by_hand(depth: np.ndarray, camera: Camera, water: Water) -> np.ndarray:
    """The loop a reader would write, without the filling of holes: nearest point to a pixel, 0 for
    none.
    """
    ideal = ideal_camera(camera, water)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    points = (
        true_points(water, camera.unproject(np.stack([u, v], -1), 1.0)[..., :2], depth)
        + water.lift_mm
    )
    places = np.floor(ideal.project(points) + 0.5)
    out = np.zeros(depth.shape)
    for row, column in np.argwhere(depth > 0):
        i, j = int(places[row, column, 1]), int(places[row, column, 0])
        if 0 <= i < camera.height and 0 <= j < camera.width:
            z = points[row, column, 2]
            out[i, j] = z if out[i, j] == 0 else min(z, out[i, j])
    return out


def test_a_recording_of_an_ideal_camera_in_air_is_handed_on_untouched() -> None:
    original = recording()
    assert rectified(original) is original
    assert original.optics == {}


@pytest.mark.parametrize("camera", [BARREL, CAMERA, FISHEYE])
def test_everything_but_the_depth_stays(camera: Camera) -> None:
    original = recording(camera)
    seen = rectified(original, WATER)
    for name in (
        "name",
        "format",
        "truncated",
        "n_whole",
        "metadata",
        "gaps",
        "rate_hz",
        "duration_s",
    ):
        assert getattr(seen, name) == getattr(original, name), name
    np.testing.assert_array_equal(seen.times_ns, original.times_ns)
    assert seen.digest() == original.digest()
    assert len(seen) == 9
    assert seen.frame(3).depth.shape == (seen.height, seen.width)
    if camera is CAMERA:
        assert (seen.width, seen.height) == (160, 120)
    assert seen.camera.distortion is None
    assert rectified(seen, WATER) is seen, "the water is undone once"
    assert seen.optics == {
        "distortion": camera.distortion and camera.distortion.to_dict(),
        "water": WATER.to_dict(),
    }


def test_it_is_lazy_and_sliceable() -> None:
    original = recording(BARREL)
    read = MagicMock(wraps=original._read)
    original._read = read
    seen = rectified(original, WATER)
    read.assert_not_called()
    part = seen[2:8:3]
    np.testing.assert_array_equal([f.depth for f in part], [seen.frame(k).depth for k in (2, 5)])
    assert (part.optics, part.digest()) == (seen.optics, original.digest())


def test_closing_closes_the_recording_behind() -> None:
    closed = []
    original = Recording(
        name="r",
        format="x",
        camera=BARREL,
        times_ns=np.arange(3),
        read=lambda k: STORED[k],
        close=lambda: closed.append(1),
    )
    with rectified(original, WATER) as seen:
        assert seen.frame(1).depth.any()
    assert closed == [1]


@pytest.mark.parametrize("camera", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_a_straight_edge_seen_through_a_bent_lens_is_straight_again(camera: Camera) -> None:
    """And every reading is one that the camera made: nothing between the plate and the floor."""
    plate = Plate(600.0, 300.0, centre=(60.0, 20.0), turn=0.2)
    bent, straight = plate.depth(camera).astype(np.float32), plate.depth(straight_camera(camera))
    undone = rectifier(camera)(bent)
    read = undone > 0
    assert set(np.unique(undone)) <= {0.0, 580.0, 600.0}
    wrong = (np.abs(undone - straight)[read] > 1).mean()
    before = (np.abs(bent - plate.depth(CAMERA)) > 1).mean()
    assert wrong < 0.005, "but for half a pixel at the edge"
    assert before > 3 * wrong


def test_the_lookup_table_takes_the_nearest_pixel() -> None:
    table = lookup_table(BARREL)
    for v, u in [(0, 0), (60, 80), (119, 159), (30, 120)]:
        place = BARREL.project(straight_camera(BARREL).unproject([u, v], 1.0))
        column, row = np.rint(place).astype(int)
        inside = 0 <= row < 120 and 0 <= column < 160
        assert table[v, u] == (row * 160 + column if inside else -1)


@pytest.mark.parametrize(
    "water", [WATER, Water(450.0, 1.34, 0.05, -0.08, "structured_light"), Water(900.0)]
)
def test_fast_and_slow_agree(water: Water) -> None:
    depth = STORED[0]
    slow = carried_by_hand(depth, CAMERA, water)
    fast = rectifier(CAMERA, water)(depth)
    reached = slow > 0
    assert (np.abs(fast - slow)[reached] > 0.05).mean() < 0.002, (
        "but for points on the border of two pixels"
    )


@pytest.mark.parametrize("ranging", RANGINGS[:3])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.06, -0.04)])
def test_the_floor_of_a_tank_is_flat_and_as_deep_as_it_is(
    ranging: str, tilt: tuple[float, float]
) -> None:
    water = Water(400.0, 1.333, *tilt, ranging)
    plate = Plate(600.0, 120.0)
    undone = rectifier(CAMERA, water)(plate.depth(CAMERA, water).astype(np.float32))
    heights = plate.floor_mm + water.lift_mm[2] - undone[undone > 0]
    assert (np.minimum(np.abs(heights), np.abs(heights - 20.0)) < 0.1).all()
    assert (undone[10:-10, 10:-10] > 0).all(), "and without holes"


def test_unread_stays_unread_and_only_cracks_are_closed() -> None:
    water = Water(400.0)
    depth = np.full((120, 160), 550.0, np.float32)
    depth[40:60, 50:80] = 0.0
    depth[80, 100] = 0.0
    undone = rectifier(CAMERA, water)(depth)
    inner = undone[20:100, 20:140]
    assert (inner == 0).sum() == pytest.approx(20 * 30 + 1, rel=0.03)
    assert (undone[42:58, 53:77] == 0).all()


@pytest.mark.parametrize(
    ("camera", "most"),
    [(BARREL, 0.07), (FISHEYE, 0.07), (replace(CAMERA, distortion=Distortion.of("", [0.1])), 0.0)],
)
def test_the_straight_picture_holds_what_the_bent_one_held(camera: Camera, most: float) -> None:
    straight = straight_camera(camera)
    assert (straight.width % 4, straight.height % 4) == (0, 0)
    assert straight.width * straight.height < 1.8 * 160 * 120
    assert (straight.fx, straight.fy) == (camera.fx, camera.fy)
    assert share_lost(camera) <= most
    middle = np.array([[80.0, 60.0]])
    off = straight.project(camera.unproject(middle, 1.0)) - straight.project(
        CAMERA.unproject(middle, 1.0)
    )
    assert np.abs(off).max() < 0.5, "and the middle keeps its detail"


def test_much_that_leaves_the_picture_is_told() -> None:
    seen = rectified(recording(replace(CAMERA, distortion=Distortion.of("plumb_bob", [-0.5]))))
    assert any("leave the image" in problem for problem in seen.problems)
    assert not any(
        "leave the image" in problem for problem in rectified(recording(CAMERA), WATER).problems
    )
