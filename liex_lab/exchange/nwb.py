"""Neurodata Without Borders (NWB) file: poses by the extension ndx-pose, rotations, actions, gaps.

One animal per file; the files of the others in its arena are named in `notes`, and the
interactions of all are in each. NWB has no type for rotations: each joint has a TimeSeries of
rotation vectors, rad. Actions, interactions and gaps are time intervals. Times are true times, s
since the session's beginning, which NWB requires with a time zone.

Species, sex and age are fields of NWB's Subject. Group, cage and batch have no field in NWB or in
any extension that archives accept. They are in the subject's description (which DANDI displays),
and all facts on the animal are in `notes`, a field of every NWB file, as lines `key: value`.
`scratch` is not meant for sharing, and other programs could not read a type of our own.
"""

import json
from datetime import datetime
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import ndx_ethogram
import ndx_pose
import numpy as np
import pynwb
from numpy.typing import NDArray

from liex_lab.errors import SessionError
from liex_lab.exchange.export import hdf5_file
from liex_lab.sessions import Session
from liex_lab.sessions.corrections import BoutEdit
from liex_lab.sessions.individuals import arena_name, individuals_of
from liex_lab.sessions.session import PULSE, PoseArrays
from liex_lab.tables.rows import stop_times
from liex_lab.tables.schema import SYNCED

_HUMAN = "human"
_MADE_BY = ("action_model", "rules")  # sections of session.json


def _catalogue(session: Session) -> Any:
    """Every word with its definition, one row each."""
    meanings = session.metadata.get("actions", {})
    words = dict.fromkeys([*meanings, *map(str, session.bouts["action"])])
    spans = np.sort(session.bouts[["start_s", "stop_s"]].to_numpy(float), axis=0)
    table = ndx_ethogram.Ethogram(
        name="Ethogram",
        description="the words of the ethogram, whether or not they occur",
        exclusive=bool((spans[1:, 0] >= spans[:-1, 1]).all()),
    )
    for word in words:
        meaning = meanings.get(word) or "no definition was stated"
        table.add_row(behavior=word, definition=meaning, behavior_type="state", check_ragged=False)
    return table


