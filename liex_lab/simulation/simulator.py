"""Virtual animals by name, test sequences for tracking, and recordings by address."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final
from urllib.parse import parse_qsl

import numpy as np

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Lens
from liex_lab.recordings.camera_file import fitting
from liex_lab.recordings.recording import Recording
from liex_lab.simulation import corruptions
from liex_lab.simulation.corruptions import Event, Loss
from liex_lab.simulation.foreign import KINDS, SEALED_BODY, ForeignRecording
from liex_lab.simulation.hand.simulator import HandSpecies, find_reference
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.scenes.catalogue import SCENES, SEALED_FROM, film
from liex_lab.simulation.scenes.groups import KINDS as GROUPS
from liex_lab.simulation.scenes.groups import film_group
from liex_lab.simulation.sensors import BY_NAME, Sensor
from liex_lab.simulation.species import FishSpecies, GenericSpecies, MouseSpecies, Species


def world_of(skeleton: Skeleton) -> Species:
    """The species of an animal; the generic one for other names than those below.

    Args:
        skeleton: of the animal; the names 'mouse', 'fish' and 'hand' have species of their own.

    Returns:
        The species; the hand uses labelled test postures if `find_reference` finds any.
    """
    known: dict[str, Callable[[Skeleton], Species]] = {
        "mouse": MouseSpecies,
        "fish": FishSpecies,
        "hand": lambda hand: HandSpecies(hand, reference=find_reference()),
    }
    return known.get(skeleton.name, GenericSpecies.of)(skeleton)


# Benchmark sequences for tracking: one moving animal, clean or corrupted, with exact truth.


# frames, as in the paper; own seed; settings, see `Take`; whether there are corruptions
SEQUENCES: Mapping[str, tuple[int, int, Mapping[str, Any], bool]] = {
    "easy": (511, 75_001, {}, False),
    "hard": (300, 76_001, {"noise": 2.0, "erosion_px": 1}, True),
}


def tracking_sequence(
    world: Species,
    name: str,
    *,
    seed: int | None = None,
    n_frames: int | None = None,
    sensor: Sensor | None = None,
    spine_mm: float | None = None,
) -> RenderedRecording:
    """The fixed sequence 'easy' or 'hard' of an animal; other seeds make similar ones.

    hard: bursts of holes, dropped frames, a bar passing between camera and animal, a second object,
    an animal that is lost in the floor's noise or in glare, and stretches at two to three times the
    speed.

    Args:
        world: the animal.
        name: 'easy' or 'hard', a key of `SEQUENCES`.
        seed: another seed makes a development sequence; None is the fixed one.
        n_frames: its length; None is the fixed one.
        sensor: the camera's make; None is the animal's first.
        spine_mm: length of the animal, mm; None draws it.

    Returns:
        The sequence with its truth and its events, including 'hidden' spans.

    Raises:
        RecordingError: there is no such sequence, or none of this animal.
    """
    if name not in SEQUENCES:
        raise RecordingError(f"there is no sequence '{name}'; known are {', '.join(SEQUENCES)}")
    usual_frames, usual_seed, settings, corrupted = SEQUENCES[name]
    n = n_frames or usual_frames
    own_seed = [usual_seed if seed is None else seed]
    rng = np.random.default_rng([*own_seed, 1])
    events: list[Event] = []
    steps = np.ones(n, np.int64)
    pace = np.ones(n, np.int64)
    if corrupted:
        events, steps = corruptions.draw_script(rng, n, world.frame_ns * 1e-9)
        pace = corruptions.pace(rng, events, n)
    rows = np.cumsum(np.concatenate([[0], (steps * pace)[1:]]))
    base = world.motion(
        own_seed,
        int(rows[-1]) + 1,
        sensor=sensor or world.sensors[0],
        spine_mm=spine_mm,
        **settings,
    )
    times = np.cumsum(np.concatenate([[0], steps[1:]])) * np.int64(world.frame_ns)
    joints, length = base.joints_camera[rows], base.spine_mm
    loss = Loss.draw(rng, events, base.camera, joints, length, world.floats)
    objects = corruptions.draw_objects(
        rng, events, base.stage.scene, base.joints_arena[rows], length, world.objects, world.floats
    )
    stage = replace(base.stage[rows], times_ns=times, objects=objects)
    title = f"track-{name}-{world.skeleton.name}-{own_seed[0]}"
    sequence = RenderedRecording(title, stage, loss=loss)
    share = np.ones(n)
    occluded = np.flatnonzero(objects[0].moment >= 0)
    share[occluded] = sequence.visible(stage.actors[0], occluded)
    events += corruptions.hidden_spans(share)
    sequence.events = sorted(events, key=lambda event: (event.start, event.stop))
    return sequence


# Addresses of synthetic recordings, `synthetic:<kind>?<key>=<value>&...`, opened like a file.


_ANIMALS: Final = {"walk": "mouse", "swim": "fish", "gesture": "hand"}  # "move" takes any
_SEQUENCES: Final = {f"track-{name}": name for name in SEQUENCES}
_KINDS: Final = (*_ANIMALS, "move", *_SEQUENCES, "scene", "pair", "foreign")
_SENSORS: Final = {
    "walk": tuple(name for name in BY_NAME if name != "raytrix-r5"),
    "swim": ("raytrix-r5",),
}
_EXAMPLE = "synthetic:walk?seed=3&frames=300&sensor=kinect-v2&spine_mm=65"
_BUILDS = ("other", "train")  # builds of animals in scenes: not used in training, or used


def open_synthetic(address: str, camera: Lens | None = None) -> Recording:
    """Open the virtual recording at an address.

    An example is synthetic:walk?seed=3&frames=300&sensor=kinect-v2&spine_mm=65. Kinds: walk, a
    mouse; swim, a fish; gesture, a hand; move, the animal of a skeleton's TOML, animal=snake.toml.
    Every setting is optional: the defaults are seed 0, 300 frames, the animal's usual sensor, and a
    size drawn from the seed. track-easy and track-hard are the test sequences
    of a mouse, or with animal=fish or animal=hand of those; with a
    seed or more frames they are new sequences of the same kind. scene is one of
    `simulation.scenes`, such as synthetic:scene?name=raised&seed=3; build=train uses a training
    body. pair are two to four mice (or animal=fish) that interact, such as
    synthetic:pair?seed=3&animals=3&apart=0.15&act=follow, see `simulation.scenes.groups`: apart is
    the difference in length between one and the next. foreign is a body that does not come from
    the training's generator, such as
    synthetic:foreign?animal=fish&body=2&seed=1, see `simulation.foreign`.

    Args:
        address: the recording's address, starting with synthetic:.
        camera: overrides the true camera, to test the effect of a wrong one; None uses the true
            one.

    Returns:
        A recording with truth (a `RenderedRecording` or a `ForeignRecording`).

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
    session: Recording
    if kind == "scene":
        session = _open_scene(address, stated)
    elif kind == "pair":
        session = _open_pair(address, stated)
    elif kind == "foreign":
        settings: dict[str, _Setting] = {
            "animal": (str, KINDS.__contains__, f"one of {', '.join(KINDS)}"),
            "body": (
                int,
                lambda body: 0 <= body < SEALED_BODY,
                f"a whole number below {SEALED_BODY}",
            ),
            **_settings(kind, 1.0),
        }
        del settings["spine_mm"]
        session = ForeignRecording(**_values(address, stated, settings))
    else:
        animal = _ANIMALS.get(kind) or stated.pop("animal", "mouse" if kind in _SEQUENCES else "")
        if not animal:
            raise RecordingError(
                f"{address} lacks the animal that moves, as in "
                "synthetic:move?animal=snake.toml&seed=3"
            )
        skeleton = Skeleton.load(animal)
        world = world_of(skeleton)
        values = _values(address, stated, _settings(kind, skeleton.length))
        if kind in _SEQUENCES:
            values["n_frames"] = values.pop("frames", None)
            session = tracking_sequence(world, _SEQUENCES[kind], **values)
        else:
            seed = values.pop("seed", 0)
            session = world.motion(
                seed, values.pop("frames", 300), name=f"synthetic-{kind}-{seed}", **values
            )
    if camera is not None:
        session.camera = fitting(
            camera, session.width, session.height, "the camera that was stated"
        )
    return session


