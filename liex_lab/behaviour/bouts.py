"""Table `bouts`: measures of bouts, contradictions to their definitions, rule-based mouse ethogram.

Bouts are named by a rule, a model or a person. The limits of a definition come from
`actions.vocabulary`.

Rules name the actions of a mouse (`ACTIONS`) by double thresholds on speed, height and posture:
one label per frame, half-open bouts, never across a gap. For every action: hysteresis (two
thresholds, enter and leave), then interruptions shorter than `merge_pauses_s` are bridged, then
bouts shorter than `min_bout_s` are dropped. If two actions claim a frame, the first of `ACTIONS`
wins. Default speeds: Live Mouse Tracker (de Chaumont et al. 2019).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.actions.timeline import Recognised, TimelineModel
from liex_lab.actions.vocabulary import limits_of, printed_meanings
from liex_lab.arrays import Array, Mask, NDArray
from liex_lab.behaviour.body import STANDS, SWIMS, kind_of
from liex_lab.behaviour.kinematics import Joints, kinematics, segments, smallest_turn
from liex_lab.plan.sections import BehaviourThresholds
from liex_lab.runtime.memory import Allocator, blocks
from liex_lab.tables.rows import Rows, constant_runs, frame_count, median_step, stop_times
from liex_lab.tables.schema import BOUTS, table_columns, to_pandas
from liex_lab.tracking.track import Track

_BOUTS = 256  # measured at once
# between the curvatures of two thirds of the body, for a wave to be accepted


class BoutReader:
    """The table `kinematics` as arrays, from which rows [start, stop) of a bout are measured.

    Args:
        kinematics: the table of one animal.
        meanings: word -> printed definition, for `broken`; only those of the bundled vocabularies
            have limits, see `actions.vocabulary.limits_of`.
    """

    def __init__(self, kinematics: pd.DataFrame, meanings: Mapping[str, str] | None = None) -> None:
        self._limits = {word: limits_of(text) for word, text in (meanings or {}).items()}
        self.frame_index = kinematics["frame_index"].to_numpy()
        self.time_s = kinematics["time_s"].to_numpy(float)
        self.hold_s = stop_times(self.time_s) - self.time_s
        step = median_step(self.time_s)
        self.fps = 1.0 / step if step > 0 else 0.0
        self.kind = kind_of(kinematics)
        self._columns = {
            str(name): values.to_numpy(float)
            for name, values in kinematics.items()
            if values.dtype == float
        }
        length = self._columns["length_mm"]
        self.length_mm = float(np.nanmedian(length)) if np.isfinite(length).any() else np.nan

    def rows_of(self, bouts: pd.DataFrame) -> list[tuple[int, int]]:
        """The rows [start, stop) of every bout, at least one row each.

        Args:
            bouts: the table `bouts`; start_frame and stop_frame are frame indices of the camera.
        """
        starts = np.searchsorted(self.frame_index, bouts["start_frame"].to_numpy())
        stops = np.searchsorted(self.frame_index, bouts["stop_frame"].to_numpy())
        n = len(self.frame_index)
        return [
            (min(int(a), n - 1), min(max(int(b), int(a) + 1), n))
            for a, b in zip(starts, stops, strict=True)
        ]

    def measure(self, start: int, stop: int) -> dict[str, float]:
        """All measures of one bout except since_last_s, which needs the previous bout.

        Args:
            start: first row of the bout.
            stop: row after its last.

        Returns:
            Column name to value; NaN if unknown.
        """
        found = {**self.motion(start, stop), **self.turn(start, stop)}
        if self.kind == SWIMS:
            return found | self._tail(start, stop)
        return found | self.height(start, stop) if self.kind == STANDS else found

    def broken(self, start: int, stop: int, word: str) -> str:
        """The contradictions between a bout and its word's definition, in words; empty if none.

        Args:
            start: first row of the bout.
            stop: row after its last.
            word: its name.
        """
        found = []
        for limit in self._limits.get(word, ()):
            values = _READ[limit.measure](self, start, stop)
            wrong = [value for value in values if not limit.holds(value)]
            if wrong:
                found.append(f"{limit.shown(wrong[0])}, not {limit.span}")
        return "; ".join(found)

    def since_last(self, bouts: pd.DataFrame, spans: Sequence[tuple[int, int]]) -> Array:
        """(n,) time since the end of the last bout of the same action, s.

        NaN for the first one, and if the animal was not observed throughout the interval.

        Args:
            bouts: the table `bouts`, in order of time.
            spans: the rows of the n bouts, see `rows_of`.
        """
        number = segments(self.time_s, np.isfinite(self._columns["x_mm"]))
        start, stop = np.array(spans, np.int64).reshape(-1, 2).T
        ends = {"action": bouts["action"].to_numpy(), "stop_s": bouts["stop_s"].to_numpy(float)}
        last = pd.DataFrame({**ends, "number": number[stop - 1]}).groupby("action").shift()
        since = bouts["start_s"].to_numpy(float) - last["stop_s"].to_numpy()
        return np.where(last["number"].to_numpy() == number[start], since, np.nan)

    def column(self, name: str, start: int, stop: int) -> Array:
        """A column of the table `kinematics` in the rows [start, stop) of a bout."""
        return self._columns[name][start:stop]

    def seconds(self, start: int, stop: int) -> float:
        """Duration of the bout in the rows [start, stop), s."""
        return float(self.time_s[stop - 1] + self.hold_s[stop - 1] - self.time_s[start])

    def motion(self, start: int, stop: int) -> dict[str, float]:
        """Path, displacement and speeds of the bout in the rows [start, stop), mm and mm/s."""
        speed = self.column("speed_mm_s", start, stop)
        step = self.column("step_mm", start, stop)
        known = np.flatnonzero(np.isfinite(speed))
        path = float(np.nansum(step))
        timed = float(self.hold_s[start:stop][known].sum())
        place = np.stack([self.column(f"{axis}_mm", start, stop) for axis in "xyz"], axis=1)
        observed = place[np.isfinite(place[:, 0])]
        displacement = observed[-1] - observed[0] if len(observed) else np.full(3, np.nan)
        top = _top(speed)
        return {
            "path_mm": path,
            "path_bl": path / self.length_mm,
            "displacement_mm": float(
                np.linalg.norm(displacement if self.kind != STANDS else displacement[:2])
            ),
            "rise_mm": float(displacement[2]),
            "mean_speed_mm_s": path / timed if timed > 0 else np.nan,
            "median_speed_mm_s": of_known(np.median, speed),
            "peak_speed_mm_s": np.nan if top is None else float(speed[top]),
            "peak_speed_sd_mm_s": np.nan
            if top is None
            else float(self.column("speed_sd_mm_s", start, stop)[top]),
            "time_to_peak_s": np.nan
            if top is None
            else float(self.time_s[start + top] - self.time_s[start]),
        }

    def turn(self, start: int, stop: int) -> dict[str, float]:
        """Turning, pitch and bend of the bout in the rows [start, stop), rad."""
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
            "mean_pitch_rad": of_known(np.mean, pitch),
            "bend_max_rad": of_known(np.max, np.abs(bend)),
        }

    def height(self, start: int, stop: int) -> dict[str, float]:
        """Nose heights of a standing animal in the rows [start, stop) of a bout, mm."""
        nose = self.column("nose_height_mm", start, stop)
        top = _top(nose)
        return {
            "peak_nose_height_mm": np.nan if top is None else float(nose[top]),
            "peak_nose_over_rump_mm": of_known(
                np.max, self.column("nose_over_rump_mm", start, stop)
            ),
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
        left = max(of_known(np.max, angle), 0.0)
        right = max(of_known(np.max, -angle), 0.0)
        return {
            "n_bends": n,
            "n_oscillations": n / 2.0,
            "tail_beat_hz": n / 2.0 / duration,
            "tail_beat_max_hz": of_known(np.max, beat),
            "tail_beat_mean_hz": of_known(np.mean, beat),
            "tail_beat_median_hz": of_known(np.median, beat),
            "tail_max_rad": of_known(np.max, size),
            "tail_mean_rad": of_known(np.mean, size),
            "tail_median_rad": of_known(np.median, size),
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
        """Speed of the bend that travels from the middle third of the body to the rear, mm/s."""
        middle, rear = (self.column(f"bend_{part}_rad", start, stop) for part in ("middle", "rear"))
        if not (np.isfinite(middle).all() and np.isfinite(rear).all()) or stop - start < 8:
            return np.nan
        time = self.time_s[start:stop]
        fine: Array = np.arange(
            time[0], time[-1], 0.1 / self.fps
        )  # true times, on an even grid ten times as fine
        a, b = (np.interp(fine, time, curve) - curve.mean() for curve in (middle, rear))
        # longest time of a wave for a third of the body
        most = min(int(0.25 * 10 * self.fps), len(fine) // 2)
        agreement = [_correlation(a[: len(a) - lag], b[lag:]) for lag in range(most)]
        best = int(np.argmax(agreement)) if agreement else 0
        # at an end of the range the peak of the correlation is uncertain
        if best in (0, most - 1) or agreement[best] < 0.5:
            return np.nan
        return self.length_mm / 3.0 / (best * 0.1 / self.fps)


def _correlation(a: Array, b: Array) -> float:
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0 else 0.0


def _top(values: Array) -> int | None:
    """Index of the largest value; None if all are NaN."""
    return int(np.nanargmax(values)) if np.isfinite(values).any() else None


def of_known(measure: Callable[[Array], Any], values: Array) -> float:
    """A measure, such as `np.median`, of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(measure(known)) if len(known) else np.nan


