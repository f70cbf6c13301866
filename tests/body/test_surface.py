"""The surface around a skeleton: closed, the right size, moving with the body; and the families of
shapes.
"""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from liex_lab.body import Pose, Skeleton
from liex_lab.body.shape import BodyShape, Surface
from liex_lab.body.variation import FAMILIES, draw_shapes, draw_tail_bends
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3

MOUSE = Skeleton.load("mouse")
STATIONS = np.array(MOUSE.surface["stations"])


def on_floor(n: int, scale: float = 1.23, height_mm: float = 20.0) -> Pose:
    pose = Pose.home(MOUSE, n)
    pose.root.translation[:, 2] = height_mm
    return Pose(pose.root, pose.angles, np.full(n, scale))


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_triangles_close_the_surface_and_face_outward(animal: str) -> None:
    skeleton = Skeleton.load(animal)
    surface = Surface.of(skeleton)
    edges = Counter((int(f[k]), int(f[(k + 1) % 3])) for f in surface.faces for k in range(3))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    a, b, c = np.moveaxis(surface.vertices(Pose.home(skeleton))[surface.faces], 1, 0)
    assert np.sum(np.cross(a, b) * c) > 0  # the volume


def test_the_trunk_moves_rigidly_with_its_root_and_scales_with_the_animal() -> None:
    rng = np.random.default_rng(0)
    surface = Surface.of(MOUSE)
    angles = rng.uniform(-0.5, 0.5, (5, 3)) * MOUSE.axes
    angles[0] = 0
    pose, T = Pose(SE3.identity(), angles, np.array(1.0)), SE3.exp(rng.uniform(-2, 2, 6))
    moved = surface.vertices(pose.moved(T))
    np.testing.assert_allclose(moved, T @ surface.vertices(pose), atol=1e-9)
    one, two = on_floor(1, 1.0, 0.0), on_floor(1, 2.0, 0.0)
    np.testing.assert_allclose(surface.vertices(two), 2.0 * surface.vertices(one), atol=1e-9)


def test_a_users_own_animal_needs_only_a_table() -> None:
    table = {
        "name": "worm",
        "joints": [{"name": "a"}, {"name": "b", "parent": "a", "offset_mm": [10, 0, 0]}],
        "surface": {"radii_mm": [2.0, 1.0]},
    }
    worm = Skeleton.from_table(table, "worm.toml")
    assert np.ptp(Surface.of(worm).vertices(Pose.home(worm))[:, 0]) == pytest.approx(13.0)
    table["surface"] = {"radii_mm": [2.0]}
    with pytest.raises(LiexError, match="one positive number for each of its 2 joints"):
        Surface.of(Skeleton.from_table(table, "worm.toml"))


@pytest.mark.parametrize("family", FAMILIES)
def test_shapes_are_bodies_and_follow_the_seed(family: str) -> None:
    shapes = draw_shapes(np.random.default_rng(5), MOUSE, family, 300)
    again = draw_shapes(np.random.default_rng(5), MOUSE, family, 300)
    np.testing.assert_array_equal(shapes.half_width, again.half_width)
    assert np.isfinite(shapes.half_width).all()
    assert np.isfinite(shapes.half_height).all()
    assert (shapes.half_width[:, 1:-1] > 0).all()
    assert shapes.half_width.max(axis=1).min() > 6.0
    assert shapes.half_width.max() < (
        40.0 if family in ("augmented", "wide") else 25.0
    )  # these two leave the range of mice


def test_the_tail_lies_on_the_floor_behind_the_animal() -> None:
    rng = np.random.default_rng(8)
    surface, pose = Surface.of(MOUSE), on_floor(20)
    shape = replace(BodyShape.default(MOUSE))
    vertices = surface.vertices(pose, shape, bends=0.3 * draw_tail_bends(rng, 20))
    tail = vertices[:, -80:]
    assert (tail[..., 2] > -1.5).all()
    assert np.median(tail[:, -30:, 2]) < 6.0
    assert (tail[:, -1, 0] < vertices[:, 0, 0]).all()
