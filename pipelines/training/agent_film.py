"""A cut-out action as a camera sees it: poses of all its frames, and what is seen in some of them.

Points are those pixels of the rendered patch that lie nearer than the empty ground and beside the
animal's joints, in the arena frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.foreground.height_maps import Patches
from liex_lab.geometry import SE3
from liex_lab.simulation.agents.render import render_agent

from .agent_tracks import Scenario, staged

Array = NDArray[np.float64]

_WINDOW_PX = 128
_ABOVE_GROUND_MM = 4.0  # a pixel so far before the empty ground shows the animal or is noise
_NEAR = 0.25  # of the body's length: what is farther from every joint is noise


@dataclass(frozen=True)
class Film:
    """An action of n frames.

    Attributes:
        joints: (n, J, 3) true joints, mm, arena frame.
        rows: (k,) the key frames among them.
        points: of each key frame (m, 3) what the camera sees of the animal, mm, arena frame.
        edges: pairs of joints that a bone connects.
    """

    joints: Array
    rows: NDArray[np.int64]
    points: list[Array]
    edges: list[tuple[int, int]]


def filmed_at(scenario: Scenario, n_key_frames: int) -> Film:
    """An action acted, and rendered at key frames that are evenly spread over it.

    Args:
        scenario: a cut-out action; what comes before and after it is left out.
        n_key_frames: number of key frames, the first and the last frame among them.
    """
    rng = np.random.default_rng([scenario.individual, scenario.seed])
    motion, steps, pose, girth, walls, species, camera, shape, _ = staged(scenario, rng)
    inside = np.flatnonzero(motion.word[steps] == scenario.word)
    rows = np.linspace(0, len(inside) - 1, min(n_key_frames, len(inside))).round().astype(int)
    at = inside[rows]
    near = None if walls is None else walls[at]
    (seen,) = render_agent(rng, species, camera, shape, pose[at], girth[at], near, _WINDOW_PX)
    joints = pose[inside].joints(species.skeleton)
    reach = _NEAR * species.skeleton.length
    points = [
        _beside(_points(seen, k, camera.T_arena_camera), joints[row], reach)
        for k, row in enumerate(rows)
    ]
    return Film(joints, rows, points, list(species.skeleton.edges))


def _points(seen: Patches, k: int, T_arena_camera: SE3) -> Array:
    """What patch k shows before the ground, (m, 3) mm, arena frame."""
    depth = seen.depth[k].astype(float)
    v, u = np.nonzero((depth > 0) & (seen.background[k] - depth > _ABOVE_GROUND_MM))
    fx, fy, cx, cy = seen.intrinsics[k]
    z = depth[v, u]
    x = (u + seen.origin[k, 0] - cx) / fx * z
    y = (v + seen.origin[k, 1] - cy) / fy * z
    return np.asarray(T_arena_camera @ np.stack([x, y, z], axis=-1))


def _beside(points: Array, joints: Array, reach_mm: float) -> Array:
    """Those of the points (m, 3) that are near a joint."""
    off = np.linalg.norm(points[:, None] - joints[None], axis=-1).min(axis=1)
    return np.asarray(points[off < reach_mm])
