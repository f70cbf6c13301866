"""Synthetic data generators, one per animal: training patches, test splits, recordings with truth.

Each simulator renders a posed body mesh through a depth camera with a sensor noise model and
returns the exact pose with every depth image. Mouse and fish have their own pose and locomotion
models (`MouseSimulator`, `FishSimulator`), the hand its own scene (`HandSimulator`); any animal
with a skeleton and a surface is drawn within its joint limits (`GenericSimulator`). Everything is
drawn from seeds, so that any part of a set can be reproduced, in any order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from liex_lab.body.skeleton import Skeleton
from liex_lab.simulation import generic, locomotion, recording, training_patches
from liex_lab.simulation.fish import FishSpecies
from liex_lab.simulation.generic import GenericSpecies
from liex_lab.simulation.hand.pose_prior import find_reference
from liex_lab.simulation.hand.simulator import HandSimulator
from liex_lab.simulation.recording import SyntheticSession, TrueRecording
from liex_lab.simulation.species import MouseSpecies, Species
from liex_lab.simulation.training_patches import TrainingPatches


class Simulator(Protocol):
    """Interface of an animal's source of synthetic training and test data.

    Everything is drawn from seeds, in any order. `world_of` selects the implementation.
    """

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""

    @property
    def splits(self) -> tuple[str, ...]:
        """The names of the test splits."""

    @property
    def protocol(self) -> str:
        """One sentence on the test splits, for reports of results."""

    @property
    def test_postures(self) -> str:
        """Source of the postures of the test splits, one phrase; '' if they follow from seeds
        alone.
        """

    @property
    def sources(self) -> str:
        """Source of the training images, one phrase, for a model's card."""

    def training_blocks(
        self,
        seed: int,
        n_blocks: int,
        *,
        first: int = 0,
        family: str = "train",
        noise: float = 1.0,
        erosion_px: int = 0,
        degraded_share: float = 0.0,
        spine_mm: float | None = None,
        window_px: int = 144,
        parallel: bool = True,
    ) -> Iterator[TrainingPatches]:
        """Blocks of `BLOCK` training patches with truth; see `training_patches.training_blocks`.

        Args:
            seed: of the whole set; a block depends only on the seed and its number.
            n_blocks: number of blocks.
            first: number of the first block.
            family: of body shapes, one of `body.shape.FAMILIES`.
            noise: multiplies the sensor's random errors and its rate of holes.
            erosion_px: pixels stripped off the animal's outline.
            degraded_share: share of mini-sessions with more noise; half of them also have more
                erosion.
            spine_mm: mean length of the animals, mm; None uses the skeleton's own.
            window_px: side of the patches, px.
            parallel: render on all threads; the images are the same either way.

        Returns:
            An iterator of sets of patches, one per block.
        """

    def test_split(
        self, name: str, spine_mm: float | None = None, n_sessions: int = 40
    ) -> Sequence[TrueRecording]:
        """The recordings of one of the `splits`.

        Args:
            name: of the split.
            spine_mm: length of every animal, mm; None draws it.
            n_sessions: number of recordings, from the first on.

        Returns:
            One recording with truth per session, each with its own camera, surroundings and animal.
        """

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> TrueRecording:
        """A continuous recording of one moving animal.

        Args:
            seed: seed or seeds of all random numbers.
            n_frames: length of the recording.
            **settings: keyword arguments as in `locomotion.walking_session`.

        Returns:
            The recording with its truth.
        """


