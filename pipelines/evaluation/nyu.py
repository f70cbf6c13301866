"""Evaluation on the NYU Hand Pose data set: published answers and our own by one protocol.

`liex evaluate nyu` takes real depth frames, the test split of 8,252 frames and two people (Lie-X
section 5.1) or any of them, with the 14 labelled points of the usual subset. Numbers, mm: mean
distance of the points and mean over frames, with 14 points and with 13 (without the palm), each for
the root as estimated and with the palm placed on the true palm, as the published answer of Lie-X
was; median, error by point, share of frames below thresholds of maximum and mean error, lost rate.
The published answers are also scored on the very frames that ours were measured on: a mean over
8,252 frames and one over a few say nothing about each other.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError
from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress, silent

if TYPE_CHECKING:
    from liex_lab.recordings.formats.images.nyu import NyuReference

_CHUNK = 32  # frames in memory at a time
_SHOWN = 10  # hands in Fig 12 of Lie-X
_OURS = "liex_lab"
_LABELS = (
    "The bone lengths of our hand, and {share:.0f} % of the postures that our bundled model was "
    "trained on, come from labels of the NYU test frames 1 to {last}, whose source states no "
    "licence. Frames among these that ours was measured on: {n} of {of}."
)
_PUBLISHED = {
    "liex": "Lie-X (Xu et al. 2017), palm placed on the true palm",
    "v2v_posenet": "V2V-PoseNet (Moon et al. 2018)",
    "deepprior": "DeepPrior (Oberweger et al. 2015)",
    "generalized_feedback": "Generalized Feedback (Oberweger et al. 2019)",
}


def evaluate_nyu(
    reference: str | Path,
    *,
    model: str | None = None,
    draw: Callable[[list[dict[str, Any]]], object] | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Errors on NYU hand data of published answers and of our own, by both root protocols.

    Args:
        reference: folder with `nyu_test_14joints.npz` (labels and answers) or `joint_data.mat`
            (labels), and any of the frames `depth_1_NNNNNNN.png`.
        model: name or path of a hand model; None takes the bundled one.
        draw: is given `shown_hands`, for a picture.
        progress: told frame by frame.

    Returns:
        `published` by method, `ours` (with a note where there are no frames or no model),
        `same_frames`: the published answers on the frames of ours alone, `labels_used`: what of our
        model comes from test labels, `n_labelled` and the protocol.

    Raises:
        LiexError: frames and labels do not belong together.
    """
    from liex_lab.evaluation.nyu import NYU_PROTOCOL, nyu_errors
    from liex_lab.recordings.formats.images.nyu import NyuReference

    folder = Path(reference)
    labels = NyuReference.load(folder)
    rows = {
        name: {"method": _PUBLISHED.get(name, name), **nyu_errors(points, labels.truth)}
        for name, points in labels.answers.items()
    }
    numbers = _frame_numbers(folder, len(labels.truth))
    ours, points = _ours(folder, labels.truth, numbers, model, progress)
    if draw is not None:
        draw(shown_hands(labels, numbers, points))
    return {
        "reference": str(folder),
        "n_labelled": len(labels.truth),
        "published": rows,
        "ours": ours,
        "same_frames": {
            name: nyu_errors(points[numbers - 1], labels.truth[numbers - 1])
            for name, points in labels.answers.items()
            if len(numbers)
        },
        "labels_used": labels_used(numbers),
        "protocol": NYU_PROTOCOL,
    }


