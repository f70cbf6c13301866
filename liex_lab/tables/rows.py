"""Rows of a session's tables (frames, poses, rotations, gaps, flips, bouts) from a track.

Intervals are half open: a frame is valid until the next one; before a gap or at the end, for one
median step. A joint's score is P(|e| < r) of an isotropic Gaussian in space, the chi distribution
with 3 degrees of freedom: erf(x / sqrt(2)) - sqrt(2 / π) x exp(-x^2 / 2), x = r / sd. The columns
are described in `schema`.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from scipy.special import erf

from liex_lab.actions.ethogram import Ethogram, runs_of
from liex_lab.arrays import Array, NDArray
from liex_lab.errors import SessionError
from liex_lab.geometry import so3
from liex_lab.recordings.timestamps import Gap, frames_apart, rounded_step
from liex_lab.recordings.timestamps import median_step as recorded_step
from liex_lab.runtime.memory import Allocator, blocks, put
from liex_lab.scene.scene import UNKNOWN, Arena
from liex_lab.scene.zones import Zone, joint_of, zone_names
from liex_lab.tables.schema import (
    BOUTS,
    FRAMES,
    ROOT_COVARIANCES,
    ROWS_PER_GROUP,
    Block,
    to_pandas,
)
from liex_lab.tracking.track import Crossing, Flip, Track

# start_s, stop_s, start_frame, stop_frame, frames missing, reason, x mm, y mm
_Found = tuple[float, float, int, int, int, str, float, float]
_SPAN_NAMES = ("start_s", "stop_s", "start_frame", "stop_frame")
_NOWHERE = (float("nan"), float("nan"))
HIDDEN = "hidden"
NOT_FROM_CAMERA = (
    "no_depth",
    "repeated",
    HIDDEN,
    "tracker_lost",
)  # reasons of gaps not caused by the camera
ROUNDED_S = 5e-4  # times are typed with three decimals
NEAR = 0.1  # radius of a joint's score, as a share of the spine


@dataclass(frozen=True)
class Rows:
    """A track with the further contents of its rows: frame indices, names, and the arena.

    Attributes:
        track: one animal's track of n frames.
        frame_index: (n,) index of each frame in the recording.
        session_id: name of the session.
        individual: name of the animal within the session.
        camera_gaps: irregularities of the recording's time.
        arena: outline of the floor, within which the animal can be.
        zones: zones of the plan, arena frame.
        allocate: allocator of the columns of the table `frames`.
        others: (n, 3) centres of each other animal of the arena, mm; NaN without a pose.
    """

    track: Track
    frame_index: NDArray[np.int64]
    session_id: str
    individual: str
    camera_gaps: Sequence[Gap] = ()
    arena: Arena = UNKNOWN
    zones: Sequence[Zone] = ()
    allocate: Allocator = np.empty
    others: Sequence[Array] = ()

    @property
    def time_s(self) -> Array:
        """(n,) s since the first frame."""
        return seconds(self.track.times_ns)

    def frames(self) -> Iterator[Block]:
        """The table `frames`, in blocks of 100 000 rows."""
        for part in self._parts(1):
            yield {
                name: column if isinstance(column, str) else column[part]
                for name, column in self._frame_columns.items()
            }

    @property
    def wall_distance_mm(self) -> Array:
        """(n,) distance of the animal from the nearest wall, mm, as in the table `frames`."""
        return np.asarray(self._frame_columns["wall_distance_mm"])

    @cached_property
    def frames_table(self) -> pd.DataFrame:
        """The table `frames`, a data frame of n rows; columns of the track are not copied."""
        return to_pandas(FRAMES, self._frame_columns, copy=False)

    def poses(self) -> Iterator[Block]:
        """The table `poses`, one row per frame and joint, in blocks of about 100 000 rows."""
        return (self._pose_rows(part) for part in self._parts(self.track.skeleton.n_joints))

    def rotations(self) -> Iterator[Block]:
        """The table `rotations`: per frame a row of the root, then one row per joint.

        The root's row contains its rigid transform T_arena_root. Blocks have about 100 000 rows.
        """
        return (self._rotation_rows(part) for part in self._parts(self.track.skeleton.n_joints + 1))

    @cached_property
    def _frame_columns(self) -> Block:
        """The columns (n,) of the table `frames`, computed once."""
        track = self.track
        missing = self.missing_before()
        pulses = np.cumsum(missing)
        codes: dict[str, dict[str, int]] = {"zone": {}, "flag": {}}
        made: dict[str, NDArray[Any]] = {}
        for part in self._parts(1):
            rows = np.arange(part.start, min(part.stop, track.n_frames))
            wall, zones = self._in_arena(part)
            values = {
                **self._when(part, 1),
                "gap_before": missing[part],
                "pulse_index": rows + pulses[part],
                "wall_distance_mm": wall,
                "spine_mm": track[part].spine_mm,
            }
            for name, words in (("zone", zones), ("flag", track.flag[part].tolist())):
                known = codes[name]
                numbers = [known.setdefault(word, len(known)) for word in words]
                values[name] = np.array(numbers, np.int16)
            put(made, part, values, track.n_frames, self.allocate)
        texts = {
            name: pa.DictionaryArray.from_arrays(made.pop(name), list(known))
            for name, known in codes.items()
        }
        return {
            **self._keys,
            **made,
            **texts,
            "time_ns": track.times_ns,
            "predicted_error_mm": track.predicted_error_mm,
            "residual_mm": track.residual_mm,
            "n_foreground_px": track.n_foreground_px,
            **{f"centroid_{a}_mm": track.centroid_mm[:, k] for k, a in enumerate("xyz")},
            **{f"centroid_{a}_px": track.centroid_px[:, k] for k, a in enumerate("uv")},
            "scale": track.scale,
            "p_flip": track.p_flip,
            "bridged": track.bridged,
            "n_animals": track.n_animals,
        }

    def _in_arena(self, part: slice) -> tuple[Array, list[str]]:
        """Distance (m,) mm of some frames' centroids from the nearest wall, and their zones."""
        names = self.track.skeleton.names
        joints = {one: joint_of(one, names) for zone in self.zones if (one := zone.part)}
        xy = self.track.centroid_mm[part, :2]
        parts = {one: self.track.joints_mm[part, at, :2] for one, at in joints.items()}
        return self.arena.wall_distance_mm(xy), zone_names(self.zones, xy, parts)

    def _pose_rows(self, part: slice) -> Block:
        track = self.track[part]
        n_joints = self.track.skeleton.n_joints
        return {
            **self._keys,
            **self._when(part, n_joints),
            "joint": repeated(track.skeleton.names, track.n_frames),
            **columns_of(track.joints_mm, track.uv_px),
            "score": nearness(
                np.sqrt((track.sd_xyz_mm**2).mean(axis=-1)), NEAR * track.spine_mm[:, None]
            ).ravel(),
            "sd_mm": track.sd_mm.ravel(),
            "sd_xy_mm": track.sd_xy_mm.ravel(),
            "sd_z_mm": track.sd_z_mm.ravel(),
        }

    def _rotation_rows(self, part: slice) -> Block:
        track = self.track[part]
        n_rows = self.track.skeleton.n_joints + 1
        turn = np.concatenate([_log(track.root_rotation)[:, None], track.angles_rad], axis=1)
        sd_root = track.sd_root
        spread = np.concatenate([sd_root[:, None, :3], track.sd_angles_rad], axis=1)
        shift = np.full(turn.shape, np.nan)
        sd_shift = np.full(turn.shape, np.nan)
        shift[:, 0] = track.root_mm
        sd_shift[:, 0] = sd_root[:, 3:]
        together = np.full((*turn.shape[:2], len(ROOT_COVARIANCES)), np.nan)
        together[:, 0] = track.cov_root[:, *np.triu_indices(6, 1)]
        return {
            **self._keys,
            **self._when(part, n_rows),
            "joint": repeated(["root", *track.skeleton.names], len(turn)),
            **_xyz("w{}_rad", turn),
            **_xyz("sd_w{}_rad", spread),
            **_xyz("t{}_mm", shift),
            **_xyz("sd_t{}_mm", sd_shift),
            **{name: together[..., k].ravel() for k, name in enumerate(ROOT_COVARIANCES)},
        }

    def missing_before(self) -> NDArray[np.int64]:
        """(n,) number of frames that the camera did not deliver just before each frame."""
        missing = np.zeros(self.track.n_frames, np.int64)
        for gap in self.camera_gaps:
            after = int(np.searchsorted(self.track.times_ns, gap.stop_ns))
            if gap.n_frames_missing and after < len(missing):
                missing[after] += gap.n_frames_missing
        return missing

    def gaps(self) -> Block:
        """The table `gaps`, in order of time.

        Undelivered frames, frames with corrected timestamps, and stretches of frames without a
        measured pose.
        """
        time = self.time_s
        count = frame_count(self.frame_index)
        found = self._camera_gaps()
        observed = self.track.observed
        lost = np.full(len(time), len(NOT_FROM_CAMERA), np.uint8)
        for k, name in enumerate(NOT_FROM_CAMERA[:-1], 1):
            lost[self.track.flagged(name)] = k
        lost[observed] = 0
        observed_rows = np.flatnonzero(observed)
        stops = stop_times(time)
        for start, stop, number in constant_runs(lost):
            if not number:
                continue
            reason = NOT_FROM_CAMERA[int(number) - 1]
            span = (time[start], stops[stop - 1], int(count[start]), int(count[stop]))
            position = _NOWHERE
            if reason == HIDDEN and len(observed_rows):
                # the last observed position before, or the first one after it
                last = observed_rows[max(0, int(np.searchsorted(observed_rows, start)) - 1)]
                x, y = self.track.centroid_mm[last, :2]
                off = [
                    np.linalg.norm(one[[last, start], :2] - [x, y], axis=1) for one in self.others
                ]
                # it did not hide where another animal was over it
                under = (np.array(off) < self.track.spine_mm[last]).any()
                position = _NOWHERE if under else (float(x), float(y))
            found.append((*span, stop - start, reason, *position))
        found.sort()
        names = (*_SPAN_NAMES, "n_frames_missing", "reason", "x_mm", "y_mm")
        values: Iterable[Any] = zip(*found, strict=True) if found else ([] for _ in names)
        kinds = (float, float, np.int64, np.int64, np.int64, str, float, float)
        return {
            **self._keys,
            **{n: np.array(v, k) for n, v, k in zip(names, values, kinds, strict=True)},
        }

    def flips(self, flips: Sequence[Flip]) -> Block:
        """The table `flips`, a block with one row for each flip.

        Args:
            flips: spans of exchanged or uncertain head and tail, in order of time.
        """
        return {
            **self._spans(flips),
            "p_flip": np.array([flip.p_flip for flip in flips], float),
            "applied": np.array([flip.applied for flip in flips], bool),
            "source": np.array([flip.source for flip in flips], str),
            "undone_at": np.array([flip.undone_at for flip in flips], str),
        }

    def crossings(self, crossings: Sequence[Crossing]) -> Block:
        """The table `crossings`, a block with one row for each crossing.

        Args:
            crossings: in which the animal takes part, in order of time.
        """
        return {
            **self._spans(crossings),
            "animals": np.array(
                [";".join(f"animal{k + 1}" for k in one.animals) for one in crossings], str
            ),
            "p_swap": np.array([one.p_swap for one in crossings], float),
            **{
                name: np.array([getattr(one, name) for one in crossings], str)
                for name in ("decided_by", "reviewed_by", "reviewed_at")
            },
        }

    def _camera_gaps(self) -> list[_Found]:
        """Irregularities of the recording's time, as rows of the table `gaps`."""
        time = self.time_s
        found = []
        stops = stop_times(time)
        for gap in self.camera_gaps:
            lost = bool(gap.n_frames_missing)
            row = int(np.searchsorted(self.track.times_ns, (gap.stop_ns if lost else gap.start_ns)))
            if row < len(time):
                begin = stops[row - 1] if lost and row else time[row]
                span = (float(begin), float(time[row] if lost else stops[row]))
                frame = int(self.frame_index[row])
                known = (frame, frame + (not lost), gap.n_frames_missing, gap.reason)
                found.append((*span, *known, *_NOWHERE))
        return found

    def _spans(self, spans: Sequence[Flip] | Sequence[Crossing]) -> Block:
        """The keys of spans of rows, and when they start and stop."""
        time, count = self.time_s, frame_count(self.frame_index)
        stops = stop_times(time)
        return {
            **self._keys,
            "start_s": np.array([time[one.start] for one in spans]),
            "stop_s": np.array([stops[one.stop - 1] for one in spans]),
            "start_frame": np.array([count[one.start] for one in spans], np.int64),
            "stop_frame": np.array([count[one.stop] for one in spans], np.int64),
        }

    @property
    def _keys(self) -> dict[str, str]:
        return {"session_id": self.session_id, "individual": self.individual}

    def _when(self, part: slice, repeat: int) -> dict[str, Any]:
        times = self.track.times_ns
        since = np.diff(times[max(part.start - 1, 0) : part.stop]) * 1e-9
        columns = {
            "frame_index": self.frame_index[part],
            "time_s": (times[part] - times[:1]).astype(np.float64) * 1e-9,
            "dt_s": since if part.start else np.concatenate([[np.nan], since])[: len(times[part])],
        }
        return {name: np.repeat(column, repeat) for name, column in columns.items()}

    def _parts(self, rows_per_frame: int) -> Iterator[slice]:
        """Blocks of frames with about 100 000 rows."""
        return blocks(max(self.track.n_frames, 1), max(1, ROWS_PER_GROUP // rows_per_frame))


def repeated(names: Sequence[str], n_frames: int) -> pa.DictionaryArray:
    """The column of names of a table with one row per frame and joint."""
    return pa.DictionaryArray.from_arrays(np.tile(np.arange(len(names)), n_frames), list(names))


def columns_of(xyz_mm: Array, uv_px: Array) -> Block:
    """Columns x_mm ... v_px, one row per frame and joint, of positions (n, J, 3) and (n, J, 2)."""
    return {
        **_xyz("{}_mm", xyz_mm),
        **{f"{axis}_px": uv_px[:, :, k].ravel() for k, axis in enumerate("uv")},
    }


def _xyz(name: str, values: Array) -> dict[str, Array]:
    return {name.format(axis): values[:, :, k].ravel() for k, axis in enumerate("xyz")}


def _log(rotation: Array) -> Array:
    """Rotation vectors (n, 3) of rotations (n, 3, 3), NaN where the rotation is NaN."""
    known = np.isfinite(rotation).all(axis=(1, 2))
    omega = np.full((len(rotation), 3), np.nan)
    omega[known] = so3.log(rotation[known])
    return omega


def nearness(sd: Array, radius: Array) -> Array:
    """Probability that a Gaussian point in space is within a radius of its mean.

    The chi distribution with 3 degrees of freedom, see the module.

    Args:
        sd: standard deviation along each axis, mm, any shape.
        radius: mm, a shape that broadcasts with `sd`.

    Returns:
        Probabilities; NaN where `sd` or `radius` is NaN.
    """
    r = radius / np.maximum(sd, 1e-9)
    return np.asarray(erf(r / np.sqrt(2.0)) - np.sqrt(2.0 / np.pi) * r * np.exp(-0.5 * r * r))


def seconds(times_ns: NDArray[np.int64]) -> Array:
    """Seconds (n,) since the first of some timestamps (n,), integer nanoseconds."""
    return (times_ns - times_ns[:1]).astype(np.float64) * 1e-9


def median_step(time_s: Array) -> float:
    """The median time between frames, s; 0 for a single frame.

    Args:
        time_s: (n,) s, increasing.

    Returns:
        Median of the steps, s; for rounded timestamps their mean, see `timestamps.rounded_step`.
    """
    if len(time_s) < 2:
        return 0.0
    return rounded_step(_in_ns(time_s)) * 1e-9 or float(np.median(np.diff(time_s)))


def _in_ns(time_s: Array) -> NDArray[np.int64]:
    return np.rint(np.asarray(time_s) * 1e9).astype(np.int64)


def gap_follows(time_s: Array) -> NDArray[np.bool_]:
    """Whether frames are missing after a frame: the next step is longer than 1.5 median steps.

    Args:
        time_s: (n,) s, increasing.

    Returns:
        (n,) bool, True also at the last frame.
    """
    times_ns = _in_ns(time_s)
    return np.append(frames_apart(times_ns, recorded_step(times_ns)) > 1, True)[: len(time_s)]


def stop_times(time_s: Array) -> Array:
    """End of each frame's validity: at the next frame, or one median step later.

    The latter before a gap and at the end of the recording.

    Args:
        time_s: (n,) s, increasing.

    Returns:
        (n,) s.
    """
    alone = gap_follows(time_s)
    usual_s = median_step(time_s)  # in this order a day needs the least memory
    stops: Array = np.append(time_s[1:], np.nan)[: len(time_s)]
    stops[alone] = time_s[alone] + usual_s
    return stops


def frame_count(frame_index: NDArray[np.int64]) -> NDArray[np.int64]:
    """The frame index of every row and of the row after the last, (n + 1,) int64.

    Args:
        frame_index: (n,) index of each frame in the recording.
    """
    return np.append(frame_index, frame_index[-1:] + 1)


def rows_between(time_s: Array, start_s: float, stop_s: float, what: str) -> tuple[int, int]:
    """First row of a span of time, and the first row after it.

    Args:
        time_s: (n,) times of the frames, s since the first.
        start_s: start, s since the first frame.
        stop_s: stop, s, exclusive.
        what: name of the span, for the error message.

    Raises:
        SessionError: the span has no frame.
    """
    first, last = (int(np.searchsorted(time_s, at - ROUNDED_S)) for at in (start_s, stop_s))
    if not (start_s < stop_s and first < last):
        raise SessionError(
            f"{what} is from a time to a later one, in seconds since the first frame, and holds a "
            f"frame; got {start_s:g} to {stop_s:g} in a session of 0 to {time_s[-1]:.3f} s"
        )
    return first, last


def constant_runs(labels: NDArray[Any]) -> list[tuple[int, int, Any]]:
    """Runs of equal labels (n,), as (start, stop, label), stop exclusive; empty for no labels."""
    if len(labels) == 0:
        return []
    return [(int(a), int(b), label) for a, b, label in zip(*runs_of(labels), strict=True)]


def bout_rows(ethogram: Ethogram, frames: pd.DataFrame, model_hash: str) -> pd.DataFrame:
    """The columns of the table `bouts` that every session has, one row for each bout.

    Args:
        ethogram: one animal's bouts.
        frames: the table `frames` of the ethogram's times, at least one row.
        model_hash: hash of the model that named the bouts; '' for a rule.
    """
    times_ns = frames["time_ns"].to_numpy(np.int64)
    count = frame_count(frames["frame_index"].to_numpy(np.int64))
    start_ns = np.array([bout.start_ns for bout in ethogram], np.int64)
    stop_ns = np.array([bout.stop_ns for bout in ethogram], np.int64)
    block = {
        "session_id": str(frames["session_id"].iloc[0]),
        "individual": str(frames["individual"].iloc[0]),
        "action": [bout.action for bout in ethogram],
        "start_s": (start_ns - times_ns[0]) * 1e-9,
        "stop_s": (stop_ns - times_ns[0]) * 1e-9,
        "duration_s": (stop_ns - start_ns) * 1e-9,
        "start_frame": count[np.searchsorted(times_ns, start_ns)],
        "stop_frame": count[np.searchsorted(times_ns, stop_ns)],
        "score": [bout.score for bout in ethogram],
        "source": ethogram.source,
        "model_hash": model_hash,
    }
    return to_pandas(BOUTS, block)