def _mean_over(values: Array, hold: Array) -> float:
    known = np.isfinite(values)
    time = float(hold[known].sum())
    return float((values * hold)[known].sum()) / time if time > 0 else np.nan


# Check of bouts against the measurable part of their definitions.


Reading = Callable[[BoutReader, int, int], tuple[float, ...]]


def _beyond_noise(bout: BoutReader, a: int, b: int) -> float:
    """Mean speed minus the apparent speed caused by pose errors, mm/s."""
    noise = of_known(np.median, bout.column("speed_sd_mm_s", a, b))
    return max(bout.motion(a, b)["mean_speed_mm_s"] - (0.0 if np.isnan(noise) else noise), 0.0)


# how to read each of `actions.vocabulary.MEASURES`; with two values, both must fit
_READ: dict[str, Reading] = {
    "speed_mm_s": lambda bout, a, b: (
        bout.motion(a, b)["mean_speed_mm_s"],
        bout.motion(a, b)["median_speed_mm_s"],
    ),
    "peak_speed_mm_s": lambda bout, a, b: (bout.motion(a, b)["peak_speed_mm_s"],),
    "quiet_bl_s": lambda bout, a, b: (_beyond_noise(bout, a, b) / bout.length_mm,),
    "speed_bl_s": lambda bout, a, b: (bout.motion(a, b)["mean_speed_mm_s"] / bout.length_mm,),
    "duration_s": lambda bout, a, b: (bout.seconds(a, b),),
    "left_turn_rad": lambda bout, a, b: (bout.turn(a, b)["net_turn_rad"],),
    "right_turn_rad": lambda bout, a, b: (-bout.turn(a, b)["net_turn_rad"],),
    "either_turn_rad": lambda bout, a, b: (abs(bout.turn(a, b)["net_turn_rad"]),),
    "swing_rad": lambda bout, a, b: (bout.turn(a, b)["heading_range_rad"],),
    "bend_rad": lambda bout, a, b: (bout.turn(a, b)["bend_max_rad"],),
    "usual_bend_rad": lambda bout, a, b: (
        of_known(np.median, np.abs(bout.column("bend_rad", a, b))),
    ),
    "pitch_rad": lambda bout, a, b: (bout.turn(a, b)["mean_pitch_rad"],),
    "raised_bl": lambda bout, a, b: (bout.height(a, b)["peak_nose_over_rump_mm"] / bout.length_mm,),
    "moved_bl": lambda bout, a, b: (bout.motion(a, b)["displacement_mm"] / bout.length_mm,),
}


