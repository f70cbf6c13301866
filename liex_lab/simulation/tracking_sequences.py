"""Benchmark sequences for tracking: one moving animal, clean or corrupted, with exact truth.

'easy' has the normal noise of a sensor; 'hard' has twice the noise, an eroded outline and the
corruptions of `corruptions`. Their lengths, 511 and 300 frames, are those of the tracking sequences
in the Lie-X paper. A script of events re-times one long recording (dropped or accelerated frames),
adds occluders and distractors to the scene and removes readings from the depth images.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.surface import Surface
from liex_lab.errors import RecordingError
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.simulation import corruptions
from liex_lab.simulation.corruptions import Event, Loss
from liex_lab.simulation.hand.simulator import FRAME_NS, NYU_SENSOR, HandSession, HandSimulator
from liex_lab.simulation.recording import FrameContents, SyntheticSession, TrueRecording
from liex_lab.simulation.simulator import BodySimulator, Simulator
from liex_lab.simulation.species import Sensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sequence:
    """A fixed test sequence and its difficulty.

    Attributes:
        n_frames: its length, as in the paper.
        seed: its seed.
        noise: multiplies the sensor's random errors and its rate of holes.
        erosion_px: pixels stripped off the animal's outline, px of the subsampled depth image.
        corrupted: whether there are corruptions.
    """

    n_frames: int
    seed: int
    noise: float
    erosion_px: int
    corrupted: bool


SEQUENCES = {
    "easy": Sequence(511, 75_001, 1.0, 0, False),
    "hard": Sequence(300, 76_001, 2.0, 1, True),
}


class TestSequence(TrueRecording):
    """A recording with its truth and events.

    Attributes:
        scene: the recording without the losses.
        events: in order of their start.
    """

    __test__ = False

    def __init__(
        self, scene: SyntheticSession | HandSession, events: list[Event], loss: Loss, name: str
    ) -> None:
        """Apply losses to a recording and keep its truth.

        Args:
            scene: the recording without the losses.
            events: its events, in order of start.
            loss: readings that are lost in its frames.
            name: of the sequence.
        """
        super().__init__(
            name=name,
            format="synthetic",
            camera=scene.camera,
            times_ns=scene.times_ns.copy(),
            read=lambda index: self.depths(index, index + 1)[0],
        )
        for fact in _TRUTH:
            setattr(self, fact, getattr(scene, fact))
        self.scene = scene
        self.events = events
        self._loss = loss

    def depths(self, start: int, stop: int) -> NDArray[np.float32]:
        """Depth images of a range of frames, with the losses.

        Args:
            start: first frame.
            stop: one past the last frame.

        Returns:
            (stop - start, H, W) float32 mm, 0 if unread.
        """
        depths = self.scene.depths(start, stop)
        camera = self.camera
        middle = self.joints_camera.mean(axis=1)
        reach = 1.2 * self.spine_mm * camera.fx / middle[:, 2]
        still = self.scene.scene.still if isinstance(self.scene, SyntheticSession) else None
        self._loss.apply(
            depths, still, start, self.scene.contents.seeds, camera.project(middle), reach
        )
        return depths


_TRUTH = (
    "skeleton",
    "surface",
    "spine_mm",
    "pose",
    "joints_camera",
    "joints_arena",
    "T_arena_camera",
    "floor",
)


def tracking_sequence(
    world: Simulator,
    name: str,
    *,
    seed: int | None = None,
    n_frames: int | None = None,
    sensor: Sensor | None = None,
    spine_mm: float | None = None,
) -> TestSequence:
    """The fixed sequence 'easy' or 'hard' of an animal; other seeds make similar ones.

    hard: bursts of holes, dropped frames, a bar passing between camera and animal, a second object,
    an animal that is lost in the floor's noise or in glare, and stretches at two to three times the
    speed.

    Args:
        world: the animal's simulator.
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
    sensor, step_ns, floats = _setting(world, sensor)
    kind = SEQUENCES[name]
    n = n_frames or kind.n_frames
    own_seed = [kind.seed if seed is None else seed]
    rng = np.random.default_rng([*own_seed, 1])
    events: list[Event] = []
    steps = np.ones(n, np.int64)
    pace = np.ones(n, np.int64)
    if kind.corrupted:
        events, steps = corruptions.draw_script(rng, n, step_ns * 1e-9)
        pace = corruptions.pace(rng, events, n)
    rows = np.cumsum(np.concatenate([[0], (steps * pace)[1:]]))
    base = world.motion(
        own_seed,
        int(rows[-1]) + 1,
        sensor=sensor,
        noise=kind.noise,
        erosion_px=kind.erosion_px * sensor.stride,
        spine_mm=spine_mm,
    )
    times = np.cumsum(np.concatenate([[0], steps[1:]])) * np.int64(step_ns)
    loss = Loss.draw(rng, events, base.camera, base.joints_camera[rows], base.spine_mm, floats)
    title = f"track-{name}-{base.skeleton.name}-{own_seed[0]}"
    place = _hands if isinstance(base, HandSession) else _animals
    scene, hidden = place(rng, world, base, rows, times, events, title)
    return TestSequence(
        scene, sorted([*events, *hidden], key=lambda event: (event.start, event.stop)), loss, title
    )


