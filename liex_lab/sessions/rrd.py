"""Rerun replay log (.rrd): depth, skeleton, scalars and actions on timelines `frame` and `time`.

Lengths are metres, the arena is right-handed with z up. Depth is streamed (see `rrd_depth`);
everything small is written at the end from the same track as the tables.
"""

import atexit
import ctypes
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, cycle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import rerun as rr

from liex_lab.actions import vocabulary
from liex_lab.arrays import Array, NDArray
from liex_lab.behaviour.body import logged_of
from liex_lab.behaviour.interactions import Interactions
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import SessionError
from liex_lab.geometry import so3
from liex_lab.runtime import durable, memory
from liex_lab.sessions.checkpoint import RRD_HEAD, rrd_messages
from liex_lab.sessions.cutouts import Boxes
from liex_lab.sessions.individuals import OtherAnimal, in_replay
from liex_lab.sessions.provenance import Provenance
from liex_lab.sessions.rrd_scene import (
    IMAGE,
    MM_PER_UNIT,
    OVERLAY,
    PALETTE,
    DepthColumns,
    body_columns,
    dot_mm,
    dot_pt,
    log_body,
    log_camera,
    log_hidden_places,
    log_outlines,
    log_surroundings,
    rgba,
    timeline,
)
from liex_lab.tables.rows import Rows, constant_runs, frame_count, stop_times
from liex_lab.tables.schema import shown
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.track import Track

SKELETON = "arena/skeleton"
ROOT = "arena/root"
UNCERTAINTY = "arena/uncertainty"
CANDIDATES = "arena/candidates"
ACTIONS = "ethogram/predicted"
TRACKING = "ethogram/tracking"
TOGETHER = "ethogram/interactions"
ANIMALS = "arena/animals"
_BLOCK = 8192  # frames of small data sent at once
_FLAG_COLOURS = {
    "doubtful": 0xCCBB44,
    "unclear": 0xEE7733,
    "not_found": int(vocabulary.NO_POSE[1:], 16),
    "hidden": 0xAA3377,
    "no_depth": 0xBBBBBB,
    "repeated": 0x66CCEE,
    "corrected": 0x4477AA,
}
# time per turn of waiting for a flush, and longest time without growth of the file
_TURN_S = 2.0
_PATIENCE_S = 60.0

BONE_COLOUR = [255, 255, 255, 255]
JOINT_COLOUR = [255, 80, 60, 255]


