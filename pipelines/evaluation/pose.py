"""Evaluation of single-frame poses: mean joint error on fixed splits of rendered recordings.

`liex evaluate pose` measures the protocol of Lie-X (section 5.2, Tables 1 and 2) on rendered test
splits, `clean`, `hard` (twice the noise, other objects in view), `other-body` (unseen family of
shapes) and `other-camera` (unseen focal lengths and resolutions), 40 recordings of 50 frames each;
none was trained on. As in a run, background, floor and animal's size are found by the product.
Numbers, over all measured frames:

- mean, median and 95 % quantile of the frame error e = mean_j |x_j - x_j^true|, mm;
- flip rate (base-to-tip direction more than 90 degrees off) and share of frames without a pose;
- Spearman's correlation of predicted and true error, coverage of the predicted 90 % interval.

`liex evaluate sizes` repeats it over animals of several lengths. `liex evaluate reference` compares
a session of a real recording with another program's centroid and axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError, PlanError
from liex_lab.evaluation.pose import POSE_PROTOCOL, PoseErrors, angle_between_axes, count_reversals
from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress, silent

from ..build import plan_of

if TYPE_CHECKING:
    from liex_lab.baselines.baseline import Baseline
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.scene.segmenter import Segmenter
    from liex_lab.simulation.recording import TrueRecording

Array = NDArray[np.float64]

_SIZES_MM = {"mouse": (45.0, 65.0, 80.0, 100.0), "fish": (18.0, 25.0, 32.0, 45.0)}
_SIZES = (0.75, 1.0, 1.25, 1.5)  # of other animals, over their home length


def estimator_of(
    animal: str,
    variant: str,
    progress: Progress = silent,
    model: str | Path | None = None,
    draw: int = 0,
) -> PoseEstimator:
    """The pose estimator of a model file or of a variant of the method.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: `default` takes the bundled model where there is one; every other is trained now,
            or taken from the cache.
        progress: told how far the training is, where there is one.
        model: name or path of a model file, which comes before the variant.
        draw: number of the draw of a model that is trained, see `make_model`.

    Raises:
        ModelError: there is no such model, or its file is damaged.
    """
    from liex_lab.catalog import bundled_models, find_model
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.estimation.model import Model

    from ..training.pose_model import cached_model

    if model is not None or (variant == "default" and animal in bundled_models()):
        return PoseEstimator(Model.load(find_model(model or animal)))
    return PoseEstimator(Model.load(cached_model(animal, variant, progress, draw)))


def subject_of(
    animal: str, variant: str, progress: Progress = silent, model: str | Path | None = None
) -> PoseEstimator | Baseline:
    """The subject that a variant names: a variant of the method, an ablation or a baseline.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: `default`, `paper`; the ablations `paper-one-pose` (one initial pose) and
            `paper-no-metric` (plain mean of all candidates); the baselines `rf` and `cnn`.
        progress: told how far the training is, where there is one.
        model: another model file than the animal's own, for variants of the method.

    Raises:
        PlanError: there is no such variant.
        MissingPackageError: the CNN is asked for and torch is not installed.
    """
    from liex_lab.baselines.ablations import PlainMean
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.estimation.method import METHODS

    from ..training.baselines import BASELINES, trained_baseline

    if variant in METHODS:
        return estimator_of(animal, variant, progress, *(() if model is None else (model,)))
    if variant == "paper-one-pose":
        return PoseEstimator(estimator_of(animal, "paper", progress).model, 1)
    if variant == "paper-no-metric":
        return PlainMean(estimator_of(animal, "paper", progress))
    if variant in BASELINES:
        return trained_baseline(animal, variant, progress)
    known = ", ".join([*METHODS, "paper-one-pose", "paper-no-metric", *BASELINES])
    raise PlanError(f"there is no variant '{variant}'; known are {known}")


def measure(
    subject: PoseEstimator | Baseline, frames: NDArray[np.float32], scene: Segmenter
) -> tuple[Array, Array, Array]:
    """Joints, predicted errors and their interval of the frames, measured by one subject.

    The animal's size is found over the frames themselves.

    Args:
        subject: an estimator or a baseline.
        frames: (n, H, W) float32 depth, mm, 0 where unread.
        scene: the learned segmentation.

    Returns:
        Joints (n, J, 3) mm, camera frame, NaN where no animal was found; predicted error (n,) mm,
        NaN where the subject predicts none; and the factors (2,) of it that bound its 90 %
        interval.
    """
    from liex_lab.baselines.baseline import Guesses

    found = subject.estimate(frames, scene, subject.find_size(frames, scene))
    if isinstance(found, Guesses):
        return found.joints, np.full(len(frames), np.nan), np.full(2, np.nan)
    calibration = cast("PoseEstimator", subject).model.calibration
    return (
        found.chosen.pose.joints(subject.skeleton),
        found.chosen.error_mm,
        np.array(calibration.quantiles),
    )


def errors_of(
    subjects: Mapping[str, PoseEstimator | Baseline],
    sessions: Sequence[TrueRecording],
    plan: Plan,
    progress: Progress,
) -> dict[str, PoseErrors]:
    """Errors of several subjects over rendered recordings, all on the same background subtraction.

    Each recording is handled as `liex run` would: background learned, size estimated, all frames.

    Args:
        subjects: estimators and baselines by name, of one animal.
        sessions: recordings with their truth.
        plan: thresholds of the foreground, and expected sizes.
        progress: told recording by recording.

    Returns:
        By the subjects' names, the errors of all frames of all recordings.
    """
    from ..build import build_scene

    parts: dict[str, list[PoseErrors]] = {name: [] for name in subjects}
    for k, recording in enumerate(sessions):
        progress(k, len(sessions), f"measuring {recording.name}")
        scene, frames = build_scene(
            recording, plan, next(iter(subjects.values())).skeleton, len(recording)
        )
        for name, subject in subjects.items():
            joints, predicted_mm, quantiles = measure(subject, frames, scene)
            tip = subject.skeleton.tip
            parts[name].append(
                PoseErrors.compare(joints, recording.joints_camera, tip, predicted_mm, quantiles)
            )
    return {name: PoseErrors.join(some) for name, some in parts.items()}


def pose_errors(
    subject: PoseEstimator | Baseline,
    sessions: Sequence[TrueRecording],
    plan: Plan,
    progress: Progress,
) -> PoseErrors:
    """Errors of one subject over rendered recordings; see `errors_of`.

    Args:
        subject: an estimator or a baseline.
        sessions: recordings with their truth.
        plan: thresholds of the foreground, and expected sizes.
        progress: told recording by recording.
    """
    return errors_of({"": subject}, sessions, plan, progress)[""]


def evaluate_pose(
    animal: str = "mouse",
    split: str = "clean",
    variant: str = "default",
    *,
    model: str | Path | None = None,
    n_frames: int | None = None,
    spine_mm: float | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """The pose errors of one split and variant; `liex evaluate pose`.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        split: a test split of the animal, such as `clean`, `hard` or `other-body`.
        variant: what is measured, see `subject_of`.
        model: another model file than the animal's own.
        n_frames: only so many frames, rounded up to whole recordings; None takes all.
        spine_mm: length of all animals, mm, instead of drawn ones.
        progress: told recording by recording.

    Returns:
        `PoseErrors.summary` with animal, split, variant, n_frames and the protocol.

    Raises:
        LiexError: there is no such split or variant.
    """
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.simulation.simulator import world_of

    world = world_of(Skeleton.load(animal))
    if split not in world.splits:
        raise LiexError(
            f"there is no split '{split}' to measure poses on; known are {', '.join(world.splits)}"
        )
    sessions = world.test_split(split, spine_mm=spine_mm)
    subject = subject_of(animal, variant, progress, model)
    if n_frames is not None:
        sessions = sessions[: max(1, -(-n_frames // len(sessions[0])))]
    errors = pose_errors(subject, sessions, plan_of(animal), progress)
    how = f"{len(sessions)} rendered recordings of {len(sessions[0])} frames, {world.protocol}"
    return {
        "animal": animal,
        "split": split,
        "variant": variant,
        "n_frames": len(errors.error_mm),
        **errors.summary(),
        "protocol": how + POSE_PROTOCOL,
    }


def sizes_of(animal: str) -> tuple[float, ...]:
    """Spine lengths, mm, from small to large, at which an animal is evaluated.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML; one without lengths of
            its own gets 0.75, 1, 1.25 and 1.5 times its home length.
    """
    from liex_lab.body.skeleton import Skeleton

    if animal in _SIZES_MM:
        return _SIZES_MM[animal]
    home = Skeleton.load(animal).length
    return tuple(round(factor * home, 1) for factor in _SIZES)


def evaluate_sizes(
    animal: str = "mouse",
    spines_mm: Sequence[float] | None = None,
    *,
    n_frames: int | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Mean joint error in per cent of the spine over animals' sizes; `liex evaluate sizes`.

    The default model on the split `clean`; sizes are estimated and not given.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        spines_mm: spine lengths, mm; None takes those of `sizes_of`.
        n_frames: frames for each size, rounded up to whole recordings; None takes all.
        progress: told recording by recording.

    Returns:
        `error_percent_of_spine` and `ratio_to_best` by length, `worst_ratio`, and the protocol.
    """
    rows = {}
    for spine in spines_mm or sizes_of(animal):
        result = evaluate_pose(
            animal, "clean", "default", n_frames=n_frames, spine_mm=spine, progress=progress
        )
        rows[f"{spine:g}"] = 100.0 * result["mean_joint_error_mm"] / spine
    best = min(rows.values())
    return {
        "animal": animal,
        "n_frames": result["n_frames"],
        "error_percent_of_spine": rows,
        "ratio_to_best": {name: value / best for name, value in rows.items()},
        "worst_ratio": max(rows.values()) / best,
        "protocol": result["protocol"],
    }


