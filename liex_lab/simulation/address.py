"""Addresses of synthetic recordings, `synthetic:<kind>?<key>=<value>&...`, opened like a file.

Example: synthetic:walk?seed=3&frames=300. The query part is parsed as that of a URL; an error about
an unknown key names the nearest valid one.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Any, Final
from urllib.parse import parse_qsl

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Lens
from liex_lab.recordings.camera_file import fitting
from liex_lab.recordings.recording import Recording
from liex_lab.simulation.recording import TrueRecording
from liex_lab.simulation.simulator import world_of
from liex_lab.simulation.species import BY_NAME
from liex_lab.simulation.tracking_sequences import SEQUENCES, tracking_sequence

_ANIMALS: Final = {"walk": "mouse", "swim": "fish", "gesture": "hand"}  # "move" takes any
_SEQUENCES: Final = {f"track-{name}": name for name in SEQUENCES}
_SCENE: Final = "scene"
_KINDS: Final = (*_ANIMALS, "move", *_SEQUENCES, _SCENE)
_SENSORS: Final = {"walk": ("kinect-v2", "primesense", "primesense-qvga"), "swim": ("raytrix-r5",)}
_EXAMPLE = "synthetic:walk?seed=3&frames=300&sensor=kinect-v2&spine_mm=65"
_MOST_FRAMES = 100_000  # an hour; the truth of every frame is in memory
_MOST_SCENE_FRAMES = 20_000  # cables and bedding are also in memory
_SIZES = (0.5, 2.9)  # of the home length
_BUILDS = ("other", "train")  # builds of animals in scenes: not used in training, or used


def open_synthetic(address: str, camera: Lens | None = None) -> Recording:
    """Open the virtual recording at an address.

    An example is synthetic:walk?seed=3&frames=300&sensor=kinect-v2&spine_mm=65. Kinds: walk, a
    mouse; swim, a fish; gesture, a hand; move, the animal of a skeleton's TOML, animal=snake.toml.
    Every setting is optional: the defaults are seed 0, 300 frames, the animal's usual sensor, and a
    size drawn from the seed. track-easy and track-hard are the test sequences of
    `simulation.tracking_sequences`, of a mouse, or with animal=fish or animal=hand of those; with a
    seed or more frames they are new sequences of the same kind. scene is one of
    `simulation.scenes`, such as synthetic:scene?name=raised&seed=3; build=train uses a training
    body.

    Args:
        address: the recording's address, starting with synthetic:.
        camera: overrides the true camera, to test the effect of a wrong one; None uses the true
            one.

    Returns:
        A recording with truth (a `TrueRecording`).

    Raises:
        RecordingError: the kind, a setting or its value is invalid, or the animal is missing.
    """
    kind, _, query = address.removeprefix("synthetic:").partition("?")
    if kind not in _KINDS:
        raise RecordingError(
            f"{address} is no virtual recording; the kinds are {', '.join(_KINDS)}, as in "
            f"{_EXAMPLE}"
        )
    stated = dict(parse_qsl(query, keep_blank_values=True))
    if kind == _SCENE:
        return _stated_camera(_open_scene(address, stated), camera)
    animal = (
        _ANIMALS[kind]
        if kind in _ANIMALS
        else stated.pop("animal", "mouse" if kind in _SEQUENCES else "")
    )
    if not animal:
        raise RecordingError(
            f"{address} lacks the animal that moves, as in synthetic:move?animal=snake.toml&seed=3"
        )
    skeleton = Skeleton.load(animal)
    settings = _settings(kind, skeleton.length)
    values = _values(address, stated, settings)
    world = world_of(skeleton)
    session: TrueRecording
    if kind in _SEQUENCES:
        seed = values.pop("seed", None)
        n_frames = values.pop("frames", None)
        session = tracking_sequence(world, _SEQUENCES[kind], seed=seed, n_frames=n_frames, **values)
    else:
        seed = values.pop("seed", 0)
        n_frames = values.pop("frames", 300)
        session = world.motion(seed, n_frames, name=f"synthetic-{kind}-{seed}", **values)
    return _stated_camera(session, camera)


def _stated_camera(session: Recording, camera: Lens | None) -> Recording:
    """The recording with the user's camera, if given."""
    if camera is not None:
        session.camera = fitting(
            camera, session.width, session.height, "the camera that was stated"
        )
    return session


