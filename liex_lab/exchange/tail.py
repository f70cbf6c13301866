"""Direction of a tail's first 30 mm, from the depth that a session keeps around its animal.

The height of each frame above the still scene is averaged along rays on the floor that leave the
tail's base, from 10 to 30 mm, up to 90 degrees to either side of straight backward, without
readings of the body. The tail stands out by the contrast of a ray with its surroundings,

    t(a) = (G_5 * h - G_20 * h)(a) / s,

with h the mean heights, G_k a Gaussian over k degrees (and 70 ms), and s the spread of the
floor's noise: 1.48 median absolute deviations of all contrasts of the session. With all directions
and an invisible tail as the hypotheses, the posterior is

    P(a) ~ exp(B max(t(a), 0)^2 / 2),    P(invisible) ~ W x number of directions.

B and W were fitted to virtual mice, so that the tail lies within 30 degrees of the most probable
direction with the stated probability.
"""

from itertools import chain
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from liex_lab.arrays import Array
from liex_lab.sessions import Session
from liex_lab.sessions.cutouts import Kept, meant_to_keep_depth, open_depth, still_scene
from liex_lab.tables.rows import median_step

TAIL = "tail_30mm"
LENGTH_MM = 30.0
_STEP_DEG = 5.0
_TURNS = np.radians(np.arange(-90.0, 90.1, _STEP_DEG))
_REACH_MM = np.arange(10.0, LENGTH_MM + 1.0, 2.0)
_OUTER = _REACH_MM > 20.0
_BODY_MM = 12.0  # higher readings are of the body
_MOST_MM = 6.0  # of a tail on the floor; more does not count
_SMOOTH_S = 0.07
_LEAST_MM = 0.05  # of the floor's noise: composed images have none
_NARROW_DEG, _WIDE_DEG = 5.0, 20.0
_NEAR_DEG = 30.0
_CERTAINTY = 0.7  # B
_INVISIBLE = 1.0  # W


class Tail(NamedTuple):
    """The point of a tail 30 mm from its base, in n frames; NaN where it was not searched.

    Attributes:
        xyz_mm: (n, 3) the point, mm, arena frame.
        sd_mm: (n, 3) its standard deviations, mm.
        probability: (n,) that the tail is visible, and within 30 degrees of its direction.
        turn: (n,) its direction from the base, rad from straight backward, positive to the animal's
            left.
        lift: (n,) rad, from the base to the point, above the horizontal.
    """

    xyz_mm: Array
    sd_mm: Array
    probability: Array
    turn: Array
    lift: Array


def find_tail(session: Session, base_mm: Array, sd_mm: Array, forward: Array) -> Tail:
    """Search the tail in the depth images that a session keeps; if it keeps none, all are NaN.

    Args:
        session: the session.
        base_mm: (n, 3) the tail's base, mm, arena frame; NaN without a pose.
        sd_mm: (n, 3) its standard deviations, mm.
        forward: (n, 2) the rump's heading, arena frame, of any length.

    Raises:
        RecordingError: the depth images cannot be read.
    """
    x, y = forward.T / np.maximum(np.linalg.norm(forward, axis=1), 1e-9)
    total, count, outer = (
        _along_rays(session, base_mm, np.stack([x, y], axis=-1))
        if meant_to_keep_depth(session)
        else np.zeros((3, len(base_mm), len(_TURNS)))
    )
    frames = _SMOOTH_S / max(median_step(session.frames["time_s"].to_numpy(float)), 1e-3)
    sums = np.stack([total, np.maximum(count, 1e-3)])
    narrow, wide = (
        np.divide(*gaussian_filter(sums, (0.0, frames, degrees / _STEP_DEG), mode="nearest"))
        for degrees in (_NARROW_DEG, _WIDE_DEG)
    )
    contrast = (narrow - wide) * np.sqrt(count / len(_REACH_MM))
    noise = 1.4826 * float(np.median(np.abs(contrast[count > 0]))) if count.any() else 0.0
    evidence = 0.5 * _CERTAINTY * np.maximum(contrast / max(noise, _LEAST_MM), 0.0) ** 2
    rows, best = np.arange(len(evidence)), evidence.argmax(axis=1)
    # the last hypothesis is an invisible tail, which has any direction
    prior = np.append(np.ones(len(_TURNS)), _INVISIBLE * len(_TURNS))
    weight = prior * np.exp(np.pad(evidence, ((0, 0), (0, 1))) - evidence[rows, best, None])
    weight /= weight.sum(axis=1, keepdims=True)
    turn = np.where(count.any(axis=1), _TURNS[best], np.nan)
    off = (_TURNS - turn[:, None]) ** 2
    sd_turn = np.sqrt((weight[:, :-1] * off).sum(axis=1) + weight[:, -1] * off.mean(axis=1))
    away = LENGTH_MM * np.stack(
        [y * np.sin(-turn) - x * np.cos(turn), x * np.sin(turn) - y * np.cos(turn)], axis=-1
    )
    height = outer[rows, best] + 0.0 * turn
    spread = LENGTH_MM * sd_turn
    return Tail(
        np.column_stack([base_mm[:, :2] + away, height]),
        np.hypot(sd_mm, np.column_stack([spread, spread, outer.std(axis=1)])),
        (weight[:, :-1] * (off < np.radians(_NEAR_DEG + 1.0) ** 2)).sum(axis=1) + 0.0 * turn,
        turn,
        np.arctan2(height - base_mm[:, 2], LENGTH_MM),
    )


def _along_rays(session: Session, base_mm: Array, forward: Array) -> Array:
    """Sum and number of the readings of each ray (n, A), and the mean height of its outer half."""
    recording, kept = open_depth(session), Kept(session)
    camera, T = session.camera, session.T_arena_camera
    still = still_scene(recording).astype(np.float32)
    found = np.zeros((3, len(base_mm), len(_TURNS)))
    rays = np.stack([-np.cos(_TURNS), np.sin(_TURNS)], axis=-1)[:, None] * _REACH_MM[:, None]
    for frame in chain.from_iterable(recording.chunks(32)):
        i = frame.index
        if not np.isfinite(base_mm[i]).all():
            continue
        x, y = forward[i]
        points = np.full((*rays.shape[:2], 3), 2.0)  # mm above the floor
        points[..., :2] = base_mm[i, :2] + rays @ np.array([[x, y], [-y, x]])
        uv = np.rint(camera.project(T.inverse() @ points)).astype(np.float32)
        read, behind = (
            cv2.remap(image, uv[..., 0], uv[..., 1], cv2.INTER_NEAREST)
            for image in (np.asarray(frame.depth, np.float32), still)
        )
        height = (read - behind) * (camera.unproject(uv, np.ones(read.shape)) @ T.rotation[2])
        known = (read > 0) & (behind > 0) & kept.holds(i, uv[..., 0], uv[..., 1])
        body = cv2.dilate((known & (height > _BODY_MM)).astype(np.uint8), np.ones((3, 3), np.uint8))
        used = known & (body == 0)
        found[0, i] = (used * np.clip(height, -_MOST_MM, _MOST_MM)).sum(axis=1)
        found[1, i] = used.sum(axis=1)
        found[2, i] = np.average(height[:, _OUTER], axis=1, weights=used[:, _OUTER] + 1e-9)
    return found