def _actions(session: Session, estimate: Any, catalogue: Any, observed: Any) -> Any:
    """The bouts: half-open intervals with label, score and source."""
    bouts = session.bouts
    about = session.metadata
    edits = {entry.author for entry in session.log.touched if isinstance(entry.what, BoutEdit)}
    by_hand = bool(edits) or _HUMAN in set(bouts["source"])
    made_by = {name: about[name] for name in _MADE_BY if about.get(name)}
    links = {"observation_intervals": observed} if observed is not None and len(observed) else {}
    table = ndx_ethogram.EthogramBouts(
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
    table.add_column("named_by", "source of the name: rule, model or human")
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


def _intervals(
    name: str, description: str, spans: NDArray[Any], **more: tuple[str, list[Any]]
) -> Any:
    """A table of spans (m, 2) s, and further columns: their description and values."""
    table = pynwb.epoch.TimeIntervals(name=name, description=description)
    for column, (what, _) in more.items():
        table.add_column(column, what)
    for k, (start, stop) in enumerate(spans.tolist()):
        values = {column: held[k] for column, (_, held) in more.items()}
        table.add_row(start_time=start, stop_time=stop, check_ragged=False, **values)
    return table


_LISTED = {  # further tables of a session: description, times, columns
    "interactions": (
        "what one animal of the arena did to another: half-open intervals",
        ["start_s", "stop_s"],
        ("agent", "target", "action", "score", "directed"),
    ),
    "events": ("events of another instrument", ["time_s", "time_s"], ("event", "sync_s")),
    "triggers": (
        "events of rules in the live recording",
        ["time_s", "time_s"],
        ("rule", "outcome", "value", "latency_ms"),
    ),
}


def _listed(session: Session, name: str) -> Any:
    """A table of `_LISTED` as intervals, without rows whose time is unknown; None if absent."""
    if not session.has(f"{name}.parquet"):
        return None
    what, times, columns = _LISTED[name]
    found = session.table(name).dropna(subset=times)
    described = session.columns.query("table == @name").set_index("name")["meaning"]
    held = {one: (str(described[one]), found[one].tolist()) for one in columns}
    return _intervals(name, what, found[times].to_numpy(float), **held)


def _in_one_arena(session: Session) -> dict[str, str]:
    """The other animals of the arena, each with the file and identifier of its export."""
    named = {one: f"{arena_name(session)}-{one}" for one in individuals_of(session)}
    del named[session.metadata["individual"]]
    return {
        f"together with {one}": f"{name}.nwb, identifier {_identifier(session, name)}"
        for one, name in named.items()
    }


def _identifier(session: Session, name: str) -> str:
    """Of the file of the session's recording with this session name."""
    return str(uuid5(NAMESPACE_URL, f"{name}-{session.metadata['input']['sha256']}"))


def observed_spans(poses: PoseArrays) -> NDArray[np.float64]:
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
    "image rows; joints lie on the body's mid-axis"
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
    with hdf5_file(path) as hdf5, pynwb.NWBHDF5IO(file=hdf5, mode="w") as file:
        file.write(build(session))


def build(session: Session) -> pynwb.NWBFile:
    """The session as an NWB file in memory.

    Raises:
        SessionError: the session has no start time with time zone.
    """
    about = session.metadata
    version = about["versions"].get("liex_lab", "unknown")
    facts = {"individual": about["individual"], **about["subject"], **_in_one_arena(session)}
    made = pynwb.NWBFile(
        session_description=(
            f"3D skeleton and actions of one {about['animal']['name']}, from a depth recording"
        ),
        identifier=_identifier(session, session.name),
        session_start_time=_start(session),
        session_id=session.name,
        subject=_subject(session),
        source_script="liex export --to nwb",
        source_script_file_name=f"liex_lab {version}",
        keywords=["depth camera", "pose", "behavior"],
        notes="\n".join(f"{name}: {' '.join(str(fact).split())}" for name, fact in facts.items()),
    )
    module = made.create_processing_module(
        "behavior", "pose estimates, rotations and actions by liex_lab"
    )
    poses = session.pose_arrays()
    estimate = _add_poses(made, module, session, poses, version)
    _add_rotations(module, session, poses)
    if clock := session.log.clock:
        module.add(
            pynwb.TimeSeries(
                name="sync_s",
                data=session.frames["sync_s"].to_numpy(),
                unit="seconds",
                timestamps=poses.time_s,
                description=f"{SYNCED['frames'][0].meaning}: {clock.name}",
                comments=str(clock),
            )
        )
    catalogue = _catalogue(session)
    if len(catalogue):
        module.add(catalogue)
    lacking = session.gaps
    gaps = _intervals(
        "gaps",
        "frames that are missing or without a pose",
        lacking[["start_s", "stop_s"]].to_numpy(float),
        reason=("why", [str(reason) for reason in lacking["reason"]]),
    )
    when = "when actions could be named"
    observed = _intervals("observed", when, observed_spans(poses)) if len(gaps) else None
    listed = (_listed(session, name) for name in _LISTED)
    for table in (_actions(session, estimate, catalogue, observed), gaps, observed, *listed):
        if table is not None and len(table):
            made.add_time_intervals(table)
    return made


def _start(session: Session) -> datetime:
    stated = session.metadata.get("session_start_time")
    try:
        moment = datetime.fromisoformat(str(stated))
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None:
        raise SessionError(
            f"NWB needs the start time of a session with its time zone, which {session.name} does "
            "not state; add it with `liex describe SESSION "
            "session_start_time=2026-08-21T10:00:00+02:00` (in Python describe_session)"
        )
    return moment


def _subject(session: Session) -> Any:
    """The animal; its sex is one of NWB's letters.

    Its id has no slash, because DANDI makes a path of it.
    """
    about = session.metadata["subject"]
    kind = session.metadata["animal"]["name"]
    sex = str(about.get("sex", ""))[:1].upper()
    facts = [f"{name} {about[name]}" for name in _FACTS if about.get(name)]
    return pynwb.file.Subject(
        subject_id=(about.get("subject_id") or session.metadata["individual"]).replace("/", "-"),
        species=about.get("species") or _SPECIES.get(kind, kind),
        sex=sex if sex in ("M", "F", "O") else "U",
        age=about.get("age"),
        description=", ".join([kind, *(facts or ["group not stated"])]),
    )


def _add_poses(
    made: pynwb.NWBFile, module: Any, session: Session, poses: PoseArrays, version: str
) -> Any:
    """Add skeleton and one series per joint with shared times; returns the PoseEstimation."""
    skeleton = ndx_pose.Skeleton(
        name=session.metadata["animal"]["name"],
        nodes=list(poses.joints),
        edges=np.array(poses.bones, np.uint8).reshape(-1, 2),
        subject=made.subject,
    )
    module.add(ndx_pose.Skeletons(skeletons=[skeleton]))
    camera = session.metadata["camera"]
    device = made.create_device(
        name="depth camera", description=str(camera.get("source", "depth camera"))
    )
    series: list[Any] = []
    for k, joint in enumerate(poses.joints):
        series.append(
            ndx_pose.PoseEstimationSeries(
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
    estimate = ndx_pose.PoseEstimation(
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
    score = poses.score.astype(np.float32)
    of_joints = f"{', '.join(poses.joints)}: {_SCORE}"
    for name, data, unit, what in (
        ("score", score, "probability", of_joints),
        ("pulse_index", poses.pulse_index, "count", PULSE.meaning),
    ):
        module.add(
            pynwb.TimeSeries(
                name=name, data=data, unit=unit, timestamps=poses.time_s, description=what
            )
        )
    return estimate


def _add_rotations(module: Any, session: Session, poses: PoseArrays) -> None:
    """The root's rigid transform and each joint's rotation relative to its parent."""
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
            pynwb.TimeSeries(
                name=f"rotation_{name}",
                data=turns[:, k],
                unit="rad",
                timestamps=poses.time_s,
                description=f"rotation vector {what}",
            )
        )
