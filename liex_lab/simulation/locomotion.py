"""Locomotion models of a walking mouse, a swimming fish and any animal: random walks in an arena.

Headings follow a correlated random walk, an AR(1) turning rate or a script of turns, with a pull
towards the centre that grows near walls; a step that would leave the arena is rejected. Postures
are drawn stretch by stretch from the animal's pose prior and blended by a Gaussian kernel. The
mouse walks, turns, pauses, rears, hunches and curls. The fish swims burst and glide: its speed
decays as exp(-t / 0.35 s) between bouts, bends begin in front and a wave runs from head to tail
while it scoots, glides, turns, rises, dives and rests.
"""

from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Body, BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.simulation.pose_prior import (
    FRONT,
    KINDS,
    Posture,
    bend_profile,
    clearance,
    draw_postures,
    hung,
    root_rotation,
    stand,
)
from liex_lab.simulation.scene import SimulatedScene, floor_point

Script = Callable[[np.random.Generator, int], tuple[NDArray[np.int64], Array]]
Path = Callable[[np.random.Generator, SimulatedScene, float, Array], tuple[Array, Array]]

_RATE_HZ = 30.0
# stretches of a walk: number in a shuffled deck, shortest and longest duration in s, speed in
# spines per second
_WALK, _CURL, _REAR, _HUNCH, _REACH = range(len(KINDS))
_STRETCHES = {
    _WALK: (4, 0.7, 3.0, (0.6, 2.8)),
    _CURL: (1, 0.5, 1.5, (0.0, 0.6)),
    _REAR: (2, 0.7, 2.0, (0.0, 0.0)),
    _HUNCH: (1, 1.0, 3.0, (0.0, 0.0)),
    _REACH: (2, 0.4, 1.2, (0.0, 0.4)),
}
_BLEND_S = 0.12  # standard deviation of the Gaussian blend between postures

GLIDE_S = 0.35  # time constant of a glide's speed
_BOUT_SPEED = (1.0, 5.0)  # that a bout reaches, body lengths/s
NEAREST_MM = 180.0  # of a fish to the camera: nearer, a large one does not fit in the image
_BEND_PER_TURN = 0.55  # degrees per joint for each rad/s of turning


# Walking.


def walk(
    rng: np.random.Generator,
    scene: SimulatedScene,
    skeleton: Skeleton,
    shape: BodyShape,
    spine_mm: float,
    n_frames: int,
    script: Script | None = None,
    path: Path | None = None,
) -> tuple[Pose, Array]:
    """The motion of one mouse in an arena, at 30 frames/s.

    Args:
        rng: random number generator; postures are drawn before the path, so that one seed gives the
            same postures in every arena.
        scene: the arena.
        skeleton: of the mouse.
        shape: its body, a batch of one.
        spine_mm: its length, mm.
        n_frames: number of frames.
        script: its activity and speed; None is `walk_script`.
        path: its path at that speed; None is `free_path`.

    Returns:
        Poses (n_frames) in the arena frame, and girths (n_frames,).
    """
    body = shape[0].broadcast(n_frames)
    kinds, spines_per_s = (script or walk_script)(rng, n_frames)
    posture = _flow(rng, skeleton, body, kinds)
    position, heading = (path or free_path)(rng, scene, spine_mm, spines_per_s * spine_mm)
    # the trunk sways with the stride
    phase = 2 * np.pi * np.cumsum(np.sqrt(spines_per_s) * 1.6) / _RATE_HZ
    sway = 0.06 * np.minimum(spines_per_s, 1.0) * np.sin(phase)
    posture.turn[:, 1:-1] += sway[:, None] * [1.0, -0.5, -0.5]
    size = np.full(n_frames, spine_mm / skeleton.length)
    gap = smoothed(rng.uniform(0.0, 3.0, n_frames), _BLEND_S * _RATE_HZ)
    return stand(skeleton, posture, heading, size, body, gap, position[:, :2])


