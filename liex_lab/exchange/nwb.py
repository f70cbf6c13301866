"""Neurodata Without Borders (NWB) file: poses by the extension ndx-pose, rotations, actions, gaps.

One animal per file. There is no type for rotations in NWB: each joint's is a TimeSeries of rotation
vectors, rad. Actions and gaps are time intervals (see `nwb_intervals`). Times are true ones, s
since the session's beginning, which NWB wants with its time zone.

Species, sex and age are fields of NWB's Subject. Group, cage and batch have none, in NWB or in any
extension that archives know: the subject's description says them to people (DANDI shows it), and
`notes`, a field of every NWB file, says to programs all that is known of the animal, a line
`key: value` for each fact. `scratch` is not meant to be shared, and a type of our own would have to
be explained to every reader.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np

from liex_lab.errors import SessionError
from liex_lab.sessions import Session
from liex_lab.sessions.pose_arrays import Poses
from liex_lab.sessions.session import PULSE

from .hdf5 import hdf5_file
from .nwb_intervals import add_intervals

if TYPE_CHECKING:
    from pynwb import NWBFile

_SPECIES = {"mouse": "Mus musculus", "fish": "Danio rerio", "hand": "Homo sapiens"}
_SAID = ("group", "cage", "batch")  # what has no field of its own
_FRAME = (
    "the arena: z up from the floor, origin at the foot of the camera's perpendicular, x along "
    "the picture's rows; joints lie on the body's mid-axis"
)
_SCORE = "probability that the joint lies within 10 % of the spine's length of the truth"
_CONFIDENCE = (
    "0.6 + 0.4 x score where the pose of the frame is trusted, 0.5 x score where it is not"
)


def write(session: Session, path: Path) -> None:
    """Write the NWB file.

    Args:
        session: the session.
        path: the .nwb file to write.

    Raises:
        SessionError: the session does not say when it began, with time zone.
    """
    from pynwb import NWBHDF5IO

    made = build(
        session
    )  # before the file is opened: it takes the types that are known by then, and no extension's
    with hdf5_file(path) as hdf5, NWBHDF5IO(file=hdf5, mode="w") as file:
        file.write(made)


def build(session: Session) -> NWBFile:
    """The session as an NWB file in memory.

    Args:
        session: the session.

    Raises:
        SessionError: the session does not say when it began, with time zone.
    """
    from pynwb import NWBFile

    about = session.metadata
    version = about["versions"].get("liex_lab", "unknown")
    made = NWBFile(
        session_description=(
            f"3D skeleton and actions of one {about['animal']['name']}, from a depth recording"
        ),
        identifier=str(uuid5(NAMESPACE_URL, f"{session.name}-{about['input']['sha256']}")),
        session_start_time=_start(session),
        session_id=session.name,
        subject=_subject(session),
        source_script="liex export --to nwb",
        source_script_file_name=f"liex_lab {version}",
        keywords=["depth camera", "pose", "behavior"],
        notes=_notes(session),
    )
    module = made.create_processing_module(
        "behavior", "pose estimates, rotations and actions by liex_lab"
    )
    poses = session.pose_arrays()
    estimate = _add_poses(made, module, session, poses, version)
    _add_rotations(module, session, poses)
    add_intervals(made, session, poses, estimate)
    return made


def _start(session: Session) -> datetime:
    stated = session.metadata.get("session_start_time")
    try:
        moment = datetime.fromisoformat(str(stated))
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None:
        raise SessionError(
            f"NWB wants to know when a session began, with time zone, and {session.name} does not "
            "say; tell it with `liex describe SESSION "
            "session_start_time=2026-08-21T10:00:00+02:00` (in Python describe_session)"
        )
    return moment


def _subject(session: Session) -> Any:
    """The animal. Its sex is one of NWB's letters, and its id holds no slash: DANDI makes a path of
    it.
    """
    from pynwb.file import Subject

    about = session.metadata["subject"]
    kind = session.metadata["animal"]["name"]
    sex = str(about.get("sex", ""))[:1].upper()
    said = [f"{name} {about[name]}" for name in _SAID if about.get(name)]
    return Subject(
        subject_id=(about.get("subject_id") or session.metadata["individual"]).replace("/", "-"),
        species=about.get("species") or _SPECIES.get(kind, kind),
        sex=sex if sex in ("M", "F", "O") else "U",
        age=about.get("age"),
        description=", ".join([kind, *(said or ["group not stated"])]),
    )


def _notes(session: Session) -> str:
    """What is known of the animal, a line for each fact."""
    about = {"individual": session.metadata["individual"], **session.metadata["subject"]}
    return "\n".join(f"{name}: {' '.join(str(value).split())}" for name, value in about.items())


def _add_poses(made: NWBFile, module: Any, session: Session, poses: Poses, version: str) -> Any:
    """Skeleton and one series per joint; the first one's times are the others' too. Returns the
    PoseEstimation.
    """
    from ndx_pose import PoseEstimation, PoseEstimationSeries, Skeleton, Skeletons
    from pynwb import TimeSeries

    skeleton = Skeleton(
        name=session.metadata["animal"]["name"],
        nodes=list(poses.joints),
        edges=np.array(poses.bones, np.uint8).reshape(-1, 2),
        subject=made.subject,
    )
    module.add(Skeletons(skeletons=[skeleton]))
    camera = session.metadata["camera"]
    device = made.create_device(
        name="depth camera", description=str(camera.get("source", "depth camera"))
    )
    series: list[Any] = []
    for k, joint in enumerate(poses.joints):
        series.append(
            PoseEstimationSeries(
                name=joint,
                description=f"position of the {joint}",
                data=poses.xyz_mm[:, k].astype(np.float32),
                unit="millimeters",
                reference_frame=_FRAME,
                timestamps=series[0] if series else poses.time_s,
                confidence=poses.likelihood[:, k].astype(np.float32),
                confidence_definition=_CONFIDENCE,
            )
        )
    estimate = PoseEstimation(
        name="PoseEstimation",
        pose_estimation_series=series,
        description="joints in millimetres, one row per frame",
        device=device,
        scorer="liex_lab",
        source_software="liex_lab",
        source_software_version=version,
        skeleton=skeleton,
    )
    module.add(estimate)
    for name, data, unit, what in (
        (
            "score",
            poses.score.astype(np.float32),
            "probability",
            f"{', '.join(poses.joints)}: {_SCORE}",
        ),
        ("pulse_index", poses.pulse_index, "count", PULSE.meaning),
    ):
        module.add(
            TimeSeries(name=name, data=data, unit=unit, timestamps=poses.time_s, description=what)
        )
    return estimate


def _add_rotations(module: Any, session: Session, poses: Poses) -> None:
    """The root's rigid transform and each joint's rotation relative to its parent."""
    from pynwb import TimeSeries

    table = session.table("rotations", ["joint", "wx_rad", "wy_rad", "wz_rad"])
    names = [str(name) for name in table["joint"].iloc[: len(poses.joints) + 1]]
    turns = table[["wx_rad", "wy_rad", "wz_rad"]].to_numpy(np.float32).reshape(-1, len(names), 3)
    for k, name in enumerate(names):
        what = (
            "of the body's base relative to the arena"
            if name == "root"
            else "relative to the joint's parent"
        )
        module.add(
            TimeSeries(
                name=f"rotation_{name}",
                data=turns[:, k],
                unit="rad",
                timestamps=poses.time_s,
                description=f"rotation vector {what}",
            )
        )