def _open_scene(address: str, stated: dict[str, str]) -> Recording:
    """The recording of a scene's address."""
    named = stated.pop("name", "plain")
    if named not in SCENES:
        near = difflib.get_close_matches(named, SCENES, 1, cutoff=0.0)[0]
        raise RecordingError(
            f"{address}: there is no scene {named}, the nearest one is {near}; known are "
            f"{', '.join(SCENES)}"
        )
    plan, _ = SCENES[named]
    kind = next(kind for kind, animal in _ANIMALS.items() if animal == plan)
    # cables and bedding are in memory as well
    settings = _settings(kind, Skeleton.load(plan).length, 20_000)
    if plan != "mouse":
        settings.pop("sensor", None)
    return film(named, **_unsealed(address, stated, settings))


def _open_pair(address: str, stated: dict[str, str]) -> Recording:
    """The recording of a group's address."""
    kind = "swim" if stated.get("animal") == "fish" else "walk"
    settings = _settings(kind, Skeleton.load(_ANIMALS[kind]).length, 20_000)
    settings["animal"] = (str, GROUPS.__contains__, f"one of {', '.join(GROUPS)}")
    acts = GROUPS[_ANIMALS[kind]].encounters
    settings["animals"] = (int, lambda n: 2 <= n <= 4, "2, 3 or 4")
    settings["apart"] = (float, lambda share: 0.0 <= share <= 0.3, "a share from 0 to 0.3")
    settings["act"] = (str, acts.__contains__, f"of a {_ANIMALS[kind]} one of {', '.join(acts)}")
    values = _unsealed(address, stated, settings)
    if act := values.pop("act", ""):
        values["encounters"] = (act,)
    return film_group(**values)[0]


