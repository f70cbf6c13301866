"""Corruptions of depth recordings as a script: holes, occluders, distractors, lost frames.

A script deals shuffled decks of the events in `EVENTS`, so that each kind recurs: discs without
readings (holes), a bar across the line of sight (occluder), a second object (object), an animal
that disappears in the floor's noise or in glare (faint), stretches at two to three times the speed
(fast), and missing frames (dropped). Objects are rendered with the scene; `Loss` is applied to the
finished depth images.
"""

from dataclasses import dataclass

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.optics.camera import Camera
from liex_lab.simulation.rendering import Solid
from liex_lab.simulation.scene import OBJECT_FACES, SimulatedScene, draw_object, mesh_of

# kind: (share of the events, shortest and longest in s)
EVENTS = {
    "holes": (4, 0.5, 1.2),
    "occluder": (3, 0.8, 1.6),
    "object": (2, 1.0, 2.0),
    "faint": (3, 0.5, 1.4),
    "fast": (3, 0.4, 1.0),
    "dropped": (3, 0.1, 0.35),
}
_CELL = 3  # side of the cells of dropout, px


@dataclass(frozen=True)
class Event:
    """An event in frames `start` to `stop`.

    Attributes:
        kind: a key of `EVENTS`, or 'hidden', frames in which less than half of the animal is
            visible.
        start: first frame.
        stop: one past the last frame.
    """

    kind: str
    start: int
    stop: int


def draw_script(
    rng: np.random.Generator, n_frames: int, step_s: float
) -> tuple[list[Event], NDArray[np.int64]]:
    """Events over n frames, and the camera's clock steps before each frame.

    The events come in shuffled decks, the first with one of each, so that none is absent for long.
    Dropped frames are removed: an event 'dropped' is the one frame after them. In addition, 2 % of
    the frames follow a single dropped frame.

    Args:
        rng: random number generator.
        n_frames: length of the recording without dropped frames.
        step_s: between two frames, s.

    Returns:
        The events in order of time, and (n_frames,) int64 steps before each frame, usually 1.
    """
    events = []
    steps = np.ones(n_frames, np.int64)
    names = [name for name, (share, *_) in EVENTS.items() for _ in range(share)]
    deck = rng.permutation(list(EVENTS)).tolist()
    at = round(1.0 / step_s)  # one second without events at the start
    while at < n_frames:
        deck = deck or rng.permutation(names).tolist()
        kind = deck.pop()
        length = max(2, round(rng.uniform(*EVENTS[kind][1:]) / step_s))
        stop = min(at + (1 if kind == "dropped" else length), n_frames)
        if kind == "dropped":
            steps[at] += length
        events.append(Event(kind, at, stop))
        # calm between two events, s
        at = stop + max(1, round(rng.uniform(0.1, 0.5) / step_s))
    # some frames are dropped singly
    alone = rng.random(n_frames) < 0.02
    alone[:2] = False
    return events, steps + alone


def pace(rng: np.random.Generator, events: list[Event], n_frames: int) -> NDArray[np.int64]:
    """Speed factor of the animal in each frame.

    Args:
        rng: random number generator.
        events: the script; only 'fast' is used.
        n_frames: length of the recording.

    Returns:
        (n_frames,) int64: 2 or 3 during 'fast', else 1.
    """
    times = np.ones(n_frames, np.int64)
    for event in events:
        if event.kind == "fast":
            times[event.start : event.stop] = rng.integers(2, 4)
    return times


