"""Rerun replay log (.rrd): depth, skeleton, scalars and actions on timelines `frame` and `time`.

Lengths are metres, the arena is right-handed with z up. Depth streams in as it comes (see
`rrd_depth`); everything small is written at the end from the same track the tables are made of.
"""

from __future__ import annotations

import atexit
import ctypes
import threading
import time
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from liex_lab.actions import vocabulary
from liex_lab.behaviour.body import logged_of
from liex_lab.errors import SessionError
from liex_lab.geometry import so3
from liex_lab.runtime.memory import blocks
from liex_lab.runtime.places import probe_full
from liex_lab.sessions.drawn import dot_mm, dot_pt
from liex_lab.sessions.provenance import Provenance
from liex_lab.sessions.rrd_body import log_body, send_body
from liex_lab.sessions.rrd_depth import IMAGE, MM_PER_UNIT, DepthColumns, timeline
from liex_lab.sessions.rrd_file import HEAD, rrd_messages
from liex_lab.sessions.rrd_scene import FLOOR as FLOOR
from liex_lab.sessions.rrd_scene import OVERLAY as OVERLAY
from liex_lab.sessions.rrd_scene import log_hidden_places, log_surroundings
from liex_lab.tables.rows import Rows, constant_runs, frame_count, stop_times
from liex_lab.tables.schema import shown

if TYPE_CHECKING:
    import pandas as pd

    from liex_lab.sessions.cutouts import Boxes
    from liex_lab.tracking.observations import Observations

Array = NDArray[np.float64]
DepthBatch = Sequence[NDArray[np.uint16]]

SKELETON = "arena/skeleton"
ROOT = "arena/root"
UNCERTAINTY = "arena/uncertainty"
CANDIDATES = "arena/candidates"
ACTIONS = "ethogram/predicted"
TRACKING = "ethogram/tracking"
_BLOCK = 8192  # frames of small things sent in one go
# turns in which a flush is waited for, and how long a file may stand still, where the disk has room
_TURN_S = 2.0
_PATIENCE_S = 60.0

PALETTE = tuple(int(colour[1:], 16) for colour in vocabulary.PALETTE)
_FLAG_COLOURS = {
    "doubtful": 0xCCBB44,
    "not_found": int(vocabulary.NO_POSE[1:], 16),
    "hidden": 0xAA3377,
    "no_depth": 0xBBBBBB,
    "repeated": 0x66CCEE,
    "corrected": 0x4477AA,
}
_WALL = 0x9AA0A6
_WORST = 12
_HOLDS_95 = 2.795  # standard deviations of a Gaussian in space
_SPREAD = [255, 170, 60, 140]
BONE_COLOUR = [255, 255, 255, 255]
JOINT_COLOUR = [255, 80, 60, 255]


