"""Import of 3D points, `liex import points`: tracks of other programs become sessions.

A session of points has our tables, ethogram, statistics and views. It has no depth: what is
measured in depth images is absent, and the report and session.json state so. Joints without a point
of their own lie on the curve through the others, a monotone cubic over their places along the body
(Fritsch and Carlson 1980).
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from liex_lab.dashboards.replay.layouts import replay_blueprint
from liex_lab.dashboards.report.report import write_views
from numpy.typing import NDArray

from liex_lab.behaviour.interactions import Individual, Interactions, find_interactions
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import VIEWS, Skeleton
from liex_lab.catalog import sha256
from liex_lab.errors import LiexError, refuse
from liex_lab.exchange.points import PointNames, Points, read_animals, read_points
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.plan import Plan, study
from liex_lab.recordings.timestamps import find_gaps, median_step
from liex_lab.runtime import durable
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Provenance, SessionWriter, evidence
from liex_lab.sessions.verdict import ALSO, SUBJECT, Verdict
from liex_lab.tracking.track import Track, short_gaps

from .build import animal_of
from .session import check_unused, conclude

_FEWEST = 10  # frames with both ends of the body
_TRUSTED = 0.6  # the usual threshold of confidences
_NO_DEPTH = (
    "The poses are 3D points of another program ({file}), not measured in depth images. What needs "
    "depth is absent: the body's surface, width and height, residuals, expected errors and "
    "standard deviations, pixels, walls and arena, images, and depth in the replay."
)


def place_joints(
    points: Points, skeleton: Skeleton, mapped: Mapping[str, Sequence[str]]
) -> NDArray[np.float64]:
    """The joints (n, J, 3) mm of a chain from its points; NaN in frames that lack an end.

    A joint is the mean of its points; one without a point in a frame lies on the curve through the
    others.

    Args:
        points: one animal's points.
        skeleton: one chain.
        mapped: joint -> names of its points, for both ends at least.
    """
    from scipy.interpolate import PchipInterpolator

    joints = np.full((len(points.time_s), skeleton.n_joints, 3), np.nan)
    for joint, names in mapped.items():
        own = points.points_mm[:, [points.names.index(name) for name in names]]
        count = np.isfinite(own).sum(axis=1)
        joints[:, skeleton.names.index(joint)] = np.nansum(own, axis=1) / np.where(
            count, count, np.nan
        )
    known = np.isfinite(joints[..., 0])
    known &= known[:, :1] & known[:, -1:]
    patterns, which = np.unique(known, axis=0, return_inverse=True)
    for k, there in enumerate(patterns):
        rows = which.ravel() == k
        joints[rows] = (
            PchipInterpolator(skeleton.reach[there], joints[rows][:, there], axis=1)(skeleton.reach)
            if there.any()
            else np.nan
        )
    return joints


def track_of_points(
    points: Points, skeleton: Skeleton, mapped: Mapping[str, Sequence[str]], bridge_s: float
) -> Track:
    """The track of imported points: their joints, and the poses whose bones point along them.

    Gaps are bridged by straight lines; nothing is smoothed. Frames whose points have a mean score
    below 0.6 are doubtful.

    Args:
        points: one animal's points.
        skeleton: one chain.
        mapped: joint -> names of its points.
        bridge_s: the longest gap that is bridged, s.

    Raises:
        LiexError: hardly any frame has both ends of the body.
    """
    joints, seconds = place_joints(points, skeleton, mapped), points.time_s
    measured = (np.linalg.norm(np.diff(joints, axis=1), axis=2) > 1e-6).all(axis=1)
    if measured.sum() < _FEWEST:
        raise LiexError(
            f"{measured.sum()} of {len(measured)} frames have points at both ends of the body "
            f"({skeleton.names[0]}, {skeleton.names[-1]}), and {_FEWEST} are needed; check the "
            "table of names"
        )
    bridged = short_gaps(seconds, measured, bridge_s)
    joints[~measured] = np.nan
    for column in joints.reshape(len(joints), -1).T:
        column[bridged] = np.interp(seconds[bridged], seconds[measured], column[measured])
    used = [points.names.index(name) for names in mapped.values() for name in names]
    sure = np.ones(len(joints)) if points.scores is None else points.scores[:, used].mean(axis=1)
    pose = Pose.from_joints(skeleton, joints, [0.0, 0.0, 1.0])
    return replace(
        Track.empty(skeleton, np.round(seconds * 1e9).astype(np.int64)),
        joints_mm=joints,
        root_rotation=pose.root.rotation,
        root_mm=pose.root.translation,
        angles_rad=pose.angles,
        scale=pose.scale,
        centroid_mm=joints.mean(axis=1),
        bridged=bridged,
        flag=np.where(measured, np.where(sure < _TRUSTED, "doubtful", ""), "not_found"),
    )


def check_track(track: Track, plan: Plan) -> None:
    """Refuse a track that does not fit the plan's animal.

    Raises:
        LiexError: its length is far out of the plan's range, as of pixels or another unit; its
            points do not follow each other along a body; it moves tail first; or it stands high
            above the floor.
    """
    animal, skeleton, known = animal_of(plan), track.skeleton, track.observed
    joints, length = track.joints_mm[known], float(np.median(track.spine_mm[known]))
    ahead = (joints[:, -1] - joints[:, 0]) * np.sign(skeleton.offsets[1, 0])
    straight = float(np.median(np.linalg.norm(ahead, axis=1) / track.spine_mm[known]))
    velocity = np.gradient(track.joints_mm.mean(axis=1), track.times_ns * 1e-9, axis=0)[known]
    fast = np.linalg.norm(velocity, axis=1) > length  # lengths a second
    backward = np.einsum("ni,ni->n", velocity[fast], ahead[fast]) < 0.0
    height = float(np.median(joints[..., 2])) / length
    refuse(
        LiexError,
        (
            straight < 0.5,
            f"the points do not follow each other along a body, whose ends are {straight:.0%} of "
            "its length apart; correct in the table of names which point is which joint",
        ),
        (
            not animal.spine_min_mm / 1.5 < length < animal.spine_max_mm * 1.5,
            f"the {skeleton.name} of this plan is {animal.spine_min_mm:g} to "
            f"{animal.spine_max_mm:g} mm long, and the points span {length:.4g}; pixels are not "
            "millimetres: state the unit in the table of names, or give points in 3D",
        ),
        (
            skeleton.view.frame == VIEWS[0] and height > 0.8,
            f"the joints are {height:.1f} lengths above the floor in the median; state in the "
            "table of names which axis points up (up) and where the floor is (floor)",
        ),
        (
            len(backward) >= 30 and backward.mean() > 0.8,
            f"the animal moves tail first in {backward.mean():.0%} of {len(backward)} fast frames; "
            f"exchange the points of {skeleton.names[0]} and {skeleton.names[-1]} in the table of "
            "names",
        ),
    )


def import_points(
    file: str | Path,
    plan: Plan | str = "mouse",
    out: str | Path = ".",
    *,
    names: str | Path | None = None,
    fps: float | None = None,
    individual: str | None = None,
    overwrite: bool = False,
    report: bool = True,
    progress: Progress = silent,
) -> Path:
    """Make a session from 3D points that another program measured; returns its folder.

    A mouse's actions are named by rules unless the plan states a model.

    Args:
        file: the points; see `liex_lab.exchange.points.read_points`.
        plan: the animal, rules, and facts about the session, or the name of a bundled plan.
        out: parent of the session folder `<file's name>.liex`.
        names: a table of names (TOML); None if points have our joints' names, in mm, z up.
        fps: frames per second, for a file without times.
        individual: the animal to read, if the file holds several.
        overwrite: replace an existing session.
        report: whether to write the report with its figures.
        progress: receives progress reports.

    Raises:
        LiexError: the points cannot be used; the message gives advice.
    """
    table = PointNames.load(names, fps=fps, individual=individual)
    progress(0, None, "reading the points")
    points = [read_points(file, table)]
    return _write_sessions(file, plan, out, table, points, overwrite, report, progress)[0]


def import_animals(
    file: str | Path,
    plan: Plan | str = "mouse",
    out: str | Path = ".",
    *,
    names: str | Path | None = None,
    fps: float | None = None,
    individual: str | None = None,
    overwrite: bool = False,
    report: bool = True,
    progress: Progress = silent,
) -> list[Path]:
    """Make a session of each animal in a file of 3D points; returns their folders.

    The animals are in one arena: each session has the tables `interactions` and
    `interaction_totals` of all of them. Otherwise like `import_points`.

    Args:
        file: the points; see `liex_lab.exchange.points.read_points`.
        plan: the animal, rules, and facts about the session, or the name of a bundled plan.
        out: parent of the session folders `<file's name>-<animal>.liex`, or of
            `<file's name>.liex` for one animal.
        names: a table of names (TOML); None if points have our joints' names, in mm, z up.
        fps: frames per second, for a file without times.
        individual: the only animal to read; None for all.
        overwrite: replace existing sessions.
        report: whether to write the reports with their figures.
        progress: receives progress reports.

    Raises:
        LiexError: the points cannot be used; the message gives advice.
    """
    table = PointNames.load(names, fps=fps, individual=individual)
    progress(0, None, "reading the points")
    points = read_animals(file, table)
    return _write_sessions(file, plan, out, table, points, overwrite, report, progress)


def _write_sessions(
    file: str | Path,
    plan: Plan | str,
    out: str | Path,
    names: PointNames,
    animals: Sequence[Points],
    overwrite: bool,
    report: bool,
    progress: Progress,
) -> list[Path]:
    """A session of each animal, and the interactions of several; nothing is written if the points
    of one of them cannot be used.
    """
    plan = plan if isinstance(plan, Plan) else Plan.load(plan)
    skeleton, source = Skeleton.load(plan.animal.skeleton), Path(file)
    if not skeleton.is_chain:
        raise LiexError(
            f"points are imported for one chain of joints, and a {skeleton.name} has limbs; choose "
            "the plan of another animal"
        )
    is_ruled = plan.actions.model is None and skeleton.name == "mouse"
    plan = plan.with_settings(["replay.depth=none", *["actions.model=rules"] * is_ruled])
    named = plan.session.name or source.stem
    alone = len(animals) == 1
    folders = [
        durable.inside(Path(out), named if alone else f"{named}-{one.individual}", ".liex")
        for one in animals
    ]
    for folder in folders:
        check_unused(folder, overwrite)
    mapped = names.of_joints(skeleton.names, animals[0].names)
    tracks = []
    for one in animals:
        try:
            track = track_of_points(one, skeleton, mapped, plan.tracking.bridge_s)
            check_track(track, plan)
        except LiexError as error:
            raise error if alone else LiexError(f"of the animal {one.individual} {error}") from None
        tracks.append(track)
    together = None
    if not alone:
        progress(0, None, "finding the interactions")
        together = find_interactions(
            animals[0].time_s,
            [
                Individual.of_track(one.individual, track)
                for one, track in zip(animals, tracks, strict=True)
            ],
            plan.interactions,
        )
    return [
        _write(source, folder, points, track, plan, names, mapped, together, overwrite, report)
        for folder, points, track in zip(folders, animals, tracks, strict=True)
    ]


def _write(
    source: Path,
    folder: Path,
    points: Points,
    track: Track,
    plan: Plan,
    names: PointNames,
    mapped: Mapping[str, Sequence[str]],
    together: Interactions | None,
    overwrite: bool,
    report: bool,
) -> Path:
    """The session of one animal."""
    started = time.perf_counter()
    n_posed, n_trusted = int(track.observed.sum()), int((track.flag == "").sum())
    derived = [joint for joint in track.skeleton.names if joint not in mapped]
    with SessionWriter(
        folder,
        _provenance(source, points, track, plan, together is None),
        overwrite=overwrite,
        blueprint=replay_blueprint,
        report=write_views if report else None,
    ) as writer:
        writer.add_times(track.times_ns)
        writer.track = track
        writer.note(
            input=evidence.link_to(source, folder),
            problems=[
                _NO_DEPTH.format(file=source.name),
                *[
                    "Joints without points lie on the curve through the others: "
                    f"{', '.join(derived)}."
                ]
                * bool(derived),
            ],
            verdict=Verdict(track.n_frames, n_posed, n_posed, n_trusted, None, 1).to_dict(),
            imported={
                "joints": mapped,
                "derived_joints": derived,
                "floor_mm": round(points.floor_mm, 3),
                "floor_origin": "estimated" if names.floor is None else "stated",
            },
        )
        timings = {"prepare": time.perf_counter() - started, "track": 0.0}
        return conclude(writer, plan, timings, together).path


def _provenance(source: Path, points: Points, track: Track, plan: Plan, alone: bool) -> Provenance:
    """Provenance of imported points; its camera is a view from above for the replay.

    Of several animals each has a session and a subject of its own.
    """
    low, high = (f(track.joints_mm, axis=(0, 1)) for f in (np.nanmin, np.nanmax))
    far = float(max(1000.0, 4.0 * high[2]))
    width, height, _ = np.clip(np.ceil(high - low) + 100.0, 100.0, 30_000.0).astype(int).tolist()
    found, stated = study.find_subject(source.with_suffix("")), plan.session
    subject = {name: getattr(stated, name) for name in (*SUBJECT, *ALSO)}
    subject["subject_id"] = stated.subject_id or (found.id if found.origin else "")
    own = "" if alone else f"-{points.individual}"
    subject["subject_id"] = f"{subject['subject_id'] or ('' if alone else source.stem)}{own}"
    return Provenance(
        durable.storable(f"{stated.name or source.stem}{own}"),
        track.skeleton,
        Camera(far, far, width / 2, height / 2, width=width, height=height, source="none"),
        SE3(np.diag([1.0, -1.0, -1.0]), np.array([*(low + high)[:2] / 2.0, far])),
        far,
        sha256(source),
        plan.to_toml(),
        f"{source.suffix} of 3D points",
        individual=points.individual or stated.individual,
        n_frames=track.n_frames,
        gaps=find_gaps(track.times_ns, median_step(track.times_ns)),
        subject={name: durable.storable(str(value)) for name, value in subject.items() if value},
        session_start_time=stated.session_start_time or "",
        animal_size={"spine_mm": round(float(np.nanmedian(track.spine_mm)), 3), "origin": "points"},
        replay_depth="none",
    )
