"""How well a plan's animal explains a recording: absolute evidence from the frames it learned from.

A learned error says how far off a pose is if the picture shows the animal that the model knows;
shown something else it may say anything. So the model is held against the picture itself:
S the silhouette, B the rendered body, r the distance between body and readings, L the length,

    covered = |S and B| / |S|,    beside = |B without S| / |B|,    r / L,    L within the plan's.

The limits below are far outside of what the animals of the model's own kind reach and well inside
of what anything else reaches; `docs/trust.md` has both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.tracking.residual import Agreement
from liex_lab.tracking.trust import MOST_ERROR, MOST_RESIDUAL

Array = NDArray[np.float64]

# of the plan's own lengths: sizes are measured to a few per cent, and plans state round numbers
_SIZE_MARGIN = 0.15
_LEAST_COVERED = 0.4
_MOST_BESIDE = 0.5
_LEAST_FOUND = 0.05
# a second thing is an animal, too, where its body fits as well as the first's usually does
_TWIN_SHARE = 0.2  # of the frames: it is no passing hand


@dataclass(frozen=True)
class SampleFit:
    """The model's agreement with the frames that a session was learned from; medians over them.

    Attributes:
        n_frames: frames that hold depth.
        n_found: frames in which something of the animal's size was found and has a pose.
        spine_mm: the animal's length, mm.
        error_mm: predicted mean joint error, mm.
        residual_mm: distance between rendered body and reading, mm; NaN where they hardly overlap.
        covered: share (0 to 1) of the silhouette that the body covers.
        beside: share (0 to 1) of the body that lies beside the silhouette.
        n_animals: how many things of the animal's size are in view at once whose outline and
            surface its body fits.
    """

    n_frames: int
    n_found: int
    spine_mm: float
    error_mm: float
    residual_mm: float
    covered: float
    beside: float
    n_animals: int = 1

    @staticmethod
    def of(
        n_frames: int, spine_mm: float, error_mm: Array, agreement: Agreement, n_animals: int = 1
    ) -> SampleFit:
        """The fit of a sample of frames.

        Args:
            n_frames: frames of the sample that hold depth.
            spine_mm: the animal's length, mm.
            error_mm: (m,) predicted errors of the m frames with a pose, mm, at least one.
            agreement: of those m poses with their pictures.
            n_animals: things of the animal's size in view at once.
        """
        residual = agreement.residual_mm[np.isfinite(agreement.residual_mm)]
        return SampleFit(
            n_frames,
            len(error_mm),
            spine_mm,
            float(np.median(error_mm)),
            float(np.median(residual)) if len(residual) else float("nan"),
            float(np.median(agreement.covered)),
            float(np.median(agreement.beside)),
            n_animals,
        )

    def has_length(self, low_mm: float, high_mm: float) -> bool:
        """Whether the length is one that a plan allows.

        Args:
            low_mm: the plan's least length of the animal, mm.
            high_mm: its largest, mm.
        """
        return low_mm * (1.0 - _SIZE_MARGIN) <= self.spine_mm <= high_mm * (1.0 + _SIZE_MARGIN)

    def misfits(self, low_mm: float, high_mm: float, stated: bool = False) -> list[str]:
        """What contradicts that this is the plan's animal; empty where nothing does.

        Args:
            low_mm: the plan's least length of the animal, mm.
            high_mm: its largest, mm.
            stated: the plan states this animal's length itself, which is not questioned then.

        Returns:
            Parts of a sentence, such as 'it is 743 mm long and the plan expects 130 to 220 mm'.
        """
        found = []
        if not stated and not self.has_length(low_mm, high_mm):
            found.append(
                f"it is {self.spine_mm:.0f} mm long and the plan expects {low_mm:g} to "
                f"{high_mm:g} mm"
            )
        if self.n_found < _LEAST_FOUND * self.n_frames:
            found.append(
                f"something of its size was found in {self.n_found} of {self.n_frames} frames"
            )
        if self.error_mm > MOST_ERROR * self.spine_mm:
            found.append(
                f"the expected error of {self.error_mm:.0f} mm is "
                f"{self.error_mm / self.spine_mm:.0%} of its length"
            )
        if not self.residual_mm <= MOST_RESIDUAL * self.spine_mm:
            found.append(
                "its body and what was read hardly overlap"
                if np.isnan(self.residual_mm)
                else f"its body lies {self.residual_mm:.0f} mm from what was read"
            )
        if self.covered < _LEAST_COVERED:
            found.append(f"its body covers {self.covered:.0%} of the outline that is seen")
        if self.beside > _MOST_BESIDE:
            found.append(f"{self.beside:.0%} of its body lies beside that outline")
        return found


def count_animals(first: Agreement, second: Agreement, rows: NDArray[np.int64], n: int) -> int:
    """How many things of the animal's size are in view at once: 1 or 2.

    Args:
        first: agreement of the animal's own poses with the pictures of n frames.
        second: the same of the next thing of about its size, in m of these frames.
        rows: (m,) which frames those are.
        n: number of frames.
    """
    if not len(rows) or not n:
        return 1
    usual = np.nanmedian(first.residual_mm) if np.isfinite(first.residual_mm).any() else 0.0
    alike = (
        (second.residual_mm <= 1.5 * usual)
        & (second.covered >= 0.8 * np.median(first.covered))
        & (second.beside <= _MOST_BESIDE)  # a shorter animal fills less of a body of this length
    )
    return 2 if alike.sum() >= max(2.0, _TWIN_SHARE * n) else 1