class ReplayWriter:
    """Writer of `session.rrd`.

    Call `add` for the depth of consecutive frames, then `finish` once, or `abandon`.

    Args:
        path: the file to write.
        origin: camera, arena, zones and skeleton, and what the replay is to hold.
        blueprint: the layout, a Rerun blueprint; None for none.
        corrected: write the replay of what people corrected, to be shown with that one: it has
            neither depth nor the scene, and its own entities (see `corrected_entity`).
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
        self._checked = HEAD
        self._n_found = 0
        self._stream.save(path)
        if blueprint is not None:
            self._stream.send_blueprint(blueprint)
        if not corrected:
            self._log_scene()
            if origin.scene is not None:
                log_surroundings(self._stream, origin.scene)

    def go_on(self, first_ns: int) -> None:
        """Continue another file's timeline.

        Args:
            first_ns: time of the first frame of that file, ns.
        """
        self._first_ns = first_ns
        self._depth.go_on()

    def add(
        self,
        frame_index: Sequence[int],
        times_ns: Sequence[int],
        depth: DepthBatch,
        boxes: Boxes | None = None,
    ) -> None:
        """Write depth of consecutive frames; nothing where there is none.

        Args:
            frame_index: the camera's count of the n frames.
            times_ns: their times, ns.
            depth: n pictures (H, W) uint16 mm, 0 where unread, outside of their cut-outs the still
                scene; none where depth is not kept.
            boxes: (n, K, 4) left, top, right and bottom of the cut-outs, px, all 0 for none; None
                where whole pictures are kept. It is the same for all frames of a replay.
        """
        if not depth:
            return
        if self._first_ns is None:
            self._first_ns = int(times_ns[0])
            self._depth.log_kind(self._stream, depth[0], whole=boxes is None)
        elapsed = [int(time_ns) - self._first_ns for time_ns in times_ns]
        for k in range(len(depth)):
            if self._depth.take(frame_index[k], elapsed[k], depth[k], _row(boxes, k)):
                self._send_depth()

    def _send_depth(self) -> None:
        """Write the depth that waits."""
        n_messages = self._depth.send(self._stream)
        if n_messages:
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
    ) -> None:
        """Write skeleton, scalars, lanes and notes of the whole track, and close the file.

        Args:
            rows: the track as the tables see it.
            kinematics: the table `kinematics`.
            bouts: the table `bouts`.
            words: the ethogram's vocabulary, coloured by `actions.colours`.
            problems: sentences about the recording, logged as warnings.
            candidates: the pose hypotheses of single frames, where they are to be shown, too.

        Raises:
            SessionError: the file was not written whole.
            OSError: the disk is full.
        """
        self._send_depth()
        index = rows.frame_index
        elapsed = rows.track.times_ns - rows.track.times_ns[:1]
        self._log_skeleton(rows, index, elapsed)
        self._log_root(rows, index, elapsed)
        if candidates is not None:
            self._log_candidates(candidates, index, elapsed)
        scalars = [
            (
                "error/predicted",
                "predicted error (mm)",
                int(vocabulary.PREDICTED_ERROR[1:], 16),
                rows.track.predicted_error_mm,
            )
        ]
        skeleton = self._origin.skeleton
        animal = {"joints": skeleton.names, "bones": skeleton.edges}
        for one in logged_of(animal):
            if one.column in kinematics:
                values, unit = shown(kinematics[one.column].to_numpy(float), one.unit)
                label = f"{one.title.lower()}{f' ({unit})' if unit else ''}"
                scalars.append((one.entity, label, int(one.colour[1:], 16), values))
        for entity, label, colour, values in scalars:
            self._stream.log(
                entity, rr.SeriesLines(names=label, colors=_rgba([colour]), widths=1.5), static=True
            )
            for part in blocks(len(index), _BLOCK):
                columns = rr.Scalars.columns(scalars=values[part])
                self._stream.send_columns(entity, timeline(index[part], elapsed[part]), [*columns])
            self._flush()
        self._log_lanes(rows, bouts, words)
        self._log_worst(rows, index, elapsed)
        if not self._corrected:
            log_hidden_places(self._stream, rows)
        for problem in problems:
            self._stream.log("log", rr.TextLog(problem, level=rr.TextLogLevel.WARN), static=True)
        self._stream.send_property(
            "session",
            rr.AnyValues(
                session_id=self._origin.name,
                animal=self._origin.skeleton.name,
                input_sha256=self._origin.input_sha256,
            ),
        )
        self.flushed()
        self.abandon()
        if not self._ended():
            raise self._why_unwritten()

    def flushed(self) -> int:
        """Hand everything to the operating system; returns the file's bytes.

        Rerun does not tell when the disk is full, so the messages on disk are counted.

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
        """Count the messages that are new on disk.

        Raises:
            SessionError: the last of them is not there as a whole.
        """
        for at, length in rrd_messages(self._path, self._checked):
            self._checked = at + length
            self._n_found += 1

    def _flush(self) -> None:
        """Wait until Rerun's thread has written what it was given.

        Where the disk is full the thread dies, and a flush may then wait for ever. So it waits in
        short turns: it goes on as long as the file grows, and gives up soon where the disk is full.

        Raises:
            SessionError: the file was not written whole.
            OSError: the disk is full.
        """
        waited = 0.0
        before = -1
        while True:
            began = time.monotonic()
            try:
                self._stream.flush(timeout_sec=_TURN_S)
                return
            except Exception as error:  # Rerun tells no more than a sentence
                took = time.monotonic() - began
                size = self._path.stat().st_size if self._path.is_file() else 0
                if took < 0.5 * _TURN_S or probe_full(self._path.parent):
                    raise self._unwritten() from error
                waited = waited + took if size == before else 0.0
                before = size
                if waited > _PATIENCE_S:
                    raise self._unwritten() from error

    def _unwritten(self) -> Exception:
        """What to raise where Rerun has not written everything; it writes no more from now on."""
        if not self._broken:
            self._broken = True
            _let_go(self._stream)
        return self._why_unwritten()

    def _why_unwritten(self) -> Exception:
        return probe_full(self._path.parent) or SessionError(
            f"the replay {self._path} was not written whole; make room on the disk or mend it, and "
            "run the same command again"
        )

    def _ended(self) -> bool:
        """Whether the closed file holds its end, with the index that Rerun writes last of all."""
        try:
            self._count()
        except SessionError:
            return False
        return self._path.stat().st_size > self._checked

    def abandon(self) -> None:
        """Close the file, whole or not.

        A file that Rerun failed to write is let go without waiting for it.

        Raises:
            SessionError: the file was not written whole.
            OSError: the disk is full.
        """
        if self._broken:
            return
        self._flush()
        closing = threading.Thread(target=self._stream.disconnect, daemon=True)
        closing.start()
        until = time.monotonic() + _PATIENCE_S
        closing.join(_TURN_S)
        while closing.is_alive():
            if time.monotonic() > until or probe_full(self._path.parent):
                raise self._unwritten()
            closing.join(_TURN_S)

    def _log_scene(self) -> None:
        camera = self._origin.camera
        T_arena_camera = self._origin.T_arena_camera
        self._stream.log("arena", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        pose = rr.Transform3D(
            translation=T_arena_camera.translation / 1000.0, mat3x3=T_arena_camera.rotation
        )
        self._stream.log("arena/camera", pose, static=True)
        lens = rr.Pinhole(
            image_from_camera=camera.matrix,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.05,
        )
        self._stream.log(IMAGE, lens, static=True)
        for name, outline, colour in self._outlines():
            ring = np.column_stack([outline, np.zeros(len(outline))])[[*range(len(outline)), 0]]
            look: dict[str, Any] = {"colors": _rgba([colour]), "labels": [name] if name else None}
            where = f"zones/{rr.escape_entity_path_part(name)}" if name else "walls"
            on_floor = rr.LineStrips3D([ring / MM_PER_UNIT], radii=0.001, **look)
            self._stream.log(f"{FLOOR}/{where}", on_floor, static=True)
            seen = camera.project(T_arena_camera.inverse() @ ring) + 0.5
            if np.isfinite(seen).all():
                in_picture = rr.LineStrips2D([seen], radii=rr.Radius.ui_points(1.0), **look)
                self._stream.log(f"{OVERLAY}/{where}", in_picture, static=True)

    def _outlines(self) -> list[tuple[str, Array, int]]:
        """Walls and zones on the floor: name (empty for the walls), corners (n, 2) mm, colour."""
        walls = self._origin.arena.outline_mm()
        zones = zip(self._origin.zones, cycle(PALETTE), strict=False)
        drawn = [(zone.name, zone.outline_mm(), colour) for zone, colour in zones]
        return ([("", walls, _WALL)] if len(walls) else []) + drawn

    def _log_skeleton(
        self, rows: Rows, index: NDArray[np.int64], elapsed: NDArray[np.int64]
    ) -> None:
        """Joints and bones in the arena and over the picture; a frame without a pose shows none."""
        track = rows.track
        skeleton = rows.track.skeleton
        names = [rr.AnnotationInfo(id=j, label=name) for j, name in enumerate(skeleton.names)]
        bones = rr.ClassDescription(
            info=rr.AnnotationInfo(id=1, label=skeleton.name, color=BONE_COLOUR),
            keypoint_annotations=names,
        )
        dot_m = dot_mm(skeleton) / MM_PER_UNIT
        pt = dot_pt(skeleton)
        radii = {
            SKELETON: (dot_m, dot_m / 2.0),
            OVERLAY: (rr.Radius.ui_points(pt), rr.Radius.ui_points(pt / 3.0)),
        }
        for entity, dot, line in (
            (SKELETON, rr.Points3D, rr.LineStrips3D),
            (OVERLAY, rr.Points2D, rr.LineStrips2D),
        ):
            thick, thin = radii[entity]
            self._stream.log(entity, rr.AnnotationContext([bones]), static=True)
            self._stream.log(
                f"{entity}/joints",
                dot.from_fields(radii=thick, colors=JOINT_COLOUR, show_labels=False),
                static=True,
            )
            self._stream.log(
                f"{entity}/bones", line.from_fields(radii=thin, colors=BONE_COLOUR), static=True
            )
        look = rr.Ellipsoids3D.from_fields(
            colors=_SPREAD, fill_mode="majorwireframe", line_radii=0.0003
        )
        self._stream.log(UNCERTAINTY, look, static=True)
        animal = self._origin.animal_size
        carriers = log_body(self._stream, skeleton, animal) if skeleton.surface else []
        for part in blocks(track.n_frames, _BLOCK):
            when = timeline(index[part], elapsed[part])
            seen = track[part].posed
            self._send_points(
                SKELETON,
                when,
                track.joints_mm[part][seen] / 1000.0,
                seen,
                rr.Points3D,
                rr.LineStrips3D,
            )
            send_body(self._stream, track, part, when, carriers)
            self._send_spread(when, track.joints_mm[part][seen], track.sd_xyz_mm[part][seen], seen)
            # the 2D view counts from the corner of the picture, we from a pixel's centre
            self._send_points(
                OVERLAY, when, track.uv_px[part][seen] + 0.5, seen, rr.Points2D, rr.LineStrips2D
            )
            self._flush()  # or hours of it wait in memory

    def _send_points(
        self,
        entity: str,
        when: list[rr.TimeColumn],
        points: Array,
        seen: NDArray[np.bool_],
        dot: Any,
        line: Any,
    ) -> None:
        """Points (k, J, 2 or 3) of the k posed frames, as dots and as bones.

        `seen` marks the k frames out of those of `when`.
        """
        skeleton = self._origin.skeleton
        size = points.shape[-1]
        edges = np.array(skeleton.edges, np.int64).reshape(-1, 2)
        dots = dot.columns(
            positions=points.reshape(-1, size),
            class_ids=np.ones(points.shape[0] * points.shape[1], np.uint16),
            keypoint_ids=np.tile(np.arange(skeleton.n_joints, dtype=np.uint16), len(points)),
        )
        strips = line.columns(strips=points[:, edges].reshape(-1, 2, size).astype(np.float32))
        n_dots = np.where(seen, skeleton.n_joints, 0)
        n_bones = np.where(seen, len(edges), 0)
        self._stream.send_columns(f"{entity}/joints", when, [*dots.partition(n_dots)])
        self._stream.send_columns(f"{entity}/bones", when, [*strips.partition(n_bones)])

    def _send_spread(
        self, when: list[rr.TimeColumn], joints_mm: Array, sd_mm: Array, seen: NDArray[np.bool_]
    ) -> None:
        """Ellipsoid around each joint that holds it with 95 %; joints_mm, sd_mm (k, J, 3).

        The half axes are 2.795 standard deviations of a Gaussian in space (a chi distribution with
        3 degrees of freedom). `seen` marks the k frames out of those of `when`.
        """
        size = _HOLDS_95 * np.nan_to_num(sd_mm).reshape(-1, 3) / MM_PER_UNIT
        spheres = rr.Ellipsoids3D.columns(
            half_sizes=size, centers=joints_mm.reshape(-1, 3) / MM_PER_UNIT
        )
        n_spheres = np.where(seen, joints_mm.shape[1], 0)
        self._stream.send_columns(UNCERTAINTY, when, [*spheres.partition(n_spheres)])

    def _log_root(self, rows: Rows, index: NDArray[np.int64], elapsed: NDArray[np.int64]) -> None:
        """Axes of the body's base; while the animal is lost they stay where it was seen last."""
        track = rows.track
        seen = track.posed
        if not seen.any():
            return
        self._stream.log(ROOT, rr.TransformAxes3D(0.02), static=True)
        for part in blocks(track.n_frames, _BLOCK):
            where = part.start + np.flatnonzero(seen[part])
            if not len(where):
                continue
            xyzw = np.roll(so3.quaternion(track.root_rotation[where]), -1, axis=-1)
            columns = rr.Transform3D.columns(
                translation=track.root_mm[where] / 1000.0, quaternion=xyzw
            )
            self._stream.send_columns(ROOT, timeline(index[where], elapsed[where]), [*columns])

    def _log_candidates(
        self, seen: Observations, index: NDArray[np.int64], elapsed: NDArray[np.int64]
    ) -> None:
        """The bones of every pose that a frame thought possible, each rank in its colour."""
        edges = np.array(seen.skeleton.edges, np.int64).reshape(-1, 2)
        for h, colour in zip(range(seen.known.shape[1]), cycle(PALETTE), strict=False):
            entity = f"{CANDIDATES}/{h + 1}"
            look = rr.LineStrips3D.from_fields(radii=0.0008, colors=_rgba([colour]))
            self._stream.log(entity, look, static=True)
            for part in blocks(len(seen), _BLOCK):
                known = seen.known[part, h]
                joints = seen[part].joints_as(h, range(seen.skeleton.n_joints))[known] / MM_PER_UNIT
                strips = rr.LineStrips3D.columns(strips=joints[:, edges].reshape(-1, 2, 3))
                when = timeline(index[part], elapsed[part])
                self._stream.send_columns(
                    entity, when, [*strips.partition(np.where(known, len(edges), 0))]
                )

    def _log_worst(self, rows: Rows, index: NDArray[np.int64], elapsed: NDArray[np.int64]) -> None:
        """The frames with the largest predicted error, as notes to jump to."""
        error = np.nan_to_num(rows.track.predicted_error_mm)
        worst = np.sort(np.argsort(-error, kind="stable")[:_WORST])
        worst = worst[error[worst] > 0]
        if len(worst) == 0:
            return
        notes = [f"frame {index[k]}: joint error to be expected {error[k]:.1f} mm" for k in worst]
        columns = rr.TextLog.columns(text=notes, level=["INFO"] * len(notes))
        self._stream.send_columns("log/worst", timeline(index[worst], elapsed[worst]), [*columns])

    def _log_lanes(self, rows: Rows, bouts: pd.DataFrame, words: Sequence[str]) -> None:
        """The lane of the actions, and the lane of frames to distrust."""
        spans = list(
            zip(
                bouts["start_frame"],
                bouts["stop_frame"],
                bouts["start_s"],
                bouts["stop_s"],
                bouts["action"],
                strict=True,
            )
        )
        end = (int(rows.frame_index[-1]) + 1, float(stop_times(rows.time_s)[-1]))
        own = vocabulary.action_colours(words)
        self._log_lane(ACTIONS, spans, {word: int(own[word][1:], 16) for word in own}, end)
        count = frame_count(rows.frame_index)
        time = rows.time_s
        stop = stop_times(rows.time_s)
        marked = [
            (int(count[a]), int(count[b]), float(time[a]), float(stop[b - 1]), str(flag))
            for a, b, flag in constant_runs(rows.track.flag)
            if flag
        ]
        self._log_lane(TRACKING, marked, _FLAG_COLOURS, end)

    def _log_lane(
        self, entity: str, spans: Sequence[Any], vocabulary: dict[str, int], end: tuple[int, float]
    ) -> None:
        """One lane of half-open spans in order of time.

        A span is (start_frame, stop_frame, start_s, stop_s, word).
        """
        labels = [word.replace("_", " ") for word in vocabulary]
        kind = rr.StateConfiguration(
            values=list(vocabulary), labels=labels, colors=_rgba(list(vocabulary.values()))
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
        self._stream.send_columns(
            entity,
            timeline(np.array(frames), elapsed),
            [*rr.StateChange.columns(state=list(words))],
        )


def corrected_entity(entity: str) -> str:
    """Entity path in the replay of corrections of what the session's own replay keeps at `entity`.

    It lies below the same camera or arena, so that both are drawn in one scene.

    Args:
        entity: the path in the session's own replay.
    """
    for above in (f"{IMAGE}/", "arena/"):
        if entity.startswith(above):
            return f"{above}corrected/{entity.removeprefix(above)}"
    return f"corrected/{entity}"


def _let_go(stream: Any) -> None:
    """Never close a stream whose thread has died, for that would wait for it for ever.

    Neither when nobody uses it any more nor at the end of the process, which closes its file.

    Args:
        stream: a Rerun stream.
    """
    atexit.unregister(rr.rerun_shutdown)
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(stream))


class _Renamed:
    """A Rerun stream whose entities are those of corrections."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._to = stream

    def log(self, entity: str, *what: Any, **how: Any) -> None:
        self._to.log(corrected_entity(entity), *what, **how)

    def send_columns(self, entity: str, *what: Any, **how: Any) -> None:
        self._to.send_columns(corrected_entity(entity), *what, **how)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._to, name)


def _row(boxes: Boxes | None, k: int) -> Boxes | None:
    return None if boxes is None else boxes[k]


def _rgba(vocabulary: Sequence[int]) -> NDArray[np.uint32]:
    """0xRRGGBB to what Rerun takes as colours without mistaking a list of numbers for channels."""
    return np.array([colour << 8 | 0xFF for colour in vocabulary], np.uint32)
