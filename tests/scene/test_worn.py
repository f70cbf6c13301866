"""Cables are cut out of pictures, and what wears none is not touched."""

import numpy as np

from liex_lab.optics.camera import Camera
from liex_lab.scene.floor import Floor
from liex_lab.scene.learning import learn_scene
from liex_lab.scene.worn import Cable, HeadStage
from tests.scene.staged import shown, walked

CAMERA = Camera(365.0, 365.0, 159.5, 119.5, 320, 240)
FLOOR_MM = 660.0
FLOOR = Floor.from_plane(np.array([0.0, 0.0, 1.0]), FLOOR_MM, CAMERA)
LIMIT = np.full((240, 320), FLOOR_MM - 7.0, np.float32)
LONGEST_MM = 115.0
AREA_MM2 = 190.0
BODY_MM = 25.0


def drawn(heights: np.ndarray) -> np.ndarray:
    return (FLOOR_MM - heights).astype(np.float32)


def mouse(x: float = 0.0, tail: bool = True) -> np.ndarray:
    """Heights (H, W) mm of half an ellipsoid with a snout and a tail, x px to the right."""
    v, u = np.mgrid[:240, :320]
    along = (u - 150.0 - x) * FLOOR_MM / 365.0 / 32.0
    across = (v - 120.0) * FLOOR_MM / 365.0 / 14.0
    heights = BODY_MM * np.sqrt(np.maximum(1.0 - along**2 - across**2, 0.0))
    snout = (abs(v - 120) <= 1) & (u > 160 + x) & (u < 174 + x)
    heights = np.where(snout, np.maximum(heights, 12.0), heights)
    if tail:
        heights[120, int(95 + x) : int(134 + x)] = 9.0
    return heights


def cabled(heights: np.ndarray, x: float = 0.0, over: bool = False) -> np.ndarray:
    """The same with a cable from the head to 260 mm above the floor, in the picture's upper left or
    right.
    """
    out = heights.copy()
    for s in np.linspace(0.0, 1.0, 400):
        u = int(164 + x + (-90 if over else 90) * s)
        v = int(118 - 60 * s)
        high = 34.0 + 226.0 * s
        out[v : v + 3, u : u + 3] = np.maximum(out[v : v + 3, u : u + 3], high)
    return out


def told(pictures: list[np.ndarray]) -> Cable | None:
    return Cable.find(np.stack(pictures), LIMIT, CAMERA, FLOOR, LONGEST_MM, AREA_MM2)


def test_a_cable_is_found_only_where_an_animal_wears_one() -> None:
    bare = [drawn(mouse(x)) for x in range(0, 40, 5)]
    edge = mouse()
    edge[40:42, 60:260] = 160.0  # it flickers high above
    assert told([drawn(cabled(mouse(x), x)) for x in range(0, 40, 5)]) is not None
    for frames in (bare, [drawn(np.zeros((240, 320)))], [drawn(edge)] * 6):
        assert told(frames) is None
    assert told([*bare, drawn(cabled(mouse()))]) is None, "it hangs there in few frames"


def test_without_its_cable_the_animal_looks_as_before() -> None:
    cable = Cable(CAMERA, FLOOR, 138.0)
    for over in (False, True):
        bare = drawn(mouse())
        cut = cable.cut(drawn(cabled(mouse(), over=over))[None], LIMIT)[0]
        animal = bare < LIMIT
        left = (cut > 0) & (cut < LIMIT)
        assert (left & animal).sum() > 0.85 * animal.sum()
        assert (left & ~animal).sum() < 0.05 * animal.sum()
        both = left & animal
        assert np.abs(cut - bare)[both].max() < 12.0
        assert np.abs(cut - bare)[both].mean() < 0.5


def test_a_picture_without_a_cable_is_the_same_to_the_last_bit() -> None:
    rng = np.random.default_rng(4)
    picture = drawn(mouse()) + rng.normal(0.0, 1.5, (240, 320)).astype(np.float32)
    picture[rng.random((240, 320)) < 0.02] = 0.0
    v, u = np.mgrid[:240, :320]
    rearing = drawn(np.where(np.hypot(u - 160, v - 120) < 6.0, 80.0, mouse(tail=False)))
    frames = np.stack([picture, rearing])
    np.testing.assert_array_equal(Cable(CAMERA, FLOOR, 138.0).cut(frames, LIMIT), frames)


