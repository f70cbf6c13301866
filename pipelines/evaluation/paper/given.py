"""What a row was given, in numbers that survive another processor's last digit.

Rendering, foreground and training are compiled for the processor at hand, and what compilers make
of a sum differs in its last digit from one kind of processor to the next; a hash tells that from
nothing else. These numbers say of each recording which pictures, object and size were given, and of
the training pictures what is in them. They agree where code and seeds are the same, and not where
arena, camera, noise, foreground or choice of object are others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .results import ELSEWHERE

if TYPE_CHECKING:
    from liex_lab.estimation.training import TrainingSet

    from .common_view import CommonView

Array = NDArray[np.float64]

DEPTH_MM = 0.05  # how far a recording's mean depth may lie off: a twentieth of a sensor's step
UNREAD = 1e-3  # and its share of unread pixels
SIZE = 5e-3  # and the size, of itself
FRAMES = 0.01  # of the frames of a split, those in which the choice of object may be another
HEIGHT_MM = 0.05  # how far mean height and mean joints of the training pictures may lie off
COVERED = 1e-3  # and the share of their pixels that the animal covers
_DECIMALS = {"depth_mm": 2, "unread": 4, "size": 4}


def processor() -> str:
    """The kind of processor that numba compiles for, as LLVM names it, such as `znver4`."""
    import llvmlite.binding as llvm
    import numba

    return str(numba.config.CPU_NAME or llvm.get_host_cpu_name())


@dataclass(frozen=True)
class Given:
    """What every row was given in the k recordings of a split.

    Attributes:
        n_frames: of all recordings.
        depth_mm: (k,) mean depth of the pixels that were read, mm; 0 where none was.
        unread: (k,) share of the pixels that were not.
        size: (k,) the animal's spine over home size.
        second: (k,) frames in which the second of two components was measured.
        wrong: (k,) frames in which another object was.
    """

    n_frames: int
    depth_mm: Array
    unread: Array
    size: Array
    second: NDArray[np.int64]
    wrong: NDArray[np.int64]

    @staticmethod
    def of(frames: NDArray[np.float32], view: CommonView) -> Given:
        """What was given in one recording.

        Args:
            frames: (n, H, W) depth, mm, 0 where unread.
            view: size and choice of object in them.
        """
        read = frames > 0
        depth = float(np.mean(frames[read], dtype=np.float64)) if read.any() else 0.0
        return Given(
            len(frames),
            np.array([depth]),
            np.array([1.0 - read.mean()]),
            np.array([view.size]),
            np.array([np.count_nonzero(view.second)]),
            np.array([np.count_nonzero(view.wrong)]),
        )

    @staticmethod
    def join(parts: Sequence[Given]) -> Given:
        """What was given in several recordings, in their order.

        Args:
            parts: one or several recordings each.
        """
        columns = {
            name: np.concatenate([getattr(one, name) for one in parts])
            for name in ("depth_mm", "unread", "size", "second", "wrong")
        }
        return Given(sum(one.n_frames for one in parts), **columns)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, rounded to a fifth of what may differ or finer."""
        return {
            name: np.round(value, _DECIMALS.get(name, 0)).tolist()
            for name, value in vars(self).items()
        }

    @staticmethod
    def from_dict(told: Mapping[str, Any]) -> Given:
        """What `to_dict` told.

        Args:
            told: plain values by attribute.
        """
        columns = {name: np.array(value) for name, value in told.items() if name != "n_frames"}
        return Given(int(told["n_frames"]), **columns)

    def differs(self, today: Given) -> str:
        """In what today's recordings differ by more than a processor explains; '' in nothing.

        Args:
            today: what is given now.
        """
        shapes = [(one.n_frames, len(one.size)) for one in (self, today)]
        if shapes[0] != shapes[1]:
            told = [f"{n} frames of {k} recordings" for n, k in shapes]
            return f"{told[0]} were given, today {told[1]}"
        for what, then, now, limit, told_as in (
            ("mean depth", self.depth_mm, today.depth_mm, DEPTH_MM, "{:.2f} mm"),
            ("unread share", self.unread, today.unread, UNREAD, "{:.2%}"),
            ("animal's size", self.size, today.size, SIZE * self.size, "{:.4f}"),
        ):
            off = np.abs(now - then) / limit
            k = int(np.argmax(off))
            if not off[k] <= 1:
                was, is_now = told_as.format(then[k]), told_as.format(now[k])
                return f"the {what} of recording {k + 1} was {was}, today {is_now}"
        for what, then_n, now_n in (
            ("the second component is measured", self.second, today.second),
            ("another object is measured", self.wrong, today.wrong),
        ):
            if (n_other := int(np.abs(now_n - then_n).sum())) > FRAMES * self.n_frames:
                return f"frames in which {what} differ by {n_other} of {self.n_frames}"
        return ""


def of_training(pictures: TrainingSet) -> dict[str, float]:
    """What is in training pictures: mean height mm, covered share, spread of the joints mm.

    Args:
        pictures: of the animal, as they are cut out, with the truth.
    """
    heights = pictures.images.heights
    covered = heights != 0
    middle = pictures.truth.positions.mean(axis=1, keepdims=True)
    height = heights[covered].mean(dtype=np.float64) / 16 if covered.any() else 0.0
    return {
        "height_mm": round(float(height), 3),
        "covered": round(float(covered.mean()), 5),
        "joints_mm": round(float(np.abs(pictures.truth.positions - middle).mean()), 3),
    }


def training_differs(then: Mapping[str, float], now: Mapping[str, float]) -> str:
    """In what today's training pictures differ by more than a processor explains; '' in nothing.

    Args:
        then: what `of_training` told of the kept row's.
        now: and of today's.
    """
    for name, what, limit, told_as in (
        ("height_mm", "mean height", HEIGHT_MM, "{:.2f} mm"),
        ("covered", "covered share", COVERED, "{:.2%}"),
        ("joints_mm", "mean distance of joints from their middle", HEIGHT_MM, "{:.2f} mm"),
    ):
        if not abs(now[name] - then[name]) <= limit:
            was, is_now = told_as.format(then[name]), told_as.format(now[name])
            return f"the {what} of the training pictures was {was}, today {is_now}"
    return ""


def elsewhere(title: str, row: Mapping[str, Any]) -> str:
    """That a row was measured on another processor, and how near what it was given is; '' if not.

    Args:
        title: of the row.
        row: it names its processor where it is another's.
    """
    if not row.get(ELSEWHERE):
        return ""
    return (
        f"{title} was measured on another processor ({row[ELSEWHERE]}) than this run's "
        f"({processor()}), of the same code and recipe; what it was given there agrees with "
        f"today's within {DEPTH_MM:g} mm of mean depth, {100 * UNREAD:g} % of unread "
        f"pixels, {100 * SIZE:g} % of size and the choice of object "
        f"in {100 * FRAMES:g} % of the frames, and not to the last digit."
    )