def recognise(
    recogniser: TimelineModel,
    track: Track,
    wall_mm: Array | None = None,
    moved: pd.DataFrame | None = None,
    allocate: Allocator = np.empty,
) -> Recognised:
    """The ethogram of a track, in which no bout contradicts its printed definition.

    Args:
        recogniser: names the track.
        track: one animal's track of n frames.
        wall_mm: (n,) distance of the animal from the nearest wall, mm; None if unknown.
        moved: the table `kinematics` of the track; None computes it with the default settings.
        allocate: allocator of large intermediate arrays and of the probabilities.
    """
    if moved is None:
        frames = Rows(track, np.arange(track.n_frames), "", "").frames_table
        moved = kinematics(frames, Joints.of_track(track), allocate=allocate)
    meanings = printed_meanings(recogniser.skeleton, recogniser.definitions)
    return recogniser.recognise(track, wall_mm, allocate, BoutReader(moved, meanings).broken)


def measure_bouts(
    bouts: pd.DataFrame, kinematics: pd.DataFrame, meanings: Mapping[str, str] | None = None
) -> pd.DataFrame:
    """The table `bouts` with its measures.

    Measures that need a higher frame rate are left empty (see unreliable_below_fps in
    columns.json).

    Args:
        bouts: needs the columns of `tables.BOUTS`; its other columns are replaced.
        kinematics: the table `kinematics` of the same animal.
        meanings: word -> printed definition, against which the bouts are checked; None skips the
            check.

    Returns:
        The table with all its columns, one row per bout.
    """
    columns = table_columns("bouts", kind_of(kinematics))
    reader = BoutReader(kinematics, meanings)
    spans = reader.rows_of(bouts)
    block: dict[str, Any] = {c.name: bouts[c.name].to_numpy() for c in BOUTS}
    own = {c.name: c for c in columns[len(BOUTS) :]}
    del own["since_last_s"]
    block |= {name: [] for name in own}
    for rows in blocks(len(spans), _BOUTS):
        for (a, b), word in zip(spans[rows], bouts["action"].iloc[rows], strict=True):
            measured: dict[str, Any] = reader.measure(a, b)
            measured["contradicts"] = reader.broken(a, b, str(word))
            for name, column in own.items():
                known = reader.fps >= (column.unreliable_below_fps or 0.0)
                empty = 0 if column.dtype == "int64" else np.nan
                block[name].append(measured[name] if known else empty)
    block["since_last_s"] = reader.since_last(bouts, spans)
    return to_pandas(columns, block)


