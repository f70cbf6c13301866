"""Roles of the joints in an animal's skeleton: front, rear, midline, heading axis and trunk."""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from liex_lab.tables.schema import shown, titled

STANDS = "stands"  # on a floor, over which it moves
SWIMS = "swims"  # in all three directions; its tail beats
BRANCHES = "branches"  # limbs at a base, such as a hand's fingers at the palm; no front
KINDS = (STANDS, SWIMS, BRANCHES)
_OWN_COLUMN = {"bend_front_rad": SWIMS, "opening": BRANCHES}  # columns of `kinematics`


@dataclass(frozen=True)
class BodyAxis:
    """The roles of an animal's joints, as indices into its skeleton.

    Attributes:
        joints: names of the J joints.
        kind: one of `KINDS`, which determines the measures.
        spine: the chain from front to rear; for a branching body, its middle limb from the end.
        axis: (from, to), the line whose direction is the heading.
        trunk: the joints whose mean is the body's centre.
        limbs: for a branching body, the chains that can bend, each from the base to its end.
    """

    joints: tuple[str, ...]
    kind: str
    spine: tuple[int, ...]
    axis: tuple[int, int]
    trunk: tuple[int, ...]
    limbs: tuple[tuple[int, ...], ...] = ()

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
    def of(joints: Sequence[str], parents: Sequence[int] | None = None) -> "BodyAxis":
        """The roles by name or along the chain, which begins at the head or at the rump.

        A chain that begins at a head is a swimming animal; any other chain begins at the rump. A
        tree of several limbs without a nose, such as a hand, has neither front nor rear: its centre
        is the mean of the base joint and its neighbours, and its heading points from the base to
        the root of its middle limb.

        A swimming body's heading is that of the front quarter of its chain, which is stiff, and its
        centre that of the front half, which the tail's beat hardly moves. A walking body's heading
        is rump to neck, and its centre includes all joints except the nose.

        Args:
            joints: names of the joints in the skeleton's order.
            parents: joint before each of them, -1 at the base; None means one chain.
        """
        names = tuple(joints)
        n = len(joints)
        if names[0] == "head":
            half = tuple(range(n // 2 + 1))
            return BodyAxis(names, SWIMS, tuple(range(n)), (min(max(n // 4, 1), n - 1), 0), half)
        limbs = _limbs(parents or range(-1, n - 1))
        if len(limbs) > 1 and "nose" not in names:
            middle = limbs[len(limbs) // 2]
            assert parents is not None
            trunk = (middle[0], *(k for k in range(n) if parents[k] == middle[0]))
            return BodyAxis(names, BRANCHES, middle[::-1], (middle[0], middle[1]), trunk, limbs)
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
        return BodyAxis(names, STANDS, spine, (rump, neck), trunk)


def kind_of(names: Iterable[Hashable]) -> str:
    """The kind of body, one of `KINDS`, whose table `kinematics` has the columns `names`."""
    return next((_OWN_COLUMN[str(name)] for name in names if name in _OWN_COLUMN), STANDS)


def parents_of(animal: Mapping[str, Any]) -> tuple[int, ...]:
    """Joint before each joint, -1 at the base.

    Args:
        animal: the section `animal` of a session.json.
    """
    before = {int(child): int(parent) for parent, child in animal["bones"]}
    return tuple(before.get(joint, -1) for joint in range(len(animal["joints"])))


def _limbs(parents: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """The chains from the base to an end with three or more joints; shorter ones cannot bend."""
    found = []
    for end in sorted(set(range(len(parents))) - set(parents)):
        chain = [end]
        while parents[chain[-1]] >= 0:
            chain.append(parents[chain[-1]])
        if len(chain) >= 3:
            found.append(tuple(chain[::-1]))
    return tuple(found)


# The measures drawn over time, by kind of body: one list for report, replay and pages.


_BLUE = "#4477aa"
_GREEN = "#228833"
_PURPLE = "#aa3377"
_BEND = ("bend_rad", "Bend", "of the whole body, positive to the left", "rad", _PURPLE, False)


@dataclass(frozen=True)
class DrawnMeasure:
    """A measure over time.

    Attributes:
        column: of the table `kinematics`.
        title: its name.
        what: the rest of its title.
        unit: of the column.
        colour: as #rrggbb.
        from_zero: whether its axis begins at zero.
    """

    column: str
    title: str
    what: str
    unit: str
    colour: str
    from_zero: bool = True

    @property
    def entity(self) -> str:
        """Its entity in a replay, named by the displayed unit, in which the replay stores it."""
        unit = shown(1.0, self.unit)[1].replace("/", "_").replace("°", "deg")
        name = titled(self.column, self.unit).replace(" ", "_")
        return f"kinematics/{name}_{unit}" if unit else f"kinematics/{name}"

    @property
    def entity_before(self) -> str:
        """Its entity in replays of earlier versions, in the unit of the table."""
        return f"kinematics/{self.column}"


def axis_of(animal: Mapping[str, Any]) -> BodyAxis:
    """The roles of an animal's joints.

    Args:
        animal: the section `animal` of a session.json.
    """
    return BodyAxis.of(animal["joints"], parents_of(animal))


def drawn_measures(animal: Mapping[str, Any]) -> tuple[DrawnMeasure, ...]:
    """The measures drawn over time for an animal, the most common first.

    Args:
        animal: the section `animal` of a session.json.
    """
    body = axis_of(animal)
    speed = DrawnMeasure("speed_mm_s", "Speed", "of the body centre", "mm/s", _BLUE)
    if body.kind == SWIMS:
        return (
            speed,
            DrawnMeasure("z_mm", "Height", "of the body centre above the floor", "mm", _GREEN),
            DrawnMeasure(*_BEND),
            DrawnMeasure("tail_beat_hz", "Tail beat", "frequency", "Hz", _PURPLE),
        )
    if body.kind == BRANCHES:
        base = body.joints[body.rear].replace("_", " ")  # where the limbs meet
        opened = f"of {_limb_names(body)}; 1: stretched out"
        return (
            speed,
            DrawnMeasure("z_mm", "Height", f"of the {base} above the background", "mm", _GREEN),
            DrawnMeasure("opening", "Opening", opened, "", _PURPLE, False),
        )
    front = body.joints[body.front].replace("_", " ").capitalize()
    return (
        speed,
        DrawnMeasure("nose_height_mm", f"{front} height", "above the floor", "mm", _GREEN),
    )


def logged_of(animal: Mapping[str, Any]) -> tuple[DrawnMeasure, ...]:
    """The measures over time in a replay: the drawn ones, and the bend of a chain.

    Args:
        animal: the section `animal` of a session.json.
    """
    drawn = drawn_measures(animal)
    return (*drawn, DrawnMeasure(*_BEND)) if (axis_of(animal).kind == STANDS) else drawn


def _limb_names(body: BodyAxis) -> str:
    """The limbs by the first word of their end joints."""
    names = [body.joints[limb[-1]].split("_")[0] for limb in body.limbs]
    if len(set(names)) < len(names):
        return f"the {len(names)} limbs"
    return f"{', '.join(names[:-1])} and {names[-1]}"
