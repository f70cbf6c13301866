"""Posture of a chain of joints per frame: heading, pitch, length, bend and midline curvature.

Heading = atan2(dy, dx) and pitch = atan2(dz, hypot(dx, dy)) of the body's axis; the bend is the sum
of the signed turning angles at the inner joints (total curvature of the discrete midline). It is
measured in the animal's frontal plane, through its axis and the horizontal, as if it did not roll.
Positive bends are towards the animal's left. Definitions of body bend differ between publications
by a factor of two and more; here it is the whole turn from the direction of the front bone to that
of the rear one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.behaviour.body import BRANCHES, STANDS, SWIMS, BodyAxis
from liex_lab.tables.rows import constant_runs

Array = NDArray[np.float64]


def posture(body: BodyAxis, xyz: Array, sd: Array) -> dict[str, Array]:
    """Measures of n single frames; joint errors of one frame are treated as one common error.

    Args:
        body: the roles of the joints.
        xyz: (n, J, 3) joints in the arena frame, mm.
        sd: (n, J) their standard deviation along an axis, mm.

    Returns:
        Columns of the table `kinematics`, (n,); `centre` (n, 3) and `centre_sd` (n,) of the body,
            mm; for a swimming body also `rear_sd`, that of the chain's rear end, mm.
    """
    chain, trunk, (start, stop) = list(body.spine), list(body.trunk), body.axis
    spine = xyz[:, chain]
    axis = xyz[:, stop] - xyz[:, start]
    axis_sd = np.hypot(sd[:, start], sd[:, stop])
    reach = np.hypot(axis[:, 0], axis[:, 1])
    size = np.linalg.norm(axis, axis=1)
    length = np.linalg.norm(np.diff(spine, axis=1), axis=2).sum(axis=1)
    # the unit vectors ahead, to the animal's left (horizontal), and out of its back
    ahead = axis / _positive(size)[:, None]
    left = np.stack([-axis[:, 1], axis[:, 0], np.zeros(len(axis))], axis=1)
    left = left / _positive(reach)[:, None]
    turns = _turns(spine, np.cross(ahead, left))
    found = {
        "centre": xyz[:, trunk].mean(axis=1),
        "centre_sd": sd[:, trunk].mean(axis=1),
        "body_pitch_rad": np.arctan2(axis[:, 2], reach),
        "body_pitch_sd_rad": axis_sd / _positive(size),
        "heading_rad": np.arctan2(axis[:, 1], axis[:, 0]),
        # at most that of an unknown direction (uniform on the circle)
        "heading_sd_rad": np.minimum(axis_sd / _positive(reach), np.pi / np.sqrt(3.0)),
        "length_mm": length,
        "straightness": np.linalg.norm(spine[:, 0] - spine[:, -1], axis=1) / _positive(length),
        "bend_rad": turns.sum(axis=1) if len(chain) > 2 else np.full(len(spine), np.nan),
    }
    if body.kind == STANDS:
        nose, rump = xyz[:, body.front], xyz[:, body.rear]
        found |= {
            "nose_height_mm": nose[:, 2],
            "nose_height_sd_mm": sd[:, body.front],
            "back_height_mm": xyz[:, list(body.back), 2].max(axis=1),
            "nose_over_rump_mm": nose[:, 2] - rump[:, 2],
            "reach_mm": np.hypot(*(nose - rump)[:, :2].T),
        }
    elif body.kind == BRANCHES:
        found["opening"] = np.mean([_stretched(xyz[:, list(limb)]) for limb in body.limbs], axis=0)
    elif body.kind == SWIMS:
        to_rear = spine[:, -1] - spine[:, 0]
        aside = np.einsum("ni,ni->n", to_rear, left)
        third = 3 * np.arange(1, turns.shape[1] + 1) // (turns.shape[1] + 1)
        found |= {
            "tail_mm": aside,
            "tail_angle_rad": np.arctan2(aside, -np.einsum("ni,ni->n", to_rear, ahead)),
            "rear_sd": sd[:, chain[-1]],
        }
        for k, part in enumerate(("front", "middle", "rear")):
            found[f"bend_{part}_rad"] = turns[:, third == k].sum(axis=1)
    return found


def _turns(spine: Array, dorsal: Array) -> Array:
    """(n, K - 2) turn at each inner joint of chains (n, K, 3), front to rear, rad.

    Positive to the left, in the plane perpendicular to the vectors `dorsal` (n, 3) out of the back.
    """
    bones = np.diff(spine, axis=1)
    a, b = bones[:, :-1], bones[:, 1:]
    # the bones point backwards: a chain with its tail on the left turns clockwise to its rear
    across = -np.einsum("nki,ni->nk", np.cross(a, b), dorsal)
    return np.asarray(np.arctan2(across, np.einsum("nki,nki->nk", a, b)))


def _stretched(limb: Array) -> Array:
    """(n,) extension of limbs (n, K, 3): 1 is straight."""
    bones = np.linalg.norm(np.diff(limb, axis=1), axis=2).sum(axis=1)
    return np.asarray(np.linalg.norm(limb[:, -1] - limb[:, 0], axis=1) / bones)


def _positive(values: Array) -> Array:
    """Values to divide by; NaN instead of 0."""
    return np.where(values > 1e-9, values, np.nan)


# Tail-beat analysis of a swimming animal: turning points of the swing, frequency and amplitude.
# Turning points are those of a peak detector with hysteresis (a reversal of at least 5 % of the
# length and 2 sd); their times are refined by the parabola through three samples. Bends and beats
# are counted as in ZebraZoom (Mirat et al. 2013).

SLOWEST_HZ = 1.0  # a slower swing is a turn of the body
# of the frame rate: a faster beat may be an alias of another one
TRUSTED_SHARE = 0.25
_LEAST_SHARE = 0.05  # least swing, of the body's length
_LEAST_SD = 2.0  # least swing, in standard deviations


def tail_beat(
    shape: dict[str, Array], time_s: Array, number: NDArray[np.int64], step_s: float
) -> dict[str, Array]:
    """Bends, frequency and amplitude of the tail's beat within each unbroken stretch.

    A swing lasts from one turning point to the next; frequency = 1 / (2 x its time). A swing slower
    than `SLOWEST_HZ` is left empty, and so are one faster than a quarter of the frame rate
    (`TRUSTED_SHARE`) and its neighbours, because bends may be missing.

    Args:
        shape: the `posture` of n frames of a swimming body.
        time_s: (n,) times of the frames, s.
        number: (n,) unbroken stretch of each frame, see `segments`.
        step_s: the median time between frames, s; 0 gives an empty beat.

    Returns:
        The columns tail_extreme_rad, tail_beat_hz and tail_beat_mm, (n,).
    """
    swing, length = shape["tail_mm"], shape["length_mm"]
    extreme, hz, mm = (np.full(len(swing), np.nan) for _ in range(3))
    out = {"tail_extreme_rad": extreme, "tail_beat_hz": hz, "tail_beat_mm": mm}
    known = np.isfinite(swing)
    if step_s <= 0 or not known.any():
        return out
    noise = np.hypot(shape["rear_sd"], length * shape["heading_sd_rad"])[known]
    typical = float(np.nanmedian(noise)) if np.isfinite(noise).any() else 0.0
    least = max(_LEAST_SHARE * float(np.median(length[known])), _LEAST_SD * typical)
    for start, stop, key in constant_runs(np.where(known, number, -1)):
        if key < 0 or len(rows := start + turning_points(swing[start:stop], least)) < 2:
            continue
        gap = np.diff(time_s[rows])
        near = np.minimum(np.append(np.inf, gap), np.append(gap, np.inf)) < 0.5 / SLOWEST_HZ
        rows = rows[near]  # a lone turning point is in a rest between two bouts
        extreme[rows] = shape["tail_angle_rad"][rows]
        at = vertex_times(time_s, swing, rows, start, stop)
        frequency = 0.5 / np.maximum(np.diff(at), 1e-9)
        fast = np.pad(frequency > TRUSTED_SHARE / step_s, 1)
        good = (frequency >= SLOWEST_HZ) & ~(fast[1:-1] | fast[:-2] | fast[2:])
        for k in np.flatnonzero(good):
            hz[rows[k] : rows[k + 1]] = frequency[k]
            mm[rows[k] : rows[k + 1]] = 0.5 * abs(swing[rows[k + 1]] - swing[rows[k]])
    return out


def turning_points(values: Array, least: float) -> NDArray[np.int64]:
    """Rows where a series reverses by `least` or more, after a change of at least that size.

    A peak detector with hysteresis: maxima and minima alternate. The first one counts only if the
    series changed by `least` before it.

    Args:
        values: (n,) the series, without NaN.
        least: smallest reversal that counts, in the unit of `values`.

    Returns:
        (k,) int64 rows, in order.
    """
    found: list[int] = []
    low = high = 0
    rising: bool | None = None
    for k, value in enumerate(values.tolist()):
        high = k if value > values[high] else high
        low = k if value < values[low] else low
        if rising is not False and values[high] - value >= least:
            found.append(high)
            rising = False
            low = k
        elif rising is not True and value - values[low] >= least:
            found.append(low)
            rising = True
            high = k
    if (
        found and np.ptp(values[: found[0] + 1]) < least
    ):  # only the tail's position before its first swing
        found = found[1:]
    return np.array(found, np.int64)


def vertex_times(
    time_s: Array, values: Array, rows: NDArray[np.int64], start: int, stop: int
) -> Array:
    """Times of turning points, from the parabola through each and its two neighbours.

    Args:
        time_s: (n,) times of the frames, s.
        values: (n,) the series.
        rows: (k,) int64 rows of the turning points.
        start: first row of the stretch.
        stop: row after the last of the stretch; a point at either end keeps its frame's time.

    Returns:
        (k,) s, each between the times of its point's neighbours.
    """
    inner = rows[(rows > start) & (rows < stop - 1)]
    at = time_s[rows].copy()
    t0 = time_s[inner - 1]
    t1 = time_s[inner]
    t2 = time_s[inner + 1]
    left = (values[inner] - values[inner - 1]) / (t1 - t0)
    right = (values[inner + 1] - values[inner]) / (t2 - t1)
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = (t0 + t1) / 2.0 - left * (t2 - t0) / (2.0 * (right - left))
    at[np.isin(rows, inner)] = np.where(np.isfinite(vertex), np.clip(vertex, t0, t2), t1)
    return at
