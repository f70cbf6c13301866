"""Reader of a bout's measures: path, speeds, turns, heights, tail beats, body wave.

The list of a swimming animal's bouts follows ZebraZoom (Mirat et al. 2013): bends, oscillations,
tail-beat frequency, first bend, asymmetry. The speed of the body wave is a third of the length over
the lag at which the curvatures of the middle and rear third correlate best (cross-correlation on a
grid ten times as fine as the frames).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.body import STANDS, SWIMS, kind_of
from liex_lab.behaviour.kinematics import segments, smallest_turn
from liex_lab.tables.rows import median_step, stop_times

Array = NDArray[np.float64]
_MOST_LAG_S = 0.25  # a wave that takes longer for a third of the body is none
# of the curvatures of two thirds of the body, for a wave that runs from one to the other
_LEAST_CORRELATION = 0.5


class BoutReader:
    """The table `kinematics` as arrays, from which rows [start, stop) of a bout are measured."""

    def __init__(self, kinematics: pd.DataFrame) -> None:
        self._table = kinematics
        self.frame_index = kinematics["frame_index"].to_numpy()
        self.time_s = kinematics["time_s"].to_numpy(float)
        self.hold_s = stop_times(self.time_s) - self.time_s
        step = median_step(self.time_s)
        self.fps = 1.0 / step if step > 0 else 0.0
        self.place = kinematics[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
        self.kind = kind_of(kinematics)
        length = self._of("length_mm")
        self.length_mm = float(np.nanmedian(length)) if np.isfinite(length).any() else np.nan
        self._columns: dict[str, Array] = {}

    def rows_of(self, bouts: pd.DataFrame) -> list[tuple[int, int]]:
        """The rows [start, stop) of every bout, at least one row each.

        Args:
            bouts: the table `bouts`; start_frame and stop_frame are the camera's counts.
        """
        starts = np.searchsorted(self.frame_index, bouts["start_frame"].to_numpy())
        stops = np.searchsorted(self.frame_index, bouts["stop_frame"].to_numpy())
        n = len(self.frame_index)
        return [
            (min(int(a), n - 1), min(max(int(b), int(a) + 1), n))
            for a, b in zip(starts, stops, strict=True)
        ]

    def measure(self, start: int, stop: int) -> dict[str, float]:
        """All measures of one bout but since_last_s, which needs the bout before.

        Args:
            start: first row of the bout.
            stop: row after its last.

        Returns:
            Column name to value; NaN where nothing is known.
        """
        found = {**self.motion(start, stop), **self.turn(start, stop)}
        if self.kind == SWIMS:
            return found | self._tail(start, stop)
        return found | self.height(start, stop) if self.kind == STANDS else found

    def since_last(self, bouts: pd.DataFrame, spans: Sequence[tuple[int, int]]) -> Array:
        """(n,) time from the end of the last bout of the same action, s.

        It is NaN at the first one, and where the animal was out of sight in between.

        Args:
            bouts: the table `bouts`, in order of time.
            spans: the rows of the n bouts, see `rows_of`.
        """
        number = segments(self.time_s, np.isfinite(self.place[:, 0]))
        last: dict[str, int] = {}
        out = np.full(len(bouts), np.nan)
        begin = bouts["start_s"].to_numpy(float)
        end = bouts["stop_s"].to_numpy(float)
        for k, action in enumerate(bouts["action"]):
            before = last.get(action)
            if (
                before is not None
                and number[spans[before][1] - 1] == number[min(spans[k][0], len(number) - 1)]
            ):
                out[k] = begin[k] - end[before]
            last[action] = k
        return out

    def _of(self, name: str) -> Array:
        return self._table[name].to_numpy(float)

    def column(self, name: str, start: int, stop: int) -> Array:
        """A column of the table `kinematics` within a bout.

        Args:
            name: of the column.
            start: first row of the bout.
            stop: row after its last.
        """
        if name not in self._columns:
            self._columns[name] = self._of(name)
        return self._columns[name][start:stop]

    def seconds(self, start: int, stop: int) -> float:
        """How long a bout lasts, s.

        Args:
            start: first row of the bout.
            stop: row after its last.
        """
        return float(self.time_s[stop - 1] + self.hold_s[stop - 1] - self.time_s[start])

    def motion(self, start: int, stop: int) -> dict[str, float]:
        """Path, displacement and speeds of a bout, mm and mm/s.

        Args:
            start: first row of the bout.
            stop: row after its last.
        """
        speed = self.column("speed_mm_s", start, stop)
        step = self.column("step_mm", start, stop)
        known = np.flatnonzero(np.isfinite(speed))
        path = float(np.nansum(step))
        timed = float(self.hold_s[start:stop][known].sum())
        seen = start + np.flatnonzero(np.isfinite(self.place[start:stop, 0]))
        displacement = (
            self.place[seen[-1]] - self.place[seen[0]] if len(seen) else np.full(3, np.nan)
        )
        top = known[speed[known].argmax()] if len(known) else None
        return {
            "path_mm": path,
            "path_bl": path / self.length_mm,
            "displacement_mm": float(
                np.linalg.norm(displacement if self.kind != STANDS else displacement[:2])
            ),
            "rise_mm": float(displacement[2]),
            "mean_speed_mm_s": path / timed if timed > 0 else np.nan,
            "median_speed_mm_s": _median(speed),
            "peak_speed_mm_s": np.nan if top is None else float(speed[top]),
            "peak_speed_sd_mm_s": np.nan
            if top is None
            else float(self.column("speed_sd_mm_s", start, stop)[top]),
            "time_to_peak_s": np.nan
            if top is None
            else float(self.time_s[start + top] - self.time_s[start]),
        }

    def turn(self, start: int, stop: int) -> dict[str, float]:
        """Turning, pitch and bend of a bout, rad.

        Args:
            start: first row of the bout.
            stop: row after its last.
        """
        heading = self.column("heading_rad", start, stop)
        sd = self.column("heading_sd_rad", start, stop)
        known = np.isfinite(heading)
        turned = np.append(0.0, np.cumsum(smallest_turn(np.diff(heading[known]))))
        pitch = self.column("body_pitch_rad", start, stop)
        bend = self.column("bend_rad", start, stop)
        some = bool(known.any())
        ends = sd[known][[0, -1]] if some else np.full(2, np.nan)
        return {
            "net_turn_rad": float(turned[-1]) if some else np.nan,
            "net_turn_sd_rad": float(np.hypot(*ends)),
            "heading_range_rad": float(np.ptp(turned)) if some else np.nan,
            "mean_pitch_rad": _mean(pitch),
            "bend_max_rad": _max(np.abs(bend)),
        }

    def height(self, start: int, stop: int) -> dict[str, float]:
        """Heights of the nose of an animal that stands on the floor, mm.

        Args:
            start: first row of the bout.
            stop: row after its last.
        """
        nose = self.column("nose_height_mm", start, stop)
        known = np.flatnonzero(np.isfinite(nose))
        top = known[nose[known].argmax()] if len(known) else None
        return {
            "peak_nose_height_mm": np.nan if top is None else float(nose[top]),
            "peak_nose_over_rump_mm": _max(self.column("nose_over_rump_mm", start, stop)),
            "time_to_peak_height_s": np.nan
            if top is None
            else float(self.time_s[start + top] - self.time_s[start]),
        }

    def _tail(self, start: int, stop: int) -> dict[str, float]:
        angle = self.column("tail_angle_rad", start, stop)
        bends = self.column("tail_extreme_rad", start, stop)
        beat = self.column("tail_beat_hz", start, stop)
        hold = self.hold_s[start:stop]
        at = np.flatnonzero(np.isfinite(bends))
        size = np.abs(bends[at])
        n = len(at)
        duration = self.seconds(start, stop)
        left = max(_max(angle), 0.0)
        right = max(_max(-angle), 0.0)
        return {
            "n_bends": n,
            "n_oscillations": n / 2.0,
            "tail_beat_hz": n / 2.0 / duration,
            "tail_beat_max_hz": _max(beat),
            "tail_beat_mean_hz": _mean(beat),
            "tail_beat_median_hz": _median(beat),
            "tail_max_rad": _max(size),
            "tail_mean_rad": _mean(size),
            "tail_median_rad": _median(size),
            "first_bend_s": float(self.time_s[start + at[0]] - self.time_s[start]) if n else np.nan,
            "first_bend_rad": float(bends[at[0]]) if n else np.nan,
            "second_over_first": float(bends[at[1]] / bends[at[0]]) if n > 1 else np.nan,
            "tail_angle_mean_rad": _mean_over(angle, hold),
            "tail_angle_mean_abs_rad": _mean_over(np.abs(angle), hold),
            "tail_symmetry": min(left, right) / max(left, right)
            if max(left, right) > 0
            else np.nan,
            "wave_speed_mm_s": self._wave(start, stop) if n > 1 else np.nan,
        }

    def _wave(self, start: int, stop: int) -> float:
        """Speed of the bend that runs from the middle third of the body to the rear one, mm/s."""
        middle, rear = (self.column(f"bend_{part}_rad", start, stop) for part in ("middle", "rear"))
        if not (np.isfinite(middle).all() and np.isfinite(rear).all()) or stop - start < 8:
            return np.nan
        time = self.time_s[start:stop]
        fine: Array = np.arange(
            time[0], time[-1], 0.1 / self.fps
        )  # true times, on an even grid ten times as fine
        a, b = (np.interp(fine, time, curve) - curve.mean() for curve in (middle, rear))
        most = min(int(_MOST_LAG_S * 10 * self.fps), len(fine) // 2)
        agreement = [_correlation(a[: len(a) - lag], b[lag:]) for lag in range(most)]
        best = int(np.argmax(agreement)) if agreement else 0
        # at an end of its range the correlation is not known to have its peak
        if best in (0, most - 1) or agreement[best] < _LEAST_CORRELATION:
            return np.nan
        return self.length_mm / 3.0 / (best * 0.1 / self.fps)


def _correlation(a: Array, b: Array) -> float:
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0 else 0.0


def _max(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else np.nan


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else np.nan


def _mean_over(values: Array, hold: Array) -> float:
    known = np.isfinite(values)
    time = float(hold[known].sum())
    return float((values * hold)[known].sum()) / time if time > 0 else np.nan


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan
