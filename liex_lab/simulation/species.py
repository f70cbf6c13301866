"""Interface between an animal and the renderer: sensors, surroundings, body shapes, pose prior.

`Species` is what `training_patches`, `recording` and `locomotion` ask of an animal; `MouseSpecies`
is the mouse, `fish.FishSpecies` the zebrafish, `generic.GenericSpecies` any animal with a skeleton.
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
from liex_lab.simulation.scene import ARENA, SceneSpec
from liex_lab.simulation.sensors import SENSORS, Sensor

Array = NDArray[np.float64]


class Postures(NamedTuple):
    """Poses of n animals, drawn from a prior.

    Attributes:
        pose: (n) arena frame, base above the origin.
        girth: (n,) factor of all lengths across the bodies.
        kind: (n,) int64, index into the species' kinds of posture.
    """

    pose: Pose
    girth: Array
    kind: NDArray[np.int64]


class Species(Protocol):
    """An animal as the renderer knows it; all is drawn from the generator handed over.

    Attributes:
        skeleton: of the animal.
        sensors: makes of cameras that look at it.
        setting: ranges of its surroundings.
        things: kinds of distractors beside it, see `objects.draw_thing`.
        sizes: smallest and largest animal over the nominal size.
        floats: it is somewhere above the floor, not on it.
        frame_ns: between two frames of a recording, ns.
    """

    @property
    def skeleton(self) -> Skeleton: ...  # noqa: D102

    @property
    def sensors(self) -> tuple[Sensor, ...]: ...  # noqa: D102

    @property
    def setting(self) -> SceneSpec: ...  # noqa: D102

    @property
    def things(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def sizes(self) -> tuple[float, float]: ...  # noqa: D102

    @property
    def floats(self) -> bool: ...  # noqa: D102

    @property
    def frame_ns(self) -> int: ...  # noqa: D102

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> Body:
        """Bodies of a family of shapes.

        Args:
            rng: source of randomness.
            family: one of `body.shape.FAMILIES`.
            n: how many.

        Returns:
            A batch of n bodies.
        """

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> Postures:
        """A posture for each of n animals, anywhere on or above the floor.

        Args:
            rng: source of randomness.
            size: (n,) of the animals over home size.
            shape: (n) their bodies.
            camera_mm: (n,) heights of the cameras above the floor, mm.

        Returns:
            The poses, base above the origin, with girths and kinds.
        """

    def bends(self, rng: np.random.Generator, n: int) -> Array | None:
        """How tails lie, see `Surface.vertices`.

        Args:
            rng: source of randomness.
            n: how many.

        Returns:
            (n, TAIL_RINGS) rad, or None for an animal without a tail of its own.
        """


@dataclass(frozen=True)
class MouseSpecies:
    """A mouse in an arena, before a PrimeSense or a Kinect v2.

    Attributes:
        skeleton: of the mouse, the preset's if not given.
        sensors: makes of cameras that look at it.
        setting: ranges of its surroundings.
        things: kinds of distractors beside it.
        sizes: smallest and largest mouse over the nominal size.
        floats: False, for it stands on the floor.
        frame_ns: between two frames of a recording, ns.
    """

    skeleton: Skeleton = field(default_factory=lambda: Skeleton.load("mouse"))
    sensors: tuple[Sensor, ...] = SENSORS
    setting: SceneSpec = ARENA
    things: tuple[str, ...] = THINGS
    sizes: tuple[float, float] = SIZE_RANGE
    floats: bool = False
    frame_ns: int = 33_333_333

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> BodyShape:
        """Mice of a family of shapes.

        Args:
            rng: source of randomness.
            family: one of `body.shape.FAMILIES`.
            n: how many.

        Returns:
            A batch of n bodies.
        """
        return draw_shapes(rng, self.skeleton, family, n)

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> Postures:
        """Mice that go about, curl up, rear, hunch and reach, by the shares of `pose_prior.SHARES`.

        Args:
            rng: source of randomness.
            size: (n,) of the mice over home size.
            shape: (n) their bodies.
            camera_mm: (n,) not used, for mice stand on the floor.

        Returns:
            The poses with girths and kinds, indices into `pose_prior.KINDS`.
        """
        assert isinstance(shape, BodyShape)
        kinds = rng.choice(len(KINDS), len(size), p=SHARES)
        pose, girth = sample_postures(rng, self.skeleton, len(size), size, shape, kinds)
        return Postures(pose, girth, kinds)

    def bends(self, rng: np.random.Generator, n: int) -> Array | None:
        """How the tails lie.

        Args:
            rng: source of randomness.
            n: how many.

        Returns:
            (n, TAIL_RINGS) rad, the turn at each ring.
        """
        return draw_tail_bends(rng, n)
