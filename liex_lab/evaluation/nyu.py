"""Mean joint error by the protocol of the NYU hand dataset: 14 points, root estimated or given.

The dataset is that of Tompson et al. (2014); the 14-point subset and the published answers are
those that Lie-X section 5.2 compares with. With x the estimate and y the truth of n frames,

    error = 1/(14 n) sum_ij |x_ij - y_ij|        or, root given, of x_ij - x_i,palm + y_i,palm.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.recordings.formats.images.nyu import PALM, POINTS

Array = NDArray[np.float64]

NYU_PROTOCOL = (
    "Error of a frame: mean over the labelled points of the 3D distance to the true point, mm; "
    "mean over frames. 14: all points; 13: without the palm. Root estimated: the answer as it is. "
    "Root given: the answer moved so that its palm lies on the true palm, as the published answer "
    "of Lie-X was; its mean over 14 then holds an error of zero, so compare it with others over "
    "13, or with theirs moved alike."
)
_MAX_BELOW_MM = (10, 20, 30, 40, 50, 60, 80)
_MEAN_BELOW_MM = (5, 10, 15, 20, 30, 40)


def nyu_errors(answer: Array, truth: Array) -> dict[str, Any]:
    """Errors of an estimate of hands against the truth.

    Args:
        answer: (n, 14, 3) estimated points, mm; frames with NaN count as lost.
        truth: (n, 14, 3) true points, mm, in the order of `POINTS`.

    Returns:
        The figures under their names, see `NYU_PROTOCOL`: number of frames, rate of lost ones, mean
        errors with the root estimated and given, over 14 points and over 13 without the palm, the
        median error of a point, mean error of each point, and shares of frames whose largest and
        mean error are below given limits; only the first two where every frame is lost.
    """
    seen = np.asarray(np.isfinite(answer).all(axis=(1, 2)))
    if not seen.any():
        return {"n_frames": len(truth), "lost_rate": 1.0}
    answer = answer[seen]
    truth = truth[seen]
    moved = answer - answer[:, PALM : PALM + 1] + truth[:, PALM : PALM + 1]
    estimated = _distances(answer, truth)
    given = _distances(moved, truth)
    others = np.arange(len(POINTS)) != PALM
    worst = estimated.max(axis=1)
    frame_mean = estimated.mean(axis=1)
    return {
        "n_frames": len(seen),
        "lost_rate": float(1.0 - seen.mean()),
        "root_estimated_mm_14": float(estimated.mean()),
        "root_estimated_mm_13": float(estimated[:, others].mean()),
        "root_given_mm_14": float(given.mean()),
        "root_given_mm_13": float(given[:, others].mean()),
        "median_mm_14": float(np.median(estimated)),
        "per_point_mm": dict(zip(POINTS, estimated.mean(axis=0).tolist(), strict=True)),
        "share_max_error_below_mm": {str(mm): float((worst < mm).mean()) for mm in _MAX_BELOW_MM},
        "share_mean_error_below_mm": {
            str(mm): float((frame_mean < mm).mean()) for mm in _MEAN_BELOW_MM
        },
    }


def _distances(answer: Array, truth: Array) -> Array:
    """Distance (n, 14) mm of every point."""
    return np.linalg.norm(answer - truth, axis=-1)
