"""Which measures are drawn over time, by what the body is: one list for report, replay and pages.

A mouse has a height of its nose, a fish a tail that beats, a hand fingers that open. What a curve
is called follows from the names of the skeleton's joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from liex_lab.behaviour.body import BRANCHES, STANDS, SWIMS, BodyAxis, parents_of
from liex_lab.tables.units import shown, titled

_BLUE = "#4477aa"
_GREEN = "#228833"
_PURPLE = "#aa3377"
_BEND = ("bend_rad", "Bend", "of the whole body, positive to the left", "rad", _PURPLE, False)


@dataclass(frozen=True)
class Curve:
    """A measure over time.

    Attributes:
        column: of the table `kinematics`.
        title: what it is called.
        what: the rest of its title.
        unit: that of the column.
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
        """Where a replay keeps it: named by the unit that people read, in which it is kept."""
        unit = shown(1.0, self.unit)[1].replace("/", "_").replace("°", "deg")
        name = titled(self.column, self.unit).replace(" ", "_")
        return f"kinematics/{name}_{unit}" if unit else f"kinematics/{name}"

    @property
    def entity_before(self) -> str:
        """Where replays of earlier versions keep it, in the unit of the table."""
        return f"kinematics/{self.column}"


def axis_of(animal: Mapping[str, Any]) -> BodyAxis:
    """Which joint plays which part.

    Args:
        animal: the section of that name of a session.json.
    """
    return BodyAxis.of(animal["joints"], parents_of(animal))


def curves_of(animal: Mapping[str, Any]) -> tuple[Curve, ...]:
    """The measures that are drawn over time of such an animal, the most usual first.

    Args:
        animal: the section of that name of a session.json.
    """
    body = axis_of(animal)
    speed = Curve("speed_mm_s", "Speed", "of the body centre", "mm/s", _BLUE)
    if body.kind == SWIMS:
        return (
            speed,
            Curve("z_mm", "Height", "of the body centre above the floor", "mm", _GREEN),
            Curve(*_BEND),
            Curve("tail_beat_hz", "Tail beat", "frequency", "Hz", _PURPLE),
        )
    if body.kind == BRANCHES:
        opened = f"of {_limbs(body)}; 1: stretched out"
        return (
            speed,
            Curve("z_mm", "Height", f"of the {_base(body)} above the background", "mm", _GREEN),
            Curve("opening", "Opening", opened, "", _PURPLE, False),
        )
    front = body.joints[body.front].replace("_", " ").capitalize()
    return (speed, Curve("nose_height_mm", f"{front} height", "above the floor", "mm", _GREEN))


def logged_of(animal: Mapping[str, Any]) -> tuple[Curve, ...]:
    """The measures that a replay keeps over time: the drawn ones, and the bend of a chain.

    Args:
        animal: the section of that name of a session.json.
    """
    drawn = curves_of(animal)
    bends = axis_of(animal).kind == STANDS
    return (*drawn, Curve(*_BEND)) if bends else drawn


def _base(body: BodyAxis) -> str:
    """What the limbs are at."""
    return body.joints[body.rear].replace("_", " ")


def _limbs(body: BodyAxis) -> str:
    """The limbs by the first word of their ends' names."""
    names = [body.joints[limb[-1]].split("_")[0] for limb in body.limbs]
    if len(set(names)) < len(names):
        return f"the {len(names)} limbs"
    return f"{', '.join(names[:-1])} and {names[-1]}"
