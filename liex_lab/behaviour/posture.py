"""The shape of a chain of joints in each frame: axis, length, bend and curvature.

A bend is measured in the animal's own frontal plane: the one through its axis and the horizontal,
as if it did not roll. Positive bends are towards the animal's left. What "the bend of a body" is
differs between publications by a factor of two and more; here it is the whole turn from the
direction of the front bone to that of the rear one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from liex_lab.behaviour.body import Body
from liex_lab.runtime.memory import Room, let_go

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Posture:
    """A body (n frames) by its joints `spine` (n, K, 3) mm, front to rear, with their sd (n, K) mm
    along an axis.

    centre (n, 3) mm and its sd (n,); axis (n, 3) mm, the line whose direction is the heading, and
    the sd (n,) of the difference of its ends.
    """

    body: Body
    spine: Array
    spine_sd: Array
    centre: Array
    centre_sd: Array
    axis: Array
    axis_sd: Array

    @staticmethod
    def of(body: Body, xyz: Array, sd: Array) -> Posture:
        """From all joints (n, J, 3) mm and their sd (n, J)."""
        spine, trunk, (start, stop) = list(body.spine), list(body.trunk), body.axis
        return Posture(
            body,
            xyz[:, spine],
            sd[:, spine],
            xyz[:, trunk].mean(axis=1),
            sd[:, trunk].mean(axis=1),
            xyz[:, stop] - xyz[:, start],
            np.hypot(sd[:, start], sd[:, stop]),
        )

    @cached_property
    def pitch_rad(self) -> Array:
        """(n,) angle of the axis above the floor."""
        return np.asarray(np.arctan2(self.axis[:, 2], self._reach))

    @cached_property
    def pitch_sd_rad(self) -> Array:
        """(n,) standard deviation of the pitch."""
        return self.axis_sd / _positive(np.linalg.norm(self.axis, axis=1))

    @cached_property
    def heading_rad(self) -> Array:
        """(n,) direction of the axis over the floor."""
        return np.asarray(np.arctan2(self.axis[:, 1], self.axis[:, 0]))

    @cached_property
    def heading_sd_rad(self) -> Array:
        """(n,) standard deviation of the heading; of a direction that is not known at all it is no
        more than that.
        """
        return np.asarray(np.minimum(self.axis_sd / _positive(self._reach), np.pi / np.sqrt(3.0)))

    @cached_property
    def length_mm(self) -> Array:
        """(n,) length of the chain, all bones added up."""
        return np.asarray(self._bone_mm.sum(axis=1))

    @cached_property
    def straightness(self) -> Array:
        """(n,) distance of the chain's ends over its length: 1 is straight."""
        return np.linalg.norm(self.spine[:, 0] - self.spine[:, -1], axis=1) / _positive(
            self.length_mm
        )

    @cached_property
    def turns_rad(self) -> Array:
        """(n, K - 2) by how much the chain turns at each inner joint, front to rear; positive to
        the left.
        """
        bones = np.diff(self.spine, axis=1)
        a = bones[:, :-1]
        b = bones[:, 1:]
        # the bones point backwards: a chain whose tail is on its left turns clockwise from front to
        # rear
        across = -np.einsum("nki,ni->nk", np.cross(a, b), self._dorsal)
        return np.asarray(np.arctan2(across, np.einsum("nki,nki->nk", a, b)))

    @cached_property
    def bend_rad(self) -> Array:
        """(n,) the whole turn from the front bone to the rear one."""
        return (
            np.asarray(self.turns_rad.sum(axis=1))
            if self.spine.shape[1] > 2
            else np.full(len(self.spine), np.nan)
        )

    @cached_property
    def rear_sd_mm(self) -> Array:
        """(n,) standard deviation of the chain's rear end."""
        return self.spine_sd[:, -1]

    def thirds_rad(self) -> tuple[Array, Array, Array]:
        """(n,) each: by how much the front, middle and rear third of the chain turns; positive to
        the left.
        """
        inner = self.turns_rad.shape[1]
        third = 3 * np.arange(1, inner + 1) // (inner + 1)
        front, middle, rear = (self.turns_rad[:, third == k].sum(axis=1) for k in range(3))
        return front, middle, rear

    @cached_property
    def tail_mm(self) -> Array:
        """(n,) how far the chain's rear end is beside the line of the axis; positive to the
        left.
        """
        return np.asarray(np.einsum("ni,ni->n", self.spine[:, -1] - self.spine[:, 0], self._left))

    @cached_property
    def tail_angle_rad(self) -> Array:
        """(n,) angle at the front between the backward axis and the line to the rear end; positive
        to the left.
        """
        to_rear = self.spine[:, -1] - self.spine[:, 0]
        ahead = self.axis / _positive(np.linalg.norm(self.axis, axis=1))[:, None]
        return np.asarray(np.arctan2(self.tail_mm, -np.einsum("ni,ni->n", to_rear, ahead)))

    @cached_property
    def _reach(self) -> Array:
        return np.asarray(np.hypot(self.axis[:, 0], self.axis[:, 1]))

    @cached_property
    def _bone_mm(self) -> Array:
        return np.asarray(np.linalg.norm(np.diff(self.spine, axis=1), axis=2))

    @cached_property
    def _left(self) -> Array:
        """(n, 3) the animal's left, horizontal; unknown for a vertical axis."""
        left = np.stack([-self.axis[:, 1], self.axis[:, 0], np.zeros(len(self.axis))], axis=1)
        return left / _positive(self._reach)[:, None]

    @cached_property
    def _dorsal(self) -> Array:
        """(n, 3) the animal's back, upright in the vertical plane through its axis."""
        ahead = self.axis / _positive(np.linalg.norm(self.axis, axis=1))[:, None]
        return np.asarray(np.cross(ahead, self._left))


@dataclass(frozen=True)
class Shape:
    """What is told of a body's posture in each of n frames; see `Posture`. thirds_rad (n, 3);
    rear_sd_mm (n,): of the chain's rear end. Of a body that does not swim the last four are empty.
    """

    centre: Array
    centre_sd: Array
    pitch_rad: Array
    pitch_sd_rad: Array
    heading_rad: Array
    heading_sd_rad: Array
    length_mm: Array
    straightness: Array
    bend_rad: Array
    thirds_rad: Array
    tail_mm: Array
    tail_angle_rad: Array
    rear_sd_mm: Array

    @staticmethod
    def empty(n: int, room: Room = np.empty) -> Shape:
        """For n frames; room: where they are to lie."""
        more = {"centre": (n, 3), "thirds_rad": (n, 3)}
        shape = Shape(*(room(more.get(one.name, (n,)), float) for one in fields(Shape)))
        for column in vars(shape).values():
            column[:] = np.nan
            let_go(column)
        return shape

    def rest(self) -> None:
        """Let go of the memory of columns that lie on disk, until they are looked at again."""
        let_go(*vars(self).values())

    def put(self, rows: slice, posture: Posture) -> None:
        """What a posture tells of some frames."""
        told = [one.name for one in fields(Shape)]
        for name in told[: None if posture.body.swims else -4]:
            if name == "thirds_rad":
                self.thirds_rad[rows] = np.stack(posture.thirds_rad(), axis=1)
            else:
                getattr(self, name)[rows] = getattr(posture, name)


def _positive(values: Array) -> Array:
    """Values to divide by; NaN instead of 0."""
    return np.where(values > 1e-9, values, np.nan)