# The rule-based ethogram of a mouse.

ACTIONS = ("rear", "groom", "run", "walk", "pause")  # if two claim a frame, the first wins


class MouseRules(BehaviourThresholds):
    """Thresholds of the rule-based ethogram, by their names in a plan.

    `MouseRules(**plan.behaviour.model_dump())` makes them from a plan. Speeds and the height of
    40 mm are those of Live Mouse Tracker; an animal shorter than 100 mm rears from 0.4 of its own
    length, as in the definitions of `actions.vocabulary`. A bout of rearing extends down to half of
    that height. Heights are above the usual one of the tail's base, which errs less than that of
    one frame. A hunched posture of a nearly still animal is grooming, as in `actions.vocabulary`.
    """

    def rear_mm(self, spine_mm: float) -> float:
        """Least height of the nose above the tail's base in a rear, mm, for a length of
        `spine_mm`.
        """
        return min(self.rear_height_mm, self.rear_height_bl * spine_mm)

    def definitions(self) -> dict[str, str]:
        """The definition of each word of `ACTIONS` with these thresholds, as sentences."""
        walk = f"{self.pause_below_mm_s / 10.0:g} cm/s"
        run = f"{self.run_above_mm_s / 10.0:g} cm/s"
        return {
            "rear": (
                f"the nose is {self.rear_height_mm:g} mm or more above the usual height of the "
                f"tail's base, or {self.rear_height_bl:g} body lengths for an animal shorter than "
                f"{self.rear_height_mm / self.rear_height_bl:.0f} mm; rising and descending "
                f"belong to it, down to {self.rear_leave:.0%} of that height"
            ),
            "groom": (
                f"sits hunched: the body's centre moves slower than {self.groom_below_mm_s / 10:g} "
                f"cm/s and the nose is within {self.groom_reach_bl:g} body lengths of the tail's "
                f"base in top view, until beyond {self.groom_leave_bl:g}; a mouse that rests "
                "curled up meets this, too"
            ),
            "run": f"the body's centre moves faster than {run}",
            "walk": f"the body's centre moves at {walk} to {run}",
            "pause": f"the body's centre moves slower than {walk}",
        }


