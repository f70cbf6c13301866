"""Actions and gaps of a session as time intervals of an NWB file.

The table `actions` is an `EthogramBouts` of the extension ndx-ethogram, which is a TimeIntervals: a
reader that knows the extension finds how the names came about, the poses they were made of and the
catalogue of words, and every other one finds the table of intervals where NWB keeps such tables,
with a `label`. So there is one table, and no second copy of it that might come to differ.

The catalogue is the table `Ethogram` of the processing module behavior: every word that could have
been said, with its definition, whether or not the animal did it. Where there are gaps, the table
`observed` says when actions could be named at all: outside of it the lack of a bout means nothing.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.sessions import Session
from liex_lab.sessions.corrections import BoutEdit
from liex_lab.sessions.pose_arrays import Poses
from liex_lab.tables.rows import stop_times

if TYPE_CHECKING:
    from pynwb import NWBFile

_HUMAN = "human"
_MADE_BY = ("action_model", "rules")  # sections of session.json


def add_intervals(made: NWBFile, session: Session, poses: Poses, estimate: Any) -> None:
    """Add the tables `actions`, `gaps` and `observed`, each where it has a row, and the catalogue.

    Args:
        made: the file in memory, with a processing module behavior.
        session: the session.
        poses: its poses.
        estimate: the same as ndx-pose's PoseEstimation in the file.
    """
    catalogue = _catalogue(session)
    if len(catalogue):
        made.processing["behavior"].add(catalogue)
    gaps = _gaps(session)
    observed = _observed(poses) if len(gaps) else None
    actions = _actions(session, estimate, catalogue, observed)
    for table in (actions, gaps, observed):
        if table is not None and len(table):
            made.add_time_intervals(table)


def _catalogue(session: Session) -> Any:
    """Every word with its definition; a row each."""
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
    """The bouts: half-open intervals with label, score and who named each."""
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
    # not `source`: so ndx-ethogram calls a link
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


def _gaps(session: Session) -> Any:
    """Frames that are missing or without a pose, and why."""
    from pynwb.epoch import TimeIntervals

    table = TimeIntervals(name="gaps", description="frames that are missing or without a pose")
    table.add_column("reason", "why")
    missing = session.gaps
    for start, stop, reason in zip(
        missing["start_s"], missing["stop_s"], missing["reason"], strict=True
    ):
        table.add_row(
            start_time=float(start), stop_time=float(stop), reason=str(reason), check_ragged=False
        )
    return table


def _observed(poses: Poses) -> Any:
    """When the animal had a pose, of which actions could be named."""
    from pynwb.epoch import TimeIntervals

    table = TimeIntervals(name="observed", description="when actions could be named")
    for start, stop in observed_spans(poses):
        table.add_row(start_time=float(start), stop_time=float(stop))
    return table


def observed_spans(poses: Poses) -> NDArray[np.float64]:
    """Spans of time in which every frame has a pose and none is missing.

    Args:
        poses: the session's poses.

    Returns:
        (m, 2) s: start and stop, exclusive, in order.
    """
    seen = np.asarray(np.isfinite(poses.xyz_mm).all(axis=(1, 2)))
    starts, stops = poses.time_s, stop_times(poses.time_s)
    goes_on = np.zeros(len(seen) + 1, np.bool_)  # the span of the frame before goes on in this one
    goes_on[1:-1] = seen[1:] & seen[:-1] & (stops[:-1] == starts[1:])
    first = np.flatnonzero(seen & ~goes_on[:-1])
    last = np.flatnonzero(seen & ~goes_on[1:])
    return np.stack([starts[first], stops[last]], axis=-1)