def _unsealed(
    address: str, stated: dict[str, str], settings: dict[str, _Setting]
) -> dict[str, Any]:
    """The values of a scene's address as `film` takes them.

    Raises:
        RecordingError: a value is invalid, or the seed is kept for sealed evaluations.
    """
    settings["build"] = (str, lambda build: build in _BUILDS, f"one of {', '.join(_BUILDS)}")
    values = {"seed": 0, "frames": 300, "build": _BUILDS[0], **_values(address, stated, settings)}
    if values["seed"] >= SEALED_FROM:
        raise RecordingError(
            f"{address}: seeds from {SEALED_FROM} on are kept for `liex evaluate scenes --sealed` "
            "and `liex evaluate several --sealed`; take a smaller one"
        )
    return values | {"n_frames": values.pop("frames"), "family": values.pop("build")}


def _values(address: str, stated: dict[str, str], settings: dict[str, _Setting]) -> dict[str, Any]:
    """The values of an address's settings, validated against the settings of its kind."""
    values: dict[str, Any] = {}
    for key, text in stated.items():
        if key not in settings:
            near = difflib.get_close_matches(key, settings, 1, cutoff=0.0)[0]
            raise RecordingError(
                f"{address}: {key} is no setting of it; the nearest one is {near}, as in {_EXAMPLE}"
            )
        read, holds, expected = settings[key]
        with suppress(KeyError, ValueError):
            values[key] = read(text)
        if key not in values or not holds(values[key]):
            raise RecordingError(
                f"{address}: {key} is {expected}, got '{text}'; correct it, as in {_EXAMPLE}"
            )
    return values


_Setting = tuple[Callable[[str], Any], Callable[[Any], bool], str]


def _settings(kind: str, home_mm: float, most_frames: int = 100_000) -> dict[str, _Setting]:
    """For each setting: its parser, its check, and the expected value for the error message."""
    low, high = (
        (30.0, 150.0)
        if kind == "walk"
        else (round(f * home_mm, -int(home_mm > 100)) for f in (0.5, 2.9))
    )
    settings: dict[str, _Setting] = {
        "seed": (int, lambda seed: seed >= 0, "a whole number from 0 on"),
        "frames": (int, lambda n: 1 <= n <= most_frames, f"a whole number from 1 to {most_frames}"),
        "spine_mm": (float, lambda mm: low <= mm <= high, f"a length from {low:g} to {high:g} mm"),
    }
    if sensors := _SENSORS.get(kind):
        known = {name: BY_NAME[name] for name in sensors}
        settings["sensor"] = (known.__getitem__, bool, f"one of {', '.join(sensors)}")
    return settings
