"""Kernels that build generalised cylinders around the joints of a pose: closed triangle meshes.

Every part of a mesh is a *tube*: a pole, some rings, a pole. A body is one tube of superellipses
along the spine, an ear or a foot an ellipsoid (a tube as well), a tail a thin tube, a capsule a
straight tube around one bone. The mid-axis of a body is a chord-length Catmull-Rom spline through
the joints, written as a cubic Hermite curve:

    c(s) = h00 p_k + h10 L m_k + h01 p_k+1 + h11 L m_k+1,

with tangents m of the parabola through three joints. Lengths in mm, in the frame of the joints; the
tail needs that frame's z up and its floor at z = 0.
"""

import math

import numpy as np
from numpy.typing import NDArray

from liex_lab.geometry._kernels import exp_so3
from liex_lab.runtime.kernels import kernel

BODY_SEGMENTS = 16
BLOB_RINGS = 4
BLOB_SEGMENTS = 8
TAIL_RINGS = 12
TAIL_SEGMENTS = 6
CAPSULE_RINGS = 6
CAPSULE_SEGMENTS = 10


def tube_faces(n_rings: int, n_segments: int) -> NDArray[np.int32]:
    """Triangles of a closed tube: first pole, ring after ring, last pole.

    Args:
        n_rings: rings between the poles.
        n_segments: vertices of a ring.

    Returns:
        (F, 3) int32; vertex 0 is the first pole, the last the other.
    """
    faces = []
    for k in range(n_segments):
        after = (k + 1) % n_segments
        faces.append((0, 1 + after, 1 + k))
        for r in range(n_rings - 1):
            low = 1 + r * n_segments
            high = 1 + (r + 1) * n_segments
            faces += [(low + k, low + after, high + after), (low + k, high + after, high + k)]
        last = 1 + (n_rings - 1) * n_segments
        faces.append((last + k, last + after, last + n_segments))
    return np.array(faces, np.int32)


def joined_faces(tubes: list[tuple[int, int]]) -> NDArray[np.int32]:
    """Triangles (F, 3) int32 of consecutive tubes.

    Args:
        tubes: (n_rings, n_segments) of each.
    """
    faces = []
    start = 0
    for n_rings, n_segments in tubes:
        faces.append(tube_faces(n_rings, n_segments) + np.int32(start))
        start += n_rings * n_segments + 2
    return np.concatenate(faces)


@kernel()
def spine_frame(joints, rotations, arc, station, out):
    """Centre, forward, left and up of the mid-axis at one station.

    A Catmull-Rom curve between the joints, extended straight beyond them. Up interpolates the
    joints' z axes.

    Args:
        joints: (J, 3) mm of a chain.
        rotations: (J, 3, 3) of its joints.
        arc: (J,) mm, length of the chain up to each joint.
        station: share of the spine's length.
        out: (4, 3), out: centre mm, and three unit vectors.
    """
    n_joints = joints.shape[0]
    total = arc[n_joints - 1]
    along = station * total
    k = 0
    while k < n_joints - 2 and along > arc[k + 1]:
        k += 1
    length = arc[k + 1] - arc[k]
    s = min(max((along - arc[k]) / length, 0.0), 1.0)
    beyond = min(along, 0.0) + max(along - total, 0.0)
    before_length = arc[k] - arc[k - 1] if k > 0 else 1.0
    after_length = arc[k + 2] - arc[k + 1] if k < n_joints - 2 else 1.0
    s2 = s * s
    s3 = s * s * s
    for axis in range(3):
        here = joints[k, axis]
        there = joints[k + 1, axis]
        bone = (there - here) / length
        start = bone
        if k > 0:
            before = (here - joints[k - 1, axis]) / before_length
            start = (before * length + bone * before_length) / (length + before_length)
        stop = bone
        if k < n_joints - 2:
            after = (joints[k + 2, axis] - there) / after_length
            stop = (after * length + bone * after_length) / (length + after_length)
        forward = (
            (6 * s2 - 6 * s) * (here - there) / length
            + (3 * s2 - 4 * s + 1) * start
            + (3 * s2 - 2 * s) * stop
        )
        centre = (2 * s3 - 3 * s2 + 1) * here + (s3 - 2 * s2 + s) * length * start
        centre += (3 * s2 - 2 * s3) * there + (s3 - s2) * length * stop
        out[0, axis] = centre + beyond * forward
        out[1, axis] = forward
        out[3, axis] = (1 - s) * rotations[k, axis, 2] + s * rotations[k + 1, axis, 2]
    _normalise(out, 1)
    _cross(out, 3, 1, 2)
    _normalise(out, 2)
    _cross(out, 1, 2, 3)


