"""The scenes by name: mice after a recipe, a fish in a small tank, a hand, and one in a mirror."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import RecordingError
from liex_lab.simulation.hand.simulator import gesture_session
from liex_lab.simulation.locomotion import swimming_session
from liex_lab.simulation.scenes.making import Making
from liex_lab.simulation.scenes.recipes import RECIPES
from liex_lab.simulation.scenes.recording import OneAnimal, TrueScene
from liex_lab.simulation.sensors import KINECT_V2_SENSOR, Sensor

SEALED_FROM: Final = 900_000_000  # seeds from here on are kept for the sealed split
# name: (the plan of its animal, the scene beside which it stands, '' for none)
SCENES: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    dict.fromkeys(RECIPES, ("mouse", "plain"))
    | {"fish": ("fish", ""), "hand": ("hand", ""), "mirrored-hand": ("hand", "hand")}
)


def film(
    name: str,
    seed: int,
    n_frames: int,
    *,
    sensor: Sensor = KINECT_V2_SENSOR,
    family: str = "other",
    spine_mm: float | None = None,
) -> TrueScene:
    """A recording of a scene.

    Args:
        name: of the scene, a key of `SCENES`.
        seed: that everything is drawn from.
        n_frames: its length, at 30 frames/s, of a fish at 50.
        sensor: the camera's make, of scenes with mice.
        family: of body shapes, see `body.shape.draw_shapes`; 'other' are builds that no model was
            trained on.
        spine_mm: length of the animals, mm; None draws it.

    Returns:
        The recording with the truth of all animals in it.

    Raises:
        RecordingError: there is no such scene.
    """
    if name not in SCENES:
        raise RecordingError(f"there is no scene '{name}'; known are {', '.join(SCENES)}")
    title = f"scene-{name}-{seed}"
    if name in RECIPES:
        return Making(name, RECIPES[name], seed, n_frames, sensor, family, spine_mm).recording()
    if name == "fish":
        fish = swimming_session([seed, 5], n_frames, family=family, spine_mm=spine_mm)
        return OneAnimal(title, name, fish)
    hand = gesture_session(
        Skeleton.load("hand"), [seed, 6], n_frames, family=family, spine_mm=spine_mm
    )
    return OneAnimal(title, name, hand, mirrored=name == "mirrored-hand")
