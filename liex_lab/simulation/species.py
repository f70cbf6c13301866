"""What the renderer needs to know of an animal: who looks at it from where, its body, and how it
lies or floats.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape, draw_shapes, draw_tail_bends
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.surface import Body
from liex_lab.simulation.objects import THINGS
from liex_lab.simulation.pose_prior import KINDS, SHARES, SIZE_RANGE, sample_postures
from liex_lab.simulation.scene import ARENA, Setting
from liex_lab.simulation.sensors import SENSORS, Sensor

Array = NDArray[np.float64]


class Postures(NamedTuple):
    """Poses (n) in the arena frame, base above the origin, the girths (n,) of their bodies, and
    their kinds (n,).
    """

    pose: Pose
    girth: Array
    kind: NDArray[np.int64]


class Habits(Protocol):
    """An animal as the renderer knows it. Everything drawn comes from the generator that is handed
    over.

    sizes: smallest and largest animal over the nominal size; floats: it is somewhere above the
    floor, not on it; frame_ns: between two frames of a recording.
    """

    @property
    def skeleton(self) -> Skeleton: ...  # noqa: D102

    @property
    def sensors(self) -> tuple[Sensor, ...]: ...  # noqa: D102

    @property
    def setting(self) -> Setting: ...  # noqa: D102

    @property
    def things(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def sizes(self) -> tuple[float, float]: ...  # noqa: D102

    @property
    def floats(self) -> bool: ...  # noqa: D102

    @property
    def frame_ns(self) -> int: ...  # noqa: D102

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> Body:
        """N bodies of a family, see `body.shape.FAMILIES`."""

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> Postures:
        """A posture for each of n animals of the given sizes (n,) over home and shapes (n),
        anywhere on or above the floor, under cameras camera_mm (n,) above it.
        """

    def bends(self, rng: np.random.Generator, n: int) -> Array | None:
        """How tails lie, see `Surface.vertices`; None for an animal without a tail of its own."""


@dataclass(frozen=True)
class MouseHabits:
    """A mouse in an arena, before a PrimeSense or a Kinect v2."""

    skeleton: Skeleton = field(default_factory=lambda: Skeleton.load("mouse"))
    sensors: tuple[Sensor, ...] = SENSORS
    setting: Setting = ARENA
    things: tuple[str, ...] = THINGS
    sizes: tuple[float, float] = SIZE_RANGE
    floats: bool = False
    frame_ns: int = 33_333_333

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> BodyShape:
        """N mice."""
        return draw_shapes(rng, self.skeleton, family, n)

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> Postures:
        """Mice that go about, curl up, rear, hunch and reach."""
        assert isinstance(shape, BodyShape)
        kinds = rng.choice(len(KINDS), len(size), p=SHARES)
        pose, girth = sample_postures(rng, self.skeleton, len(size), size, shape, kinds)
        return Postures(pose, girth, kinds)

    def bends(self, rng: np.random.Generator, n: int) -> Array | None:
        """How the tails lie."""
        return draw_tail_bends(rng, n)