def evaluate_reference(session: str | Path, reference: str | Path) -> dict[str, Any]:
    """A session against another program's centroid and long axis in the same recording.

    Distances are pixels times the size of a pixel on the floor; headings are compared modulo pi.

    Args:
        session: the session folder.
        reference: a CSV with one row a frame and the columns `frame`, `centroid_x_px`,
            `centroid_y_px`, `angle_rad` (direction (cos a, -sin a) in (right, down), known modulo
            pi) and, where present, `reliable` (rows other than 1 are left out).

    Returns:
        Median distances of centroid and joints, px and mm, median heading difference in degrees,
        number of reversals and of lost frames, median distance of rendered body and depth, and the
        protocol.

    Raises:
        LiexError: the table cannot be read, lacks a column, or has no reliable row for any frame.
    """
    import pandas as pd

    from liex_lab.sessions import Session

    opened = Session.open(session)
    try:
        table = pd.read_csv(reference)
    except (OSError, ValueError) as error:  # pandas' own errors are ValueErrors
        raise LiexError(
            f"{reference} should be a table with one row a frame, as CSV, but: {error}"
        ) from None
    needed = {"frame", "centroid_x_px", "centroid_y_px", "angle_rad"}
    if not needed <= set(table.columns):
        raise LiexError(
            f"{reference} should have the columns {', '.join(sorted(needed))}; it lacks some of "
            "them"
        )
    poses = opened.poses
    frames = opened.frames
    names = opened.metadata["animal"]["joints"]
    u, v = (
        poses.pivot(index="frame_index", columns="joint", values=name)[names].to_numpy()
        for name in ("u_px", "v_px")
    )
    rows = table["frame"].to_numpy(int)
    used = (rows >= 0) & (rows < len(u))
    if "reliable" in table:
        used &= table["reliable"].to_numpy() == 1
    table = table[used]
    rows = rows[used]
    if not len(rows):
        raise LiexError(
            f"{reference} has no reliable row for any frame of {session}; its column frame counts "
            "from 0"
        )
    camera = opened.metadata["camera"]
    mm_per_px = camera["floor_distance_mm"] / np.sqrt(camera["fx"] * camera["fy"])
    known = table[["centroid_x_px", "centroid_y_px"]].to_numpy()
    outline = frames[["centroid_u_px", "centroid_v_px"]].to_numpy()[rows]
    off = float(np.nanmedian(np.linalg.norm(outline - known, axis=1)))
    middle = np.stack([u[rows].mean(axis=1), v[rows].mean(axis=1)], axis=1)
    joints_off = float(np.nanmedian(np.linalg.norm(middle - known, axis=1)))
    heading = np.arctan2(-(v[:, -1] - v[:, 0]), u[:, -1] - u[:, 0])
    turn = np.degrees(angle_between_axes(heading[rows], table["angle_rad"].to_numpy()))
    return {
        "session": str(session),
        "n_frames": len(frames),
        "n_compared": int(len(rows)),
        "n_lost": int((~np.isfinite(u[:, 0])).sum()),
        "n_lost_without_flag": int(
            (~np.isfinite(u[:, 0]) & (frames["flag"].to_numpy() == "")).sum()
        ),
        "spine_mm": opened.metadata["animal"].get("spine_mm"),
        "centroid_median_px": off,
        "centroid_median_mm": off * mm_per_px,
        "joint_mean_median_mm": joints_off * mm_per_px,
        "heading_median_deg": float(np.nanmedian(turn)),
        "n_reversals": count_reversals(heading),
        "surface_median_mm": float(np.nanmedian(frames["residual_mm"])),
        "protocol": (
            "centroid: of the animal's outline (frames.parquet) against the reference's; "
            "joint_mean: the plain mean of the joints, which lies ahead of the outline's centre; "
            "both in pixels times the floor's mm a pixel. heading: base to tip in the image, "
            "modulo pi. reversals: heading turns of more than 90 degrees between consecutive "
            "measured frames. surface: median over frames of the median |rendered body - depth| "
            "in the animal"
        ),
    }
