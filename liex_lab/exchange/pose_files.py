"""Writers of pose files for DeepLabCut, SLEAP and movement.

HDF5 files are made in memory and written at once. HDF5 does not handle a full disk: it tries to
write again at the interpreter's exit, with tracebacks of its own and sometimes a crash. Here the
only write to disk is Python's, which raises an ordinary error.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.errors import SessionError
from liex_lab.runtime.text_files import write_csv
from liex_lab.sessions import Session
from liex_lab.sessions.corrections import BoutEdit
from liex_lab.sessions.session import PULSE, Array, Poses
from liex_lab.tables.rows import stop_times

if TYPE_CHECKING:
    import h5py
    from pynwb import NWBFile


@contextmanager
def hdf5_file(path: Path) -> Iterator[h5py.File]:
    """An empty HDF5 file to fill, written to `path` if the block ends without an error.

    Raises:
        OSError: it cannot be written there.
    """
    import h5py

    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        yield file
    path.write_bytes(memory.getbuffer())


# DeepLabCut's CSV tables: three header rows (scorer, bodyparts, coords), then one row per frame.


SCORER = "liex_lab"


def write_dlc(session: Session, path: Path) -> None:
    """Write a new folder with both tables, the times and the bouts."""
    poses = session.pose_arrays()
    path.mkdir()
    write_csv(dlc_table(poses, poses.xyz_mm, "xyz"), path / "poses_3d.csv", index=True)
    flat = np.concatenate([poses.uv_px, poses.likelihood[..., None]], axis=-1)
    write_csv(dlc_table(poses, flat, ("x", "y", "likelihood")), path / "poses_2d.csv", index=True)
    _write_times(path / "times.csv", poses)
    write_csv(session.bouts, path / "bouts.csv")


def dlc_table(poses: Poses, values: Array, coords: str | tuple[str, ...]) -> pd.DataFrame:
    """Data frame with DeepLabCut's columns: scorer, bodyparts, coords.

    Args:
        poses: the session's poses, for joints and frame index.
        values: (n, J, k) values.
        coords: names of the k coordinates; a str is one letter each.

    Returns:
        (n, J k) table, indexed by the frame index of the recording.
    """
    columns = pd.MultiIndex.from_product(
        [[SCORER], list(poses.joints), list(coords)], names=["scorer", "bodyparts", "coords"]
    )
    return pd.DataFrame(values.reshape(len(values), -1), index=poses.frame_index, columns=columns)


def _write_times(path: Path, poses: Poses) -> None:
    """Write a CSV with the true time of each row, for formats without times.

    Args:
        path: the CSV file to write: frame_index, time_s with nine decimals, pulse_index.
        poses: the session's poses.
    """
    rows = zip(poses.frame_index, poses.time_s, poses.pulse_index, strict=True)
    lines = [f"{index},{time:.9f},{pulse}" for index, time, pulse in rows]
    path.write_text("\n".join(["frame_index,time_s,pulse_index", *lines]) + "\n", encoding="utf-8")


# SLEAP's analysis file (HDF5), in its own order of axes (Matlab's).


def write_sleap(session: Session, path: Path) -> None:
    """Write one track with every recorded frame as an .analysis.h5 file.

    Pixel coordinates are SLEAP's, from the centre of the top-left pixel.
    """
    import h5py

    poses = session.pose_arrays()
    observed = np.isfinite(poses.uv_px[:, :, 0])
    order = {
        "tracks": ("track", "xy", "node", "frame"),
        "point_scores": ("track", "node", "frame"),
        "track_occupancy": ("frame", "track"),
        "instance_scores": ("track", "frame"),
        "tracking_scores": ("track", "frame"),
    }
    mean_score = np.where(
        observed.any(axis=1), np.nanmean(np.where(observed, poses.likelihood, 0.0), axis=1), np.nan
    )
    arrays = {
        "tracks": poses.uv_px.transpose(2, 1, 0)[None],
        "point_scores": poses.likelihood.T[None],
        "track_occupancy": observed.any(axis=1, keepdims=True).astype(np.uint8),
        "instance_scores": mean_score[None],
        "tracking_scores": np.where(observed.any(axis=1), 1.0, np.nan)[None],
        "time_s": poses.time_s,
        "pulse_index": poses.pulse_index,
    }
    edges = [(poses.joints[a], poses.joints[b]) for a, b in poses.bones]
    texts = {"node_names": poses.joints, "track_names": (poses.individual,), "edge_names": edges}
    with hdf5_file(path) as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values, compression="gzip", compression_opts=4)
            if name in order:
                file[name].attrs["dims"] = json.dumps(order[name])
        for name, words in texts.items():
            file.create_dataset(name, data=np.array(words, dtype=object), dtype=h5py.string_dtype())
        file.create_dataset("edge_inds", data=np.array(poses.bones, np.int64).reshape(-1, 2))
        for name, value in (("labels_path", ""), ("video_path", session.metadata["input"]["name"])):
            file.create_dataset(name, data=value, dtype=h5py.string_dtype())
        file.create_dataset("video_ind", data=0)
        file.create_dataset(
            "provenance", data=json.dumps({"software": "liex_lab"}), dtype=h5py.string_dtype()
        )
        file.attrs["preset"] = "matlab"
        file.attrs["format"] = "analysis"


# Poses data set of the Python package movement as netCDF; xarray and `movement.io` open it.


def write_movement(session: Session, path: Path) -> None:
    """Write netCDF 4 (.nc)."""
    # in memory, see `hdf5_file`
    path.write_bytes(session.to_xarray().to_netcdf(engine="h5netcdf"))


# Neurodata Without Borders (NWB) file: poses by the extension ndx-pose, rotations, actions, gaps.


_HUMAN = "human"
_MADE_BY = ("action_model", "rules")  # sections of session.json


def add_intervals(made: NWBFile, session: Session, poses: Poses, estimate: Any) -> None:
    """Add the catalogue and the tables `actions`, `gaps` and `observed`, each if it has rows.

    Args:
        made: the file in memory, with a processing module behavior.
        session: the session.
        poses: its poses.
        estimate: the same as ndx-pose's PoseEstimation in the file.
    """
    catalogue = _catalogue(session)
    if len(catalogue):
        made.processing["behavior"].add(catalogue)
    lacking = session.gaps
    spans, reasons = lacking[["start_s", "stop_s"]].to_numpy(float), lacking["reason"].tolist()
    gaps = _intervals("gaps", "frames that are missing or without a pose", spans, reasons)
    when = "when actions could be named"
    observed = _intervals("observed", when, observed_spans(poses), ()) if len(gaps) else None
    actions = _actions(session, estimate, catalogue, observed)
    for table in (actions, gaps, observed):
        if table is not None and len(table):
            made.add_time_intervals(table)


def _catalogue(session: Session) -> Any:
    """Every word with its definition, one row each."""
    from ndx_ethogram import Ethogram

    meanings = session.metadata.get("actions", {})
    words = dict.fromkeys([*meanings, *map(str, session.bouts["action"])])
    spans = np.sort(session.bouts[["start_s", "stop_s"]].to_numpy(float), axis=0)
    table = Ethogram(
        name="Ethogram",
        description="the words of the ethogram, whether or not they were said",
        exclusive=bool((spans[1:, 0] >= spans[:-1, 1]).all()),
    )
    for word in words:
        meaning = meanings.get(word) or "no definition was stated"
        table.add_row(behavior=word, definition=meaning, behavior_type="state", check_ragged=False)
    return table


def _actions(session: Session, estimate: Any, catalogue: Any, observed: Any) -> Any:
    """The bouts: half-open intervals with label, score and source."""
    from ndx_ethogram import EthogramBouts

    bouts = session.bouts
    about = session.metadata
    edits = {entry.author for entry in session.log.touched if isinstance(entry.what, BoutEdit)}
    by_hand = bool(edits) or _HUMAN in set(bouts["source"])
    made_by = {name: about[name] for name in _MADE_BY if about.get(name)}
    links = {"observation_intervals": observed} if observed is not None and len(observed) else {}
    table = EthogramBouts(
        name="actions",
        description="the ethogram: half-open intervals",
        labeling_method="curated" if by_hand else "automated",
        source_software=f"liex_lab {about['versions'].get('liex_lab', '')}".strip(),
        annotator=", ".join(sorted(edits)) or None,
        parameters=json.dumps(made_by, sort_keys=True) if made_by else None,
        source_pose=estimate,
        ethogram=catalogue if len(catalogue) else None,
        **links,
    )
    table.add_column("score", "how well the bout fits its action, 0 to 1")
    # not `source`, which is a link in ndx-ethogram
    table.add_column("named_by", "who named it: rule, model or human")
    columns = ("start_s", "stop_s", "action", "score", "source")
    for start, stop, word, score, source in zip(*(bouts[name] for name in columns), strict=True):
        table.add_row(
            start_time=float(start),
            stop_time=float(stop),
            label=str(word),
            score=float(score),
            named_by=str(source),
            check_ragged=False,
        )
    return table


def _intervals(name: str, description: str, spans: NDArray[Any], reasons: Sequence[str]) -> Any:
    """A table of spans (m, 2) s; gaps also have a reason."""
    from pynwb.epoch import TimeIntervals

    table = TimeIntervals(name=name, description=description)
    if name == "gaps":
        table.add_column("reason", "why")
    for k, (start, stop) in enumerate(spans):
        why = {"reason": str(reasons[k])} if name == "gaps" else {}
        table.add_row(start_time=float(start), stop_time=float(stop), check_ragged=False, **why)
    return table


def observed_spans(poses: Poses) -> NDArray[np.float64]:
    """Spans of time in which every frame has a pose and none is missing.

    Returns:
        (m, 2) s: start and stop, exclusive, in order.
    """
    observed = np.asarray(np.isfinite(poses.xyz_mm).all(axis=(1, 2)))
    starts, stops = poses.time_s, stop_times(poses.time_s)
    # whether the span of the frame before continues in this one
    continues = np.zeros(len(observed) + 1, np.bool_)
    continues[1:-1] = observed[1:] & observed[:-1] & (stops[:-1] == starts[1:])
    first = np.flatnonzero(observed & ~continues[:-1])
    last = np.flatnonzero(observed & ~continues[1:])
    return np.stack([starts[first], stops[last]], axis=-1)


_SPECIES = {"mouse": "Mus musculus", "fish": "Danio rerio", "hand": "Homo sapiens"}
_FACTS = ("group", "cage", "batch")  # facts without a field of their own
_FRAME = (
    "the arena: z up from the floor, origin at the foot of the camera's perpendicular, x along "
    "the picture's rows; joints lie on the body's mid-axis"
)
_SCORE = "probability that the joint lies within 10 % of the spine's length of the truth"
_CONFIDENCE = (
    "0.6 + 0.4 x score where the pose of the frame is trusted, 0.5 x score where it is not"
)


def write_nwb(session: Session, path: Path) -> None:
    """Write the NWB file.

    Args:
        session: the session.
        path: the .nwb file to write.

    Raises:
        SessionError: the session has no start time with time zone.
    """
    from pynwb import NWBHDF5IO

    made = build(session)  # before the file is opened, which only registers the types known by then
    with hdf5_file(path) as hdf5, NWBHDF5IO(file=hdf5, mode="w") as file:
        file.write(made)


def build(session: Session) -> NWBFile:
    """The session as an NWB file in memory.

    Raises:
        SessionError: the session has no start time with time zone.
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
    """The animal; its sex is one of NWB's letters.

    Its id has no slash, because DANDI makes a path of it.
    """
    from pynwb.file import Subject

    about = session.metadata["subject"]
    kind = session.metadata["animal"]["name"]
    sex = str(about.get("sex", ""))[:1].upper()
    facts = [f"{name} {about[name]}" for name in _FACTS if about.get(name)]
    return Subject(
        subject_id=(about.get("subject_id") or session.metadata["individual"]).replace("/", "-"),
        species=about.get("species") or _SPECIES.get(kind, kind),
        sex=sex if sex in ("M", "F", "O") else "U",
        age=about.get("age"),
        description=", ".join([kind, *(facts or ["group not stated"])]),
    )


def _notes(session: Session) -> str:
    """The facts on the animal, one line each."""
    about = {"individual": session.metadata["individual"], **session.metadata["subject"]}
    return "\n".join(f"{name}: {' '.join(str(value).split())}" for name, value in about.items())


def _add_poses(made: NWBFile, module: Any, session: Session, poses: Poses, version: str) -> Any:
    """Add skeleton and one series per joint with shared times; returns the PoseEstimation."""
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
