"""Which of two animals in view is followed, told by their sizes where these differ.

Where two animals touch and are one thing in the picture, either may come out of it as the one that
was followed: their places do not tell. Of two that differ in size the pixels of each do, over the
seconds after. Only sizes that keep their order while both are apart count: of animals as large as
each other the larger one is now this, now that, as they stretch and rear.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.tracking.observations import Observations

Array = NDArray[np.float64]

_FEWEST = 12  # frames with two things in view
_LEAST = 0.08  # of the logarithm of the larger one's pixels over the smaller one's
_NOISE = 0.08  # standard deviation of it, at least
_IN_ORDER = 0.9  # of the frames, while both are apart: the larger one is the larger one throughout
_MOST = 2.0  # nats that a frame says
_CLEARLY = 1.5  # times the residual of one animal is that of another body


def cost_of_the_other(seen: Observations, path: NDArray[np.int64]) -> Array | None:
    """What it costs (n, H) each hypothesis not to be of the animal that a path follows, nats.

    The likelihood ratio of one order of sizes over the other, log-normal, at most 2 nats a frame.
    Which of the two, the larger or the smaller one, is to be followed is the one that the body of
    this session fits clearly better, for its size and girth were measured on that one; else what
    the path says of most frames.

    Args:
        seen: hypotheses (n, H) of the frames, those of a frame's second thing after the first's.
        path: (n,) which of them is meant, negative for none.

    Returns:
        0 where only one thing is in view; None where sizes do not tell one from the other.
    """
    first, second = seen.n_px[:, 0], seen.n_px[:, 2]
    apart = seen.known[:, 0] & seen.known[:, 2] & (first != second)
    apart &= np.minimum(first, second) > 0  # of a session that does not know, none is told
    ratio = np.zeros(len(seen))
    ratio[apart] = np.log(first[apart] / second[apart])
    if apart.sum() < _FEWEST:
        return None
    size = np.abs(ratio[apart])
    usual = float(np.median(size))
    noise = max(_NOISE, 1.4826 * float(np.median(np.abs(size - usual))))
    followed = apart & (path >= 0)
    own = np.where(path >= 2, -ratio, ratio)[followed]
    if usual < _LEAST or not len(own) or not _keeps_order(own, np.flatnonzero(followed)):
        return None
    fits = _better_fit(seen, ratio, apart)
    is_larger = fits or (1.0 if own.sum() > 0.0 else -1.0)
    said = np.clip(2.0 * is_larger * usual / noise**2 * ratio, -_MOST, _MOST)
    cost = np.zeros(seen.score.shape)
    cost[:, :2] = np.maximum(-said, 0.0)[:, None]
    cost[:, 2:] = np.maximum(said, 0.0)[:, None]
    return cost


def _better_fit(seen: Observations, ratio: Array, apart: NDArray[np.bool_]) -> float:
    """1 where the session's body fits the larger one clearly better while both are apart, -1 where
    it fits the smaller one, 0 where neither, by their residuals in the frames `apart` (n,).
    """
    first, second = (seen.residual_mm[apart, h].astype(float) for h in (0, 2))
    first_larger = ratio[apart] > 0.0
    larger = np.where(first_larger, first, second)
    smaller = np.where(first_larger, second, first)
    known = np.isfinite(larger) & np.isfinite(smaller)
    if known.sum() < _FEWEST:
        return 0.0
    off = float(np.log(np.median(smaller[known]) / max(np.median(larger[known]), 1e-9)))
    return float(np.sign(off)) if abs(off) > np.log(_CLEARLY) else 0.0


def _keeps_order(own: Array, frames: NDArray[np.int64]) -> bool:
    """Whether a followed thing is the larger one, or the smaller one, all the while that both are
    apart.

    Args:
        own: (k,) logarithm of its pixels over the other's.
        frames: (k,) their indices; where some are left out both may have touched.
    """
    begins = np.concatenate([[0], np.flatnonzero(np.diff(frames) > 1) + 1])
    n = np.diff(np.append(begins, len(own)))
    larger = np.add.reduceat((own > 0).astype(int), begins)
    return bool(np.maximum(larger, n - larger).sum() >= _IN_ORDER * len(own))
