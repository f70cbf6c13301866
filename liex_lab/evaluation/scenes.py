"""Scores of a session against a scene's truth: found, joint error, hidden, wrong but trusted.

The error of a frame is the mean per-joint position error of Lie-X section 5.3, e = 1/J sum_j |x_j -
y_j| (mm), in the camera frame, so that a wrong floor counts. Individuals of the session and animals
of the scene are matched once a recording, by the least sum of errors (Hungarian method); a frame
without a pose costs a spine. `SCENES_PROTOCOL` states every figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from liex_lab.simulation.scenes.recording import TrueAnimal

Array = NDArray[np.float64]

IN_VIEW = 0.5  # at least so much of an animal is seen
HIDDEN = 0.25  # at most so much
FAR = 0.15  # of the spine: an error beyond it is wrong

SCENES_PROTOCOL = (
    "Each scene is rendered, measured as `liex run` does, and its tables read back; joints are "
    "compared in the camera frame. found: of the frames in which at least half of an animal is in "
    "view, all animals together, the share that have a pose. mean_joint_error_mm and "
    "median_joint_error_mm: over those poses, mean over joints of the 3D distance to the true one. "
    "flips: share of those poses whose base-to-tip direction is more than 90 degrees off. "
    "hidden_right: of the frames in which an animal is there and at most a quarter of it is seen, "
    "the share without a trusted pose; null where there are none. wrong_but_trusted: of the "
    "frames that the tables flag as trusted, the share whose error is beyond 15 % of the true "
    "spine; where there is no animal, or one of another kind than the plan's, or an individual "
    "that is none of the animals, every trusted frame counts; 0 where none is trusted. trusted: "
    "share of all frames that are. ratio_to_plain: the mean error over that of the plain scene "
    "of the same animal. said: the problems that the session lists, or the sentence with which "
    "the run ended. exit_code: of the run."
)


@dataclass(frozen=True)
class Individual:
    """What a session says of one animal in n frames.

    Attributes:
        joints_camera: (n, J, 3) mm, camera frame; NaN without a pose.
        trusted: (n,) bool, whether the tables flag the pose as trusted.
    """

    joints_camera: Array
    trusted: NDArray[np.bool_]


@dataclass
class Tally:
    """Counts over recordings of one scene, from which its figures follow.

    Attributes:
        n_frames: of the recordings.
        in_view: frames and animals in view.
        found: of them, with a pose.
        hidden: frames and animals that are hidden.
        hidden_right: of them, without a trusted pose.
        trusted: frames and individuals that are flagged as trusted.
        wrong: of them, those that are wrong.
        errors_mm: of the poses in view, mm, an array for each animal.
        flipped: which of them have head and tail exchanged.
    """

    n_frames: int = 0
    in_view: int = 0
    found: int = 0
    hidden: int = 0
    hidden_right: int = 0
    trusted: int = 0
    wrong: int = 0
    errors_mm: list[Array] = field(default_factory=list)
    flipped: list[NDArray[np.bool_]] = field(default_factory=list)

    def add(
        self,
        truths: Sequence[TrueAnimal],
        individuals: Sequence[Individual],
        n_frames: int,
        tip: int = -1,
        fits: bool = True,
    ) -> None:
        """Count one recording.

        Args:
            truths: its animals.
            individuals: what the session says; () where the run was refused.
            n_frames: length of the recording.
            tip: the joint that the base's heading points at.
            fits: whether the animals are of the plan's kind; where they are not, every trusted
                frame is wrong and nothing else is counted.
        """
        self.n_frames += n_frames
        self.trusted += sum(int(one.trusted.sum()) for one in individuals)
        if not fits:
            self.wrong += sum(int(one.trusted.sum()) for one in individuals)
            return
        pairs = matched(truths, individuals)
        for k, one in enumerate(individuals):
            if k not in pairs.values():
                self.wrong += int(one.trusted.sum())
        for t, truth in enumerate(truths):
            self._add_animal(truth, individuals[pairs[t]] if t in pairs else None, tip)

    def _add_animal(self, truth: TrueAnimal, one: Individual | None, tip: int) -> None:
        there = np.isfinite(truth.joints_camera).all(axis=(1, 2))
        view = there & (truth.visible >= IN_VIEW)
        hidden = there & (truth.visible <= HIDDEN)
        self.in_view += int(view.sum())
        self.hidden += int(hidden.sum())
        if one is None:
            self.hidden_right += int(hidden.sum())
            return
        error = error_mm(one.joints_camera, truth.joints_camera)
        posed = np.isfinite(one.joints_camera).all(axis=(1, 2))
        self.found += int((view & posed).sum())
        self.hidden_right += int((hidden & ~one.trusted).sum())
        self.wrong += int((one.trusted & ~(error <= FAR * truth.spine_mm)).sum())
        rows = view & posed
        self.errors_mm.append(error[rows])
        own, true = (j[rows, tip] - j[rows, 0] for j in (one.joints_camera, truth.joints_camera))
        self.flipped.append(np.einsum("nd,nd->n", own, true) < 0)

    def figures(self) -> dict[str, Any]:
        """The figures of the scene under their names, see `SCENES_PROTOCOL`; None where a figure
        has no frames.
        """
        errors = np.concatenate([np.zeros(0), *self.errors_mm])
        flipped = np.concatenate([np.zeros(0, np.bool_), *self.flipped])
        some = len(errors) > 0
        return {
            "n_frames": self.n_frames,
            "found": self.found / self.in_view if self.in_view else None,
            "mean_joint_error_mm": float(errors.mean()) if some else None,
            "median_joint_error_mm": float(np.median(errors)) if some else None,
            "flips": float(flipped.mean()) if some else None,
            "hidden_right": self.hidden_right / self.hidden if self.hidden else None,
            "trusted": self.trusted / max(self.n_frames, 1),
            "wrong_but_trusted": self.wrong / self.trusted if self.trusted else 0.0,
        }


def error_mm(joints: Array, truth: Array) -> Array:
    """Mean joint errors.

    Args:
        joints: (n, J, 3) measured joints, mm; NaN without a pose.
        truth: (n, J, 3) true joints, mm; NaN where there is no animal.

    Returns:
        (n,) mm; NaN where either is missing.
    """
    return np.asarray(np.linalg.norm(joints - truth, axis=-1).mean(axis=1))


def matched(truths: Sequence[TrueAnimal], individuals: Sequence[Individual]) -> dict[int, int]:
    """Which individual of a session is which animal, by the least sum of errors over frames.

    An error counts up to a spine, and a spine stands for a missing pose.

    Args:
        truths: the animals.
        individuals: of the session.

    Returns:
        The individual's number for each animal's that has one.
    """
    from scipy.optimize import linear_sum_assignment

    if not truths or not individuals:
        return {}
    cost = np.array(
        [
            [
                np.minimum(
                    np.nan_to_num(
                        error_mm(one.joints_camera, truth.joints_camera), nan=truth.spine_mm
                    ),
                    truth.spine_mm,
                ).mean()
                for one in individuals
            ]
            for truth in truths
        ]
    )
    rows, columns = linear_sum_assignment(cost)
    return {int(t): int(k) for t, k in zip(rows, columns, strict=True)}