def find_bouts(
    frames: pd.DataFrame, kinematics: pd.DataFrame, rules: MouseRules | None = None
) -> pd.DataFrame:
    """The rule-based table `bouts` of one animal, with the measures of each bout.

    Args:
        frames: the table `frames`; spine_mm is read.
        kinematics: the table `kinematics` of the same frames.
        rules: the thresholds; None uses the defaults.

    Returns:
        One row per bout in order of time, source "rule"; the score is the share of its frames that
            satisfy the rule themselves.
    """
    rules = rules or MouseRules()
    time_s = kinematics["time_s"].to_numpy(float)
    observed = np.isfinite(kinematics["x_mm"].to_numpy(float))
    number = segments(time_s, observed)
    stop_s = stop_times(time_s)
    raw = raw_labels(
        kinematics,
        float(np.nanmedian(frames["spine_mm"])) if observed.any() else np.nan,
        number,
        rules,
    )
    label = np.full(len(time_s), "", dtype=object)
    for action in ACTIONS:
        free = (label == "") & observed
        least = rules.merge_pauses_s, rules.min_bout_s
        for start, stop in tidy(raw[action] & free, free, number, time_s, stop_s, *least):
            label[start:stop] = action
    return _table(kinematics, label, raw, number, stop_s)


def raw_labels(
    kinematics: pd.DataFrame, spine_mm: float, number: NDArray[np.int64], rules: MouseRules
) -> dict[str, Mask]:
    """Per action (n,) bool: the frames that satisfy its rule, with hysteresis in every stretch.

    Args:
        kinematics: the table `kinematics`; without nose_over_rump_mm (a swimming animal) nothing
            rears or grooms.
        spine_mm: length of the animal's spine, mm.
        number: (n,) unbroken stretch of each frame, see `segments`.
        rules: the thresholds.
    """
    speed = kinematics["speed_mm_s"].to_numpy(float)
    raised, hunched = np.full((2, len(speed)), np.nan)
    if "nose_over_rump_mm" in kinematics:
        reach = kinematics["reach_mm"].to_numpy(float) / spine_mm
        hunched = np.where(speed < rules.groom_below_mm_s, -reach, np.nan)
        nose = kinematics["nose_height_mm"].to_numpy(float)
        raised = nose - of_known(np.median, nose - kinematics["nose_over_rump_mm"].to_numpy(float))
    rear_mm = rules.rear_mm(spine_mm)
    low = 1.0 - rules.speed_hysteresis
    high = 1.0 + rules.speed_hysteresis
    moving = hysteresis(speed, rules.pause_below_mm_s * high, rules.pause_below_mm_s * low, number)
    running = hysteresis(speed, rules.run_above_mm_s * high, rules.run_above_mm_s * low, number)
    known = np.isfinite(speed)
    return {
        "rear": hysteresis(raised, rear_mm, rules.rear_leave * rear_mm, number),
        "groom": hysteresis(hunched, -rules.groom_reach_bl, -rules.groom_leave_bl, number),
        "run": running & known,
        "walk": moving & ~running & known,
        "pause": ~moving & known,
    }