def walk_script(rng: np.random.Generator, n: int) -> tuple[NDArray[np.int64], Array]:
    """Activity and speed of a mouse in each frame: stretches of all kinds of posture.

    Returns:
        Kinds of posture (n,), indices into `pose_prior.KINDS`, and speeds (n,), spines/s.
    """
    kinds, speed = np.empty(n, np.int64), np.empty(n)
    cards = [kind for kind, (number, *_) in _STRETCHES.items() for _ in range(number)]
    deck: list[int] = []
    at = 0
    while at < n:
        # used up before it is shuffled again, so that no kind is absent for long
        deck = deck or rng.permutation(cards).tolist()
        kind = deck.pop()
        _, shortest, longest, speeds = _STRETCHES[kind]
        stop = at + int(_RATE_HZ * rng.uniform(shortest, longest))
        kinds[at:stop], speed[at:stop] = kind, rng.uniform(*speeds)
        at = stop
    return kinds, np.maximum(smoothed(speed, _BLEND_S * _RATE_HZ), 0.0)


def _flow(
    rng: np.random.Generator, skeleton: Skeleton, shape: BodyShape, kinds: NDArray[np.int64]
) -> Posture:
    """Postures, redrawn when the kind changes and about every 25 frames, blended."""
    drawn = draw_postures(rng, skeleton, kinds, shape)
    n = len(kinds)
    change = np.concatenate([[True], (kinds[1:] != kinds[:-1]) | (rng.random(n - 1) < 0.04)])
    keep = np.maximum.accumulate(np.where(change, np.arange(n), 0))
    columns = (drawn.elevation, drawn.turn, drawn.roll, drawn.stretch)
    return Posture(*(smoothed(column[keep], _BLEND_S * _RATE_HZ) for column in columns))


def free_path(
    rng: np.random.Generator, scene: SimulatedScene, spine_mm: float, speed: Array
) -> tuple[Array, Array]:
    """The path of a mouse that wanders and turns back before walls.

    Args:
        rng: random number generator.
        scene: the arena.
        spine_mm: length of the animal, mm.
        speed: (n,) mm/s.

    Returns:
        Positions (n, 2) of the body's centre, mm, arena frame, and headings (n,) rad.
    """
    camera = scene.camera
    middle = floor_point(
        camera,
        scene.T_arena_camera,
        np.array([(camera.width - 1) / 2.0, (camera.height - 1) / 2.0]),
    )
    home = scene.centre if scene.freedom(scene.centre) > scene.freedom(middle) else middle
    margin = min(0.85 * spine_mm, 0.7 * scene.freedom(home))
    start = np.array([*(home + rng.normal(0.0, 0.2 * margin, 2)), 0.0])
    azimuth = rng.uniform(-np.pi, np.pi)
    rate = lfilter([1.0], [1.0, -0.93], rng.normal(0.0, 0.25, len(speed)))
    pace = np.minimum(speed / spine_mm, 1.0)
    position, heading = _steered(
        scene,
        home,
        start,
        azimuth,
        spine_mm,
        margin,
        speed / _RATE_HZ,
        np.zeros(len(speed)),
        (0.0, 0.0),
        # it turns back faster at higher speed, within a mouse's turning rate
        lambda i, close, away: (
            np.clip(rate[i] * (0.2 + pace[i]) + 6.0 * close * away * pace[i], -7.0, 7.0) / _RATE_HZ
        ),
    )
    return position[:, :2], heading