def draw_objects(
    rng: np.random.Generator,
    events: list[Event],
    scene: SimulatedScene,
    joints: Array,
    length_mm: float,
    kinds: tuple[str, ...],
    floats: bool,
) -> tuple[Solid, ...]:
    """The occluder and a second object.

    Args:
        rng: random number generator.
        events: the script; only 'occluder' and 'object' are used.
        scene: the still scene and its camera.
        joints: (n, J, 3) of the animal, mm, arena frame.
        length_mm: of the animal, mm.
        kinds: kinds of second objects, see `scene.draw_object`.
        floats: the animal is above the floor, so that the occluder passes at 0.65 of the camera's
            height; else at up to three body lengths.
    """
    eye = scene.T_arena_camera.translation
    mesh = np.zeros((2, len(joints), int(OBJECT_FACES.max()) + 1, 3))
    shown = np.zeros((2, len(joints)), np.bool_)
    for event in events:
        span = slice(event.start, event.stop)
        if event.kind == "occluder":
            mesh[0, span] = _passing(rng, eye, joints[span], length_mm, floats)
            shown[0, span] = True
        elif event.kind == "object":
            mesh[1, span] = beside(rng, scene, joints[span], length_mm, kinds)
            shown[1, span] = True
    return tuple(Solid.of(mesh[k], OBJECT_FACES, shown[k]) for k in range(2))


