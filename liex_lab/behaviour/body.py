"""Roles of the joints in an animal's skeleton: front, rear, midline, heading axis and trunk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class BodyAxis:
    """An animal's joints by the parts they play, as indices into its skeleton.

    Attributes:
        joints: names of the J joints.
        swims: whether the chain begins at the head, as a fish's does, and the animal moves in all
            three directions.
        spine: the chain from front to rear.
        axis: (from, to), the line whose direction is the heading.
        trunk: the joints whose mean is the body's centre.
    """

    joints: tuple[str, ...]
    swims: bool
    spine: tuple[int, ...]
    axis: tuple[int, int]
    trunk: tuple[int, ...]

    @property
    def front(self) -> int:
        """The nose, or the head, as an index."""
        return self.spine[0]

    @property
    def rear(self) -> int:
        """The tail's base, or its tip, as an index."""
        return self.spine[-1]

    @property
    def back(self) -> tuple[int, ...]:
        """The joints between front and rear, as indices."""
        return self.spine[1:-1] or self.spine[:1]

    @staticmethod
    def of(joints: Sequence[str]) -> BodyAxis:
        """The parts by name or along the chain, which begins at the head or at the rump.

        A chain that begins at a head is that of an animal that swims; any other begins at the rump.

        A swimming body's heading is that of the front quarter of its chain, which is stiff, and its
        centre that of the front half, which the tail's beat hardly moves; a walking body's are rump
        to neck, and all but the nose.

        Args:
            joints: names of the joints in the skeleton's order.
        """
        names = tuple(joints)
        n = len(joints)
        if names[0] == "head":
            half = tuple(range(n // 2 + 1))
            return BodyAxis(names, True, tuple(range(n)), (min(max(n // 4, 1), n - 1), 0), half)
        at = {name: k for k, name in enumerate(names)}
        rump, neck, nose = (
            at.get(name, place)
            for name, place in (("rump", 0), ("neck", max(n - 2, 0)), ("nose", n - 1))
        )
        spine = (
            (nose, *(k for k in reversed(range(n)) if k not in (nose, rump)), rump)
            if n > 1
            else (0,)
        )
        trunk = tuple(k for k in range(n) if k != nose) or (nose,)
        return BodyAxis(names, False, spine, (rump, neck), trunk)