def hysteresis(
    values: Array, enter: float, leave: float, number: NDArray[np.int64], *, trim: bool = False
) -> Mask:
    """(n,) bool: the runs above `leave` that reach `enter`, separately in every stretch.

    It is True until the values fall below `leave`. The frames between `leave` and `enter` just
    before the threshold is reached are included (as in Canny's edge detector, not as in a causal
    Schmitt trigger).

    Args:
        values: (n,) the measure; NaN is below every threshold.
        enter: upper threshold, in the unit of `values`.
        leave: lower threshold, in the unit of `values`.
        number: (n,) unbroken stretch of each frame, see `segments`.
        trim: begin and end with values of `enter` or more; those below it are only bridged.
    """
    high = values >= enter
    inside = values >= leave
    out = np.zeros(len(values), bool)
    group = np.where(
        inside, number, -1 - number
    )  # a run of one group is within one stretch, all above `leave` or all below
    for start, stop, which in constant_runs(group):
        rows = start + np.flatnonzero(high[start:stop])
        if which >= 0 and len(rows):
            out[slice(rows[0], rows[-1] + 1) if trim else slice(start, stop)] = True
    return out


def tidy(
    mask: Mask,
    free: Mask,
    number: NDArray[np.int64],
    time_s: Array,
    stop_s: Array,
    merge_s: float,
    min_s: float,
) -> Iterator[tuple[int, int]]:
    """Yield the bouts (start, stop) of a mask: short pauses bridged, then short bouts dropped.

    Pauses are bridged over free frames of one stretch only.

    Args:
        mask: (n,) bool, the frames that satisfy the rule.
        free: (n,) bool, the frames that no earlier action claimed.
        number: (n,) unbroken stretch of each frame, see `segments`.
        time_s: (n,) times of the frames, s.
        stop_s: (n,) end of each frame's validity, s, see `stop_times`.
        merge_s: shorter pauses are bridged, s.
        min_s: shorter bouts are dropped, s.

    Yields:
        Rows [start, stop) of each bout, in order of time.
    """
    merged: list[tuple[int, int]] = []
    for start, stop, which in constant_runs(np.where(mask, number, -1)):
        if which < 0:
            continue
        if merged:
            last_start, last_stop = merged[-1]
            bridge = number[last_stop - 1] == which and free[last_stop:start].all()
            if bridge and time_s[start] - stop_s[last_stop - 1] < merge_s:
                merged[-1] = (last_start, stop)
                continue
        merged.append((start, stop))
    for start, stop in merged:
        if stop_s[stop - 1] - time_s[start] >= min_s:
            yield start, stop


def _table(
    kinematics: pd.DataFrame,
    label: NDArray[np.object_],
    raw: dict[str, Mask],
    number: NDArray[np.int64],
    stop_s: Array,
) -> pd.DataFrame:
    """The table `bouts`: one row per run of equal labels inside one stretch."""
    time_s = kinematics["time_s"].to_numpy(float)
    count = frame_count(kinematics["frame_index"].to_numpy())
    code = {action: k for k, action in enumerate(ACTIONS)}
    runs = np.array([code.get(word, -1) for word in label], np.int64)
    pieces = [
        (start, stop)
        for start, stop, key in constant_runs(np.where(runs >= 0, runs + len(code) * number, -1))
        if key >= 0
    ]
    a, b = np.array(pieces, np.int64).reshape(-1, 2).T
    named = to_pandas(
        BOUTS,
        {
            "session_id": str(kinematics["session_id"].iloc[0]),
            "individual": str(kinematics["individual"].iloc[0]),
            "action": label[a],
            "start_s": time_s[a],
            "stop_s": stop_s[b - 1],
            "duration_s": stop_s[b - 1] - time_s[a],
            "start_frame": count[a],
            "stop_frame": count[b],
            "score": [float(raw[str(label[i])][i:j].mean()) for i, j in pieces],
            "source": "rule",
            "model_hash": "",
        },
    )
    return measure_bouts(named, kinematics)
