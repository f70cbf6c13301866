"""Which poses of a track the picture contradicts, whatever error the model predicts for them.

An error of more than a quarter of the length is none to trust, whatever limit the plan states. Of a
measured pose three numbers come from the picture itself (`residual.Agreement`): the distance
between rendered body and readings, the share of the silhouette that the body covers, and the share
of the body beside it. Of a pose that was smoothed or bridged, the distance from what the frame
itself says is asked: while an animal is in full view, a pose that lies elsewhere is none.

The limits were set on virtual recordings of the mouse, the fish and the hand with known truth; how,
and what lies on either side of them, stands in `docs/trust.md`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.tracking.observations import Observations, joints_of

Array = NDArray[np.float64]

# of the animal's length
MOST_ERROR = 0.25
MOST_RESIDUAL = 0.12
_ALWAYS_RESIDUAL = 0.04  # below this a residual contradicts nothing, however quiet the session is
_TIMES_RESIDUAL = 4.0  # of the session's own usual residual
_LEAST_COVERED = 0.35
_MOST_BESIDE = 0.6
# an animal is in full view where it shows this share of the usual pixels, at least and at most
_LEAST_SHOWN = 0.6
_MOST_SHOWN = 1.6
# a pose lies elsewhere if its joints are so far from every pose that the frame itself allows: so
# many predicted errors, and this share of the length
_TIMES_ERROR = 4.0
_ELSEWHERE = 0.25


def contradicted(
    seen: Observations, path: NDArray[np.int64], length_mm: float
) -> NDArray[np.bool_]:
    """Whether (n,) the picture contradicts the pose that a frame's own hypothesis gives.

    Args:
        seen: hypotheses (n, H) of the frames.
        path: (n,) which of them is meant, negative for none.
        length_mm: of the animal.

    Returns:
        False where there is no hypothesis, or nothing is known of how it agrees with the picture.
    """
    residual = seen.along(seen.residual_mm, path)
    known = residual[np.isfinite(residual)]
    usual = float(np.median(known)) if len(known) else 0.0
    limit = min(
        max(_TIMES_RESIDUAL * usual, _ALWAYS_RESIDUAL * length_mm), MOST_RESIDUAL * length_mm
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (residual > limit)
            | (seen.along(seen.covered, path) < _LEAST_COVERED)
            | (seen.along(seen.beside, path) > _MOST_BESIDE)
        )


def elsewhere(
    skeleton: Skeleton,
    seen: Observations,
    joints_mm: Array,
    error_mm: Array,
    length_mm: float,
    usual_px: float,
) -> NDArray[np.bool_]:
    """Whether (n,) a pose lies elsewhere than everything that its frame says of an animal in view.

    Either way round counts, for which end is the head is told by more than one frame.

    Args:
        skeleton: kinematic tree of the animal.
        seen: hypotheses (n, H) of the frames.
        joints_mm: (n, J, 3) the poses, arena frame, mm; NaN where there is none.
        error_mm: (n,) their predicted errors, mm.
        length_mm: of the animal.
        usual_px: pixels that the animal usually shows.

    Returns:
        False where nothing of the animal's size is in full view, or there is no pose.
    """
    nearest = np.full(len(seen), np.inf)
    allowed = np.zeros(len(seen))
    for h in range(seen.score.shape[1]):
        shown = seen.n_px[:, h] / max(usual_px, 1.0)
        rows = np.flatnonzero(
            seen.known[:, h]
            & np.isfinite(error_mm)
            & (shown >= _LEAST_SHOWN)
            & (shown <= _MOST_SHOWN)
        )
        if not len(rows):
            continue
        own = joints_of(skeleton, seen.pose(np.full(len(seen), h))[rows])
        off = np.linalg.norm(own - joints_mm[rows], axis=-1).mean(axis=1)
        nearer = off < nearest[rows]
        nearest[rows[nearer]] = off[nearer]
        both = np.hypot(seen.error_mm[rows, h], error_mm[rows])
        allowed[rows[nearer]] = np.maximum(_TIMES_ERROR * both, _ELSEWHERE * length_mm)[nearer]
    return np.asarray(np.isfinite(nearest) & (nearest > allowed))
