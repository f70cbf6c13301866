"""A head stage is cut out of pictures, and what wears none is not touched."""

from __future__ import annotations

import numpy as np

from liex_lab.optics.camera import Camera
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.floor import Floor
from liex_lab.scene.worn import HeadStage
from tests.scene.staged import stage, walk

CAMERA = Camera(365.0, 365.0, 159.5, 119.5, 320, 240)
FLOOR_MM = 660.0
FLOOR = Floor.from_plane(np.array([0.0, 0.0, 1.0]), FLOOR_MM, CAMERA)
LIMIT = np.full((240, 320), FLOOR_MM - 7.0, np.float32)
AREA_MM2 = 190.0
BODY_MM = 28.0
PX_MM = FLOOR_MM / 365.0


def mouse(x: int = 0) -> np.ndarray:
    """Heights (H, W) mm of half an ellipsoid and a lower head, x px to the right."""
    v, u = np.mgrid[:240, :320]
    heights = np.zeros((240, 320))
    for middle, long, wide, high in ((145.0, 30.0, 15.0, BODY_MM), (164.0, 16.0, 9.0, 20.0)):
        along = (u - middle - x) * PX_MM / long
        across = (v - 120.0) * PX_MM / wide
        dome = high * np.sqrt(np.maximum(1.0 - along**2 - across**2, 0.0))
        heights = np.maximum(heights, dome)
    return heights


def wearing(heights: np.ndarray, x: int = 0, high: float = 31.0) -> np.ndarray:
    """The same with a block of 6 x 5 px (11 x 9 mm) on the head."""
    out = heights.copy()
    out[118:123, 163 + x : 169 + x] = high
    return out


def drawn(heights: np.ndarray) -> np.ndarray:
    return (FLOOR_MM - heights).astype(np.float32)


def told(pictures: list[np.ndarray]) -> HeadStage | None:
    sample = np.stack([drawn(heights) for heights in pictures])
    return HeadStage.find(sample, LIMIT, CAMERA, FLOOR, AREA_MM2)


PLACES = range(0, 40, 4)


def test_a_head_stage_is_found_where_an_animal_wears_one_and_not_where_it_does_not() -> None:
    worn = told([wearing(mouse(x), x) for x in PLACES])
    assert worn is not None
    assert 0.5 < worn.area_mm2 / (30 * PX_MM**2) < 1.5
    assert told([mouse(x) for x in PLACES]) is None
    assert told([np.zeros((240, 320))]) is None


def test_mice_that_walk_and_rear_wear_no_head_stage() -> None:
    recording = walk(stage((170.0, 150.0), height_mm=700.0, room=False), 60)
    assert BackgroundSubtraction.learn(recording, (40.0, 115.0), 60)[0].stage is None


def test_what_stands_out_in_few_frames_is_no_head_stage() -> None:
    pictures = [mouse(x) for x in PLACES]
    pictures[3] = wearing(pictures[3], PLACES[3])
    assert told(pictures) is None


def test_without_its_head_stage_the_animal_looks_as_before() -> None:
    block = HeadStage(CAMERA, FLOOR, 30 * PX_MM**2)
    bare = drawn(mouse())
    cut = block.cut(drawn(wearing(mouse()))[None], LIMIT)[0]
    animal = bare < LIMIT
    assert ((cut > 0) & (cut < LIMIT))[animal].mean() > 0.97
    off = np.abs(cut - bare)[animal & (cut > 0)]
    assert off.max() < 6.0
    assert off.mean() < 0.5
    np.testing.assert_array_equal(block.cut(bare[None], LIMIT)[0], bare)