@kernel()
def _set(rows, k, x, y, z):
    """Set row k of `rows` (., 3)."""
    rows[k, 0] = x
    rows[k, 1] = y
    rows[k, 2] = z


@kernel()
def _normalise(rows, k):
    """Scale row k of `rows` (., 3) to unit length."""
    length = math.sqrt(rows[k, 0] ** 2 + rows[k, 1] ** 2 + rows[k, 2] ** 2)
    for axis in range(3):
        rows[k, axis] /= length


@kernel()
def _cross(rows, a, b, out):
    """Set row `out` to the cross product of rows a and b of `rows` (., 3)."""
    x = rows[a, 1] * rows[b, 2] - rows[a, 2] * rows[b, 1]
    y = rows[a, 2] * rows[b, 0] - rows[a, 0] * rows[b, 2]
    z = rows[a, 0] * rows[b, 1] - rows[a, 1] * rows[b, 0]
    _set(rows, out, x, y, z)


@kernel()
def chain_arc(joints, arc):
    """The chain's length up to each joint.

    Args:
        joints: (J, 3) mm.
        arc: (J,) mm, out.
    """
    arc[0] = 0.0
    for j in range(1, joints.shape[0]):
        square = 0.0
        for axis in range(3):
            square += (joints[j, axis] - joints[j - 1, axis]) ** 2
        arc[j] = arc[j - 1] + math.sqrt(square)


@kernel()
def _body(
    joints, rotations, arc, girth, stations, half_width, half_height, power, frame, out, start
):
    """The trunk: a superellipse across the mid-axis at every station; the first and last stations
    are the poles.
    """
    n = len(stations)
    at = start
    for r in range(n):
        spine_frame(joints, rotations, arc, stations[r], frame)
        if r == 0 or r == n - 1:
            for axis in range(3):
                out[at, axis] = frame[0, axis]
            at += 1
            continue
        wide = girth * half_width[r]
        high = girth * half_height[r]
        for k in range(BODY_SEGMENTS):
            phi = 2.0 * math.pi * k / BODY_SEGMENTS
            c = math.cos(phi)
            s = math.sin(phi)
            if power != 2.0:
                c = math.copysign(abs(c) ** (2.0 / power), c)
                s = math.copysign(abs(s) ** (2.0 / power), s)
            for axis in range(3):
                out[at, axis] = (
                    frame[0, axis] + wide * c * frame[2, axis] + high * s * frame[3, axis]
                )
            at += 1
    return at


@kernel()
def ellipsoid(frame, radii, out, start):
    """An ellipsoid's vertices.

    Args:
        frame: (4, 3) centre, forward, left, up.
        radii: (3,) mm forward, left, up.
        out: (V, 3) mm, out.
        start: index of its first row in `out`.

    Returns:
        The index of the first row after it.
    """
    at = start
    for r in range(BLOB_RINGS + 2):
        theta = math.pi * r / (BLOB_RINGS + 1)
        along = -math.cos(theta) * radii[0]
        across = math.sin(theta)
        for k in range(1 if r == 0 or r == BLOB_RINGS + 1 else BLOB_SEGMENTS):
            phi = 2.0 * math.pi * k / BLOB_SEGMENTS
            left = across * math.cos(phi) * radii[1]
            up = across * math.sin(phi) * radii[2]
            for axis in range(3):
                out[at, axis] = (
                    frame[0, axis]
                    + along * frame[1, axis]
                    + left * frame[2, axis]
                    + up * frame[3, axis]
                )
            at += 1
    return at