@dataclass(frozen=True)
class BodySimulator:
    """Simulator of an animal that is described by a `Species`.

    Attributes:
        species: the animal's species.
        splits: names of the test splits.
    """

    species: Species
    splits: tuple[str, ...] = tuple(recording.SPLITS)

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""
        return self.species.skeleton

    @property
    def protocol(self) -> str:
        """One sentence on the test splits, for reports of results."""
        return (
            "each with its own camera, arena, animal; the background, the floor, the blob and the "
            "animal's size are found by the product, nothing is handed over. "
        )

    @property
    def test_postures(self) -> str:
        """'': postures follow from the seeds alone."""
        return ""

    @property
    def sources(self) -> str:
        """Source of the training images, one phrase."""
        return "rendered from a seed; no recording of an animal was used"

    def training_blocks(
        self, seed: int, n_blocks: int, **settings: Any
    ) -> Iterator[TrainingPatches]:
        """Blocks of training patches with truth.

        Args:
            seed: of the whole set.
            n_blocks: number of blocks.
            **settings: keyword arguments as in `training_patches.training_blocks`.

        Returns:
            An iterator of sets of patches, one per block.
        """
        return training_patches.training_blocks(seed, n_blocks, self.species, **settings)

    def test_split(
        self, name: str, spine_mm: float | None = None, n_sessions: int = 40
    ) -> list[SyntheticSession]:
        """The recordings of a split; see `recording.test_split`.

        Args:
            name: 'clean', 'hard', 'other-body', 'other-camera', or 'sealed', see
                `recording.SEALED`.
            spine_mm: length of every animal, mm; None draws it.
            n_sessions: number of recordings, from the first on.

        Returns:
            One recording of independent postures per session.

        Raises:
            LiexError: there is no split of this name.
        """
        return recording.test_split(name, spine_mm, n_sessions, self.species)


@dataclass(frozen=True)
class MouseSimulator(BodySimulator):
    """Simulator of a mouse in an arena, recorded from above."""

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> SyntheticSession:
        """A recording of a mouse that walks, turns, rears and curls up; see `walking_session`.

        Args:
            seed: seed or seeds of all random numbers.
            n_frames: length of the recording, at 30 frames/s.
            **settings: further keyword arguments of `locomotion.walking_session`.

        Returns:
            The recording with its truth.
        """
        assert isinstance(self.species, MouseSpecies)
        return locomotion.walking_session(seed, n_frames, species=self.species, **settings)


@dataclass(frozen=True)
class FishSimulator(BodySimulator):
    """Simulator of a zebrafish in a tank, recorded from above."""

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> SyntheticSession:
        """A recording of a fish that swims in bouts; see `swimming_session`.

        Args:
            seed: seed or seeds of all random numbers.
            n_frames: length of the recording, at 50 frames/s.
            **settings: further keyword arguments of `locomotion.swimming_session`.

        Returns:
            The recording with its truth.
        """
        assert isinstance(self.species, FishSpecies)
        return locomotion.swimming_session(seed, n_frames, species=self.species, **settings)


@dataclass(frozen=True)
class GenericSimulator(BodySimulator):
    """Simulator of any animal on a floor, or above one."""

    def window_px(self, length_mm: float) -> int:
        """Side of a square patch, px, that contains an animal of this mean length at any position.

        Args:
            length_mm: mean length of the animals, mm.

        Returns:
            The side, a multiple of 8 px.
        """
        assert isinstance(self.species, GenericSpecies)
        return self.species.window_px(length_mm)

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> SyntheticSession:
        """A recording of an animal that moves and changes its posture; see `moving_session`.

        Args:
            seed: seed or seeds of all random numbers.
            n_frames: length of the recording.
            **settings: further keyword arguments of `generic.moving_session`.

        Returns:
            The recording with its truth.
        """
        assert isinstance(self.species, GenericSpecies)
        return generic.moving_session(seed, n_frames, species=self.species, **settings)


def world_of(skeleton: Skeleton) -> Simulator:
    """The simulator of an animal; the generic one for other names than those below.

    Args:
        skeleton: of the animal; the names 'mouse', 'fish' and 'hand' have their own simulators.

    Returns:
        The simulator; that of the hand uses labelled test postures if `find_reference` finds any.
    """
    if skeleton.name == "mouse":
        return MouseSimulator(MouseSpecies(skeleton))
    if skeleton.name == "fish":
        return FishSimulator(FishSpecies(skeleton))
    if skeleton.name == "hand":
        return HandSimulator(skeleton, find_reference())
    return GenericSimulator(GenericSpecies(skeleton))