def test_every_second_pixel_tells_the_same() -> None:
    cable = Cable(CAMERA, FLOOR, 138.0)
    picture = drawn(cabled(mouse()))[::2, ::2]
    cut = cable.every(2).cut(picture[None], LIMIT[::2, ::2])[0]
    assert ((cut > 0) & (cut < FLOOR_MM - 100.0)).sum() == 0


def test_thin_parts_that_stay_where_they_are_belong_to_the_arena() -> None:
    """A lid's bar over one end of the arena is no cable, though it is cut out of the pictures: what
    lies behind it is hidden. A cable that goes with its animal is worn.
    """
    bar = np.zeros((240, 320))
    bar[60:220, 210:213] = 200.0
    pictures = np.stack([drawn(np.maximum(cabled(mouse(x), x), bar)) for x in range(0, 80, 5)])
    cable = Cable.find(pictures, LIMIT, CAMERA, FLOOR, LONGEST_MM, AREA_MM2)
    assert cable is not None
    cut = cable.cut(pictures, LIMIT)
    known = cable.with_fixed(pictures, cut)
    assert known.fixed is not None
    assert known.fixed[80:200, 209:214].all()
    assert known.fixed.mean() < 0.03
    worn = known.worn(pictures, LIMIT)
    changed = cut != pictures
    assert not worn[:, 80:200, 210:213].any()
    assert worn[0].sum() > 0.6 * (changed[0] & ~known.fixed).sum() > 0
    every = known.every(2)
    assert every.fixed is not None
    np.testing.assert_array_equal(every.fixed, known.fixed[::2, ::2])


# A head stage is cut out of pictures, and what wears none is not touched.


BROAD_MM = 28.0
PX_MM = FLOOR_MM / 365.0


def broad_mouse(x: int = 0) -> np.ndarray:
    """Heights (H, W) mm of half an ellipsoid and a lower head, x px to the right."""
    v, u = np.mgrid[:240, :320]
    heights = np.zeros((240, 320))
    for middle, long, wide, high in ((145.0, 30.0, 15.0, BROAD_MM), (164.0, 16.0, 9.0, 20.0)):
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


def stage_of(pictures: list[np.ndarray]) -> HeadStage | None:
    sample = np.stack([drawn(heights) for heights in pictures])
    return HeadStage.find(sample, LIMIT, CAMERA, FLOOR, AREA_MM2)


PLACES = range(0, 40, 4)


def test_a_head_stage_is_found_where_an_animal_wears_one_and_not_where_it_does_not() -> None:
    worn = stage_of([wearing(broad_mouse(x), x) for x in PLACES])
    assert worn is not None
    assert 0.5 < worn.area_mm2 / (30 * PX_MM**2) < 1.5
    assert stage_of([broad_mouse(x) for x in PLACES]) is None
    assert stage_of([np.zeros((240, 320))]) is None
    few = [broad_mouse(x) for x in PLACES]
    few[3] = wearing(few[3], PLACES[3])
    assert stage_of(few) is None


def test_mice_that_walk_and_rear_wear_no_head_stage() -> None:
    assert learn_scene(shown(walked()[1]), (40.0, 115.0), 60)[0].worn == ()


def test_without_its_head_stage_the_animal_looks_as_before() -> None:
    block = HeadStage(CAMERA, FLOOR, 30 * PX_MM**2)
    bare = drawn(broad_mouse())
    cut = block.cut(drawn(wearing(broad_mouse()))[None], LIMIT)[0]
    animal = bare < LIMIT
    assert ((cut > 0) & (cut < LIMIT))[animal].mean() > 0.97
    off = np.abs(cut - bare)[animal & (cut > 0)]
    assert off.max() < 6.0
    assert off.mean() < 0.5
    np.testing.assert_array_equal(block.cut(bare[None], LIMIT)[0], bare)
