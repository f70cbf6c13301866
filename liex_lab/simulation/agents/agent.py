"""How an animal goes from one act to the next: its own way of moving, acts that flow into one
another, and a place.

An act is a stretch of channels on a fine clock: speed, turning, climbing, and what the species adds
(bends, postures). A `Story` strings acts together, smooths them with a causal filter as a body
does, and keeps the animal inside its place: an act that would lead outside is drawn again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter, lfilter_zi

Array = NDArray[np.float64]

STEP_S = 0.005  # of the clock on which an animal moves, whatever the camera's rate
UNLABELLED = ""
# channels that every animal has: mm/s, rad/s, rad
SPEED = 0
TURN = 1
CLIMB = 2
_TRIES = 16
_TRAITS = {
    "vigour": 0.16,
    "tempo": 0.12,
    "bend": 0.12,
    "patience": 0.2,
}  # spread of the logarithm at the range's end


@dataclass(frozen=True)
class Individual:
    """One animal's own way: factors of speed, of rhythm, of bending and of how long its acts last;
    its size over home, how restless it is (0 to 1), and which side it prefers (-1 right to 1 left).
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
    ) -> Individual:
        """An animal; a novel one has traits at and beyond the ends of the range that all others
        come from.
        """
        low, high = (0.7, 1.5) if novel else (0.0, 1.0)
        reach = rng.uniform(low, high, len(_TRAITS)) * rng.choice([-1.0, 1.0], len(_TRAITS))
        factors = {
            name: float(np.exp(_TRAITS[name] * z)) for name, z in zip(_TRAITS, reach, strict=True)
        }
        size = rng.uniform(*sizes)
        restless = rng.random()
        side = rng.uniform(-0.5, 0.5)
        return Individual(size=float(size), **factors, restless=float(restless), side=float(side))

    def way(self, rng: np.random.Generator) -> float:
        """Left (1) or right (-1)."""
        return 1.0 if rng.random() < 0.5 + 0.5 * self.side else -1.0


@dataclass(frozen=True)
class Motion:
    """A story told: channels (m, C), heading (m,) rad, position (m, 3) mm of the body's middle and
    the word (m,) of every step of the clock; `act` (m,) numbers the acts.
    """

    channels: Array
    heading: Array
    position: Array
    word: NDArray[np.str_]
    act: NDArray[np.int64]

    def __getitem__(self, rows: NDArray[np.int64]) -> Motion:
        """Some steps of it."""
        return Motion(
            self.channels[rows],
            self.heading[rows],
            self.position[rows],
            self.word[rows],
            self.act[rows],
        )

    def at(self, rate_hz: float) -> NDArray[np.int64]:
        """The steps that a camera of this rate sees."""
        return np.arange(0.0, len(self.heading), 1.0 / (rate_hz * STEP_S)).astype(np.int64)


class Story:
    """Acts, one after the other. fits: whether an animal can be at positions (m, 3) mm with
    headings (m,) rad.
    """

    def __init__(
        self,
        rest: Array,
        blend_s: float,
        position: Array,
        heading: float,
        fits: Callable[[Array, Array], bool],
    ) -> None:
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
        self._told: list[tuple[Array, Array, Array, str]] = []
        self.n_steps = 0

    def play(self, word: str, draw: Callable[[], Array], tries: int = _TRIES) -> bool:
        """Add the act that `draw` returns, channels (m, C); False where none of the tries leads to
        a possible place.
        """
        for _ in range(tries):
            channels, state = lfilter(*self._taps, wanted := draw(), axis=0, zi=self._state)
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
                self._told.append((channels, heading, position, word))
                self.n_steps += len(wanted)
                return True
        return False

    def nudge(self, position: Array) -> None:
        """Cornered: the animal stops there and is put a little inside."""
        self.position = np.array(position, float)
        self._state[:, SPEED] = 0.0

    def told(self) -> Motion:
        """All of it. A word begins when the body, which follows with a lag, begins to show
        its act.
        """
        lengths = [len(heading) for _, heading, _, _ in self._told]
        word = np.repeat([word for *_, word in self._told], lengths)
        act = np.repeat(np.arange(len(lengths)), lengths)
        lag = min(self._lag, lengths[0] if lengths else 0)
        late = np.maximum(np.arange(len(word)) - lag, 0)
        channels, heading, position = (
            np.concatenate([part[k] for part in self._told]) for k in range(3)
        )
        return Motion(channels, heading, position, word[late], act[late])


def clock(seconds: float) -> Array:
    """(m,) s: the steps of an act of that length."""
    return np.asarray(np.arange(max(2, round(seconds / STEP_S))) * STEP_S)


def bump(t: Array, length_s: float, peak: float = 0.5) -> Array:
    """(m,) rises from 0 to 1 at `peak` of the length and falls back, smooth at both ends; 0
    outside.
    """
    x = np.clip(t / length_s, 0.0, 1.0)
    phase = np.where(x < peak, 0.5 * x / peak, 0.5 + 0.5 * (x - peak) / (1.0 - peak))
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * phase)


def slow_noise(rng: np.random.Generator, m: int, seconds: float, columns: int = 1) -> Array:
    """(m, columns) of unit deviation that wanders over about so many seconds."""
    knots = int(m * STEP_S / seconds) + 3
    at = np.arange(m) * STEP_S / seconds + rng.random()
    low = at.astype(int)
    share = 0.5 - 0.5 * np.cos(np.pi * (at - low))[:, None]
    values = rng.normal(0.0, 1.2, (knots + 1, columns))
    return np.asarray(values[low] * (1.0 - share) + values[low + 1] * share)
