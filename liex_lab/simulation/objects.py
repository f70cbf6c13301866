"""Superellipsoid meshes of distractors: blocks, balls, cables, hands, pellets, plants, fish.

A superellipsoid is |x / a|^p + |y / b|^p + |z / c|^p = 1: p = 2 is an ellipsoid, a large p a block
with rounded edges. A unit sphere's vertices are scaled to it along their rays (`rounded`). Every
object has `N_PARTS` parts, so that all meshes share one table of triangles, `THING_FACES`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.body._skinning_kernels import joined_faces

Array = NDArray[np.float64]

THINGS = ("block", "ball", "cable", "hand")
N_PARTS = 8
_RINGS = 7
_SEGMENTS = 14


def _unit_sphere() -> Array:
    """Vertices (V, 3) of a sphere as a tube: pole, rings, pole."""
    rows = [[-1.0, 0.0, 0.0]]
    for theta in np.pi * np.arange(1, _RINGS + 1) / (_RINGS + 1):
        rows += [
            [-np.cos(theta), np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)]
            for phi in 2 * np.pi * np.arange(_SEGMENTS) / _SEGMENTS
        ]
    return np.array([*rows, [1.0, 0.0, 0.0]])


SPHERE = _unit_sphere()
THING_FACES = joined_faces([(_RINGS, _SEGMENTS)] * N_PARTS)
PART_FACES = joined_faces([(_RINGS, _SEGMENTS)])


def rounded(centre: Array, radii: Array, yaw: Array, power: Array) -> Array:
    """Vertices of superellipsoids, turned about the vertical.

    Args:
        centre: (..., 3) centres, mm.
        radii: (..., 3) half axes, mm.
        yaw: (...) turn about the z axis, rad.
        power: (...) exponent; 2 is an ellipsoid, a large power a block.

    Returns:
        (..., V, 3) mm, with triangles as in `PART_FACES`.
    """
    p = np.asarray(power, float)[..., None, None]
    unit = SPHERE / (np.abs(SPHERE) ** p).sum(axis=-1, keepdims=True) ** (1.0 / p)
    local = unit * np.asarray(radii, float)[..., None, :]
    c = np.cos(yaw)[..., None]
    s = np.sin(yaw)[..., None]
    turned = np.stack(
        [
            c * local[..., 0] - s * local[..., 1],
            s * local[..., 0] + c * local[..., 1],
            local[..., 2],
        ],
        -1,
    )
    return turned + np.asarray(centre, float)[..., None, :]


def _pellet(
    rng: np.random.Generator, spine_mm: float, centre: Array, radii: Array, yaw: Array
) -> None:
    """A lump of food on its way down."""
    radii[0] = spine_mm * rng.uniform(0.04, 0.13) * rng.uniform(0.7, 1.0, 3)
    centre[0, 2] = radii[0, 2] + spine_mm * rng.uniform(0.0, 2.0)


def _plant(
    rng: np.random.Generator, spine_mm: float, centre: Array, radii: Array, yaw: Array
) -> None:
    """A tuft of thin leaves that stand in the water."""
    for k in range(N_PARTS):
        tall = spine_mm * rng.uniform(0.3, 0.9)
        radii[k] = [spine_mm * rng.uniform(0.02, 0.05), spine_mm * rng.uniform(0.03, 0.10), tall]
        centre[k] = [*rng.normal(0.0, 0.12, 2) * spine_mm, 0.9 * tall]
        yaw[k] = rng.uniform(-np.pi, np.pi)


def _fish(
    rng: np.random.Generator, spine_mm: float, centre: Array, radii: Array, yaw: Array
) -> None:
    """Another fish, well smaller than the animal: a body and a tail."""
    long = spine_mm * rng.uniform(0.30, 0.55)
    heading = rng.uniform(-np.pi, np.pi)
    ahead = np.array([np.cos(heading), np.sin(heading)])
    lift = spine_mm * rng.uniform(0.15, 1.5)
    for k, (at, length, wide, high) in enumerate(
        [(0.12, 0.40, 0.075, 0.11), (-0.32, 0.22, 0.02, 0.07)]
    ):
        centre[k] = [*(at * long * ahead), lift]
        radii[k] = long * np.array([length, wide, high])
        yaw[k] = heading


_IN_WATER = {"pellet": _pellet, "plant": _plant, "fish": _fish}


def draw_thing(rng: np.random.Generator, kind: str, spine_mm: float) -> Array:
    """Vertices of one random object that stands on the floor around the origin.

    Blocks and balls are from a third of to somewhat over the animal's size; pellets sink, plants
    stand and another fish swims in a tank. Unused parts shrink to nothing.

    Args:
        rng: source of randomness.
        kind: 'block', 'ball', 'cable', 'pellet', 'plant' or 'fish'; anything else is a hand.
        spine_mm: length of the animal, mm, which sets the size; cable and hand have one of their
            own.

    Returns:
        (N_PARTS * V, 3) mm, arena frame, with triangles as in `THING_FACES`.
    """
    centre = np.zeros((N_PARTS, 3))
    radii = np.zeros((N_PARTS, 3))
    yaw = np.zeros(N_PARTS)
    power = np.full(N_PARTS, 2.0)
    if kind in ("block", "ball"):
        radii[0] = spine_mm * rng.uniform(0.16, 0.55, 3) * [1.0, 0.75, 0.6]
        if kind == "block":
            yaw[0] = rng.uniform(-np.pi, np.pi)
            power[0] = 12.0
        else:
            radii[0] = radii[0].mean() * rng.uniform(0.9, 1.1, 3)
        centre[0, 2] = radii[0, 2]
    elif kind in _IN_WATER:
        _IN_WATER[kind](rng, spine_mm, centre, radii, yaw)
    elif kind == "cable":
        step = rng.uniform(10, 22)
        thick = rng.uniform(3, 7)
        heading = rng.uniform(-3, 3)
        bend = rng.normal(0, 0.25)
        at = np.array([-3.5 * step * np.cos(heading), -3.5 * step * np.sin(heading)])
        for k in range(N_PARTS):
            centre[k] = [*at, thick]
            radii[k] = [0.8 * step, thick, thick]
            yaw[k] = heading
            at = at + step * np.array([np.cos(heading), np.sin(heading)])
            heading += bend + rng.normal(0, 0.15)
    else:
        lift = rng.uniform(0, 50)
        size = rng.uniform(0.8, 1.1)
        pointing = rng.uniform(-np.pi, np.pi)
        centre[0] = [0, 0, lift + 16]
        radii[0] = size * np.array([42.0, 38.0, 15.0])
        power[0] = 3.0
        yaw[0] = pointing
        for k in range(1, 6):
            fan = pointing + (k - 3) * 0.28
            reach = size * (70.0 if k < 5 else 55.0)
            centre[k] = [reach * np.cos(fan), reach * np.sin(fan), lift + 12]
            radii[k] = size * np.array([34.0, 8.0, 8.0])
            yaw[k] = fan
    return rounded(centre, radii, yaw, power).reshape(-1, 3)
