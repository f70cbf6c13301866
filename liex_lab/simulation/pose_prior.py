"""Pose priors: postures of mice on the floor, bends of fish, joint angles of any animal.

A mouse's posture is drawn as bone elevations and turns: walking, curled up, reared up, hunched or
reaching (`KINDS`, with the weights `SHARES`). It is then placed on the plane z = 0 by forward
kinematics: the rear of the trunk touches the floor, and if the front would be below it, the animal
is tilted up around its rump (`stand`). Stretch preserves volume: girth is size / sqrt(stretch).

A fish's yaw at arc length s (0 at the base joint, 1 at the end of the chain) consists of two arcs,
joined by a logistic step, plus a travelling wave whose amplitude grows along the body, A (0.35 +
0.65 s) sin(2 pi s / L - phase), plus four small standing waves (`bend_profile`).

Any other animal's joint angles are drawn by a Gaussian copula: a standard normal number follows an
AR(1) process down every chain (correlation 0.75 with the parent's), and its quantile sets the
joint's position between its limits (`draw_angles`).
"""

from dataclasses import dataclass

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body._skinning_kernels import chain_arc, spine_frame
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Body, BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.runtime.kernels import kernel
from liex_lab.runtime.processes import in_parallel

# share of frames: walking, curled up, reared up, hunched (grooming, eating), reaching with the head
KINDS = ("walk", "curl", "rear", "hunch", "reach")
SHARES = (0.42, 0.17, 0.17, 0.10, 0.14)
STRETCH = (0.93, 1.07)  # of the spine, from frame to frame
SIZE_RANGE = (0.9, 1.1)  # of animals, over the skeleton's own size


@dataclass(frozen=True)
class Posture:
    """n postures without position and heading.

    Attributes:
        elevation: (n, J - 1) of the bones above the floor, rad.
        turn: (n, J) to the left at each joint, rad.
        roll: (n,) rad.
        stretch: (n,) of the spine over its rest length.
    """

    elevation: Array
    turn: Array
    roll: Array
    stretch: Array


def sample_postures(
    rng: np.random.Generator,
    skeleton: Skeleton,
    size: Array,
    shape: BodyShape,
    kinds: NDArray[np.int64],
) -> tuple[Pose, Array]:
    """Poses in the arena frame, rump above the origin, headings uniform, and their girths.

    Args:
        rng: random number generator.
        skeleton: of the mouse.
        size: (n,) over home size, before the spine is stretched.
        shape: the bodies, a batch (n).
        kinds: (n,) int64, indices into `KINDS`.

    Returns:
        Poses (n) and girths (n,): factors of all lengths across the body.
    """
    n = len(kinds)
    posture = draw_postures(rng, skeleton, kinds, shape)
    heading = rng.uniform(-np.pi, np.pi, n)
    return stand(skeleton, posture, heading, size, shape, rng.uniform(0.0, 3.0, n))


def draw_postures(
    rng: np.random.Generator, skeleton: Skeleton, kinds: NDArray[np.int64], shape: BodyShape
) -> Posture:
    """Postures of given kinds, for bodies of given shapes.

    Args:
        rng: random number generator.
        skeleton: of the animal.
        kinds: (n,) int64, indices into `KINDS`.
        shape: (n) the bodies, whose thickness sets the height of the mid-axis.

    Returns:
        n postures that are not placed yet; see `stand`.
    """
    n = len(kinds)
    n_bones = skeleton.n_joints - 1
    bones = np.linalg.norm(skeleton.offsets[1:], axis=1)
    rest = resting_heights(skeleton, shape)
    # masks (n, 1) of the postures of each kind
    _, curled, reared, hunched, reaching = (kinds[:, None] == k for k in range(len(KINDS)))
    # walking: the mid-axis is at half the body's thickness, slightly higher in front; the nose is
    # low
    height = rest + np.linspace(0.5, 4.0, n_bones + 1) * rng.random((n, n_bones + 1))
    height[:, -1] = rng.uniform(4.0, 15.0, n)
    low = np.arcsin(np.clip(np.diff(height, axis=1) / bones, -0.9, 0.9))
    steep = np.radians(rng.uniform(12.0, 82.0, (n, 1)))
    tower = steep + np.radians(rng.normal(0.0, 12.0, (n, n_bones)))
    tower[:, -1:] = steep + np.radians(rng.uniform(-75.0, 25.0, (n, 1)))
    arch = low + np.radians(
        np.interp(np.linspace(0, 1, n_bones), [0.0, 0.35, 0.7, 1.0], [32.0, 12.0, -25.0, -40.0])
        * rng.uniform(0.3, 1.2, (n, 1))
        + rng.normal(0.0, 6.0, (n, n_bones))
    )
    reach = low.copy()
    reach[:, -1] = np.radians(rng.uniform(-40.0, 40.0, n))
    reach[:, -2] += np.radians(rng.uniform(-10.0, 25.0, n))
    elevation = np.select([reared, hunched, reaching], [tower, arch, reach], low)
    return Posture(
        elevation,
        _draw_turns(rng, skeleton, curled | (rng.random((n, 1)) < 0.1), reaching),
        np.clip(rng.normal(0.0, np.radians(5.0), n), -np.radians(15.0), np.radians(15.0)),
        rng.uniform(*STRETCH, n),
    )


