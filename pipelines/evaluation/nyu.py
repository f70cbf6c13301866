"""Evaluation on the NYU Hand Pose data set: published results and ours by one protocol.

`liex evaluate nyu` uses real depth frames, the test split of 8,252 frames and two people (Lie-X
section 5.1) or any of them, with the 14 labelled points of the usual subset (Tompson et al. 2014).
With x the estimate and y the truth of n frames,

    error = 1/(14 n) sum_ij |x_ij - y_ij|        or, root given, of x_ij - x_i,palm + y_i,palm.

The published results are also scored on exactly the frames that ours were measured on, because a
mean over 8,252 frames and one over a few are not comparable.
"""

from pathlib import Path
from typing import Any

import numpy as np
from liex_lab.dashboards.paper.figures import draw_poses
from numpy.typing import NDArray

from liex_lab.errors import LiexError, ModelError, RecordingError
from liex_lab.plan import Plan
from liex_lab.recordings.formats.images.nyu import (
    PALM,
    POINTS,
    Array,
    NyuReference,
    frame_numbers,
    points_of_joints,
)
from liex_lab.runtime.progress import Progress, silent

from ..build import build_estimator, build_recording, build_scene

Numbers = NDArray[np.int64]

NYU_PROTOCOL = (
    "Error of a frame: mean over the labelled points of the 3D distance to the true point, mm; "
    "mean over frames. 14: all points; 13: without the palm. Root estimated: the answer as it is. "
    "Root given: the answer moved so that its palm lies on the true palm, as the published answer "
    "of Lie-X was; its mean over 14 then holds an error of zero, so compare it with others over "
    "13, or with theirs moved alike."
)
_SHOWN = 10  # hands in Fig 12 of Lie-X
_OURS = "liex_lab"
_PUBLISHED = {
    "liex": "Lie-X (Xu et al. 2017), palm placed on the true palm",
    "v2v_posenet": "V2V-PoseNet (Moon et al. 2018)",
    "deepprior": "DeepPrior (Oberweger et al. 2015)",
    "generalized_feedback": "Generalized Feedback (Oberweger et al. 2019)",
}


def nyu_errors(answer: Array, truth: Array) -> dict[str, Any]:
    """Errors of an estimate of hands against the truth, see `NYU_PROTOCOL`.

    Args:
        answer: (n, 14, 3) estimated points, mm; frames with NaN count as lost.
        truth: (n, 14, 3) true points, mm, in the order of `POINTS`.

    Returns:
        Number of frames, rate of lost ones, mean errors with the root estimated and given, over 14
        points and over 13 without the palm, the median error of a point, mean error of each point,
        and shares of frames whose largest and mean error are below given limits; only the first two
        if every frame is lost.
    """
    posed = np.asarray(np.isfinite(answer).all(axis=(1, 2)))
    if not posed.any():
        return {"n_frames": len(truth), "lost_rate": 1.0}
    answer, truth = answer[posed], truth[posed]
    moved = answer - answer[:, PALM : PALM + 1] + truth[:, PALM : PALM + 1]
    estimated, given = (np.linalg.norm(points - truth, axis=-1) for points in (answer, moved))
    others = np.arange(len(POINTS)) != PALM
    worst, mean = estimated.max(axis=1), estimated.mean(axis=1)
    return {
        "n_frames": len(posed),
        "lost_rate": float(1.0 - posed.mean()),
        "root_estimated_mm_14": float(estimated.mean()),
        "root_estimated_mm_13": float(estimated[:, others].mean()),
        "root_given_mm_14": float(given.mean()),
        "root_given_mm_13": float(given[:, others].mean()),
        "median_mm_14": float(np.median(estimated)),
        "per_point_mm": dict(zip(POINTS, estimated.mean(axis=0).tolist(), strict=True)),
        "share_max_error_below_mm": {
            str(mm): float((worst < mm).mean()) for mm in (10, 20, 30, 40, 50, 60, 80)
        },
        "share_mean_error_below_mm": {
            str(mm): float((mean < mm).mean()) for mm in (5, 10, 15, 20, 30, 40)
        },
    }