def shown_hands(
    labels: NyuReference, numbers: NDArray[np.int64], ours: NDArray[np.float64]
) -> list[dict[str, Any]]:
    """Ten labelled hands, evenly spaced from the first on, with what methods answer, for Fig 12.

    Args:
        labels: true points and published answers.
        numbers: (m,) numbers of the frames that ours was measured on, from 1 on.
        ours: (m, 14, 3) our points in them, mm, camera frame; NaN where nothing was found.

    Returns:
        Of each `frame`, its number, `truth` (14, 3) mm, and `answers` (14, 3) mm by method; ours is
        among them where it found the hand.
    """
    n = len(labels.truth)
    own = {int(k): points for k, points in zip(numbers, ours, strict=True)}
    found = []
    for row in np.unique(np.arange(_SHOWN) * n // _SHOWN):
        answers = {name: points[row] for name, points in labels.answers.items()}
        points = own.get(row + 1)
        if points is not None and np.isfinite(points).all():
            answers = {_OURS: points, **answers}
        found.append({"frame": int(row) + 1, "truth": labels.truth[row], "answers": answers})
    return found


def labels_used(numbers: NDArray[np.int64]) -> str:
    """What of our hand model comes from labels of the test frames, in one sentence.

    Args:
        numbers: (n,) numbers of the frames that are measured, from 1 on.
    """
    from liex_lab.recordings.formats.images.nyu import N_FIRST_PERSON
    from liex_lab.simulation.hand.pose_prior import SEEN_SHARE

    n = int((numbers <= N_FIRST_PERSON).sum())
    return _LABELS.format(share=100 * SEEN_SHARE, last=N_FIRST_PERSON, n=n, of=len(numbers))


def _frame_numbers(folder: Path, n_labelled: int) -> NDArray[np.int64]:
    """Numbers, from 1 on, of the frames in the folder; none where there are no frames."""
    from liex_lab.errors import RecordingError
    from liex_lab.recordings.formats.images.nyu import frame_numbers

    try:
        numbers = np.array(frame_numbers(folder), np.int64)
    except RecordingError:
        return np.zeros(0, np.int64)
    if numbers.max() > n_labelled:
        raise LiexError(
            f"{folder} holds the frame {numbers.max()}, but labels of {n_labelled} frames; give "
            "the frames that belong to the labels"
        )
    return numbers


def in_short(result: dict[str, Any]) -> dict[str, str]:
    """One line for each method, and the protocol.

    Args:
        result: what `evaluate_nyu` returns.
    """
    lines = {}
    for name, row in [*result["published"].items(), (_OURS, result["ours"])]:
        if "root_estimated_mm_14" not in row:
            lines[name] = row.get("note", f"lost in all of {row['n_frames']} frames")
            continue
        lines[name] = (
            f"{row['n_frames']} frames; 14 points: {row['root_estimated_mm_14']:.3f} mm, root "
            f"given {row['root_given_mm_14']:.3f}; 13 points: {row['root_estimated_mm_13']:.3f} "
            f"mm, root given {row['root_given_mm_13']:.3f}"
        )
    n = result["ours"].get("n_frames", 0)
    for name, row in result["same_frames"].items():
        lines[f"{name}, same {n} frame{'s' if n != 1 else ''} as ours"] = (
            f"14 points: {row['root_estimated_mm_14']:.2f} mm, root given "
            f"{row['root_given_mm_14']:.2f}"
        )
    return {**lines, "labels used": result["labels_used"], "protocol": result["protocol"]}


def _ours(
    folder: Path,
    truth: np.ndarray,
    numbers: NDArray[np.int64],
    model: str | None,
    progress: Progress,
) -> tuple[dict[str, Any], NDArray[np.float64]]:
    """Our errors on the frames in the folder, a note where there are none, or no model; and our
    points (m, 14, 3) mm in them, camera frame.
    """
    from liex_lab.errors import ModelError
    from liex_lab.evaluation.nyu import nyu_errors
    from liex_lab.recordings.formats.images.nyu import points_of_joints

    from ..build import build_estimator, build_recording, build_scene

    plan = Plan.load("hand")
    if model is not None:
        plan = plan.with_settings([f"estimation.model={model}"])
    points = np.full((len(numbers), *truth.shape[1:]), np.nan)
    if not len(numbers):
        return {"n_frames": 0, "note": f"no frames depth_1_NNNNNNN.png in {folder}"}, points
    try:
        estimator = build_estimator(plan)
    except ModelError as error:
        return {"n_frames": 0, "note": str(error)}, points
    with build_recording(folder, plan) as recording:
        scene, sample = build_scene(
            recording, plan, estimator.skeleton, plan.foreground.n_background_frames
        )
        size = estimator.find_size(sample, scene)
        weights = points_of_joints(estimator.skeleton)
        for frames in recording.chunks(_CHUNK):
            depths = np.stack([frame.depth for frame in frames])
            joints = estimator.estimate(depths, scene, size).chosen.pose.joints(estimator.skeleton)
            points[[frame.index for frame in frames]] = weights @ joints
            progress(frames[-1].index + 1, len(recording), "measuring hands")
    ours = {
        "method": "liex_lab, default",
        "spine_mm": size * estimator.skeleton.length,
        **nyu_errors(points, truth[numbers - 1]),
    }
    return ours, points