def _setting(world: Simulator, sensor: Sensor | None) -> tuple[Sensor, int, bool]:
    """The camera, the nanoseconds between its frames, and whether the animal floats."""
    if isinstance(world, HandSimulator):
        return sensor or NYU_SENSOR, FRAME_NS, True
    if isinstance(world, BodySimulator):
        return sensor or world.species.sensors[0], world.species.frame_ns, world.species.floats
    raise RecordingError(
        f"there are no test sequences of a {world.skeleton.name}; mouse, fish and hand have them"
    )


def _hands(
    rng: np.random.Generator,
    world: Simulator,
    base: TrueRecording,
    rows: NDArray[np.int64],
    times: NDArray[np.int64],
    events: list[Event],
    title: str,
) -> tuple[HandSession, list[Event]]:
    """Some moments of a hand, with an occluder and a distractor, and its hidden spans."""
    assert isinstance(base, HandSession)
    contents = base.contents[rows]
    hidden = list[Event]()
    if events:
        arena = corruptions.draw_things(
            rng,
            events,
            base.T_arena_camera.translation,
            base.joints_arena[rows],
            base.spine_mm,
            corruptions.beside_hand,
        )
        things = base.T_arena_camera.inverse() @ arena
        contents = replace(
            contents,
            thing=things,
            shown=np.ones(len(rows), np.bool_),
            thing_faces=corruptions.TWO_FACES,
        )
        hidden = _hidden(base.camera, contents.hand, things, events)
    return HandSession(title, base.skeleton, base.sensor, contents, times), hidden


def _animals(
    rng: np.random.Generator,
    world: Simulator,
    base: TrueRecording,
    rows: NDArray[np.int64],
    times: NDArray[np.int64],
    events: list[Event],
    title: str,
) -> tuple[SyntheticSession, list[Event]]:
    """The same as `_hands`, for an animal."""
    assert isinstance(base, SyntheticSession)
    assert isinstance(world, BodySimulator)
    contents = _taken(base.contents, rows)
    scene = base.scene
    species = world.species
    hidden = list[Event]()

    def beside(rng: np.random.Generator, joints: Array, length_mm: float) -> Array:
        return corruptions.beside_animal(rng, scene, joints, length_mm, species.things)

    if events:
        things = corruptions.draw_things(
            rng,
            events,
            base.T_arena_camera.translation,
            base.joints_arena[rows],
            base.spine_mm,
            beside,
            species.floats,
        )
        contents = replace(
            contents,
            things=things,
            shown=np.ones(len(rows), np.bool_),
            thing_faces=corruptions.TWO_FACES,
        )
        surface = Surface.of(base.skeleton)
        T_camera_arena = base.T_arena_camera.inverse()
        body = surface.vertices(contents.pose, contents.shape, contents.girth, contents.bends)[
            :, : surface.n_trunk_vertices
        ]
        hidden = _hidden(base.camera, T_camera_arena @ body, T_camera_arena @ things, events)
    return SyntheticSession(title, scene, contents, times), hidden


def _taken(contents: FrameContents, rows: NDArray[np.int64]) -> FrameContents:
    """Some moments of the moving contents, in a new order."""
    pose = Pose(
        SE3(contents.pose.root.rotation[rows], contents.pose.root.translation[rows]),
        contents.pose.angles[rows],
        contents.pose.scale[rows],
    )
    return replace(
        contents,
        pose=pose,
        girth=contents.girth[rows],
        bends=None if contents.bends is None else contents.bends[rows],
        things=contents.things[rows],
        shown=contents.shown[rows],
        parameters=contents.parameters[rows],
        seeds=contents.seeds[rows],
    )


def _hidden(camera: Camera, body: Array, things: Array, events: list[Event]) -> list[Event]:
    """Spans in which the occluder hides the animal; meshes (n, V, 3) mm in the camera frame."""
    spans = [np.arange(event.start, event.stop) for event in events if event.kind == "occluder"]
    rows = np.concatenate(spans) if spans else np.zeros(0, np.int64)
    one = things.shape[1] // 2
    return corruptions.hidden_spans(
        corruptions.visible_share(body[:, ::4], things[:, :one], camera, rows)
    )
