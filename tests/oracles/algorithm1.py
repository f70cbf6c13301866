"""Lie-X Algorithm 1 as the paper's page reads: one candidate, one joint, one round and one tree
after the other.

Rigid motions are 4x4 matrices and their exponentials SciPy's; points are projected through the
camera, and an offset's way over the map is a finite difference of that. Only the walk down a tree
is shared with `oracles.forest`.
"""

from dataclasses import dataclass
from math import erf

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.shape import Spheres
from liex_lab.estimation.model import Model
from liex_lab.forests.forest import Forest
from tests.oracles import motion
from tests.oracles.explain import explained
from tests.oracles.forest import leaf_by_hand

Array = NDArray[np.float64]


@dataclass
class Candidate:
    """One pose under way: a matrix (4, 4) for each joint, in the view frame, and the scale of its
    bones.
    """

    joints: list[Array]
    scale: float
    score: float = np.inf


@dataclass(frozen=True)
class Picture:
    """One height map (S, S), how it was cut (17,), its moments (9,), and the animal's size over
    home.
    """

    heights: NDArray[np.int16]
    look: Array
    moments: Array
    size: float
    reach_mm: float

    def pixel(self, point: Array) -> Array:
        """The crop's pixel (column, row) of a point (3,) mm in the view frame."""
        fx, fy, cx, cy = self.look[:4]
        x, y, z = self.look[4:13].reshape(3, 3).T @ (point - [0.0, 0.0, self.look[13]])
        return (np.array([fx * x / z + cx, fy * y / z + cy]) - self.look[14:16]) / self.look[16]

    def view(self, joint: Array) -> NDArray[np.float32]:
        """The nine numbers of a joint (4, 4): where it is, where offsets lead, how high it is."""
        h, place, unit = 1e-4, joint[:3, 3], self.reach_mm * self.size / 127.0
        columns = [
            (
                self.pixel(place + h * unit * joint[:3, k])
                - self.pixel(place - h * unit * joint[:3, k])
            )
            / (2 * h)
            for k in range(3)
        ]
        matrix = np.stack(columns, axis=1)
        return np.array(
            [*self.pixel(place), *matrix[0], *matrix[1], 16.0 * place[2] / self.size], np.float32
        )

    def scalars(self, joint: Array, scale: float) -> NDArray[np.float32]:
        """The eleven numbers that describe the whole animal as a joint (4, 4) sees it."""
        _, area, volume, x, y, axis, along, across, _ = self.moments
        size, place, forward = self.size, joint[:3, 3], joint[:3, 0]
        to_middle = np.array([x - place[0], y - place[1], 0.0])
        turned = axis - np.arctan2(forward[1], forward[0])
        return np.array(
            [
                500 * np.log(max(area, 1) / size**2),
                500 * np.log(max(volume, 1) / size**3),
                16 * along / size,
                16 * across / size,
                16 * to_middle @ joint[:3, 0] / size,
                16 * to_middle @ joint[:3, 1] / size,
                16 * place[2] / size,
                500 * joint[2, 0],
                500 * joint[2, 1],
                500 * np.sin(2 * turned) * (along - across) / max(along + across, 1e-6),
                500 * np.log(scale / size),
            ],
            np.float32,
        )


def votes_of(
    forest: Forest, picture: Picture, views: NDArray[np.float32], scalars: NDArray[np.float32]
) -> Array:
    """What each tree says (T, D)."""
    exact = views.astype(float)  # numpy would add float32 numbers as float32
    leaves = [
        leaf_by_hand(
            forest.nodes, root, picture.heights, np.float32(1 / picture.size), exact, scalars
        )
        for root in forest.roots
    ]
    return forest.leaves[leaves].astype(float)


def mode(votes: Array, bandwidth: float) -> Array:
    """Four mean-shift steps with a Gaussian kernel, from the mean of votes (T, D)."""
    at = votes.mean(axis=0)
    for _ in range(4):
        weight = np.exp(-0.5 * np.sum((votes - at) ** 2, axis=1) / bandwidth**2)
        if weight.sum() < 1e-12:
            return at
        at = weight @ votes / weight.sum()
    return at