def _open_scene(address: str, stated: dict[str, str]) -> Recording:
    """Open the recording of a scene's address."""
    from liex_lab.simulation.scenes.catalogue import SCENES, SEALED_FROM, film

    named = stated.pop("name", "plain")
    if named not in SCENES:
        near = difflib.get_close_matches(named, SCENES, 1, cutoff=0.0)[0]
        raise RecordingError(
            f"{address}: there is no scene {named}, the nearest one is {near}; known are "
            f"{', '.join(SCENES)}"
        )
    plan, _ = SCENES[named]
    kind = next(kind for kind, animal in _ANIMALS.items() if animal == plan)
    settings = _settings(kind, Skeleton.load(plan).length)
    settings["frames"] = (
        int,
        lambda n: 1 <= n <= _MOST_SCENE_FRAMES,
        f"a whole number from 1 to {_MOST_SCENE_FRAMES}",
    )
    if plan != "mouse":
        settings.pop("sensor", None)
    settings["build"] = (str, lambda build: build in _BUILDS, f"one of {', '.join(_BUILDS)}")
    values = _values(address, stated, settings)
    seed = values.pop("seed", 0)
    if seed >= SEALED_FROM:
        raise RecordingError(
            f"{address}: seeds from {SEALED_FROM} on are kept for `liex evaluate scenes --sealed`; "
            "take a smaller one"
        )
    family = values.pop("build", _BUILDS[0])
    return film(named, seed, values.pop("frames", 300), family=family, **values)


def _values(address: str, stated: dict[str, str], settings: dict[str, _Setting]) -> dict[str, Any]:
    """The values of an address's settings, validated against the settings of its kind."""
    for key in stated:
        if key not in settings:
            near = difflib.get_close_matches(key, settings, 1, cutoff=0.0)[0]
            raise RecordingError(
                f"{address}: {key} is no setting of it; the nearest one is {near}, as in {_EXAMPLE}"
            )
    return {key: _value(address, key, text, settings[key]) for key, text in stated.items()}


_Setting = tuple[Callable[[str], Any], Callable[[Any], bool], str]


def _settings(kind: str, home_mm: float) -> dict[str, _Setting]:
    """For each setting: its parser, its check, and the expected value for the error message."""
    low, high = (
        (30.0, 150.0)
        if kind == "walk"
        else (round(f * home_mm, -int(home_mm > 100)) for f in _SIZES)
    )
    settings: dict[str, _Setting] = {
        "seed": (int, lambda seed: seed >= 0, "a whole number from 0 on"),
        "frames": (
            int,
            lambda n: 1 <= n <= _MOST_FRAMES,
            f"a whole number from 1 to {_MOST_FRAMES}",
        ),
        "spine_mm": (float, lambda mm: low <= mm <= high, f"a length from {low:g} to {high:g} mm"),
    }
    if sensors := _SENSORS.get(kind):
        settings["sensor"] = (
            lambda name: BY_NAME[name] if name in sensors else BY_NAME[""],
            lambda _: True,
            f"one of {', '.join(sensors)}",
        )
    return settings


def _value(address: str, key: str, text: str, setting: _Setting) -> Any:
    """Parse the value of one setting of an address."""
    read, holds, expected = setting
    try:
        value = read(text)
        if holds(value):
            return value
    except (KeyError, ValueError):
        pass
    raise RecordingError(
        f"{address}: {key} is {expected}, got '{text}'; correct it, as in {_EXAMPLE}"
    )
