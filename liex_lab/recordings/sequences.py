"""Sequences to measure tracking on: one animal that moves, as a sensor sees it or as on a bad day, with the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.surface import Surface
from liex_lab.errors import RecordingError
from liex_lab.geometry import SE3
from liex_lab.recordings import hazards
from liex_lab.recordings.hazards import Event, Loss
from liex_lab.recordings.sensors import Sensor
from liex_lab.recordings.synthetic import Cast, SyntheticSession
from liex_lab.recordings.worlds import RenderedWorld, World

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sequence:
    """A fixed test sequence: frames, seed, and how bad the day is. The lengths are those of the paper's."""

    n_frames: int
    seed: int
    noise: float
    erosion_px: int
    hazards: bool


SEQUENCES = {
    "easy": Sequence(511, 75_001, 1.0, 0, False),
    "hard": Sequence(300, 76_001, 2.0, 1, True),
}


class TestSequence(SyntheticSession):
    """A recording with its truth (see `SyntheticSession`) and what happens in it: events, in order of their start."""

    __test__ = False

    def __init__(self, base: SyntheticSession, cast: Cast, times_ns: NDArray[np.int64], events: list[Event], loss: Loss,
                 name: str) -> None:  # fmt: skip
        super().__init__(name, base.stage, cast, times_ns)
        self.events, self._loss = events, loss

    def depths(self, start: int, stop: int) -> NDArray[np.float32]:
        """Depth (n, H, W) mm of frames start to stop."""
        depths = super().depths(start, stop)
        camera, joints = self.stage.camera, self.joints_camera
        middle = joints.mean(axis=1)
        reach = 1.2 * self.spine_mm * camera.fx / middle[:, 2]
        self._loss.apply(depths, self.stage.still, start, self.cast.seeds, camera.project(middle), reach)
        return depths


def tracking_sequence(
    world: World, name: str, *, seed: int | None = None, n_frames: int | None = None, sensor: Sensor | None = None,
    spine_mm: float | None = None,
) -> TestSequence:  # fmt: skip
    """The fixed sequence 'easy' or 'hard' of an animal's world; other seeds make sequences of its kind, to develop on.

    hard: bursts of holes, frames dropped, a bar passing between camera and animal, a second object, an animal that is
    lost in the floor or in glare, and stretches at several times the speed.
    """
    if name not in SEQUENCES:
        raise RecordingError(f"there is no sequence '{name}'; known are {', '.join(SEQUENCES)}")
    if not isinstance(world, RenderedWorld):
        raise RecordingError(f"there are no test sequences of a {world.skeleton.name}; mouse and fish have them")
    kind, habits = SEQUENCES[name], world.habits
    n, own_seed = n_frames or kind.n_frames, [kind.seed if seed is None else seed]
    rng, step_ns = np.random.default_rng([*own_seed, 1]), habits.frame_ns
    sensor = sensor or habits.sensors[0]
    events: list[Event] = []
    steps, pace = np.ones(n, np.int64), np.ones(n, np.int64)
    if kind.hazards:
        events, steps = hazards.draw_script(rng, n, step_ns * 1e-9)
        pace = hazards.pace(rng, events, n)
    rows = np.cumsum(np.concatenate([[0], (steps * pace)[1:]]))
    base = world.motion(own_seed, int(rows[-1]) + 1, sensor=sensor, noise=kind.noise,
                        erosion_px=kind.erosion_px * sensor.stride, spine_mm=spine_mm)  # fmt: skip
    assert isinstance(base, SyntheticSession)  # a rendered world's
    times = np.cumsum(np.concatenate([[0], steps[1:]])) * np.int64(step_ns)
    cast = _taken(base.cast, rows)
    joints, length = cast.pose.joints(base.skeleton), base.spine_mm
    loss = Loss.draw(rng, events, base.camera, base.T_arena_camera.inverse() @ joints, length, habits.floats)
    if kind.hazards:
        things = hazards.draw_things(rng, events, base.stage, joints, length, habits)
        cast = replace(cast, things=things, shown=np.ones(n, np.bool_), thing_faces=hazards.TWO_FACES)
        events = sorted([*events, *_hidden(base, cast, events)], key=lambda event: (event.start, event.stop))
    return TestSequence(base, cast, times, events, loss, f"track-{name}-{base.skeleton.name}-{own_seed[0]}")


def _taken(cast: Cast, rows: NDArray[np.int64]) -> Cast:
    """Some moments of what moves, in another order of time."""
    pose = Pose(SE3(cast.pose.root.rotation[rows], cast.pose.root.translation[rows]), cast.pose.angles[rows],
                cast.pose.scale[rows])  # fmt: skip
    return replace(
        cast, pose=pose, girth=cast.girth[rows], bends=None if cast.bends is None else cast.bends[rows],
        things=cast.things[rows], shown=cast.shown[rows], parameters=cast.parameters[rows], seeds=cast.seeds[rows],
    )  # fmt: skip


def _hidden(base: SyntheticSession, cast: Cast, events: list[Event]) -> list[Event]:
    """The stretches in which the occluder hides the animal."""
    surface, one = Surface.of(base.skeleton), cast.things.shape[1] // 2
    vertices = surface.vertices(cast.pose, cast.shape, cast.girth, cast.bends)[:, : surface.n_trunk_vertices]
    spans = [np.arange(event.start, event.stop) for event in events if event.kind == "occluder"]
    rows = np.concatenate(spans) if spans else np.zeros(0, np.int64)
    return hazards.hidden_spans(hazards.visible_share(vertices[:, ::4], cast.things[:, :one], base.stage, rows))
