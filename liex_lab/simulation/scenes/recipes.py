"""What scenes of mice are made of, by name.

A `SceneRecipe` says what is unlike the plain scene: a mouse alone in a clean open field whose floor
is the largest plane.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

import numpy as np

from liex_lab.simulation.scene import BOX, ROUND


@dataclass(frozen=True)
class SceneRecipe:
    """What a scene of mice is made of.

    Attributes:
        says: what stands before the camera, in words.
        camera_mm: height of the camera above the floor, mm.
        tilt_rad: of the camera, rad.
        kind: outline of the arena, 'box' or 'round'.
        half_mm: half the arena's sides, mm.
        wall_mm: height of its walls, mm.
        n_arenas: arenas in the picture, 1, 2 or 4, each with an animal of its own.
        around: 'bench', 'untidy' or 'table', see `places`.
        n_animals: in one arena.
        presence: of the animals, one of `cast.PRESENCES`.
        worn: '', 'head stage' or 'tether'.
        fixture: '', 'house', 'object', which is put in, 'object out', which is taken out, or 'lid'.
        bedding: whether there is bedding on the floor.
        glossy: whether the floor reflects, so that it is unread in places.
        drift_mm: what the sensor's depth changes by while it warms up, mm.
    """

    says: str
    camera_mm: float = 660.0
    tilt_rad: float = 0.06
    kind: str = BOX
    half_mm: tuple[float, float] = (260.0, 220.0)
    wall_mm: float = 160.0
    n_arenas: int = 1
    around: str = "bench"
    n_animals: int = 1
    presence: str = "always"
    worn: str = ""
    fixture: str = ""
    bedding: bool = False
    glossy: bool = False
    drift_mm: float = 0.0


def _recipes() -> dict[str, SceneRecipe]:
    plain = SceneRecipe("one mouse in a clean open field whose floor is the largest plane")
    unlike = {
        "small": {
            "says": "an arena of 30 cm among things of all heights, 15 % of the picture",
            "camera_mm": 610.0,
            "half_mm": (150.0, 150.0),
            "wall_mm": 140.0,
            "around": "untidy",
        },
        "raised": {
            "says": "an arena on a stool, the room's floor in view 48 cm below",
            "half_mm": (190.0, 190.0),
            "wall_mm": 150.0,
            "around": "table",
        },
        "tilted": {
            "says": "the camera tilted by 35 degrees",
            "camera_mm": 560.0,
            "tilt_rad": float(np.radians(35.0)),
            "half_mm": (230.0, 200.0),
            "wall_mm": 90.0,
        },
        "glossy": {"says": "a glossy floor, unread in places", "glossy": True},
        "round": {
            "says": "a round open field",
            "kind": ROUND,
            "half_mm": (230.0, 230.0),
            "wall_mm": 220.0,
        },
        "two-arenas": {
            "says": "two arenas in one picture, a mouse in each",
            "camera_mm": 720.0,
            "half_mm": (170.0, 210.0),
            "wall_mm": 120.0,
            "n_arenas": 2,
        },
        "four-arenas": {
            "says": "four arenas in one picture, a mouse in each",
            "camera_mm": 800.0,
            "half_mm": (165.0, 150.0),
            "wall_mm": 110.0,
            "n_arenas": 4,
        },
        "tether": {"says": "a cable from the head to a commutator above", "worn": "tether"},
        "head-stage": {"says": "a head stage of 10 x 8 x 12 mm", "worn": "head stage"},
        "bedding": {
            "says": "bedding with lumps of 18 mm that change where the animal walks",
            "half_mm": (210.0, 180.0),
            "bedding": True,
        },
        "house": {
            "says": "a shelter into which the animal goes",
            "half_mm": (240.0, 210.0),
            "fixture": "house",
        },
        "object": {
            "says": "a novel object, put in during the recording, that stays",
            "fixture": "object",
        },
        "object-out": {
            "says": "an object that is taken out during the recording",
            "fixture": "object out",
        },
        "asleep": {"says": "motionless for 78 % of the recording", "presence": "asleep"},
        "still": {"says": "the animal never moves", "presence": "still"},
        "late": {"says": "the animal is put in after two thirds", "presence": "late"},
        "leaves": {"says": "the animal is taken out before the middle", "presence": "leaves"},
        "empty": {"says": "no animal at all", "presence": "never", "n_animals": 0},
        "two-animals": {"says": "two mice in one arena", "n_animals": 2},
        "drift": {"says": "the sensor warms up by 5 mm", "drift_mm": 5.0},
        "cage": {
            "says": "a home cage with sloping walls, its rim, and the bars of its lid over a third",
            "camera_mm": 560.0,
            "half_mm": (185.0, 115.0),
            "wall_mm": 130.0,
            "fixture": "lid",
        },
    }
    return {"plain": plain} | {
        name: replace(plain, **changes)  # type: ignore[arg-type]
        for name, changes in unlike.items()
    }


RECIPES: Final[Mapping[str, SceneRecipe]] = MappingProxyType(_recipes())