class ReplayWriter:
    """Writer of `session.rrd`.

    Call `add` for the depth of consecutive frames, then `finish` once, or `abandon`.

    Args:
        path: the file to write.
        origin: camera, arena, zones and skeleton, and the extent of the replay.
        blueprint: the layout, a Rerun blueprint; None if absent.
        corrected: write the replay of the corrections, to be shown with the original one: it has
            neither depth nor scene, and separate entities (see `corrected_entity`).
    """

    def __init__(
        self, path: Path, origin: Provenance, blueprint: Any = None, *, corrected: bool = False
    ) -> None:
        self._origin = origin
        self._first_ns: int | None = None
        self._depth = DepthColumns(origin)
        stream = rr.RecordingStream(
            "liex_lab", recording_id=origin.recording_id, send_properties=False
        )
        stream.set_log_time_enabled(False)
        self._stream: Any = _Renamed(stream) if corrected else stream
        self._path = path
        self._n_sent = 0
        self._broken = False
        self._corrected = corrected
        self._checked = RRD_HEAD
        self._n_found = 0
        self._stream.save(path)
        if blueprint is not None:
            self._stream.send_blueprint(blueprint)
        if not corrected:
            log_camera(self._stream, origin.camera, origin.T_arena_camera)
            log_outlines(self._stream, origin)
            if origin.scene is not None:
                log_surroundings(self._stream, origin.scene)

    def resume(self, first_ns: int) -> None:
        """Continue the timeline of another file.

        Args:
            first_ns: time of the first frame of that file, ns.
        """
        self._first_ns = first_ns
        self._depth.resume()

    def add(
        self,
        frame_index: Sequence[int],
        times_ns: Sequence[int],
        depth: Sequence[NDArray[np.uint16]],
        boxes: Boxes | None = None,
    ) -> None:
        """Write depth of consecutive frames; nothing without depth.

        Args:
            frame_index: the camera's count of the n frames.
            times_ns: their times, ns.
            depth: n images (H, W) uint16 mm, 0 where unread, with the still scene outside of
                cut-outs; empty if depth is not kept.
            boxes: (n, K, 4) left, top, right and bottom of the cut-outs, px, all 0 if absent; None
                if whole images are kept. It is the same for all frames of a replay.
        """
        if not depth:
            return
        if self._first_ns is None:
            self._first_ns = int(times_ns[0])
            self._depth.log_kind(self._stream, depth[0], whole=boxes is None)
        elapsed = [int(time_ns) - self._first_ns for time_ns in times_ns]
        for k in range(len(depth)):
            cuts = None if boxes is None else boxes[k]
            if self._depth.take(frame_index[k], elapsed[k], depth[k], cuts):
                self._send_depth()

    def _send_depth(self) -> None:
        """Write the waiting depth."""
        if n_messages := self._depth.send(self._stream):
            self._flush()
            self._n_sent += n_messages

    def finish(
        self,
        rows: Rows,
        kinematics: pd.DataFrame,
        bouts: pd.DataFrame,
        words: Sequence[str],
        problems: Sequence[str],
        candidates: Observations | None = None,
        together: Interactions | None = None,
    ) -> None:
        """Write skeleton, scalars, lanes and notes of the whole track, and close the file.

        Args:
            rows: the track in the form of the tables.
            kinematics: the table `kinematics`.
            bouts: the table `bouts`.
            words: the ethogram's vocabulary, coloured by `vocabulary.action_colours`.
            problems: sentences about the recording, logged as warnings.
            candidates: the pose hypotheses of single frames, to be shown as well; None if absent.
            together: the interactions with other animals of the arena, which are shown with them;
                None if it is alone.

        Raises:
            SessionError: the file was not written completely.
            OSError: the disk is full.
        """
        self._send_depth()
        track = rows.track
        self._index = rows.frame_index
        self._elapsed = track.times_ns - track.times_ns[:1]
        curves = self._log_curves(rows, kinematics)
        carriers = self._log_styles(track, 0 if candidates is None else candidates.known.shape[1])
        own, others = in_replay(self._origin, together)
        if own is not None:
            for name, skeleton, over, colour in (
                (self._origin.individual, SKELETON, OVERLAY, own),
                *((one.name, *_entities_of(one.name), one.colour) for one in others),
            ):
                self._log_animal(name, skeleton, over, colour)
        for part in memory.blocks(track.n_frames, _BLOCK):
            self._send_root(track, part)
            for entity, columns in chain(
                _skeleton_columns(track[part]),
                body_columns(track[part], carriers),
                *(_other_columns(one, track.skeleton, part) for one in others),
                () if candidates is None else _candidate_columns(candidates[part]),
                *(
                    [(curve, rr.Scalars.columns(scalars=factor * values[part]))]
                    for curve, (values, factor) in curves.items()
                ),
            ):
                self._send(entity, part, columns)
            self._flush()  # limits the memory of a long recording
        self._log_lanes(rows, bouts, words)
        if together is not None:
            self._log_together(rows, together)
        self._log_worst(track.predicted_error_mm)
        if not self._corrected:
            log_hidden_places(self._stream, rows)
        for problem in problems:
            self._stream.log("log", rr.TextLog(problem, level=rr.TextLogLevel.WARN), static=True)
        facts = rr.AnyValues(
            session_id=self._origin.name,
            animal=self._origin.skeleton.name,
            input_sha256=self._origin.input_sha256,
        )
        self._stream.send_property("session", facts)
        self.flushed()
        self.abandon()
        del self._index, self._elapsed  # large over a day, and the report needs the room
        try:
            self._count()
        except SessionError:
            raise self._why_unwritten() from None
        if self._path.stat().st_size <= self._checked:  # without the index that Rerun writes last
            raise self._why_unwritten()

    def flushed(self) -> int:
        """Pass everything to the operating system; returns the file's bytes.

        Rerun does not report a full disk, so the messages on disk are counted.

        Raises:
            SessionError: messages are missing.
            OSError: the disk is full.
        """
        self._send_depth()
        self._flush()
        self._count()
        if self._n_found < self._n_sent:
            raise self._unwritten()
        return self._checked

    def _count(self) -> None:
        """Count new messages on disk.

        Raises:
            SessionError: the last one is incomplete.
        """
        for at, length in rrd_messages(self._path, self._checked):
            self._checked = at + length
            self._n_found += 1

    def _flush(self) -> None:
        """Wait until Rerun's thread has written its queue.

        On a full disk the thread dies, and a flush may then block forever, so it waits in short
        turns.

        Raises:
            SessionError: the file was not written completely.
            OSError: the disk is full.
        """

        def flushed() -> bool:
            began = time.monotonic()
            try:
                self._stream.flush(timeout_sec=_TURN_S)
            except Exception as error:  # Rerun raises no specific type
                if time.monotonic() - began < 0.5 * _TURN_S:
                    raise self._unwritten() from error
                return False
            return True

        self._wait(flushed)

    def _wait(self, turn: Callable[[], bool]) -> None:
        """Take turns until one succeeds, unless the disk is full or the file stops growing."""
        waited = 0.0
        before = -1
        while not turn():
            size = self._path.stat().st_size if self._path.is_file() else 0
            waited = waited + _TURN_S if size == before else 0.0
            before = size
            if waited > _PATIENCE_S or durable.probe_full(self._path.parent):
                raise self._unwritten()

    def _unwritten(self) -> Exception:
        """The error to raise if Rerun has not written everything; it writes nothing from now on."""
        if not self._broken:
            self._broken = True
            # closing a stream whose thread has died would block forever, so neither garbage
            # collection nor the end of the process closes it; the process's end closes its file
            atexit.unregister(rr.rerun_shutdown)
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._stream))
        return self._why_unwritten()

    def _why_unwritten(self) -> Exception:
        return durable.probe_full(self._path.parent) or SessionError(
            f"the replay {self._path} was not written whole; make room on the disk or mend it, and "
            "run the same command again"
        )

    def abandon(self) -> None:
        """Close the file, whole or not.

        A file that Rerun failed to write is abandoned without waiting.

        Raises:
            SessionError: the file was not written completely.
            OSError: the disk is full.
        """
        if self._broken:
            return
        self._flush()
        closing = threading.Thread(target=self._stream.disconnect, daemon=True)
        closing.start()

        def closed() -> bool:
            closing.join(_TURN_S)
            return not closing.is_alive()

        self._wait(closed)

    def _send(self, entity: str, rows: slice | NDArray[np.int64], columns: Any) -> None:
        """Send columns of an entity for some rows of the track."""
        when = timeline(self._index[rows], self._elapsed[rows])
        self._stream.send_columns(entity, when, [*columns])

    def _log_curves(self, rows: Rows, kinematics: pd.DataFrame) -> dict[str, tuple[Array, float]]:
        """Log the style of the curves over time; returns values and their unit by entity."""
        error = rows.track.predicted_error_mm
        label = "predicted error (mm)"
        drawn = [("error/predicted", label, vocabulary.PREDICTED_ERROR, (error, 1.0))]
        skeleton = self._origin.skeleton
        for one in logged_of({"joints": skeleton.names, "bones": skeleton.edges}):
            if one.column in kinematics:
                factor, unit = shown(1.0, one.unit)
                label = f"{one.title.lower()}{f' ({unit})' if unit else ''}"
                values = kinematics[one.column].to_numpy(float)
                drawn.append((one.entity, label, one.colour, (values, factor)))
        for entity, label, colour, _ in drawn:
            style = rr.SeriesLines(names=label, colors=rgba([int(colour[1:], 16)]), widths=1.5)
            self._stream.log(entity, style, static=True)
        return {entity: values for entity, _, _, values in drawn}

    def _log_styles(self, track: Track, n_candidates: int) -> list[int]:
        """Log the style of all moving entities; returns the joints that carry part of the body."""
        skeleton = track.skeleton
        names = [rr.AnnotationInfo(id=j, label=name) for j, name in enumerate(skeleton.names)]
        whole = rr.AnnotationInfo(id=1, label=skeleton.name, color=BONE_COLOUR)
        kind = rr.ClassDescription(info=whole, keypoint_annotations=names)
        dot_m = dot_mm(skeleton) / MM_PER_UNIT
        pt = dot_pt(skeleton)
        dot: dict[str, Any] = {"colors": JOINT_COLOUR, "show_labels": False}
        thick, thin = rr.Radius.ui_points(pt), rr.Radius.ui_points(pt / 3.0)
        styles: dict[str, rr.AsComponents] = {
            SKELETON: rr.AnnotationContext([kind]),
            f"{SKELETON}/joints": rr.Points3D.from_fields(radii=dot_m, **dot),
            f"{SKELETON}/bones": rr.LineStrips3D.from_fields(radii=dot_m / 2.0, colors=BONE_COLOUR),
            OVERLAY: rr.AnnotationContext([kind]),
            f"{OVERLAY}/joints": rr.Points2D.from_fields(radii=thick, **dot),
            f"{OVERLAY}/bones": rr.LineStrips2D.from_fields(radii=thin, colors=BONE_COLOUR),
            UNCERTAINTY: rr.Ellipsoids3D.from_fields(
                colors=[255, 170, 60, 140], fill_mode="majorwireframe", line_radii=0.0003
            ),
        }
        if track.posed.any():
            styles[ROOT] = rr.TransformAxes3D(0.02)
        for h, colour in zip(range(n_candidates), cycle(PALETTE), strict=False):
            style = rr.LineStrips3D.from_fields(radii=0.0008, colors=rgba([colour]))
            styles[f"{CANDIDATES}/{h + 1}"] = style
        for entity, archetype in styles.items():
            self._stream.log(entity, archetype, static=True)
        animal = self._origin.animal_size
        return log_body(self._stream, skeleton, animal) if skeleton.surface else []

    def _log_animal(self, name: str, skeleton: str, over: str, colour: int) -> None:
        """Log name and colour of one of several animals, in space and over the depth image."""
        dot_m, pt = (f(self._origin.skeleton) for f in (dot_mm, dot_pt))
        style: dict[str, Any] = {"colors": rgba([colour])}
        for entity, dots, lines, size in (
            (skeleton, rr.Points3D, rr.LineStrips3D, dot_m / MM_PER_UNIT),
            (over, rr.Points2D, rr.LineStrips2D, rr.Radius.ui_points(pt / 2.0)),
        ):
            points: Any = dots.from_fields(radii=size, show_labels=False, **style)
            bones: Any = lines.from_fields(radii=size, labels=[name], show_labels=True, **style)
            self._stream.log(f"{entity}/joints", points, static=True)
            self._stream.log(f"{entity}/bones", bones, static=True)

    def _log_together(self, rows: Rows, together: Interactions) -> None:
        """Log a lane of the interactions of each agent towards each target."""
        end = (int(rows.frame_index[-1]) + 1, float(stop_times(rows.time_s)[-1]))
        own = vocabulary.action_colours([*vocabulary.INTERACTIONS])
        for (agent, target), spans in together.states().items():
            lane = rr.escape_entity_path_part(f"{agent} to {target}")
            words = dict.fromkeys(span[-1] for span in spans)
            colours = {word: int(own[word.partition(", ")[0]][1:], 16) for word in words}
            self._log_lane(f"{TOGETHER}/{lane}", spans, colours, end)

    def _send_root(self, track: Track, part: slice) -> None:
        """Send the axes of the body's base; they keep their last pose while the animal is lost."""
        posed = part.start + np.flatnonzero(track.posed[part])
        if len(posed):
            xyzw = np.roll(so3.quaternion(track.root_rotation[posed]), -1, axis=-1)
            place = track.root_mm[posed] / MM_PER_UNIT
            self._send(ROOT, posed, rr.Transform3D.columns(translation=place, quaternion=xyzw))

    def _log_worst(self, predicted_error_mm: Array) -> None:
        """Log the frames with the largest predicted error, as notes to jump to."""
        error = np.nan_to_num(predicted_error_mm)
        worst = np.sort(np.argsort(-error, kind="stable")[:12])
        worst = worst[error[worst] > 0]
        if len(worst):
            notes = [f"frame {self._index[k]}: predicted error {error[k]:.1f} mm" for k in worst]
            columns = rr.TextLog.columns(text=notes, level=["INFO"] * len(notes))
            self._send("log/worst", worst, columns)

    def _log_lanes(self, rows: Rows, bouts: pd.DataFrame, words: Sequence[str]) -> None:
        """Log the lane of the actions, and the lane of flagged frames."""
        columns = ["start_frame", "stop_frame", "start_s", "stop_s", "action"]
        spans = [*bouts[columns].itertuples(index=False, name=None)]
        stop = stop_times(rows.time_s)
        end = (int(rows.frame_index[-1]) + 1, float(stop[-1]))
        own = {word: int(at[1:], 16) for word, at in vocabulary.action_colours(words).items()}
        self._log_lane(ACTIONS, spans, own, end)
        count, time_s = frame_count(rows.frame_index), rows.time_s
        flags = rows.frames_table["flag"].cat
        marked = [
            (count[a], count[b], time_s[a], stop[b - 1], flag)
            for a, b, number in constant_runs(flags.codes.to_numpy())
            if (flag := flags.categories[number])
        ]
        self._log_lane(TRACKING, marked, _FLAG_COLOURS, end)

    def _log_lane(
        self, entity: str, spans: Sequence[Any], colours: dict[str, int], end: tuple[int, float]
    ) -> None:
        """Log one lane of half-open spans in order of time.

        A span is (start_frame, stop_frame, start_s, stop_s, word).
        """
        labels = [word.replace("_", " ") for word in colours]
        kind = rr.StateConfiguration(
            values=list(colours), labels=labels, colors=rgba(list(colours.values()))
        )
        self._stream.log(entity, kind, static=True)
        changes: list[tuple[int, float, str]] = []
        for k, (start_frame, stop_frame, start_s, stop_s, word) in enumerate(spans):
            changes.append((int(start_frame), float(start_s), str(word)))
            if k + 1 == len(spans) or spans[k + 1][0] > stop_frame or spans[k + 1][2] > stop_s:
                changes.append((int(stop_frame), float(stop_s), ""))
        if not changes:
            changes = [(0, 0.0, ""), (*end, "")]
        frames, times, words = zip(*changes, strict=True)
        elapsed = np.rint(np.array(times) * 1e9).astype(np.int64)
        states = rr.StateChange.columns(state=list(words))
        self._stream.send_columns(entity, timeline(np.array(frames), elapsed), [*states])


def corrected_entity(entity: str) -> str:
    """Entity path, in the replay of corrections, for `entity` of the session's own replay.

    It is below the same camera or arena, so that both are drawn in one scene.

    Args:
        entity: the path in the session's own replay.
    """
    for above in (f"{IMAGE}/", "arena/"):
        if entity.startswith(above):
            return f"{above}corrected/{entity.removeprefix(above)}"
    return f"corrected/{entity}"


class _Renamed:
    """A Rerun stream that writes to the entities of corrections."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._to = stream

    def log(self, entity: str, *what: Any, **how: Any) -> None:
        self._to.log(corrected_entity(entity), *what, **how)

    def send_columns(self, entity: str, *what: Any, **how: Any) -> None:
        self._to.send_columns(corrected_entity(entity), *what, **how)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._to, name)


def _entities_of(name: str) -> tuple[str, str]:
    """The entities of another animal's skeleton, in space and over the depth image."""
    part = rr.escape_entity_path_part(name)
    return f"{ANIMALS}/{part}", f"{OVERLAY}/animals/{part}"


def _other_columns(
    other: OtherAnimal, skeleton: Skeleton, part: slice
) -> Iterator[tuple[str, Any]]:
    """Joints and bones of another animal of the arena; empty without a pose."""
    joints, uv_px = other.joints_mm[part], other.uv_px(part)
    posed = np.asarray(np.isfinite(joints).all(axis=(1, 2)))
    yield from _chain_columns(_entities_of(other.name), skeleton, posed, joints, uv_px)


def _chain_columns(
    entities: tuple[str, str],
    skeleton: Skeleton,
    posed: NDArray[np.bool_],
    joints_mm: Array,
    uv_px: Array,
) -> Iterator[tuple[str, Any]]:
    """Joints and bones of n frames, in space and over the depth image; empty without a pose."""
    n_posed, n_joints = int(posed.sum()), skeleton.n_joints
    edges = np.array(skeleton.edges, np.int64).reshape(-1, 2)
    for entity, dot, line, points in (
        (entities[0], rr.Points3D, rr.LineStrips3D, joints_mm[posed] / MM_PER_UNIT),
        # the 2D view counts from the image's corner; our pixels count from their centre
        (entities[1], rr.Points2D, rr.LineStrips2D, uv_px[posed] + 0.5),
    ):
        size = points.shape[-1]
        dots = dot.columns(
            positions=points.reshape(-1, size),
            class_ids=np.ones(n_posed * n_joints, np.uint16),
            keypoint_ids=np.tile(np.arange(n_joints, dtype=np.uint16), n_posed),
        )
        strips = line.columns(strips=points[:, edges].reshape(-1, 2, size).astype(np.float32))
        yield f"{entity}/joints", dots.partition(np.where(posed, n_joints, 0))
        yield f"{entity}/bones", strips.partition(np.where(posed, len(edges), 0))