def evaluate_nyu(
    reference: str | Path,
    *,
    model: str | None = None,
    figure: Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Errors on NYU hand data of published results and of ours, by both root protocols.

    Args:
        reference: folder with `nyu_test_14joints.npz` (labels and results) or `joint_data.mat`
            (labels), and any of the frames `depth_1_NNNNNNN.png`.
        model: name or path of a hand model; None means the bundled one.
        figure: PNG of Fig. 12 of Lie-X; None draws none.
        progress: called frame by frame.

    Returns:
        `published` by method, `ours` (with a note if there are no frames or no model),
        `same_frames`: the published results on the frames of ours alone, `n_labelled` and the
        protocol.

    Raises:
        LiexError: frames and labels do not belong together.
    """
    folder = Path(reference)
    labels = NyuReference.load(folder)
    numbers = frame_numbers_in(folder, len(labels.truth))
    ours, points = _ours(folder, labels.truth, numbers, model, progress)
    if figure is not None:
        draw_poses(
            "NYU test frames, 14 points: labels, blue; answer, red",
            shown_hands(labels, numbers, points),
            figure,
        )
    published, same = {}, {}
    for name, answer in labels.answers.items():
        published[name] = {"method": _PUBLISHED.get(name, name), **nyu_errors(answer, labels.truth)}
        if len(numbers):
            same[name] = nyu_errors(answer[numbers - 1], labels.truth[numbers - 1])
    return {
        "reference": str(folder),
        "n_labelled": len(labels.truth),
        "published": published,
        "ours": ours,
        "same_frames": same,
        "protocol": NYU_PROTOCOL,
    }


def shown_hands(
    labels: NyuReference, numbers: Numbers, ours: Array
) -> dict[str, list[dict[str, Any]]]:
    """Ten evenly spaced labelled hands, with the results of all methods, for Fig 12.

    Args:
        labels: true points and published results.
        numbers: (m,) numbers of the frames that ours was measured on, from 1 on.
        ours: (m, 14, 3) our points in them, mm, camera frame; NaN if nothing was found.

    Returns:
        By method, for each hand its `head`, `truth` (14, 3) mm, and `pose` (14, 3) mm if the method
        has one; ours comes first if it found any of them.
    """
    rows = np.unique(np.arange(_SHOWN) * len(labels.truth) // _SHOWN)
    own = np.full_like(labels.truth, np.nan)
    own[numbers - 1] = ours
    found: dict[str, list[dict[str, Any]]] = {}
    for name, answer in {_OURS: own, **labels.answers}.items():
        if np.isfinite(answer[rows]).all(axis=(1, 2)).any():
            found[name] = [{"head": f"frame {k + 1}", "truth": labels.truth[k]} for k in rows]
            for hand, k in zip(found[name], rows, strict=True):
                if np.isfinite(answer[k]).all():
                    hand["pose"] = answer[k]
    return found or {"labels": [{"head": f"frame {k + 1}", "truth": labels.truth[k]} for k in rows]}


def frame_numbers_in(folder: Path, n_labelled: int) -> Numbers:
    """Numbers, from 1 on, of the frames in the folder; empty if there are none."""
    try:
        numbers = np.array(frame_numbers(folder), np.int64)
    except RecordingError:
        return np.zeros(0, np.int64)
    if numbers.max() > n_labelled:
        raise LiexError(
            f"{folder} contains the frame {numbers.max()}, but labels of {n_labelled} frames; give "
            "the frames that belong to the labels"
        )
    return numbers


def hands_in_short(result: dict[str, Any]) -> dict[str, str]:
    """One line for each method, and the protocol, from the result of `evaluate_nyu`."""
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
    return {**lines, "protocol": result["protocol"]}


def _ours(
    folder: Path, truth: Array, numbers: Numbers, model: str | None, progress: Progress
) -> tuple[dict[str, Any], Array]:
    """Our errors on the frames in the folder, and our points (m, 14, 3) mm in them, camera frame.

    The errors are a note if there are no frames or no model.
    """
    points = np.full((len(numbers), *truth.shape[1:]), np.nan)
    if not len(numbers):
        return {"n_frames": 0, "note": f"no frames depth_1_NNNNNNN.png in {folder}"}, points
    plan = Plan.load("hand").with_settings([f"estimation.model={model}"] if model else [])
    try:
        estimator = build_estimator(plan)
    except ModelError as error:
        return {"n_frames": 0, "note": str(error)}, points
    skeleton = estimator.skeleton
    with build_recording(folder, plan) as recording:
        scene, sample = build_scene(recording, plan, skeleton, plan.foreground.n_background_frames)
        size = estimator.find_size(sample, scene)
        weights = points_of_joints(skeleton)
        # frames in memory at a time
        for frames in recording.chunks(32):
            joints = estimator.estimate(
                np.stack([frame.depth for frame in frames]), scene, size
            ).chosen.pose.joints(skeleton)
            points[[frame.index for frame in frames]] = weights @ joints
            progress(frames[-1].index + 1, len(recording), "measuring hands")
    return {
        "method": "liex_lab, default",
        "spine_mm": size * skeleton.length,
        **nyu_errors(points, truth[numbers - 1]),
    }, points
