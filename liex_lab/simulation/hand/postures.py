"""Postures and orientations of a right hand before a camera, from anatomy and not from recordings.

A posture is a shape of `postures.toml`, a grasp around a cylinder or a ball, or fingers that bend
independently; some are blends of two. Fingers then vary along the first two synergies of Santello
et al. (1998), all joints together and knuckles against middle joints, and one by one. An end joint
bends by about two thirds of its middle joint (Rijpkema and Girard 1991), and neighbours follow a
bent finger (Haeger-Ross and Schieber 2000).

An orientation is that of a hand at a two-link arm of a person in front of the camera, whose elbow
hangs, whose forearm turns, and whose wrist bends within its range (AAOS 1965).
"""

import tomllib
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from liex_lab.body.skeleton import Array, Skeleton
from liex_lab.body.variation import ARM_MM

_FREE, _GRASPS, _BLENDS = 0.4, 0.12, 0.3  # shares; blends are of two of any kind
# of one posture of a shape: degrees of roots and middles, spread, degrees of the thumb
_DEVIATION = np.array([6.0] * 8 + [0.25] + [8.0, 8.0, 10.0, 12.0])
_FAN_DEG = np.array([10.0, 1.0, -8.0, -18.0])  # yaw of spread fingers
# how much a finger takes on of its own bend and of its neighbours'
_FOLLOWS = np.array(
    [[0.94, 0.06, 0.0, 0.0], [0.07, 0.86, 0.07, 0.0], [0.0, 0.1, 0.8, 0.1], [0.0, 0.02, 0.13, 0.85]]
)
_FINGER_MM, _UPPER_ARM_MM = 9.0, 300.0  # half of a finger's thickness; shoulder to elbow


@cache
def _shapes() -> Array:
    """The shapes (S, 14): share, then degrees of roots and middles, spread, and the thumb."""
    text = Path(__file__).with_name("postures.toml").read_text(encoding="utf-8")
    return np.array([np.hstack([*row.values()]) for row in tomllib.loads(text)["shapes"].values()])


def draw_postures(rng: np.random.Generator, skeleton: Skeleton, n: int) -> Array:
    """Draw postures of the hand.

    Args:
        rng: random number generator.
        skeleton: of the hand, J joints in the order of its preset.
        n: number of postures.

    Returns:
        (n, J, 3) rad, within the joints' limits.
    """
    one, other = (_drawn(rng, skeleton, n) for _ in range(2))
    t = np.where(rng.random((n, 1)) < _BLENDS, rng.random((n, 1)), 0.0)
    loose = rng.uniform(0.0, 1.5, (n, 1))  # some hands make a shape exactly
    p = (1.0 - t) * one + t * other + loose * rng.normal(0.0, _DEVIATION, (n, len(_DEVIATION)))
    together, against = loose * rng.normal(0.0, [[[10.0]], [[8.0]]], (2, n, 1))
    root, middle, spread, thumb = np.split(p, [4, 8, 9], axis=1)
    root, middle = root + together + against, middle + 1.2 * together - against
    end = middle * rng.uniform(0.4, 0.9, (n, 1)) + rng.normal(0.0, 5.0, (n, 4))
    closed = 0.7 * np.clip(root / 80.0, 0.0, 1.0)  # bent fingers do not spread
    yaw = (1.0 - closed) * (spread * _FAN_DEG + rng.normal(0.0, 5.0, (n, 4)))
    angles = np.zeros((n, skeleton.n_joints, 3))
    angles[:, 1:][:, skeleton.axes[1:]] = np.radians(
        np.hstack([thumb, np.stack([root, yaw, middle, end], axis=2).reshape(n, 16)])
    )
    return np.clip(angles, skeleton.limits[..., 0], skeleton.limits[..., 1])


def _drawn(rng: np.random.Generator, skeleton: Skeleton, n: int) -> Array:
    """Shapes, independently bent fingers and grasps (n, 13), as in `_shapes`."""
    share, shapes = np.split(_shapes(), [1], axis=1)
    shape = shapes[rng.choice(len(share), n, p=share[:, 0] / share.sum())]
    kind = rng.random((n, 1))
    others = [_free(rng, n), _grasps(rng, skeleton, n)]
    return np.select([kind < _FREE, kind > 1.0 - _GRASPS], others, shape)


def _free(rng: np.random.Generator, n: int) -> Array:
    """Fingers bent independently or all alike, and any thumb: (n, 13), as in `_shapes`."""
    bent = np.where(
        rng.random((n, 1)) < 0.3, rng.random((n, 1)), rng.beta(0.5, 0.5, (n, 4)) @ _FOLLOWS.T
    )
    root = -8.0 + 85.0 * bent * rng.uniform(0.2, 1.1, (n, 4))
    thumb = rng.uniform([-28.0, -25.0, -5.0, -15.0], [50.0, 25.0, 65.0, 75.0], (n, 4))
    return np.hstack([root, 100.0 * bent, rng.uniform(-1.0, 1.4, (n, 1)), thumb])