def _skeleton_columns(track: Track) -> Iterator[tuple[str, Any]]:
    """Joints, bones and ellipsoids that contain the joints with 95 %; empty without a pose.

    Half axes are 2.795 standard deviations of a Gaussian in space (a chi distribution with 3
    degrees of freedom).
    """
    posed, skeleton = track.posed, track.skeleton
    yield from _chain_columns((SKELETON, OVERLAY), skeleton, posed, track.joints_mm, track.uv_px)
    joints = track.joints_mm[posed] / MM_PER_UNIT
    # standard deviations of a Gaussian in space
    axes = 2.795 * np.nan_to_num(track.sd_xyz_mm[posed]).reshape(-1, 3) / MM_PER_UNIT
    spheres = rr.Ellipsoids3D.columns(half_sizes=axes, centers=joints.reshape(-1, 3))
    yield UNCERTAINTY, spheres.partition(np.where(posed, skeleton.n_joints, 0))


def _candidate_columns(observations: Observations) -> Iterator[tuple[str, Any]]:
    """The bones of every pose hypothesis, ranked."""
    edges = np.array(observations.skeleton.edges, np.int64).reshape(-1, 2)
    for h in range(observations.known.shape[1]):
        known = observations.known[:, h]
        joints = (
            observations.joints_as(h, range(observations.skeleton.n_joints))[known] / MM_PER_UNIT
        )
        strips = rr.LineStrips3D.columns(strips=joints[:, edges].reshape(-1, 2, 3))
        yield f"{CANDIDATES}/{h + 1}", strips.partition(np.where(known, len(edges), 0))