def _draw_turns(
    rng: np.random.Generator,
    skeleton: Skeleton,
    curled: NDArray[np.bool_],
    reaching: NDArray[np.bool_],
) -> Array:
    """Turns (n, J) rad to the left at the joints: slight or curled, plus those of the head.

    A curl is 30 to 100 degrees in total.
    """
    n = len(curled)
    inner = skeleton.n_joints - 2
    turn = np.zeros((n, skeleton.n_joints))
    slight = np.radians(rng.normal(0.0, 8.0, (n, inner)))
    total = np.radians(rng.uniform(30.0, 100.0, (n, 1))) * rng.choice([-1.0, 1.0], (n, 1))
    curl = total * rng.dirichlet(np.full(inner, 3.0), n) + 0.5 * slight
    turn[:, 1:-1] = np.where(curled, curl, slight)
    head = np.where(reaching[:, 0], rng.uniform(-60.0, 60.0, n), rng.normal(0.0, 10.0, n))
    turn[:, -2] += np.radians(head)
    return turn


def resting_heights(skeleton: Skeleton, shape: BodyShape) -> Array:
    """Heights of the joints when the trunk just touches the floor below each.

    Args:
        skeleton: of the animal, with stations in its [surface] table.
        shape: (n) the bodies.

    Returns:
        (n, J) mm at scale 1.
    """
    stations = np.asarray(skeleton.surface["stations"], float)
    along = skeleton.reach / skeleton.length
    return np.stack([np.interp(along, stations, high) for high in shape.half_height])


def stand(
    skeleton: Skeleton,
    posture: Posture,
    heading: Array,
    size: Array,
    shape: BodyShape,
    gap: Array,
    middle: Array | None = None,
    n_middle: int | None = None,
) -> tuple[Pose, Array]:
    """Place postures on the floor z = 0.

    The rear part of the trunk is `gap` above the floor; if the front would be below it, the whole
    animal is tilted up around the rump, in at most six iterations.

    Args:
        skeleton: of the animal.
        posture: n postures.
        heading: (n,) rad.
        size: (n,) of the animals over home size.
        shape: (n) their bodies.
        gap: (n,) between the floor and the lowest point of the rear, mm.
        middle: (n, 2) mean of the joints in the floor, mm; None puts the rump above the origin.
        n_middle: number of joints, from the rump on, whose mean is at `middle`; None is all.

    Returns:
        Poses (n) in the arena frame, their angles clipped to the joints' limits, and girths (n,).
    """
    angles = np.zeros((len(size), skeleton.n_joints, 3))
    angles[:, 1:-1, 1] = -np.diff(posture.elevation, axis=1)
    angles[..., 2] = posture.turn
    angles = np.clip(angles, skeleton.limits[..., 0], skeleton.limits[..., 1])
    angles[:, 0] = 0.0
    scale = size * posture.stretch
    girth = size / np.sqrt(posture.stretch)
    stations = np.asarray(skeleton.surface["stations"], float)
    elevation = posture.elevation[:, 0].copy()
    # the rear part of the trunk supports a reared animal
    rear = stations <= 0.35
    for _ in range(6):
        rotation = root_rotation(heading, elevation, posture.roll)
        pose = Pose(SE3(rotation, np.zeros((len(size), 3))), angles, scale)
        frames = pose.frames(skeleton)
        lowest = np.empty((len(size), len(stations)))
        in_parallel(
            _lowest_points,
            len(size),
            frames.translation,
            frames.rotation,
            girth,
            stations,
            shape.half_width,
            shape.half_height,
            lowest,
        )
        height = gap - lowest[:, rear].min(axis=1)
        deficit = np.maximum(gap - (lowest[:, ~rear].min(axis=1) + height), 0.0)
        if deficit.max() < 0.2:
            break
        elevation = elevation + np.where(
            deficit > 0.2, deficit / (0.5 * scale * skeleton.length), 0.0
        )
    sunk = np.maximum(-(lowest.min(axis=1) + height), 0.0)
    pose.root.translation[:, 2] = height + sunk
    if middle is not None:
        off = middle - pose.joints(skeleton)[:, :n_middle, :2].mean(axis=1)
        pose.root.translation[:, :2] += off
    return pose, girth