def start(model: Model, moments: Array, number: int, drawn: Array, size: float) -> Candidate:
    """Candidate `number` of an animal with moments (9,), from its drawn numbers (4,)."""
    _, area, volume, x, y, axis, along, across, _ = moments
    length = model.skeleton.length
    if model.method.axis_start:
        spread = 0.12 + 0.7 * (across / max(along, 1e-6)) ** 2
        heading = axis + (np.pi if number % 2 else 0.0) + spread * drawn[0]
        scale = size
        back = 0.42 * length * size
        place = [
            x - back * np.cos(heading) + 2 * size * drawn[1],
            y - back * np.sin(heading) + 2 * size * drawn[2],
            0.2 * length * size,
        ]
    else:
        # uniform in [0.9, 1.1]: what share of a bell lies below the number that was drawn
        heading, scale = np.pi * drawn[3], size * (1 + 0.1 * erf(drawn[1] / np.sqrt(2)))
        place = [x, y, volume / max(area, 1)]
    base = motion.exp([0, 0, heading, 0, 0, 0])
    base[:3, 3] = place
    return Candidate([base] + [np.eye(4)] * (model.skeleton.n_joints - 1), scale)


def seen_start(model: Model, picture: Picture, number: int, size: float) -> Candidate:
    """Candidate `number` where the method starts from proposals: what one tree says, the axis taken
    one way.
    """
    method, forest, (tree, way) = model.method, model.cascade.proposals, divmod(number, 2)
    assert forest is not None
    _, area, volume, x, y, axis, *_ = picture.moments
    frame = motion.exp([0, 0, axis + np.pi * way, 0, 0, 0])
    frame[:3, 3] = [x, y, volume / max(area, 1)]
    told = np.append(picture.scalars(frame, size), np.float32(1000 - 2000 * way))
    wide = Picture(picture.heights, picture.look, picture.moments, size, method.proposal_reach_mm)
    vote = votes_of(forest, wide, wide.view(frame)[None], told)[tree]
    u, _, vt = np.linalg.svd(vote[:9].reshape(3, 3))
    base = np.eye(4)
    base[:3, :3] = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    base[:3, 3] = size * vote[9:]
    return Candidate([frame @ base] + [np.eye(4)] * (model.skeleton.n_joints - 1), size)


def placed(model: Model, candidate: Candidate, joint: int) -> Array:
    """Where its parent carries a joint, at its home angle."""
    skeleton = model.skeleton
    home = np.eye(4)
    home[:3, :3], home[:3, 3] = skeleton.rest[joint], candidate.scale * skeleton.offsets[joint]
    return candidate.joints[skeleton.parents[joint]] @ home


def solve(model: Model, picture: Picture, candidate: Candidate) -> Candidate:
    """The candidate through all joints and rounds, and its score."""
    skeleton, method = model.skeleton, model.method
    for joint, rounds in zip(skeleton.solved, model.cascade.forests, strict=True):
        if joint > 0:
            candidate.joints[joint] = placed(model, candidate, joint)
        for forest in rounds:
            here = candidate.joints[joint]
            votes = votes_of(
                forest, picture, picture.view(here)[None], picture.scalars(here, candidate.scale)
            )
            value = (
                mode(votes, method.mean_shift_mm) if method.mean_shift_mm else votes.mean(axis=0)
            )
            twist = np.zeros(6)
            if joint == 0:
                twist[:3], twist[3:] = value[:3] / method.base_lever_mm, value[3:6] * picture.size
                candidate.scale *= (
                    np.exp(value[6] / method.scale_lever_mm) if method.regress_scale else 1.0
                )
            else:
                twist[:3][skeleton.axes[joint]] = value / method.joint_lever_mm
            candidate.joints[joint] = here @ motion.exp(twist)
    for joint in range(1, skeleton.n_joints):
        if joint not in skeleton.solved:
            candidate.joints[joint] = placed(model, candidate, joint)
    views = np.stack([picture.view(joint) for joint in candidate.joints])
    scalars = picture.scalars(candidate.joints[0], candidate.scale)
    if method.explains:
        joints = np.array(candidate.joints)
        fit = explained(
            picture.heights,
            picture.look,
            picture.moments[5],
            Spheres.of(skeleton),
            joints[:, :3, :3],
            joints[:, :3, 3],
            candidate.scale,
            picture.size,
        )
        scalars = np.append(scalars, np.floor(np.clip(fit, -32768, 32767)).astype(np.float32))
    told = votes_of(model.metric, picture, views, scalars)
    candidate.score = float(
        mode(told, method.mean_shift_mm)[0] if method.mean_shift_mm else told.mean()
    )
    return candidate