def _steered(
    scene: SimulatedScene,
    home: Array,
    start: Array,
    azimuth: float,
    length: float,
    margin: float,
    run: Array,
    pitch: Array,
    heights: tuple[float, float],
    turn: Callable[[int, float, float], float],
) -> tuple[Array, Array]:
    """A path by steps; a step that would leave the free space is rejected.

    Args:
        scene: the arena.
        home: (2,) the free place to which the animal turns near obstacles, mm, arena frame.
        start: (3,) first position, mm, arena frame.
        azimuth: first heading, rad.
        length: of the animal, mm.
        margin: smallest distance from walls, clutter and the image border, mm.
        run: (n,) length of each step, mm.
        pitch: (n,) rad.
        heights: lowest and highest position above the floor, mm.
        turn: function of a step's number, the nearness of obstacles (0 to 1) and the bearing of
            `home` (rad, left positive, at most 1) that gives the change of heading, rad.

    Returns:
        Positions (n, 3) mm, arena frame, and headings (n,) rad.
    """
    position, heading = np.empty((len(run), 3)), np.empty(len(run))
    xy, z = start[:2], float(start[2])
    for i in range(len(run)):
        back = np.arctan2(home[1] - xy[1], home[0] - xy[0])
        away = (back - azimuth + np.pi) % (2 * np.pi) - np.pi
        here = scene.freedom(xy, z)
        close = np.clip(1.0 - (here - margin) / (0.8 * length), 0.0, 1.0)
        azimuth += turn(i, close, np.clip(away, -1.0, 1.0))
        step = run[i] * np.cos(pitch[i]) * np.array([np.cos(azimuth), np.sin(azimuth)])
        there = scene.freedom(xy + step, z)
        if there > margin or there > here:
            xy = xy + step
        z = float(np.clip(z + run[i] * np.sin(pitch[i]), *heights))
        position[i], heading[i] = [*xy, z], azimuth
    return position, heading


# Swimming.


def swim(
    rng: np.random.Generator,
    scene: SimulatedScene,
    skeleton: Skeleton,
    shape: Body,
    length: float,
    n_frames: int,
    script: Callable[..., tuple[Array, Array, Array, Array]] | None = None,
    path: Path | None = None,
    step_s: float = 0.02,
) -> tuple[Pose, Array]:
    """The motion of one fish, and its girths, likewise, with `step_s` between two frames, s.

    Positions of a `path` are (n, 3), with the heights; the fish climbs and dives along it.
    """
    speed, turning, amplitude, beat = (script or _swim_script)(rng, n_frames, step_s)
    # turns and waves run from head to tail
    hind = np.concatenate([np.zeros(2), turning[:-2]]) if n_frames > 2 else turning
    yaw = bend_profile(
        skeleton,
        _BEND_PER_TURN * turning,
        1.3 * _BEND_PER_TURN * hind,
        amplitude,
        beat,
        np.ones(n_frames),
        np.full(n_frames, FRONT),
        smoothed(rng.normal(0.0, 0.8, (n_frames, 4)), 6.0),
    )
    size = np.full(n_frames, length / skeleton.length)
    pitch = np.radians(25.0) * np.tanh(smoothed(rng.normal(0.0, 6.0, n_frames), 25.0))
    roll = np.radians(smoothed(rng.normal(0.0, 12.0, n_frames), 8.0))
    if path is not None:
        position, heading = path(rng, scene, length, speed * length)
        climb = np.gradient(position[:, 2]) / step_s / length / (speed + 0.5)
        pitch = np.radians(25.0) * np.tanh(climb)
    else:
        level = hung(skeleton, yaw, root_rotation(np.zeros(n_frames), pitch, roll), size)
        low, high = clearance(skeleton, level, shape[0].broadcast(n_frames), size)
        camera_mm = float(scene.T_arena_camera.translation[2])
        top = max(camera_mm - NEAREST_MM - float(high.max()), float(low.max()) + 2.0)
        water = (float(low.max()) + 0.5, top)
        position, heading = wander(rng, scene, length, speed, turning, pitch, water, step_s)
    pose = hung(skeleton, yaw, root_rotation(heading, pitch, roll), size)
    pose.root.translation[:] += position
    return pose, size


def strokes(speed: Array, heading: Array, step_s: float) -> tuple[Array, Array, Array, Array]:
    """The script of a fish on a given path, whose tail beats faster and wider at higher speed.

    Args:
        speed: (n,) body lengths/s.
        heading: (n,) rad, continuous.
        step_s: between two frames, s.

    Returns:
        Speed, turning, and the tail's amplitude and phase, for `swim`.
    """
    share = np.minimum(speed / _BOUT_SPEED[1], 1.0)
    beat = 2 * np.pi * np.cumsum(2.0 + 7.0 * share) * step_s
    return speed, np.gradient(heading) / step_s, 0.5 + 4.0 * np.sqrt(share), beat


