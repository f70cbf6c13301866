"""Animals that lie on one another: the lower one is held where it lay before, or lies afterwards.

A single frame hardly shows the lower one of two animals. Each of them in turn is held in its pose
of the nearest frame before and after that shows all; the pixels that are nearer to the camera than
its body are the upper one, which is measured in them. Cost of an explanation: see `joint`. Which
animal is the lower one, and where, is the path of least cost through a stretch (Viterbi 1967), and
replaces the explanation of a frame alone where it costs less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from liex_lab.arrays import Mask, NDArray
from liex_lab.recordings.frame import DepthFrame, stacked
from liex_lab.runtime.memory import Rows
from liex_lab.runtime.processes import threads
from liex_lab.scene.height_maps import HeightMaps
from liex_lab.tracking.association import NONE
from liex_lab.tracking.identity import Slots, covering, fitting, viterbi
from liex_lab.tracking.joint import JointTracker
from liex_lab.tracking.observations import OF_COMPONENTS, Array, Observations
from liex_lab.tracking.trust import finite_median

_HELD_S = 5.0  # longest time from a frame that shows all animals
_MOST_WAYS = 512  # of explaining the frames of a stretch
_NEARER = 0.5  # of the largest distance from the depth: what is nearer is not the lower animal
_RAISED = 0.15  # how much higher than usual a raised animal is, in its usual heights
_GOOD = 2.0  # residual of poses to hold, over the usual one
_REACH = 2.0  # of animals that cover each other, from where they were in view, lengths
_TWO = 1.1  # least volume of two animals, over that of the largest one
_CHANGE = 0.3  # cost of another animal being the lower one
_BOTH = 1.25  # cost with a pose of both over that with one, which it may have


@dataclass(frozen=True)
class _Ways(Rows):
    """Ways of explaining q frames, in no frame any or several.

    Attributes:
        frame: (w,) number of the frame.
        anchor: (w,) row of the frame from which the lower animal is held.
        lower: (w,) that animal.
        body: (w,) the body of the upper one.
        blob: (w,) row of the height map of both.
        over: (w,) the component that the upper one becomes.
        under: (w,) that of the lower one.
    """

    frame: NDArray[np.int64]
    anchor: NDArray[np.int64]
    lower: NDArray[np.int64]
    body: NDArray[np.int64]
    blob: NDArray[np.int64]
    over: NDArray[np.int64]
    under: NDArray[np.int64]


def covered_stretches(
    every: Sequence[Observations], length_mm: float
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """The stretches in which animals cover each other, or touch and have poses that do not fit.

    Args:
        every: for each animal, all frames (n) measured with its body.
        length_mm: of an animal.

    Returns:
        For each the rows (q,) of its frames, cut where they are many, and of the nearest frames
        (q, 2) before and after that show all animals, `NONE` without one within 5 s.
    """
    observed = every[0]
    known = observed.known[:, ::2]
    touching = np.isfinite(observed.objects[..., 0]).sum(axis=1) < len(every)
    fits = np.any([fitting(one, length_mm) for one in every], axis=0).all(axis=1)
    fits &= ~covering(observed, touching, None)
    off_mm = np.min([one.residual_mm[:, ::2] for one in every], axis=0)
    usual_mm = finite_median(off_mm[fits & ~touching], 0.0)
    whole = fits & (off_mm < _GOOD * usual_mm).all(axis=1)
    anchors, seconds = np.pad(np.flatnonzero(whole), 1, constant_values=NONE), observed.seconds
    rows = np.flatnonzero(touching & known.any(axis=1) & ~fits)
    after = 1 + np.searchsorted(anchors[1:-1], rows)
    near = np.stack([anchors[after - 1], anchors[after]], axis=1)
    near[np.abs(seconds[near] - seconds[rows][:, None]) > _HELD_S] = NONE
    some = (near != NONE).any(axis=1)
    rows, near = rows[some], near[some]
    cuts = np.flatnonzero((np.diff(rows) > 1) | (np.diff(near, axis=0) != 0).any(axis=1)) + 1
    most = _MOST_WAYS // (2 * len(every) ** 2)
    stretches = np.split(np.arange(len(rows)), cuts)
    pieces = [one[at : at + most] for one in stretches for at in range(0, len(one), most)]
    return [(rows[piece], near[piece]) for piece in pieces]


def measure_covered(
    joint: JointTracker,
    frames: Sequence[DepthFrame],
    rows: NDArray[np.int64],
    near: NDArray[np.int64],
    observed: Sequence[Observations],
    slots: Slots,
) -> None:
    """Explain the frames of a stretch by a held animal and one on top of it, in place where that is
    better.

    Args:
        joint: the tracker.
        frames: the q frames.
        rows: (q,) their rows.
        near: (q, 2) those of the frames to hold from, see `covered_stretches`.
        observed: for each animal, all frames (n) measured with its body.
        slots: (n, N) component of each animal.
    """
    depths = stacked(frames)
    with threads(True):
        crops = joint.components(depths)
        ways = _ways(joint, crops, rows, near, observed[0], slots)
        if not len(ways.frame):
            return
        blobs = crops[ways.blob]
        names = np.full((len(rows), len(observed) + 1), NONE)  # NONE is the last column
        np.put_along_axis(names, slots[rows], np.arange(len(observed))[None], axis=1)
        held = slots[ways.anchor, ways.lower]
        lower = _drawn(joint, observed, ways.lower, ways.anchor, held, blobs)
        depth = joint.depth_of(blobs)
        inside = depth > 0
        above = inside & ((lower == 0) | (depth < lower - _NEARER * joint.most_off_mm))
        tops, upper = _on_top(joint, blobs, above, ways.body)
        cost = _cost(joint, depth, lower, upper)
        cost[~lower.any(axis=(1, 2)) | ~upper.any(axis=(1, 2))] = np.inf
        now = [
            _drawn(joint, observed, names[ways.frame, own], rows[ways.frame], own, blobs)
            for own in (ways.over, ways.under)
        ]
        as_is = _cost(joint, depth, *now)
        both = ~observed[0].known[rows[ways.frame], 2 * ways.under]
        best = _best(ways, cost - np.where(both, _BOTH, 1.0) * as_is, len(rows))
        if len(best):
            below = joint.cut(blobs[best], (inside & ~above)[best], np.zeros(len(best)))
            some, row = ways[best], rows[ways.frame[best]]
            _put(joint, observed, row, some, held[best], tops[best], below, depths[some.frame])


def _ways(
    joint: JointTracker,
    crops: HeightMaps,
    rows: NDArray[np.int64],
    near: NDArray[np.int64],
    observed: Observations,
    slots: Slots,
) -> _Ways:
    """All ways of explaining frames whose components are `crops` (some q rows)."""
    q, n_animals, place = len(near), slots.shape[1], observed.centroid_mm[:, ::2, :2]
    middles = np.full((len(crops.n_px), 3), np.inf)
    middles[crops.found] = joint.scene.middles(crops[crops.found], joint.camera_view)
    middles = middles.reshape(-1, q, 3)[..., :2]
    largest_mm3 = max(joint.usual_mm * [body.scene.area_mm2 for body in joint.bodies])
    two = (crops.blobs.volume_mm3 > _TWO * largest_mm3).reshape(-1, q)
    ways = []
    for i, (row, known) in enumerate(zip(rows, observed.known[rows, ::2], strict=True)):
        there, missing = np.flatnonzero(known), np.flatnonzero(~known)
        off = np.linalg.norm(middles[:, i, None] - place[row, there], axis=-1)
        for anchor in near[i]:
            lay = place[anchor, slots[anchor]]
            for k in range(n_animals if anchor != NONE else 0):
                blob = np.linalg.norm(middles[:, i] - lay[k], axis=-1).argmin()
                pair = there[off.argmin(axis=0) == blob]
                pair = np.append(pair, missing[:1]) if len(pair) == 1 else pair
                away = np.linalg.norm(middles[blob, i] - lay, axis=-1) / joint.trackers[0].spine_mm
                together = away[k] < 1.0 and (away < _REACH).sum() > 1 and len(pair) == 2
                for body in range(len(joint.bodies)) if together and two[blob, i] else ():
                    ways.append((i, anchor, k, body, blob * q + i, *pair))
    return _Ways(*np.array(ways, np.int64).reshape(-1, 7).T)


def _drawn(
    joint: JointTracker,
    observed: Sequence[Observations],
    animal: NDArray[np.int64],
    rows: NDArray[np.int64],
    component: NDArray[np.int64],
    blobs: HeightMaps,
) -> NDArray[np.float32]:
    """The bodies (w, S, S) mm of animals (w,) in poses measured earlier, empty without one."""
    drawn = np.zeros(blobs.heights.shape, np.float32)
    for k, own in enumerate(observed):
        mine = np.flatnonzero((animal == k) & own.known[rows, 2 * component])
        if len(mine):
            pose = own[rows[mine]].pose(2 * component[mine])
            drawn[mine] = joint.trackers[k].body.rendered(pose, blobs[mine], joint.scene)
    return drawn


def _cost(joint: JointTracker, depth: NDArray[np.float32], *drawn: NDArray[np.float32]) -> Array:
    """The cost (w,) of explaining depth (w, S, S) mm by bodies (w, S, S) mm."""
    shown = np.arange(len(drawn) * len(depth)).reshape(len(drawn), -1).T
    return joint.costs(depth, np.concatenate(drawn), shown)


def _on_top(
    joint: JointTracker, blobs: HeightMaps, above: Mask, bodies: NDArray[np.int64]
) -> tuple[HeightMaps, NDArray[np.float32]]:
    """The upper animals, in the pixels `above` (w, S, S), and their bodies (w, S, S) mm.

    An animal on top of another one is measured from so far above the floor that its mean height is
    the usual one. What is not raised is on the floor, and has no body here.
    """
    n_px = np.maximum(above.sum(axis=(1, 2)), 1)
    usual_mm = joint.usual_mm[bodies]
    up_mm = np.where(above, blobs.heights, 0).sum(axis=(1, 2)) / 16.0 / n_px - usual_mm
    raised = up_mm > _RAISED * usual_mm
    tops = joint.cut(blobs[np.arange(len(n_px))], above, np.where(raised, up_mm, 0.0))
    drawn = np.zeros(blobs.heights.shape, np.float32)
    for k, body in enumerate(joint.bodies):
        mine = np.flatnonzero((bodies == k) & raised & (tops.blobs.area_mm2 > joint.least_mm2))
        own = np.zeros((len(mine), *drawn.shape[1:]), np.float32)
        joint.draw(body, tops[mine], own)
        drawn[mine] = own
    return tops, drawn


def _best(ways: _Ways, off: Array, q: int) -> NDArray[np.int64]:
    """The ways that are taken: at most one for each of q frames, of less cost than it has.

    Args:
        ways: w ways.
        off: (w,) how much more each costs than the explanation of its frame alone.
        q: frames.
    """
    kinds = np.stack([ways.anchor, ways.lower], axis=1)
    states, state = np.unique(kinds, axis=0, return_inverse=True)
    least = np.zeros((q, len(states)))
    np.minimum.at(least, (ways.frame, state), off)
    change = np.full((q - 1, len(states), len(states)), _CHANGE)
    change[:, np.arange(len(states)), np.arange(len(states))] = 0.0
    path, _ = viterbi(change, least)
    taken = (off < 0.0) & (state == path[ways.frame]) & (off == least[ways.frame, state])
    rows = np.flatnonzero(taken)
    return rows[np.unique(ways.frame[rows], return_index=True)[1]]


def _put(
    joint: JointTracker,
    observed: Sequence[Observations],
    rows: NDArray[np.int64],
    ways: _Ways,
    held: NDArray[np.int64],
    tops: HeightMaps,
    below: HeightMaps,
    depths: NDArray[np.float32],
) -> None:
    """Put the upper animals, measured in `tops`, and the held ones into rows (k,) of observations.

    The held ones, components `held` (k,) of the frames they are held from, are compared with what
    of them is visible, `below`: a hidden pose does not fit.
    """
    cleared = joint.scene.cleared(depths)
    below.n_px[:] = np.maximum(below.n_px, 1)
    to = 2 * np.stack([ways.over, ways.over, ways.under, ways.under], axis=1) + (0, 1, 0, 1)
    for tracker, out in zip(joint.trackers, observed, strict=True):
        own = Observations.empty(out.skeleton, out.times_ns[rows], 2)
        upper = tracker.estimator.both_directions([joint.candidates(tracker, tops)], tracker.size)
        poses = [tracker.put(own, h, one, depths) for h, one in enumerate(upper)]
        for name in OF_COMPONENTS:
            getattr(own, name)[:, 2:] = getattr(out, name)[
                ways.anchor[:, None], 2 * held[:, None] + (0, 1)
            ]
        own.n_px[:, 2:] = below.n_px[:, None]
        lower = [
            replace(one, found=there, crops=below)
            for one, there in zip(upper, own.known[:, 2:].T, strict=True)
        ]
        poses += [own.pose(np.full(len(own), 2 + h)) for h in range(2)]
        tracker.put_agreement(own, [*upper, *lower], poses, cleared)
        for name in OF_COMPONENTS:
            getattr(out, name)[rows[:, None], to] = getattr(own, name)
