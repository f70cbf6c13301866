"""Behaviour simulator: a sequence of labelled actions, smoothed by a causal filter, within bounds.

An action is a stretch of control channels on a clock of 5 ms: speed, turning, climbing, and those
of the species (bends, postures). A `BehaviourSequence` concatenates actions, smooths them with a
critically damped second-order low pass, two poles at exp(-dt / tau), as a body does, integrates
heading and position, and redraws an action that would leave the bounds. Animals differ in
log-uniform traits (`Individual`).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter, lfilter_zi

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Body, Surface
from liex_lab.scene.height_maps import Patches
from liex_lab.simulation._sensor_kernels import ANIMAL, UNIT
from liex_lab.simulation.rendering import Solid, Views
from liex_lab.simulation.scene import draw_views
from liex_lab.simulation.sensors import Sensor, draw_units
from liex_lab.simulation.species import Species
from liex_lab.simulation.training_patches import floor_views

STEP_S = 0.005  # of the animal's clock, independent of the camera's rate
UNLABELLED = ""
# channels of every animal: mm/s, rad/s, rad
SPEED, TURN, CLIMB = range(3)
_TRIES = 16
_TRAITS = {
    "vigour": 0.16,
    "tempo": 0.12,
    "bend": 0.12,
    "patience": 0.2,
}  # spread of the logarithm at the end of the range


@dataclass(frozen=True)
class Individual:
    """Traits of one animal's movement.

    Attributes:
        size: over home size.
        vigour: factor of speed.
        tempo: factor of rhythm.
        bend: factor of bending.
        patience: factor of the duration of its actions.
        restless: from 0 to 1.
        side: preferred side, from -1 (right) to 1 (left).
    """

    size: float
    vigour: float
    tempo: float
    bend: float
    patience: float
    restless: float
    side: float

    @staticmethod
    def draw(
        rng: np.random.Generator, sizes: tuple[float, float], novel: bool = False
    ) -> "Individual":
        """Draw an animal with traits exp(spread z), z uniform.

        Args:
            rng: random number generator.
            sizes: smallest and largest animal over home size.
            novel: draw |z| from 0.7 to 1.5, at and beyond the ends of the usual range from 0 to 1.

        Returns:
            The animal.
        """
        low, high = (0.7, 1.5) if novel else (0.0, 1.0)
        reach = rng.uniform(low, high, len(_TRAITS)) * rng.choice([-1.0, 1.0], len(_TRAITS))
        factors = {
            name: float(np.exp(_TRAITS[name] * z)) for name, z in zip(_TRAITS, reach, strict=True)
        }
        return Individual(
            size=rng.uniform(*sizes),
            **factors,
            restless=rng.random(),
            side=rng.uniform(-0.5, 0.5),
        )

    def duration(
        self, rng: np.random.Generator, shortest: float, longest: float, least: float
    ) -> float:
        """Draw the duration of an action, s; most are near the shortest.

        Args:
            rng: random number generator.
            shortest: of an animal of usual patience, s.
            longest: of any, s.
            least: of the most impatient, s.
        """
        usual = (longest - shortest) * rng.beta(1.3, 2.2)
        return float(np.clip(shortest + usual * self.patience, least, longest))

    def turn_side(self, rng: np.random.Generator) -> float:
        """Draw a turning direction, left (1) or right (-1), by the preferred side.

        Returns:
            1.0 or -1.0.
        """
        return 1.0 if rng.random() < 0.5 + 0.5 * self.side else -1.0


@dataclass(frozen=True)
class ActedMotion:
    """A behaviour sequence at the steps of the 5 ms clock.

    Attributes:
        channels: (m, C) speed mm/s, turning rad/s, climb rad, and the species' own.
        heading: (m,) rad.
        position: (m, 3) of the body's centre, mm, arena frame.
        word: (m,) name of the action, '' if unnamed.
        act: (m,) int64, number of the action in the sequence.
    """

    channels: Array
    heading: Array
    position: Array
    word: NDArray[np.str_]
    act: NDArray[np.int64]

    def at(self, rate_hz: float) -> NDArray[np.int64]:
        """Steps at which a camera takes frames.

        Args:
            rate_hz: of the camera, Hz.

        Returns:
            (n,) int64 numbers of steps.
        """
        return np.arange(0.0, len(self.heading), 1.0 / (rate_hz * STEP_S)).astype(np.int64)


class BehaviourSequence:
    """A sequence of actions, with the state of the animal at its end.

    Attributes:
        position: (3,) of the body's centre, mm, arena frame.
        heading: rad.
    """

    def __init__(
        self,
        rest: Array,
        blend_s: float,
        position: Array,
        heading: float,
        fits: Callable[[Array, Array], bool],
    ) -> None:
        """Begin a sequence at rest.

        Args:
            rest: (C,) channels of the animal at rest, the filter's initial state.
            blend_s: time constant of each of the filter's two poles, s.
            position: (3,) initial position, mm.
            heading: initial heading, rad.
            fits: whether an animal can be at positions (m, 3) mm with headings (m,) rad.
        """
        gain = 1.0 - np.exp(-STEP_S / blend_s)
        self._taps = (
            np.array([gain * gain]),
            np.array([1.0, -2.0 * (1.0 - gain), (1.0 - gain) ** 2]),
        )
        self._state = lfilter_zi(*self._taps)[:, None] * rest
        self._lag = round(2.0 * blend_s / STEP_S)
        self.position = np.array(position, float)
        self.heading = heading
        self._fits = fits
        self._actions: list[tuple[Array, Array, Array, str]] = []

    def play(self, word: str, draw: Callable[[], Array], tries: int = _TRIES) -> bool:
        """Add an action, redrawn until it leads only to possible positions.

        Args:
            word: name of the action.
            draw: draws its channels (m, C).
            tries: number of draws.

        Returns:
            False if no draw fits; the sequence is then unchanged.
        """
        for _ in range(tries):
            channels, state = lfilter(*self._taps, draw(), axis=0, zi=self._state)
            heading = self.heading + np.cumsum(channels[:, TURN]) * STEP_S
            run = channels[:, SPEED] * STEP_S
            climb = channels[:, CLIMB]
            steps = np.stack(
                [np.cos(climb) * np.cos(heading), np.cos(climb) * np.sin(heading), np.sin(climb)],
                axis=1,
            )
            position = self.position + np.cumsum(run[:, None] * steps, axis=0)
            if self._fits(position, heading):
                self._state = state
                self.position = position[-1]
                self.heading = float(heading[-1])
                self._actions.append((channels, heading, position, word))
                return True
        return False

    def words(
        self, rng: np.random.Generator, shares: Mapping[str, float], seconds: float
    ) -> Iterator[str]:
        """Draw actions until the sequence has a minimum length.

        Args:
            rng: random number generator.
            shares: relative frequencies of the actions, around which those of one animal vary.
            seconds: minimum length, s.

        Yields:
            Names of actions to play.
        """
        own = np.array(list(shares.values())) * np.exp(rng.normal(0.0, 0.25, len(shares)))
        while sum(len(channels) for channels, *_ in self._actions) * STEP_S < seconds:
            yield str(rng.choice(list(shares), p=own / own.sum()))

    def nudge(self, position: Array) -> None:
        """Stop a cornered animal and move it slightly inside.

        Args:
            position: (3,) position to resume from, mm.
        """
        self.position = np.array(position, float)
        self._state[:, SPEED] = 0.0

    def motion(self) -> ActedMotion:
        """The motion of the sequence so far.

        A label begins when the action becomes visible in the body, which lags by 2 time constants
        of the filter.

        Returns:
            The motion on the 5 ms clock.
        """
        *parts, words = zip(*self._actions, strict=True)
        lengths = [len(heading) for heading in parts[1]]
        act = np.repeat(np.arange(len(words)), lengths)
        late = np.maximum(np.arange(len(act)) - min(self._lag, lengths[0]), 0)
        channels, heading, position = (np.concatenate(part) for part in parts)
        return ActedMotion(channels, heading, position, np.array(words)[act[late]], act[late])


def clock(seconds: float) -> Array:
    """Times of the steps of an action, at least two.

    Args:
        seconds: its length, s.

    Returns:
        (m,) s, from 0 in steps of `STEP_S`.
    """
    return np.asarray(np.arange(max(2, round(seconds / STEP_S))) * STEP_S)


def bump(t: Array, length_s: float, peak: float = 0.5) -> Array:
    """Raised cosine, from 0 to 1 at `peak` of the length and back; 0 outside.

    Args:
        t: (m,) s.
        length_s: of the bump, s.
        peak: position of the maximum, over the length.

    Returns:
        (m,) from 0 to 1.
    """
    x = np.clip(t / length_s, 0.0, 1.0)
    phase = np.where(x < peak, 0.5 * x / peak, 0.5 + 0.5 * (x - peak) / (1.0 - peak))
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * phase)


def slow_noise(rng: np.random.Generator, m: int, seconds: float, columns: int = 1) -> Array:
    """Smooth noise of about unit standard deviation with the given correlation time.

    Normal numbers (standard deviation 1.2) at knots, joined by raised cosines.

    Args:
        rng: random number generator.
        m: number of steps.
        seconds: between two knots, s.
        columns: number of independent channels.

    Returns:
        (m, columns).
    """
    knots = int(m * STEP_S / seconds) + 3
    at = np.arange(m) * STEP_S / seconds + rng.random()
    low = at.astype(int)
    share = 0.5 - 0.5 * np.cos(np.pi * (at - low))[:, None]
    values = rng.normal(0.0, 1.2, (knots + 1, columns))
    return np.asarray(values[low] * (1.0 - share) + values[low + 1] * share)


# Rendering of an acting animal by a virtual depth camera: the patch around it, frame by frame.


_BLOCK = 256  # frames rendered at a time


def draw_camera(
    rng: np.random.Generator,
    species: Species,
    sensor: Sensor,
    fur: Array,
    height_mm: float,
    stride: int,
) -> Views:
    """Draw a camera of a make at a given height, with every `stride`-th pixel read.

    Its image is twice as wide and high as the sensor's, so that an animal has space for long
    stretches of action.

    Args:
        rng: random number generator.
        species: the species, which sets the scene's tilt and scale.
        sensor: the camera's make.
        fur: (1,) of the animal, from 0 to 1.
        height_mm: of the camera above the floor, mm.
        stride: sensor pixels per image pixel.

    Returns:
        The camera, a batch of one.
    """
    unit = replace(sensor, stride=stride)
    intrinsics, size_px, parameters = draw_units(rng, (unit,), np.zeros(1, np.int64), fur)
    intrinsics[:, 2:] += size_px / 2.0
    place = draw_views(rng, 1, species.setting)
    place.translation[:] = [0.0, 0.0, height_mm]
    error = rng.standard_normal((1, 3)) * [0.002, 0.002, 0.5 * species.setting.scale]
    return floor_views(intrinsics, 2 * size_px, place, parameters, error)


def render_agent(
    rng: np.random.Generator,
    species: Species,
    views: Views,
    shape: Body,
    pose: Pose,
    girth: Array,
    window_px: int,
) -> Iterator[Patches]:
    """Patches around an animal in given poses, 256 frames at a time.

    Args:
        rng: random number generator for the noise and the tail.
        species: the species.
        views: the camera and the wall in each frame (n).
        shape: its body, a batch of which the first is used.
        pose: (n) arena frame.
        girth: (n,) factor of all lengths across the body.
        window_px: side of the patches, px.

    Yields:
        Up to 256 patches: depth and background float32 mm with the camera's intrinsics and floor.
    """
    surface = Surface.of(species.skeleton)
    seeds = rng.integers(1, 2**63, len(girth)).astype(np.uint64)
    bends = species.bends(rng, 1)
    unit = np.float32(views.parameters[0, UNIT])
    for start in range(0, len(girth), _BLOCK):
        part = slice(start, start + _BLOCK)
        some = views[part]
        vertices = surface.vertices(pose[part], shape[0], girth[part], bends)
        body = Solid.of(vertices, surface.faces, label=ANIMAL)
        origin = some.around(vertices[:, : surface.n_trunk_vertices], window_px)
        size = (window_px, window_px)
        depth, background = some.render([body], seeds[part], origin, size, learn=True)
        yield Patches(
            depth * unit,
            background * unit,
            some.intrinsics,
            origin.astype(float),
            some.floor,
            species.skeleton.view,
        )