@kernel()
def _blob(joints, rotations, arc, girth, blob, frame, out, start):
    """One ear or foot: `blob` = station, left, up of its centre, its three radii, mm at scale 1;
    radius 0 hides it.
    """
    spine_frame(joints, rotations, arc, blob[0], frame)
    for axis in range(3):
        frame[0, axis] += girth * (blob[1] * frame[2, axis] + blob[2] * frame[3, axis])
    return ellipsoid(frame, girth * blob[3:6], out, start)


@kernel()
def _tail(joints, rotations, arc, girth, first, tail, bends, frame, out, start):
    """A tube that leaves the rump at station `first`, sinks to the floor z = 0 and turns by `bends`
    rad at its rings.

    tail: length, radius at the rump, radius at the tip, mm at scale 1; length 0 hides it inside the
    body.
    """
    spine_frame(joints, rotations, arc, first, frame)
    x = frame[0, 0]
    y = frame[0, 1]
    z = frame[0, 2]
    if girth * tail[0] <= 0.0:
        for k in range(TAIL_RINGS * TAIL_SEGMENTS + 2):
            _set(out, start + k, x, y, z)
        return start + TAIL_RINGS * TAIL_SEGMENTS + 2
    heading = math.atan2(-frame[1, 1], -frame[1, 0])
    if (
        math.hypot(frame[1, 0], frame[1, 1]) < 0.35
    ):  # an upright rump: the tail leaves away from the belly
        heading = math.atan2(frame[3, 1], frame[3, 0])
    step = girth * tail[0] / TAIL_RINGS
    at = start
    _set(out, at, x, y, z)
    at += 1
    for r in range(TAIL_RINGS):
        share = (r + 1.0) / TAIL_RINGS
        radius = girth * (tail[1] + share * (tail[2] - tail[1]))
        heading += bends[r]
        fall = min(max((z - radius) * 0.45, -0.6 * step), 0.8 * step)
        run = math.sqrt(step * step - fall * fall)
        x = x + run * math.cos(heading)
        y = y + run * math.sin(heading)
        z = z - fall
        for k in range(TAIL_SEGMENTS):
            phi = 2.0 * math.pi * k / TAIL_SEGMENTS
            across = radius * math.cos(phi)
            _set(
                out,
                at,
                x - across * math.sin(heading),
                y + across * math.cos(heading),
                z + radius * math.sin(phi),
            )
            at += 1
    _set(out, at, x, y, z)
    return at + 1


@kernel(nogil=True)
def skin_tubes(
    joints,
    rotations,
    girth,
    stations,
    half_mm,
    power,
    blobs,
    tail,
    bends,
    out,
    start,
    stop,
):
    """Vertices of n animals with tubular bodies: trunk, ellipsoids, tail; see `BodyShape`.

    Args:
        joints: (n, J, 3) mm of chains.
        rotations: (n, J, 3, 3) of their joints.
        girth: (n,) multiplies all lengths of the shape.
        stations: (R,) shares of the spine's length, shared.
        half_mm: (2, n, R) half widths and half heights, mm.
        power: (n,) of the superellipses.
        blobs: (n, B, 6) ellipsoids.
        tail: (n, 3) length, radius at the rump, radius at the tip.
        bends: (n, TAIL_RINGS) rad.
        out: (n, V, 3) mm, out.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for i in range(start, stop):
        arc = np.empty(joints.shape[1])
        frame = np.empty((4, 3))
        chain_arc(joints[i], arc)
        at = _body(
            joints[i],
            rotations[i],
            arc,
            girth[i],
            stations,
            half_mm[0, i],
            half_mm[1, i],
            power[i],
            frame,
            out[i],
            0,
        )
        for b in range(blobs.shape[1]):
            at = _blob(joints[i], rotations[i], arc, girth[i], blobs[i, b], frame, out[i], at)
        _tail(
            joints[i],
            rotations[i],
            arc,
            girth[i],
            stations[0],
            tail[i],
            bends[i],
            frame,
            out[i],
            at,
        )


@kernel(nogil=True)
def skin_capsules(rotations, joints, scale, girth, which, offsets, radii, out, start, stop):
    """Vertices of C tapered capsules, round at both ends, for a batch.

    Args:
        rotations: (n, J, 3, 3).
        joints: (n, J, 3) mm.
        scale: (n,) multiplies the offsets.
        girth: (n,) multiplies the radii.
        which: (C, 2) int64, the joints that carry the ends.
        offsets: (n, C, 2, 3) mm of the ends in the joints' frames.
        radii: (n, C, 2) mm.
        out: (n, V, 3) mm, out.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for i in range(start, stop):
        at = 0
        frame = np.empty((4, 3))
        ends = np.empty((2, 3))
        for c in range(len(which)):
            for e in range(2):
                j = which[c, e]
                for axis in range(3):
                    ends[e, axis] = joints[i, j, axis]
                    for k in range(3):
                        ends[e, axis] += scale[i] * rotations[i, j, axis, k] * offsets[i, c, e, k]
            at = _capsule(
                ends[0],
                ends[1],
                girth[i] * radii[i, c, 0],
                girth[i] * radii[i, c, 1],
                frame,
                out[i],
                at,
            )