def root_rotation(heading: Array, elevation: Array, roll: Array) -> Array:
    """Rotations of a base: Rz(heading) Ry(-elevation) Rx(roll).

    Args:
        heading: (n,) about the vertical, rad.
        elevation: (n,) above the horizontal, rad.
        roll: (n,) about the long axis, rad.

    Returns:
        (n, 3, 3).
    """
    zero = np.zeros_like(heading)
    turn = so3.exp(np.stack([zero, zero, heading], axis=-1))
    rise = so3.exp(np.stack([zero, -elevation, zero], axis=-1))
    return turn @ rise @ so3.exp(np.stack([roll, zero, zero], axis=-1))


@kernel(nogil=True)
def _lowest_points(joints, rotations, girth, stations, half_width, half_height, out, start, stop):
    """Fill out (n, R) with the lowest point of the trunk's ellipse at every station, mm.

    Args:
        joints: (n, J, 3) mm.
        rotations: (n, J, 3, 3) of the joints.
        girth: (n,) factor across the body.
        stations: (R,) along the spine, over its length.
        half_width: (n, R) mm.
        half_height: (n, R) mm.
        out: (n, R) output, mm.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for i in range(start, stop):
        arc = np.empty(joints.shape[1])
        frame = np.empty((4, 3))
        chain_arc(joints[i], arc)
        for r in range(len(stations)):
            spine_frame(joints[i], rotations[i], arc, stations[r], frame)
            side = girth[i] * half_width[i, r] * frame[2, 2]
            rise = girth[i] * half_height[i, r] * frame[3, 2]
            out[i, r] = frame[0, 2] - np.sqrt(side * side + rise * rise)


# Fish: travelling waves of bending.


# at rest or gliding; scooting with waves down the body; J: the hind half bent, C: both halves, S:
# in opposite directions
FISH_KINDS = ("glide", "scoot", "j", "c", "s")
FISH_SHARES = (0.28, 0.30, 0.14, 0.14, 0.14)
FRONT = 0.47  # front arc's share of the body (as in human annotations)


def draw_bends(rng: np.random.Generator, skeleton: Skeleton, kind: NDArray[np.int64]) -> Array:
    """Yaw at each joint for kinds of posture, within the skeleton's limits.

    Two arcs, a wave that travels down the body, and small independent bends. Degrees are those of a
    chain of 20 bones; the hind half bends about twice as much as the front half, up to some 7
    degrees per joint in a turn.

    Args:
        rng: random number generator.
        skeleton: of the fish.
        kind: (n,) int64, indices into `FISH_KINDS`.

    Returns:
        (n, J) rad.
    """
    n = len(kind)
    side = rng.choice([-1.0, 1.0], n)
    slight = rng.normal(0.0, 1.0, (2, n)) * [[0.6], [1.2]]
    strong = rng.uniform(0.0, 1.0, (2, n))
    front = np.choose(
        kind,
        [
            slight[0],
            1.2 * slight[0],
            1.2 * slight[0],
            side * (2 + 7 * strong[0]),
            side * (1.5 + 5 * strong[0]),
        ],
    )
    hind = np.choose(
        kind,
        [
            slight[1],
            1.5 * slight[1],
            side * (2.5 + 6.5 * strong[1]),
            side * (1.5 + 9 * strong[1]),
            -side * (2 + 6.5 * strong[1]),
        ],
    )
    amplitude = np.choose(
        kind, [0.4, 1.0 + 5.0 * strong[0], 1.5 * strong[0], 1.5 * strong[0], 2.0 * strong[0]]
    )
    phase = rng.uniform(-np.pi, np.pi, n)
    length = rng.uniform(0.7, 1.4, n)
    middle = rng.normal(FRONT, 0.06, n)
    own = rng.normal(0.0, 0.5, (n, 4))
    return bend_profile(skeleton, front, hind, amplitude, phase, length, middle, own)


def bend_profile(
    skeleton: Skeleton,
    front: Array,
    hind: Array,
    amplitude: Array,
    phase: Array,
    length: Array,
    middle: Array,
    own: Array,
) -> Array:
    """Yaw at each joint of two arcs with a travelling wave.

    With s the joint's share of the body's length, the arcs join in a logistic step of width 0.05 at
    `middle`; the wave is amplitude (0.35 + 0.65 s) sin(2 pi s / length - phase).

    Args:
        skeleton: of the fish; only joints with a yaw axis bend, within their limits.
        front: (n,) bend of the front arc, degrees per joint of 20.
        hind: (n,) bend of the hind arc, degrees per joint of 20.
        amplitude: (n,) of the travelling wave, degrees per joint of 20.
        phase: (n,) of the travelling wave, rad.
        length: (n,) of the travelling wave, over the body's length.
        middle: (n,) position where the arcs meet, over the body's length.
        own: (n, 4) amplitudes of standing waves, degrees per joint of 20.

    Returns:
        (n, J) rad, 0 at the base joint.
    """
    s = skeleton.reach / skeleton.length
    joint = 20.0 / max(1, skeleton.n_joints - 1)
    share = 1.0 / (1.0 + np.exp(-(s - middle[:, None]) / 0.05))
    arcs = front[:, None] * (1.0 - share) + hind[:, None] * share
    wave = (
        amplitude[:, None]
        * (0.35 + 0.65 * s)
        * np.sin(2 * np.pi * s / length[:, None] - phase[:, None])
    )
    stand = np.stack([np.sin(np.pi * (k + 1) * s + k) for k in range(own.shape[1])])
    yaw = np.radians((arcs + wave + own @ stand) * joint) * skeleton.axes[:, 2]
    yaw[:, 0] = 0.0
    return np.clip(yaw, skeleton.limits[:, 2, 0], skeleton.limits[:, 2, 1])


def hung(skeleton: Skeleton, yaw: Array, rotation: Array, size: Array) -> Pose:
    """Poses with given bends and orientations and the mean of their joints at the origin.

    Args:
        skeleton: of the animal.
        yaw: (n, J) bend at each joint, rad.
        rotation: (n, 3, 3) of the base joint, arena frame.
        size: (n,) over home size.

    Returns:
        Poses (n) in the arena frame.
    """
    angles = np.zeros((*yaw.shape, 3))
    angles[..., 2] = yaw
    return centred(skeleton, angles, rotation, size)


def clearance(skeleton: Skeleton, pose: Pose, shape: Body, size: Array) -> tuple[Array, Array]:
    """Upper bounds of the extent of bodies below and above the origin.

    Args:
        skeleton: of the animal.
        pose: (n) around the origin.
        shape: (n) their bodies, `BodyShape`.
        size: (n,) over home size.

    Returns:
        Extent below (n,) and above (n,), mm.
    """
    assert isinstance(shape, BodyShape)
    z = pose.joints(skeleton)[..., 2]
    thick = size * shape.half_height.max(axis=-1)
    return thick - z.min(axis=1), thick + z.max(axis=1)


# Any animal: joint angles by a Gaussian copula over the kinematic tree.


_LIKE_NEXT = 0.75  # correlation of a joint's bend with its parent's
_USUAL_RAD = np.radians(45.0)  # and turns by this much


def draw_angles(rng: np.random.Generator, skeleton: Skeleton, n: int) -> Array:
    """Joint angles about the free axes, within the limits, correlated with the parent's.

    A standard normal number follows an AR(1) process down every chain; its quantile sets the
    joint's position between its limits. A factor from a beta distribution pulls each body towards
    its home pose, so that some are nearly straight. An axis whose range is wider than 200 degrees
    counts as unlimited and turns by up to 45 degrees either way.

    Returns:
        (n, J, 3) rad, 0 at the base joint.
    """
    from scipy.special import ndtr

    low, high = np.moveaxis(skeleton.limits, -1, 0)
    # a wide range counts as unlimited
    wide = high - low > 2.0 * np.radians(100.0)
    low = np.where(wide, -_USUAL_RAD, low)
    high = np.where(wide, _USUAL_RAD, high)
    bent = rng.beta(1.2, 1.0, (n, 1, 1))  # deviation of this body from its home pose
    number = rng.standard_normal((n, skeleton.n_joints, 3))
    for j in range(1, skeleton.n_joints):
        p = skeleton.parents[j]
        if p > 0:
            number[:, j] = _LIKE_NEXT * number[:, p] + np.sqrt(1.0 - _LIKE_NEXT**2) * number[:, j]
    home = np.clip(0.0, low, high)
    angles = home + bent * (low + ndtr(number) * (high - low) - home)
    angles = angles * skeleton.axes
    angles[:, 0] = 0.0
    return angles


def centred(skeleton: Skeleton, angles: Array, rotation: Array, size: Array) -> Pose:
    """Poses (n) with their joints' mean at the origin."""
    pose = Pose(SE3(rotation, np.zeros((len(angles), 3))), angles, np.asarray(size, float))
    pose.root.translation[:] -= pose.joints(skeleton).mean(axis=1)
    return pose
