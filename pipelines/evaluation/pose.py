"""Evaluation of poses: joint errors on fixed splits of rendered recordings, and of other builds.

`liex evaluate pose` follows the protocol of Lie-X (section 5.2, Tables 1 and 2) on rendered test
splits, `clean`, `hard` (twice the noise, other objects in view), `other-body` (unseen family of
shapes) and `other-camera` (unseen focal lengths and resolutions), 40 recordings of 50 frames each;
none was trained on. As in a run, background, floor and the animal's size are estimated.
`other-build` tracks, as a run does, moving animals of builds that no forest was trained on, and as
many of builds like the training's; its sealed part has seeds that are not used in tests, training
or development. `liex evaluate sizes` repeats `clean` over animals of several lengths. `liex
evaluate reference` compares a session with another program's centroid and axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import pandas as pd

from liex_lab.arrays import Array, NDArray
from liex_lab.baselines.baseline import Baseline, Guesses, PlainMean
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import EstimationError, LiexError, PlanError, expecting
from liex_lab.estimation.estimator import Estimates, PoseEstimator
from liex_lab.estimation.method import METHODS
from liex_lab.evaluation.scores import (
    FAR,
    POSE_PROTOCOL,
    Followed,
    PoseErrors,
    interval95,
    rank_correlation,
)
from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session
from liex_lab.simulation import simulator
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.track import Track

from ..build import build_scene, plan_of
from ..training.motion_model import observed
from ..training.pose_model import BASELINES, estimator_of, trained_baseline

Subject = PoseEstimator | Baseline

OTHER_BUILD: Final = "other-build"
SEEDS: Final = tuple(range(500, 524))
SEALED_SEEDS: Final = tuple(range(953_200_417, 953_200_441))
N_FRAMES: Final = 120  # frames per recording of another build
_NOISES = (0.7, 1.0, 1.5)
_FLIP_CLASSES = (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 1.0)  # of p_flip
_SIZES_MM = {"mouse": (45.0, 65.0, 80.0, 100.0), "fish": (18.0, 25.0, 32.0, 45.0)}
BUILDS_PROTOCOL = (
    "Rendered recordings of one moving animal each, of a build that no forest was trained on "
    "(the tracker's calibration knows other animals of the same family of builds, and so does "
    "the stated remainder of a fish's own shape; that shape is learned of a wider family, which "
    "reaches about as far), filmed by "
    "makes of camera of the training's and of focal lengths that it had not, in turn, with "
    "0.7, 1 and 1.5 times their noise; background, floor, animal and size are found by the "
    "product. Beside them the same of builds like the training's. found: share of frames with"
    " a pose. Error of a frame: mean over joints of the 3D distance between tracked and true "
    "joint in the arena; error_percent: of the true length, mean over all poses, "
    "error_percent95: its 95 % interval, recordings drawn with replacement. interval90: share"
    " of joint coordinates within 1.645 sd (sd_xy_mm, sd_z_mm) of the truth; interval90_x_y, "
    "interval90_z: of these alone; interval90_least: of the worst joint. spearman: rank "
    "correlation of predicted and true error, both of the length. flips: share of poses whose"
    " base-to-tip direction is more than 90 degrees off; longest_flip: most frames in a row. "
    "p_flip: by classes of the predicted probability, how many poses, its mean, and the share"
    " that are. wrong_but_trusted: of the poses that are flagged as trusted, those whose "
    "error is beyond 15 % of the length. length_off: mean of |found / true length - 1|. "
    "height_off_mm: mean over recordings of |mean height error|, and height_bias_mm of the "
    "error itself."
)
_REFERENCE_PROTOCOL = (
    "centroid: of the animal's outline (frames.parquet) against the reference's; joint_mean: the "
    "plain mean of the joints, which lies ahead of the outline's centre; both in pixels times the "
    "floor's mm a pixel. heading: base to tip in the image, modulo pi. reversals: heading turns of "
    "more than 90 degrees between consecutive measured frames. surface: median over frames of the "
    "median |rendered body - depth| in the animal"
)


def subject_of(
    animal: str, variant: str, progress: Progress = silent, model: str | Path | None = None
) -> Subject:
    """The subject of a variant: a variant of the method, an ablation or a baseline.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: `default`, `paper`; the ablations `paper-one-pose` (one initial pose) and
            `paper-no-metric` (plain mean of all candidates); the baselines `rf` and `cnn`.
        progress: called with the progress of the training.
        model: another model file than the animal's own, for variants of the method.

    Raises:
        PlanError: there is no such variant.
        MissingPackageError: the variant is `cnn` and torch is not installed.
    """
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


def unpacked(subject: Subject, found: Estimates | Guesses) -> tuple[Array, Array, Array]:
    """Unpack a subject's estimates of n frames.

    Returns:
        Joints (n, J, 3) mm, camera frame, NaN if no animal was found; predicted error (n,) mm, NaN
        if the subject predicts none; and its factors (2,) that bound the 90 % interval.
    """
    if isinstance(found, Guesses):
        return found.joints, np.full(len(found.joints), np.nan), np.full(2, np.nan)
    return (
        found.chosen.pose.joints(subject.skeleton),
        found.chosen.error_mm,
        np.array(cast("PoseEstimator", subject).model.calibration.quantiles),
    )


def errors_of(
    subject: Subject, sessions: Sequence[RenderedRecording], plan: Plan, progress: Progress
) -> PoseErrors:
    """Errors of a subject over rendered recordings.

    Each recording is processed as by `liex run`: background learned, size estimated, all frames.

    Args:
        subject: an estimator or a baseline.
        sessions: recordings with their truth.
        plan: thresholds of the foreground, and expected sizes.
        progress: called recording by recording.
    """
    parts: list[PoseErrors] = []
    skeleton = subject.skeleton
    for k, recording in enumerate(sessions):
        progress(k, len(sessions), f"measuring {recording.name}")
        scene, frames = build_scene(recording, plan, skeleton, len(recording))
        joints, *predicted = unpacked(
            subject, subject.estimate(frames, scene, subject.find_size(frames, scene))
        )
        parts.append(PoseErrors.compare(joints, recording.joints_camera, skeleton.tip, *predicted))
    return PoseErrors.join(parts)


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
        variant: the subject, see `subject_of`.
        model: another model file than the animal's own.
        n_frames: number of frames, rounded up to whole recordings; None means all.
        spine_mm: length of all animals, mm, instead of drawn ones.
        progress: called recording by recording.

    Returns:
        `PoseErrors.summary` with animal, split, variant, n_frames and the protocol.

    Raises:
        LiexError: there is no such split or variant.
    """
    world = simulator.world_of(Skeleton.load(animal))
    if split not in world.splits:
        raise LiexError(
            f"there is no split '{split}' to measure poses on; known are {', '.join(world.splits)}"
        )
    subject = subject_of(animal, variant, progress, model)
    sessions = world.test_split(split, spine_mm=spine_mm)
    if n_frames is not None:
        sessions = sessions[: max(1, -(-n_frames // len(sessions[0])))]
    errors = errors_of(subject, sessions, plan_of(animal), progress)
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

    The default is 0.75, 1, 1.25 and 1.5 times the home length.
    """
    if animal in _SIZES_MM:
        return _SIZES_MM[animal]
    home = Skeleton.load(animal).length
    return tuple(round(factor * home, 1) for factor in (0.75, 1.0, 1.25, 1.5))


def evaluate_sizes(
    animal: str = "mouse", *, n_frames: int | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Mean joint error in per cent of the spine over animals' sizes; `liex evaluate sizes`.

    The default model on the split `clean`; sizes are estimated, not given.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        n_frames: frames for each size, rounded up to whole recordings; None means all.
        progress: called recording by recording.

    Returns:
        `error_percent_of_spine` and `ratio_to_best` by length, `worst_ratio`, and the protocol.
    """
    rows = {}
    for spine in sizes_of(animal):
        result = evaluate_pose(animal, n_frames=n_frames, spine_mm=spine, progress=progress)
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


@dataclass(frozen=True)
class Built:
    """A tracked recording of one animal with its truth.

    Attributes:
        track: (n) the track, without a pose if no animal was found.
        truth: (n, J, 3) true joints, mm, in the track's frame.
        length_mm: true length of the animal.
        found_mm: estimated length; NaN if no animal was found.
        tip: the joint whose direction from the base is the heading.
    """

    track: Track
    truth: Array
    length_mm: float
    found_mm: float
    tip: int


def evaluate_builds(
    animal: str = "mouse",
    *,
    n_frames: int | None = None,
    sealed: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Errors and intervals of tracks of animals of another build, and of usual builds.

    Args:
        animal: `mouse` or `fish`.
        n_frames: frames of other builds, rounded up to whole recordings of 120; None means 12
            recordings.
        sealed: the sealed part of the split.
        progress: called recording by recording.

    Returns:
        `other` and `usual`, see `BUILDS_PROTOCOL`, the ratio of their errors in per cent of the
        length, seeds and protocol.

    Raises:
        LiexError: the animal's simulator has one build only, or there are too few recordings.
    """
    n_recordings = 12 if n_frames is None else max(1, -(-n_frames // N_FRAMES))
    seeds = SEALED_SEEDS if sealed else SEEDS
    if n_recordings > len(seeds):
        raise LiexError(
            f"the split {OTHER_BUILD} has {len(seeds) * N_FRAMES} frames, got {n_frames}; ask for "
            "at most that many"
        )
    seeds = seeds[:n_recordings]
    estimator = estimator_of(animal, "default", progress)
    rows: dict[str, list[Built]] = {"other": [], "usual": []}
    for k, seed in enumerate(seeds):
        for name, family in (("other", "other"), ("usual", "train")):
            recording = film(animal, seed, k, family)
            progress(
                len(rows["other"]) + len(rows["usual"]),
                2 * len(seeds),
                f"measuring {recording.name}",
            )
            rows[name].append(track(estimator, recording, plan_of(animal)))
    joints = estimator.skeleton.names
    figures = {name: build_figures(some, joints) for name, some in rows.items()}
    own, usual = (figures[name].get("error_percent") for name in ("other", "usual"))
    return {
        "animal": animal,
        "split": OTHER_BUILD,
        **figures,
        "ratio_to_usual": own / usual if own and usual else None,
        "seeds": "sealed" if sealed else list(seeds),
        "protocol": BUILDS_PROTOCOL,
    }


def film(animal: str, seed: int, k: int, family: str) -> RenderedRecording:
    """Recording k of the split other-build: cameras and noise take turns.

    Args:
        animal: `mouse` or `fish`.
        seed: for everything else that is drawn.
        k: number of the recording.
        family: of builds, `other` or `train`.

    Raises:
        LiexError: the animal's simulator has one build only.
    """
    if animal not in ("mouse", "fish"):
        raise LiexError(f"the split {OTHER_BUILD} is of mouse and fish, not of '{animal}'")
    world = simulator.world_of(Skeleton.load(animal))
    sensors = (*world.sensors, *world.other_sensors)
    return world.motion(
        [seed],
        N_FRAMES,
        family=family,
        sensor=sensors[k % len(sensors)],
        noise=_NOISES[k % len(_NOISES)],
        name=f"{OTHER_BUILD}-{family}-{k:02d}",
    )


def track(estimator: PoseEstimator, recording: RenderedRecording, plan: Plan) -> Built:
    """Track a recording as a run does; returned with its truth."""
    skeleton = estimator.skeleton
    try:
        each = observed(estimator, plan, OTHER_BUILD, recording)
    except EstimationError:
        lost = Track.empty(skeleton, recording.times_ns)
        return Built(lost, recording.joints_arena, recording.spine_mm, np.nan, skeleton.tip)
    return Built(
        track_whole(each.subject, each.observations).track,
        each.truth,
        recording.spine_mm,
        each.subject.length_mm,
        skeleton.tip,
    )


def build_figures(rows: Sequence[Built], joints: Sequence[str]) -> dict[str, Any]:
    """Results over some recordings, see `BUILDS_PROTOCOL`.

    Returns:
        By name; without a pose, only those that need none.
    """
    followed = [
        Followed(row.track.joints_mm, row.truth, row.track.sd_xyz_mm, np.nan, row.tip)
        for row in rows
    ]
    recording = np.repeat(np.arange(len(rows)), [len(row.truth) for row in rows])
    lengths_mm = np.array([row.length_mm for row in rows])[recording]
    error = np.concatenate([one.error_mm for one in followed]) / lengths_mm
    posed = np.isfinite(error)
    figures: dict[str, Any] = {
        "n_recordings": len(rows),
        "n_frames": len(error),
        "found": float(posed.mean()),
    }
    if not posed.any():
        return figures
    inside = np.concatenate([one.inside for one in followed])[posed]
    by_joint = inside.mean(axis=(0, 2))
    trusted = np.concatenate([row.track.observed & (row.track.flag == "") for row in rows])
    flipped = np.concatenate([one.flipped for one in followed])[posed]
    predicted = np.concatenate([row.track.predicted_error_mm for row in rows]) / lengths_mm
    p_flip = np.concatenate([row.track.p_flip for row in rows])[posed]
    off_mm = [(one.joints - one.truth)[..., 2] for one in followed]
    heights = np.array([np.nanmean(off) for off in off_mm if np.isfinite(off).any()])
    bounds = interval95(100.0 * error, recording, np.mean)
    return figures | {
        "mean_joint_error_mm": float((error * lengths_mm)[posed].mean()),
        "error_percent": float(100.0 * error[posed].mean()),
        "error_percent95": None if bounds is None else list(bounds),
        "interval90": float(inside.mean()),
        "interval90_x_y": float(inside[..., :2].mean()),
        "interval90_z": float(inside[..., 2].mean()),
        "interval90_least": float(by_joint.min()),
        "interval90_by_joint": dict(zip(joints, by_joint.tolist(), strict=True)),
        "spearman": rank_correlation(predicted[posed], error[posed]),
        "flips": float(flipped.mean()),
        "longest_flip": max(one.longest_flip for one in followed),
        "p_flip": _reliability(p_flip, flipped),
        "wrong_but_trusted": float((error > FAR)[trusted].mean()) if trusted.any() else 0.0,
        "trusted": float(trusted.mean()),
        "length_off": float(np.nanmean([abs(row.found_mm / row.length_mm - 1.0) for row in rows])),
        "height_bias_mm": float(heights.mean()),
        "height_off_mm": float(np.abs(heights).mean()),
    }


def _reliability(predicted: Array, flipped: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """Number of poses and share of flipped ones by classes of the predicted probability (m,)."""
    rows = []
    for low, high in pairwise(_FLIP_CLASSES):
        some = (predicted >= low) & ((predicted < high) | (high == _FLIP_CLASSES[-1]))
        if some.any():
            shares = {"told": float(predicted[some].mean()), "flipped": float(flipped[some].mean())}
            rows.append({"from": low, "to": high, "n": int(some.sum()), **shares})
    return rows


def evaluate_reference(session: str | Path, reference: str | Path) -> dict[str, Any]:
    """Compare a session with another program's centroid and long axis in the same recording.

    Distances are pixels times the size of a pixel on the floor; headings are compared modulo pi.

    Args:
        session: the session folder.
        reference: a CSV with one row per frame and the columns `frame`, `centroid_x_px`,
            `centroid_y_px`, `angle_rad` (direction (cos a, -sin a) in (right, down), modulo pi)
            and, optionally, `reliable` (rows other than 1 are left out).

    Returns:
        Median distances of centroid and joints, px and mm, median heading difference in degrees,
        number of reversals and of lost frames, median distance of rendered body and depth, and the
        protocol.

    Raises:
        LiexError: the table cannot be read, lacks a column, or has no reliable row for any frame.
    """
    opened = Session.open(session)
    with expecting(
        LiexError,
        f"{reference} should be a table with one row a frame, as CSV",
        OSError,
        ValueError,  # pandas' own errors
    ):
        table = pd.read_csv(reference)
    needed = {"frame", "centroid_x_px", "centroid_y_px", "angle_rad"}
    if not needed <= set(table.columns):
        raise LiexError(
            f"{reference} should have the columns {', '.join(sorted(needed))}; it lacks some of "
            "them"
        )
    poses, frames, camera = opened.poses, opened.frames, opened.metadata["camera"]
    names = opened.metadata["animal"]["joints"]
    u, v = (
        poses.pivot(index="frame_index", columns="joint", values=name)[names].to_numpy()
        for name in ("u_px", "v_px")
    )
    used = table["frame"].astype(int).between(0, len(u) - 1)
    if "reliable" in table:
        used &= table["reliable"] == 1
    table = table[used]
    rows = table["frame"].to_numpy(int)
    if not len(rows):
        raise LiexError(
            f"{reference} has no reliable row for any frame of {session}; its column frame counts "
            "from 0"
        )
    mm_per_px = camera["floor_distance_mm"] / np.sqrt(camera["fx"] * camera["fy"])
    known = table[["centroid_x_px", "centroid_y_px"]].to_numpy()
    outline = frames[["centroid_u_px", "centroid_v_px"]].to_numpy()[rows]
    middle = np.stack([u[rows].mean(axis=1), v[rows].mean(axis=1)], axis=1)
    off, joints_off = (
        float(np.nanmedian(np.linalg.norm(points - known, axis=1))) for points in (outline, middle)
    )
    heading = np.arctan2(-(v[:, -1] - v[:, 0]), u[:, -1] - u[:, 0])
    turn = np.degrees(angle_between_axes(heading[rows], table["angle_rad"].to_numpy()))
    lost = ~np.isfinite(u[:, 0])
    return {
        "session": str(session),
        "n_frames": len(frames),
        "n_compared": len(rows),
        "n_lost": int(lost.sum()),
        "n_lost_without_flag": int((lost & (frames["flag"].to_numpy() == "")).sum()),
        "spine_mm": opened.metadata["animal"].get("spine_mm"),
        "centroid_median_px": off,
        "centroid_median_mm": off * mm_per_px,
        "joint_mean_median_mm": joints_off * mm_per_px,
        "heading_median_deg": float(np.nanmedian(turn)),
        "n_reversals": count_reversals(heading),
        "surface_median_mm": float(np.nanmedian(frames["residual_mm"])),
        "protocol": _REFERENCE_PROTOCOL,
    }


def angle_between_axes(a: Array, b: Array) -> Array:
    """Angles (n,) between undirected axes at angles a and b (n,), rad in [0, pi / 2]."""
    difference = np.mod(a - b, np.pi)
    return np.minimum(difference, np.pi - difference)


def count_reversals(heading: Array) -> int:
    """How often a heading (n,) rad turns by more than a right angle; NaN frames are skipped."""
    known = heading[np.isfinite(heading)]
    return int((np.cos(np.diff(known)) < 0).sum())