@kernel()
def _capsule(first, last, first_radius, last_radius, frame, out, start):
    """A tube around one bone: half its rings round off each end."""
    length = 0.0
    for axis in range(3):
        frame[1, axis] = last[axis] - first[axis]
        length += frame[1, axis] ** 2
        frame[3, axis] = 0.0
    length = math.sqrt(length)
    if length < 1e-9:  # joints that coincide: a ball
        frame[1, 0] = 1.0
    _normalise(frame, 1)
    frame[3, 2 if abs(frame[1, 2]) < 0.9 else 0] = 1.0
    _cross(frame, 3, 1, 2)
    _normalise(frame, 2)
    _cross(frame, 1, 2, 3)
    half = CAPSULE_RINGS // 2
    at = start
    for r in range(CAPSULE_RINGS + 2):
        near = r <= half
        radius = first_radius if near else last_radius
        theta = 0.5 * math.pi * (r if near else CAPSULE_RINGS + 1 - r) / half
        along = -radius * math.cos(theta) if near else length + radius * math.cos(theta)
        for k in range(1 if r == 0 or r == CAPSULE_RINGS + 1 else CAPSULE_SEGMENTS):
            phi = 2.0 * math.pi * k / CAPSULE_SEGMENTS
            left = radius * math.sin(theta) * math.cos(phi)
            up = radius * math.sin(theta) * math.sin(phi)
            for axis in range(3):
                out[at, axis] = (
                    first[axis]
                    + along * frame[1, axis]
                    + left * frame[2, axis]
                    + up * frame[3, axis]
                )
            at += 1
    return at


# Forward kinematics of many poses: each joint's rest rotation times exp(angles), parent by parent.


@kernel()
def place_joints(tree, rotation, translation, angles, scale, out):
    """Positions of the joints of n poses; the kernel twin of `Pose.joints`.

    Args:
        tree: `KinematicTree` of the skeleton.
        rotation: (n, 3, 3) of the root.
        translation: (n, 3) mm of the root.
        angles: (n, J, 3) rad.
        scale: (n,) of the bones.
        out: (n, J, 3) mm, out.
    """
    n_joints = tree.parents.size
    turned = np.empty((n_joints, 3, 3))
    own = np.empty((3, 3))
    step = np.empty((3, 3))
    for i in range(scale.size):
        for a in range(3):
            out[i, 0, a] = translation[i, a]
            for b in range(3):
                turned[0, a, b] = rotation[i, a, b]
        for j in range(1, n_joints):
            p = tree.parents[j]
            if tree.turning[j]:
                exp_so3(angles[i, j, 0], angles[i, j, 1], angles[i, j, 2], own)
            for a in range(3):
                total = 0.0
                for k in range(3):
                    total += turned[p, a, k] * tree.offsets[j, k]
                out[i, j, a] = out[i, p, a] + scale[i] * total
                for b in range(3):
                    value = 0.0
                    for k in range(3):
                        value += turned[p, a, k] * tree.rest[j, k, b]
                    step[a, b] = value
            for a in range(3):
                for b in range(3):
                    if tree.turning[j]:
                        turned[j, a, b] = (
                            step[a, 0] * own[0, b] + step[a, 1] * own[1, b] + step[a, 2] * own[2, b]
                        )
                    else:
                        turned[j, a, b] = step[a, b]
