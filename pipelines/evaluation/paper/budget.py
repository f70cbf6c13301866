"""How much of the tables is measured, trained or taken from what is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from liex_lab.errors import PlanError

from .rows import ROWS

CURVES = "fig7"  # stands for the curves among the names of rows
_QUICK_FRAMES = 100


@dataclass(frozen=True)
class Budget:
    """How much is measured, and of what.

    Attributes:
        n_frames: frames of each split, rounded up to whole recordings; None takes all.
        fresh: rows that are trained and measured now; the others come from datasets/kept_results.
        curves: those of Fig. 7 are, too, where none of today's method and code is kept.
        kept: results that fit are taken from there.
        quick: every row is trained on next to nothing, to see that everything runs.
        sealed: the sealed split is measured instead of the others.
        n_illustrated: images behind the figures of candidates and convergence.
    """

    n_frames: int | None = None
    fresh: tuple[str, ...] = ()
    kept: bool = True
    quick: bool = False
    sealed: bool = False
    n_illustrated: int = 128
    curves: bool = False

    @staticmethod
    def of(
        n_frames: int | None, quick: bool, fresh: bool, rows: Sequence[str], sealed: bool
    ) -> Budget:
        """What the options of the command line ask for.

        Args:
            n_frames: frames of each split; with any, nothing kept is used.
            quick: every row is trained on next to nothing.
            fresh: all rows and curves are trained and measured now.
            rows: names of rows that are, and `CURVES`; () names none.
            sealed: the sealed split; with it, nothing kept is used.

        Raises:
            PlanError: there is no such row.
        """
        known = (*ROWS, CURVES)
        if unknown := [row for row in rows if row not in known]:
            raise PlanError(f"there is no row '{unknown[0]}'; known are {', '.join(known)}")
        wanted = tuple(row for row in ROWS if not rows or row in rows or row == "default")
        if quick:
            return Budget(n_frames or _QUICK_FRAMES, wanted, False, True, sealed, 16, curves=True)
        whole = n_frames is None and not sealed
        return Budget(
            n_frames,
            wanted if fresh or rows or not whole else ("default",),
            whole and not (fresh and not rows),
            False,
            sealed,
            curves=whole and (CURVES in rows or (fresh and not rows)),
        )
