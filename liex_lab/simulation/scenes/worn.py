"""What animals wear: a head stage, and a cable from it to a commutator above the arena.

The head's own frame is the neck joint's, moved to a station between neck and nose. The cable has a
constant length l and, between two ends d apart, bows sideways by half a sine of amplitude
a = (2 / pi) sqrt(d (l - d)), whose length is l to second order; it leaves the head along the head's
up, and which way it bows wanders slowly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.simulation.locomotion import smoothed
from liex_lab.simulation.scenes.meshes import Mesh, box, cables

Array = NDArray[np.float64]

HEAD_STAGE_MM = (10.0, 8.0, 12.0)
PLUG_MM = (5.0, 5.0, 7.0)
_NECK = -2  # joint: the head's bone begins there
_AT_STATION = 0.83  # of the spine: behind the eyes
_RINGS = 30


def on_head(skeleton: Skeleton, pose: Pose, shape: BodyShape, girth: Array) -> SE3:
    """Where something cemented to the skull stands.

    Args:
        skeleton: of the animal, a chain.
        pose: (n) arena frame.
        shape: its body, or n bodies.
        girth: (n,) factor of all lengths across the body.

    Returns:
        (n) T_arena_mount: x forward, z up from the skull, the origin on the skin.
    """
    frames = pose.frames(skeleton)
    stations = np.asarray(skeleton.surface["stations"], float)
    k = int(np.searchsorted(stations, _AT_STATION)) - 1
    share = (_AT_STATION - stations[k]) / (stations[k + 1] - stations[k])
    thick = (1.0 - share) * shape.half_height[..., k] + share * shape.half_height[..., k + 1]
    reach = np.linalg.norm(skeleton.offsets[1:], axis=1)
    ahead = (_AT_STATION * reach.sum() - reach[: _NECK + 1].sum()) * pose.scale
    local = np.stack([ahead, np.zeros_like(ahead), thick * girth], axis=-1)
    rotation = frames.rotation[:, _NECK]
    shift = np.einsum("nij,nj->ni", rotation, local)
    return SE3(rotation, frames.translation[:, _NECK] + shift)


def stage_on(mount: SE3, sides_mm: tuple[float, float, float]) -> tuple[Array, NDArray[np.int32]]:
    """A block on the head.

    Args:
        mount: (n) T_arena_mount.
        sides_mm: its length, width and height.

    Returns:
        Vertices (n, V, 3) mm, arena frame, and faces (F, 3).
    """
    half = 0.5 * np.array(sides_mm)
    block = box([0.0, 0.0, half[2] - 1.0], half)
    placed = np.einsum("nij,vj->nvi", mount.rotation, block.vertices) + mount.translation[:, None]
    return placed, block.faces


def tether(
    rng: np.random.Generator, mount: SE3, commutator: Array, thick_mm: float
) -> tuple[Array, NDArray[np.int32]]:
    """A flexible cable from the head to a commutator.

    Args:
        rng: source of randomness.
        mount: (n) T_arena_mount.
        commutator: (3,) mm, arena frame.
        thick_mm: its diameter, mm.

    Returns:
        Vertices (n, V, 3) mm, arena frame, and faces (F, 3).
    """
    n = len(mount.translation)
    way = rng.uniform(-np.pi, np.pi) + np.cumsum(smoothed(rng.normal(0.0, 0.12, (n, 1)), 12.0))
    longest = float(np.linalg.norm(commutator - mount.translation, axis=-1).max())
    length = np.full(n, longest * rng.uniform(1.03, 1.08))
    return cables(_hanging(mount, commutator, length, way), 0.5 * thick_mm)


def _hanging(mount: SE3, commutator: Array, length: Array, way: Array) -> Array:
    """Midlines (n, R, 3) mm of cables that bow towards `way` (n,) rad; `length` (n,) mm."""
    start = mount.translation + PLUG_MM[2] * mount.rotation[..., 2]
    span = commutator - start
    apart = np.linalg.norm(span, axis=-1)
    bow = 2.0 / np.pi * np.sqrt(apart * np.maximum(length - apart, 0.0))
    side = np.stack([np.cos(way), np.sin(way), np.full(len(way), -0.15)], axis=-1)
    s = np.linspace(0.0, 1.0, _RINGS)[:, None]
    straight = start[:, None] + s * span[:, None]
    swing = (bow[:, None] * side)[:, None] * np.sin(np.pi * s)
    # stiff where it leaves the plug: it goes up from the head before it bends over
    stiff = (25.0 * mount.rotation[..., 2])[:, None] * (s * np.exp(-((s / 0.12) ** 2)) / 0.06)
    return np.asarray(straight + swing + stiff)


def draw_worn(
    rng: np.random.Generator,
    skeleton: Skeleton,
    pose: Pose,
    shape: BodyShape,
    girth: Array,
    share: float,
    per_session: int,
) -> tuple[Array, NDArray[np.int32], NDArray[np.bool_]]:
    """Head stages and cables of animals in independent postures, for training pictures.

    Half of the animals that wear anything wear a head stage of 6 to 14 mm a side, the others a plug
    and a cable of 2 to 5 mm to a commutator of their own.

    Args:
        rng: source of randomness.
        skeleton: of the animals, a chain.
        pose: (n) arena frame.
        shape: (n) their bodies.
        girth: (n,) factors of all lengths across the bodies.
        share: of the animals that wear something.
        per_session: consecutive postures that are of one animal.

    Returns:
        Vertices (n, V, 3) mm, arena frame, faces (F, 3), and which postures wear them (n,).
    """
    n = len(girth)
    each = np.arange(n) // per_session
    m = int(each[-1]) + 1
    wears = rng.random(m) < share
    tethered = rng.random(m) < 0.5
    blocks = rng.uniform([7.0, 6.0, 7.0], [14.0, 10.0, 14.0], (m, 3))
    sides = np.where(tethered[:, None], np.array(PLUG_MM), blocks)[each]
    mount = on_head(skeleton, pose, shape, girth)
    block = box([0.0, 0.0, 0.0], [0.5, 0.5, 0.5])
    local = block.vertices * sides[:, None]
    local[..., 2] += 0.5 * sides[:, None, 2] - 1.0
    stage = np.einsum("nij,nvj->nvi", mount.rotation, local) + mount.translation[:, None]
    away = rng.uniform(0.0, 160.0, m)[each]
    towards = rng.uniform(-np.pi, np.pi, n)
    high = rng.uniform(180.0, 320.0, m)[each]
    above = np.stack([away * np.cos(towards), away * np.sin(towards), high], axis=-1)
    commutator = mount.translation + above
    length = np.linalg.norm(above, axis=-1) * rng.uniform(1.0, 1.15, n)
    curves = _hanging(mount, commutator, length, rng.uniform(-np.pi, np.pi, n))
    cable, faces = cables(curves, 0.5 * rng.uniform(2.0, 5.0, m)[each])
    cable = np.where(tethered[each][:, None, None], cable, stage[:, :1])  # one point draws nothing
    joined_faces = np.concatenate([block.faces, faces + np.int32(len(block.vertices))])
    return np.concatenate([stage, cable], axis=1), joined_faces.astype(np.int32), wears[each]


def holder(commutator: Array) -> list[Mesh]:
    """The commutator and the arm that holds it over the arena.

    Args:
        commutator: (3,) mm, arena frame.

    Returns:
        The meshes.
    """
    x, y, z = commutator
    return [
        box([x, y, z + 14.0], [11.0, 11.0, 14.0]),
        box([x, y + 400.0, z + 28.0], [7.0, 400.0, 7.0]),
    ]
