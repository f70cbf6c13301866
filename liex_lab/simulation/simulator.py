"""The worlds that animals are rendered in: training images, test splits and continuous recordings
of each of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from liex_lab.body.skeleton import Skeleton
from liex_lab.simulation import generic, locomotion
from liex_lab.simulation import recording as synthetic
from liex_lab.simulation import training_patches as windows
from liex_lab.simulation.fish import FishHabits
from liex_lab.simulation.generic import GenericHabits
from liex_lab.simulation.hand.simulator import HandWorld, find_reference
from liex_lab.simulation.recording import SyntheticSession, TrueRecording
from liex_lab.simulation.species import Habits, MouseHabits
from liex_lab.simulation.training_patches import TrainingWindows


class World(Protocol):
    """Where an animal's training and test data come from. Everything is drawn from seeds, in any
    order.
    """

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""

    @property
    def splits(self) -> tuple[str, ...]:
        """The names of the test splits."""

    @property
    def protocol(self) -> str:
        """What to say of the test splits beside figures measured on them."""

    @property
    def sources(self) -> str:
        """What the training images were made from, for a model's card."""

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
    ) -> Iterator[TrainingWindows]:
        """Blocks of training images from block `first` on; see `windows.training_blocks`."""

    def test_split(
        self, name: str, spine_mm: float | None = None, n_sessions: int = 40
    ) -> Sequence[TrueRecording]:
        """The recordings of one of the `splits`; spine_mm sets the animals' size instead of drawing
        it.
        """

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> TrueRecording:
        """A recording in which one animal moves; settings as in `locomotion.walking_session`."""


@dataclass(frozen=True)
class RenderedWorld:
    """The world of an animal with these habits."""

    habits: Habits
    splits: tuple[str, ...] = tuple(synthetic.SPLITS)

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""
        return self.habits.skeleton

    @property
    def protocol(self) -> str:
        """What to say of the test splits beside figures measured on them."""
        return (
            "each with its own camera, arena, animal; the background, the floor, the blob and the "
            "animal's size are found by the product, nothing is handed over. "
        )

    @property
    def sources(self) -> str:
        """What the training images were made from."""
        return "rendered from a seed; no recording of an animal was used"

    def training_blocks(
        self, seed: int, n_blocks: int, **settings: Any
    ) -> Iterator[TrainingWindows]:
        """Blocks of training images."""
        return windows.training_blocks(seed, n_blocks, self.habits, **settings)

    def test_split(
        self, name: str, spine_mm: float | None = None, n_sessions: int = 40
    ) -> list[SyntheticSession]:
        """The recordings of a split."""
        return synthetic.test_split(name, spine_mm, n_sessions, self.habits)


@dataclass(frozen=True)
class MouseWorld(RenderedWorld):
    """A mouse in an arena, seen from above."""

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> SyntheticSession:
        """A mouse that walks, turns, rears and curls up."""
        assert isinstance(self.habits, MouseHabits)
        return locomotion.walking_session(seed, n_frames, habits=self.habits, **settings)


@dataclass(frozen=True)
class FishWorld(RenderedWorld):
    """A zebrafish in a tank, seen from above."""

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> SyntheticSession:
        """A fish that swims."""
        assert isinstance(self.habits, FishHabits)
        return locomotion.swimming_session(seed, n_frames, habits=self.habits, **settings)


@dataclass(frozen=True)
class GenericWorld(RenderedWorld):
    """Any animal on a floor, or above one."""

    def window_px(self, length_mm: float) -> int:
        """Pixels a side that hold an animal of this mean length, wherever it is."""
        assert isinstance(self.habits, GenericHabits)
        return self.habits.window_px(length_mm)

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> SyntheticSession:
        """An animal that goes about and changes its posture."""
        assert isinstance(self.habits, GenericHabits)
        return generic.moving_session(seed, n_frames, habits=self.habits, **settings)


def world_of(skeleton: Skeleton) -> World:
    """The world of an animal; of one that is not known here by its name, the generic one."""
    if skeleton.name == "mouse":
        return MouseWorld(MouseHabits(skeleton))
    if skeleton.name == "fish":
        return FishWorld(FishHabits(skeleton))
    if skeleton.name == "hand":
        return HandWorld(skeleton, find_reference())
    return GenericWorld(GenericHabits(skeleton))