def _passing(
    rng: np.random.Generator, eye: Array, joints: Array, length_mm: float, floats: bool
) -> Array:
    """A bar (n, V, 3) mm that moves across the view between the camera and the animal."""
    height = 0.65 * eye[2] if floats else min(3.0 * length_mm, 0.5 * eye[2])
    target = joints[len(joints) // 2].mean(axis=0)
    share = (eye[2] - height) / (eye[2] - target[2])  # on the ray from the camera to the animal
    over = eye[:2] + (target[:2] - eye[:2]) * share
    direction = rng.uniform(-np.pi, np.pi)
    # half width, length and initial distance over the animal's length
    half = rng.uniform(0.12, 0.5) * length_mm * share
    sides = [half, 2.5 * length_mm * share, 0.1 * length_mm]
    mesh = mesh_of([(np.zeros(3), sides, direction, 8.0)])
    s = np.linspace(-1.0, 1.0, len(joints))[:, None] * 2.0 * length_mm * share
    along = s * np.array([np.cos(direction), np.sin(direction)])
    place = np.concatenate([over + along, np.full((len(s), 1), height)], axis=1)
    return mesh + place[:, None]


def beside(
    rng: np.random.Generator,
    scene: SimulatedScene,
    joints: Array,
    length_mm: float,
    kinds: tuple[str, ...],
) -> Array:
    """A stationary object (V, 3) mm near the animal's path, close to it if there is space.

    Of 60 random positions, the one whose gap to the path is nearest to half a body length is used,
    with penalties for overlapping the walls or the path.

    Args:
        rng: random number generator.
        scene: the scene with its walls.
        joints: (n, J, 3) of the animal during the event, mm, arena frame.
        length_mm: of the animal, mm.
        kinds: kinds of objects to choose from, see `scene.draw_object`.
    """
    mesh = draw_object(rng, str(rng.choice(kinds)), length_mm)
    path = joints[..., :2].reshape(-1, 2)
    reach = np.abs(mesh[:, :2]).max()

    def cost(place: Array) -> float:
        free = np.linalg.norm(path - place, axis=1).min() - reach
        outside = max(0.0, reach - float(scene.wall_clearance(place)))
        return float(abs(free - 0.5 * length_mm) + outside + 50.0 * (free < 0))

    places = [
        joints[rng.integers(len(joints)), 0, :2] + rng.normal(0.0, 1.6, 2) * length_mm
        for _ in range(60)
    ]
    best = min(places, key=cost)
    floor = scene.still.size > 0  # without one it is at the animal's depth
    lift = 0.0 if floor else joints[..., 2].mean() - mesh[:, 2].max() / 2.0
    return np.asarray(mesh + np.array([*best, lift]))


@dataclass(frozen=True)
class Loss:
    """Lost readings in n frames.

    Attributes:
        discs: for frame i, discs[i]: (k, 3) centre u, v and radius, px, of unread discs.
        faint_mm: (n,) smaller heights above the still scene are replaced by it, mm.
        dropout: (n,) unread share of the animal's surroundings.
    """

    discs: tuple[Array, ...]
    faint_mm: Array
    dropout: Array

    @staticmethod
    def draw(
        rng: np.random.Generator,
        events: list[Event],
        camera: Camera,
        joints: Array,
        length_mm: float,
        floats: bool,
    ) -> "Loss":
        """Draw the lost readings of a script.

        Args:
            rng: random number generator.
            events: the script; only 'faint' and 'holes' are used.
            camera: the camera.
            joints: (n, J, 3) of the animal, mm, camera frame.
            length_mm: of the animal, mm.
            floats: 'faint' is then dropout of 40 to 75 % of the readings; else heights below 0.2 to
                0.4 body lengths are lost in the floor.

        Returns:
            The loss of n frames.
        """
        n = len(joints)
        discs: list[Array] = [np.zeros((0, 3))] * n
        faint = np.zeros(n)
        dropout = np.zeros(n)
        for event in events:
            span = slice(event.start, event.stop)
            if event.kind == "faint" and floats:
                # lost share of the readings of a floating animal
                dropout[span] = rng.uniform(0.4, 0.75)
            elif event.kind == "faint":
                # smaller heights are lost in the floor
                faint[span] = rng.uniform(0.2, 0.4) * length_mm
            elif event.kind == "holes":
                for i in range(event.start, event.stop):
                    centres = joints[i, rng.integers(joints.shape[1], size=int(rng.integers(2, 5)))]
                    centres = centres + rng.normal(0.0, 0.1 * length_mm, centres.shape)
                    # radius over the animal's length
                    share = rng.uniform(0.1, 0.26, (len(centres), 1))
                    px = camera.fx / centres[:, 2:] * share * length_mm
                    discs[i] = np.concatenate([camera.project(centres), px], axis=1)
        return Loss(tuple(discs), faint, dropout)

    def apply(
        self,
        depths: NDArray[np.float32],
        still: NDArray[np.float32] | None,
        first: int,
        seeds: NDArray[np.uint64],
        middle_px: Array,
        reach_px: Array,
    ) -> None:
        """Remove the lost readings from depth images, in place.

        Args:
            depths: (k, H, W) float32 mm, the frames from `first` on; changed.
            still: (H, W) float32 mm, the still scene; None without one.
            first: number of the first frame.
            seeds: (n,) uint64 of all frames, for the dropout's pattern.
            middle_px: (n, 2) the animal's centre in the image, px.
            reach_px: (n,) radius of the dropout around it, px.
        """
        height, width = depths.shape[1:]
        v, u = np.mgrid[:height, :width]
        for k, depth in enumerate(depths):
            i = first + k
            if still is not None and self.faint_mm[i] > 0:
                lost = (depth > 0) & (still > 0) & (still - depth < self.faint_mm[i])
                depth[lost] = still[lost]
            if self.dropout[i] > 0:
                rng = np.random.default_rng(int(seeds[i]))
                cells = rng.random((-(-height // _CELL), -(-width // _CELL))) < self.dropout[i]
                gone = np.repeat(np.repeat(cells, _CELL, axis=0), _CELL, axis=1)[:height, :width]
                near = np.hypot(u - middle_px[i, 0], v - middle_px[i, 1]) < reach_px[i]
                depth[gone & near] = 0.0
            for u0, v0, radius in self.discs[i]:
                depth[np.hypot(u - u0, v - v0) < radius] = 0.0


def hidden_spans(share: Array) -> list[Event]:
    """The spans of frames in which less than half of the animal is visible.

    Args:
        share: (n,) visible share of the animal.

    Returns:
        Events of kind 'hidden', in order of time.
    """
    hidden = np.concatenate([[False], share < 0.5, [False]])
    edges = np.flatnonzero(hidden[1:] != hidden[:-1])
    return [Event("hidden", int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