def _swim_script(
    rng: np.random.Generator, n: int, step_s: float
) -> tuple[Array, Array, Array, Array]:
    """Speed, turning, and the tail's amplitude and phase, each (n,).

    In body lengths/s, rad/s, degrees per joint and rad.
    """
    speed, turning, amplitude, rate = np.zeros((4, n))
    at, pace = 0, 0.0
    while at < n:
        pace = max(rng.uniform(*_BOUT_SPEED), pace)
        beats = rng.uniform(4.0, 9.0)
        beating, resting = (
            max(2, int(rng.uniform(*span) / step_s)) for span in ((0.15, 0.6), (0.1, 1.2))
        )
        stop = min(at + beating, n)
        speed[at:stop], rate[at:stop] = pace, beats
        amplitude[at:stop] = rng.uniform(1.5, 5.0) * np.sqrt(pace / _BOUT_SPEED[1])
        # share of bouts that begin with a turn
        if rng.random() < 0.35:
            brief = min(at + max(2, int(0.14 / step_s)), n)
            turning[at:brief] = rng.choice([-1.0, 1.0]) * rng.uniform(4.0, 16.0)
        glide = np.arange(max(0, min(resting, n - stop)))
        speed[stop : stop + resting] = pace * np.exp(-(glide + 1) * step_s / GLIDE_S)
        pace *= float(np.exp(-resting * step_s / GLIDE_S))
        at = stop + resting
    return (
        smoothed(speed, 1.5),
        smoothed(turning, 1.2) + smoothed(rng.normal(0.0, 3.0, n), 12.0),
        smoothed(amplitude, 2.0),
        2 * np.pi * np.cumsum(rate) * step_s,
    )


def wander(
    rng: np.random.Generator,
    scene: SimulatedScene,
    length: float,
    speed: Array,
    turning: Array,
    pitch: Array,
    water: tuple[float, float],
    step_s: float,
) -> tuple[Array, Array]:
    """Path of an animal through a scene, between two heights, and its headings.

    The heading integrates `turning` and a pull towards the image centre near walls and the image
    border; a step without free space is rejected.

    Args:
        rng: random number generator.
        scene: the scene with walls and camera.
        length: of the animal, mm.
        speed: (n,) body lengths/s.
        turning: (n,) rad/s, positive to the left.
        pitch: (n,) rad, positive upwards.
        water: lowest and highest position of the body's centre, mm above the floor.
        step_s: between two frames, s.

    Returns:
        Positions (n, 3) of the body's centre, mm, arena frame, and headings (n,) rad.
    """
    camera = scene.camera
    centre = camera.unproject([(camera.width - 1) / 2, (camera.height - 1) / 2], 1.0)
    T = scene.T_arena_camera
    ray = T.rotation @ centre
    z = rng.uniform(*water)
    home = (T.translation + ray * (T.translation[2] - z) / -ray[2])[:2]
    start = np.array([*(home + rng.normal(0.0, 0.1 * length, 2)), z])
    return _steered(
        scene,
        home,
        start,
        rng.uniform(-np.pi, np.pi),
        length,
        0.6 * length,
        speed * length * step_s,
        pitch,
        water,
        lambda i, close, away: (turning[i] + 8.0 * close * away) * step_s,
    )


def waver(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Changes of a tail's bends, rad, over frames and rings."""
    return 4.0 * smoothed(rng.normal(0.0, 0.05, shape), _BLEND_S * _RATE_HZ)


def smoothed(rows: Array, frames: float, deviations: float = 4.0) -> Array:
    """Samples convolved with a Gaussian kernel, with the end values extended.

    Args:
        rows: (n, ...) samples.
        frames: standard deviation of the kernel, in samples.
        deviations: the kernel's reach, in standard deviations.

    Returns:
        (n, ...).
    """
    reach = int(deviations * frames)
    bell = np.exp(-0.5 * (np.arange(-reach, reach + 1) / frames) ** 2)
    padded = np.pad(rows, [(reach, reach)] + [(0, 0)] * (rows.ndim - 1), mode="edge")
    return np.apply_along_axis(np.convolve, 0, padded, bell / bell.sum(), mode="valid")