def _grasps(rng: np.random.Generator, skeleton: Skeleton, n: int) -> Array:
    """Grasps around cylinders and balls of 15 to 110 mm: (n, 13), as in `_shapes`.

    Bones are tangents: a joint bends by 2 atan(t / r) if both of its bones touch the object at t
    from it, with r from the object's axis to the fingers'. At the middle joint, t is a quarter of
    both bones together; the rest of the proximal bone is the t of the knuckle.
    """
    size = rng.uniform(15.0, 110.0, (n, 1))
    _, proximal, middle, _ = np.linalg.norm(skeleton.offsets[7:], axis=1).reshape(4, 4).T
    at = 0.25 * (proximal + middle)
    bend = 2.0 * np.degrees(np.arctan(np.hstack([proximal - at, at]) / (0.5 * size + _FINGER_MM)))
    spread = np.where(rng.random((n, 1)) < 0.4, size / 100.0, -0.8)  # balls, cylinders
    thumb = [38.0, -4.0, 40.0, 45.0] + size / 100.0 * [-28.0, 22.0, -26.0, -26.0]
    return np.hstack([bend, spread, thumb])


def draw_turns(rng: np.random.Generator, n: int, anywhere: float = 0.0) -> Array:
    """Draw orientations of the right hand of a person in front of the camera.

    The hand is 0.4 to 0.9 arm lengths before the shoulder, the elbow on the circle that this
    leaves, usually below. In 70 % of the draws the palm is turned to the camera.

    Args:
        rng: random number generator.
        n: number of orientations.
        anywhere: share of hands before cameras anywhere: any spin, tilts of 35 degrees, and the
            palm towards the viewer in two thirds of them, else the back.

    Returns:
        (n, 3, 3) T_view_palm, the view's z axis pointing at the viewer, y up.
    """
    # in the view of a camera at eye level, from the shoulder; a person's right is the view's left
    way = rng.uniform([-50.0, -35.0], [45.0, 35.0], (n, 2))  # to the left, and down
    ahead = _turned("YX", way)[:, :, 2]
    reach = rng.uniform(0.4, 0.9, (n, 1)) * (_UPPER_ARM_MM + ARM_MM)
    down = _perpendicular(-_turned("Z", rng.normal(-25.0, 30.0, (n, 1)))[:, :, 1], ahead)
    along = (reach**2 + _UPPER_ARM_MM**2 - ARM_MM**2) / (2.0 * reach)
    elbow = along * ahead + np.sqrt(_UPPER_ARM_MM**2 - along**2) * down
    forward = (reach * ahead - elbow) / ARM_MM
    # half way between palm up and palm down, the thumb is on the side of the upper arm
    thumb = _perpendicular(-elbow, forward)
    forearm = np.stack([forward, thumb, np.cross(forward, thumb)], axis=-1)
    # the forearm turns; the wrist bends to the palm and to the thumb
    bend = rng.normal([-55.0, -10.0, -5.0], [30.0, 22.0, 11.0], (n, 3))
    bend[:, 0] = np.where(rng.random(n) < 0.7, bend[:, 0], rng.uniform(-85.0, 85.0, n))
    bend = np.clip(bend, [-85.0, -65.0, -30.0], [85.0, 70.0, 20.0])
    # the camera is tilted down, and the person turned from it
    view = rng.normal([8.0, 0.0], [18.0, 25.0], (n, 2))
    free = np.column_stack([rng.uniform(-180.0, 180.0, n), rng.normal(0.0, 35.0, (n, 2))])
    free[:, 2] += 180.0 * (rng.random(n) < 2.0 / 3.0)  # z leaves through the back
    held = _turned("XY", view) @ forearm @ _turned("XYZ", bend)
    return np.where(rng.random((n, 1, 1)) < anywhere, _turned("ZYX", free), held)


def _turned(axes: str, degrees: Array) -> Array:
    """Rotations (n, 3, 3) by angles (n, A) about the axes of a moving frame, as 'ZYX'."""
    return Rotation.from_euler(axes, degrees, degrees=True).as_matrix()


def _perpendicular(vectors: Array, axes: Array) -> Array:
    """Unit vectors (n, 3) along the parts of vectors (n, 3) perpendicular to unit axes (n, 3)."""
    rest = vectors - np.sum(vectors * axes, axis=1, keepdims=True) * axes
    return rest / np.linalg.norm(rest, axis=1, keepdims=True)
