"""Fixed-lag smoothing of an ongoing recording: the methods of `offline` over a sliding window.

A window of 48 frames is associated by Viterbi, with earlier decisions fixed, and smoothed by the
Kalman filter and Rauch-Tung-Striebel smoother of an integrated Ornstein-Uhlenbeck process.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.tracking.association import NONE, HypothesisAssociation
from liex_lab.tracking.motion_model import TrackingParameters
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.smoother import smooth
from liex_lab.tracking.track import Subject, Track
from liex_lab.tracking.track_rows import hide, to_track
from liex_lab.tracking.trust import Watch

# frames used to choose the hypothesis, and frames before the current one used to smooth
_WINDOW = 48
_BEFORE = 20


class OnlineTracker:
    """Receives observations of frames as they arrive; returns a row for each, `lag` frames later.

    The hypothesis chosen for a frame does not change once its row is returned; estimates improve
    with a longer lag. With lag 0 a row is returned at once, from the past alone.

    Args:
        subject: the animal.
        lag: frames by which a row is delayed.
        tuning: motion and association parameters; None uses the animal's own.
    """

    def __init__(
        self, subject: Subject, lag: int = 0, tuning: TrackingParameters | None = None
    ) -> None:
        tuning = tuning or TrackingParameters.of(subject.skeleton.name)
        self._subject = subject
        self._lag = lag
        self._motion = tuning.motion
        self._chain = HypothesisAssociation(
            subject.skeleton, subject.length_mm, tuning.chain, subject.n_animals
        )
        self._seen: Observations | None = None
        self._told = 0  # number of the window's frames already returned
        self._path: NDArray[np.int64] = np.zeros(0, np.int64)
        # joints of the window's hypotheses that the association uses
        self._joints: NDArray[np.float32] | None = None
        self._watch = Watch()

    def add(self, seen: Observations) -> Track | None:
        """Add frames; returns the rows that are due.

        Args:
            seen: hypotheses (n, H) of the next n frames, arena frame.

        Returns:
            The rows that are due, in order; None if none are.
        """
        rows = []
        for k in range(len(seen)):
            self._take(seen[k : k + 1])
            if len(self._path) - self._told > self._lag:
                rows.append(self._tell(1))
        return Track.join(rows) if rows else None

    def close(self) -> Track | None:
        """The delayed rows, at the end of the recording; None if there are none."""
        left = len(self._path) - self._told
        return self._tell(left) if left else None

    def _take(self, frame: Observations) -> None:
        """Advance the window by one frame."""
        joined = frame if self._seen is None else Observations.join([self._seen, frame])
        joints = self._chain.joints(frame)
        joints = joints if self._joints is None else np.concatenate([self._joints, joints])
        gone = max(0, len(joined) - _WINDOW)
        self._seen = joined[gone:]
        self._joints = joints[gone:]
        self._told = self._told - gone
        self._path = np.append(self._path[gone:], NONE)

    def _tell(self, n: int) -> Track:
        """The rows of the next n frames that have not been returned yet."""
        assert self._seen is not None
        seen = self._seen
        told = self._told
        assert self._joints is not None
        emission = self._chain.emission(seen, self._joints)
        path = self._chain.path(seen, self._path[:told], self._joints, emission=emission)
        self._path[told : told + n] = path[told : told + n]
        doubt = self._chain.doubt(seen, path, self._joints, emission=emission)
        first = max(0, told - _BEFORE)
        if (path[first:] == NONE).all():  # all observations of the animal are older
            first = 0
        seen = seen[first:]
        path = path[first:]
        doubt = doubt[first:]
        told = told - first
        pose = seen.pose(path)
        error = seen.along(seen.error_mm, path)
        curve = smooth(
            self._subject.skeleton, seen.seconds, pose, error, self._subject.length_mm, self._motion
        )
        self._told += n
        due = slice(told, told + n)
        track = to_track(
            self._subject,
            seen,
            path,
            curve,
            doubt,
            ahead=True,
            told=due,
            usual_px=self._watch.usual_px,
        )
        hide(track, self._watch.gone(seen[due], path[due], track.observed))
        return track
