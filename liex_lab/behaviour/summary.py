"""All behaviour tables of one animal, and the summary: one row with the main results.

Combines `kinematics`, `bouts` and `activity` (with transitions, zones and places); the summary
adds distance, speeds, turn bias, time budget (count, time, share, rate and latency of each action,
and of all rears together) and times in zones. Shares are of the observed time, and count observed
frames only.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.actions.labels import HUMAN
from liex_lab.arrays import Array
from liex_lab.behaviour.activity import (
    Surroundings,
    activity,
    depth_measures,
    inside_zones,
    observed_hold,
    place_measures,
    surface_height_mm,
    time_named,
    transitions,
    visits,
)
from liex_lab.behaviour.body import SWIMS, kind_of, parents_of
from liex_lab.behaviour.bouts import ACTIONS, MouseRules, find_bouts, measure_bouts, of_known
from liex_lab.behaviour.days import Light, activity_by_hour, rhythm
from liex_lab.behaviour.kinematics import Joints, kinematics
from liex_lab.errors import PlanError
from liex_lab.plan.sections import BehaviourThresholds, Period
from liex_lab.runtime.memory import Allocator
from liex_lab.tables.rows import Rows, stop_times
from liex_lab.tables.schema import (
    BEHAVIOUR,
    GAPS,
    Column,
    SessionTables,
    Vocabulary,
    empty_table,
    rears_of,
    to_pandas,
)
from liex_lab.tracking.track import DOUBTFUL, ends_of


@dataclass(frozen=True)
class Behaviour:
    """The behaviour tables of one animal.

    Attributes:
        kinematics: one row per frame.
        bouts: one row per bout, with its measures.
        summary: one row.
        transitions: one row per ordered pair of different actions.
        activity: one row per time bin.
        zones: one row per zone.
        rules: the thresholds.
        vocabulary: determines the columns.
        actions: word of the ethogram -> its definition.
        stated: the tables of light and dark, and of periods, if the plan states them.
    """

    kinematics: pd.DataFrame
    bouts: pd.DataFrame
    summary: pd.DataFrame
    transitions: pd.DataFrame
    activity: pd.DataFrame
    zones: pd.DataFrame
    rules: MouseRules
    vocabulary: Vocabulary
    actions: Mapping[str, str] = field(default_factory=dict)
    stated: Mapping[str, pd.DataFrame] = field(default_factory=dict)

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """Every table by its name."""
        return {name: getattr(self, name) for name in BEHAVIOUR} | dict(self.stated)

    @property
    def columns(self) -> tuple[Column, ...]:
        """The columns of the tables."""
        stated = [column for name in self.stated for column in self.vocabulary.table(name)]
        return (*self.vocabulary.columns, *stated)

    def for_session(self) -> dict[str, Any]:
        """The arguments for closing a session: `writer.close(**behaviour.for_session())`."""
        return {
            "results": self.tables,
            "columns": self.columns,
            "actions": self.actions,
            "record": {"rules": self.rules.model_dump(exclude_none=True)},
        }


def moving(
    frames: pd.DataFrame,
    poses: pd.DataFrame | Joints,
    rules: MouseRules,
    around: Surroundings,
    allocate: Allocator = np.empty,
) -> pd.DataFrame:
    """The table `kinematics`, computed with a session's thresholds and surroundings.

    Args:
        frames: the table `frames`.
        poses: the table `poses` of these frames, or its joints.
        rules: window of the speed, and the impossible speed.
        around: the water's surface, and the seams: ends of flips corrected by hand.
        allocate: makes the arrays of the table (an allocator, as `np.empty`).
    """
    return kinematics(
        frames,
        poses,
        rules.speed_half_window_s,
        rules.impossible_above_mm_s,
        around.surface_z_mm,
        around.seams,
        allocate,
    )


def measure(
    frames: pd.DataFrame,
    poses: pd.DataFrame | Joints,
    rules: MouseRules | None = None,
    around: Surroundings | None = None,
    gaps: pd.DataFrame | None = None,
    *,
    bouts: pd.DataFrame | None = None,
    actions: Mapping[str, str] | None = None,
    moved: pd.DataFrame | None = None,
    allocate: Allocator = np.empty,
) -> Behaviour:
    """The behaviour tables of one animal from its poses.

    Args:
        frames: the table `frames`.
        poses: the table `poses` of these frames, or its joints.
        rules: the thresholds; None uses the defaults.
        around: arena, zones and water; None if unknown.
        gaps: the table `gaps`; None if absent.
        bouts: an ethogram by a model or a person (the columns of `tables.BOUTS`); None applies the
            rules.
        actions: its vocabulary, word -> definition; None uses that of the rules. Missing words are
            added without a definition.
        moved: the table `kinematics` of these poses, if already computed, see `moving`.
        allocate: makes the arrays of the table `kinematics` (an allocator, as `np.empty`).
    """
    rules = rules or MouseRules()
    around = around or Surroundings()
    moved = moving(frames, poses, rules, around, allocate) if moved is None else moved
    actions = dict(rules.definitions() if actions is None else actions)
    named = (
        find_bouts(frames, moved, rules) if bouts is None else measure_bouts(bouts, moved, actions)
    )
    actions |= dict.fromkeys(sorted(set(named["action"]) - set(actions)), "")
    words = Vocabulary(tuple(actions), tuple(around.zones), kind_of(moved))
    gaps = empty_table(GAPS) if gaps is None else gaps
    stated = {}
    if around.light is not None:
        hours = activity_by_hour(moved, around.light, observed_hold(moved))
        stated = {"hours": hours, "rhythm": rhythm(hours, around.light)}
    if rules.periods:
        stated["periods"] = by_period(frames, moved, named, words, around, rules)
    return Behaviour(
        moved,
        named,
        summarise(frames, moved, named, words, around, rules),
        transitions(named, words.words, gaps, rules.merge_pauses_s),
        activity(moved, named, words.words, rules.bin_s),
        visits(frames, moved, words.zones, rules),
        rules,
        words,
        actions,
        stated,
    )


def measure_rows(
    rows: Rows, rules: MouseRules | None = None, around: Surroundings | None = None, **how: Any
) -> Behaviour:
    """`measure` of a track that is not in a session yet.

    Args:
        rows: the track with its frame indices and names.
        rules: the thresholds; None uses the defaults.
        around: arena, zones and water; None if unknown.
        **how: bouts, actions, moved and allocate of `measure`.
    """
    gaps = to_pandas(GAPS, rows.gaps())
    return measure(rows.frames_table, Joints.of_track(rows.track), rules, around, gaps, **how)


def kinematics_of_rows(
    rows: Rows, rules: MouseRules, around: Surroundings, allocate: Allocator = np.empty
) -> pd.DataFrame:
    """The table `kinematics` of a track that is not in a session yet, see `moving`.

    Args:
        rows: the track with its frame indices and names.
        rules: window of the speed, and the impossible speed.
        around: the water's surface and the seams.
        allocate: makes the arrays of the table (an allocator, as `np.empty`).
    """
    return moving(rows.frames_table, Joints.of_track(rows.track), rules, around, allocate)


def stated_by(session: SessionTables) -> tuple[MouseRules, Surroundings]:
    """The thresholds and the surroundings of a session.

    Thresholds missing from its session.json are the defaults.
    """
    about = session.metadata
    known = about.get("rules") or {}
    stated = {name: known[name] for name in MouseRules.model_fields if name in known}
    surface = surface_height_mm(
        about["camera"]["floor_distance_mm"], about["camera"].get("optics", {})
    )
    flips = session.table("flips", ["start_frame", "stop_frame", "source"])
    by_hand = flips[flips["source"] == HUMAN]
    seams = ends_of(zip(by_hand["start_frame"], by_hand["stop_frame"], strict=True))
    zones = [zone.name for zone in session.zones]
    light = Light.of(about["plan"].get("light") or {}, about.get("session_start_time"))
    return MouseRules(**stated), Surroundings(session.arena, zones, surface, seams, light)


def measure_session(session: SessionTables, rules: MouseRules | None = None) -> Behaviour:
    """The behaviour tables of a session, from its folder, with its own ethogram.

    Without `rules`, the session's own thresholds are used.
    """
    stated, around = stated_by(session)
    poses = session.table("poses", ["frame_index", "joint", "x_mm", "y_mm", "z_mm", "sd_mm"])
    frames = session.frames
    return measure(
        frames,
        Joints.of_table(poses, len(frames), parents_of(session.metadata["animal"])),
        rules or stated,
        around,
        session.gaps,
        bouts=session.bouts,
        actions=session.metadata.get("actions", {}),
    )


def summarise(
    frames: pd.DataFrame,
    kinematics: pd.DataFrame,
    bouts: pd.DataFrame,
    words: Vocabulary | None = None,
    around: Surroundings | None = None,
    rules: MouseRules | None = None,
) -> pd.DataFrame:
    """The table `summary`: one row for one animal.

    Args:
        frames: the table `frames`.
        kinematics: the table `kinematics`.
        bouts: the table `bouts` with its measures.
        words: actions, zones and the kind of body; None means the rules' actions of a walking
            animal.
        around: arena, zones and water; None if unknown.
        rules: speeds below their pause threshold do not count as movement; None uses the defaults.
    """
    words = words or Vocabulary(ACTIONS)
    around = around or Surroundings()
    time_s = kinematics["time_s"].to_numpy(float)
    observed = np.isfinite(kinematics["x_mm"].to_numpy(float))
    hold = observed_hold(kinematics)  # seconds that each observed frame stands for
    first = float(time_s[observed][0]) if observed.any() else np.nan
    block: dict[str, Any] = {
        "session_id": str(frames["session_id"].iloc[0]),
        "individual": str(frames["individual"].iloc[0]),
        "n_frames": len(frames),
        "n_lost": int((~observed).sum()),
        "n_doubtful": int(frames["flag"].isin(DOUBTFUL).sum()),
        "duration_s": float(stop_times(time_s)[-1]),
        "observed_s": float(hold.sum()),
        "spine_mm": _median(frames["spine_mm"]) if "spine_mm" in frames else np.nan,
        **_motion(kinematics, hold),
        **place_measures(frames, hold, around.arena),
        **_budget(kinematics, bouts, words.words, first),
        **_time_in_zones(frames, words.zones, hold),
    }
    if words.kind == SWIMS:
        block |= depth_measures(kinematics, hold, around.surface_z_mm)
        block |= {name: _median(kinematics[name]) for name in ("tail_beat_hz", "tail_beat_mm")}
    else:
        pause_mm_s = (rules or MouseRules()).pause_below_mm_s
        faster = kinematics["speed_mm_s"] > np.fmax(pause_mm_s, block["speed_noise_mm_s"])
        step = kinematics["step_mm"].to_numpy(float)
        block["distance_moving_m"] = float(np.nansum(step[faster.to_numpy()])) / 1000.0
    return to_pandas(words.table("summary"), block)


def by_period(
    frames: pd.DataFrame,
    kinematics: pd.DataFrame,
    bouts: pd.DataFrame,
    words: Vocabulary,
    around: Surroundings,
    rules: MouseRules,
) -> pd.DataFrame:
    """The table `periods`: the summary of each period that the plan states.

    A bout across the border of a period is cut there, and counts on both sides.

    Args:
        frames: the table `frames`.
        kinematics: the table `kinematics`.
        bouts: the table `bouts` with its measures.
        words: actions, zones and the kind of body.
        around: arena, zones and water.
        rules: its periods, and the pause threshold of `summarise`.

    Raises:
        PlanError: a period is not in the recording, see `frames_of_periods`.
    """
    rows = []
    for period, own, stop_s in frames_of_periods(rules, kinematics["time_s"].to_numpy(float)):
        within = bouts[
            (bouts["start_s"] < stop_s - 1e-6) & (bouts["stop_s"] > period.start_s + 1e-6)
        ]
        cut = within[["start_s", "stop_s"]].clip(period.start_s, stop_s)
        within = within.assign(**cut, duration_s=cut["stop_s"] - cut["start_s"])
        row = summarise(frames[own], kinematics[own], within, words, around, rules)
        rows.append(row.assign(period=period.name, start_s=period.start_s, stop_s=stop_s))
    block = {str(name): values.to_numpy() for name, values in pd.concat(rows).items()}
    return to_pandas(words.table("periods"), block)


def frames_of_periods(
    rules: BehaviourThresholds, time_s: Array
) -> Iterator[tuple[Period, slice, float]]:
    """Yield each period, its frames, and its end, s.

    Args:
        rules: the plan's `[behaviour]`.
        time_s: (n,) times of the frames since the first one, s.

    Raises:
        PlanError: a period begins or ends after the recording, or has fewer than two frames.
    """
    end_s = float(stop_times(time_s)[-1])
    for one in rules.periods or ():
        stop_s = end_s if one.stop_s is None else one.stop_s
        own = slice(*np.searchsorted(time_s, [one.start_s - 1e-6, stop_s - 1e-6]))
        if own.stop - own.start < 2 or stop_s > end_s + 0.1:  # a length is rarely round
            raise PlanError(
                f"the period {one.name} of behaviour.periods, from {one.start_s:g} to {stop_s:g} "
                f"s, should have frames and lie in the recording, which lasts {end_s:.6g} s; "
                "correct its times, or leave it out"
            )
        yield one, own, min(stop_s, end_s)


def _motion(kinematics: pd.DataFrame, hold: Array) -> dict[str, float]:
    """Distance, speeds and turning."""
    speed, step = (kinematics[name].to_numpy(float) for name in ("speed_mm_s", "step_mm"))
    known = np.isfinite(speed)
    distance = float(np.nansum(step))
    timed = float(hold[known].sum())
    turning = kinematics["yaw_rate_rad_s"].to_numpy(float)
    turns = np.isfinite(turning)
    turned = float((turning * hold)[turns].sum())
    turned_abs = float((np.abs(turning) * hold)[turns].sum())
    turn_s = float(hold[turns].sum())
    return {
        "distance_m": distance / 1000.0,
        "mean_speed_mm_s": distance / timed if timed > 0 else np.nan,
        "median_speed_mm_s": _median(kinematics["speed_mm_s"]),
        "max_speed_mm_s": float(speed[known].max()) if known.any() else np.nan,
        "speed_noise_mm_s": _median(kinematics["speed_sd_mm_s"]),
        "mean_abs_yaw_rate_rad_s": turned_abs / turn_s if turn_s > 0 else np.nan,
        "turn_bias": turned / turned_abs if turned_abs > 0 else np.nan,
    }


def _budget(
    kinematics: pd.DataFrame, bouts: pd.DataFrame, words: Sequence[str], first_s: float
) -> dict[str, float]:
    """Time, number and latency of each action, and the unlabelled time."""
    spent = time_named(kinematics, bouts, words)[0]  # s: unlabelled first, then each word
    observed_s = float(spent.sum())
    share = spent / observed_s if observed_s > 0 else np.full(len(spent), np.nan)
    found: dict[str, float] = {}
    for k, word in enumerate(words, 1):
        own = bouts[bouts["action"] == word]
        n = len(own)
        found |= {
            f"{word}_count": n,
            f"{word}_s": float(spent[k]),
            f"{word}_share": float(share[k]),
            f"{word}_mean_s": float(own["duration_s"].mean()) if n else np.nan,
            f"{word}_per_min": 60.0 * n / observed_s if observed_s > 0 else np.nan,
            f"{word}_latency_s": float(own["start_s"].min()) - first_s if n else np.nan,
        }
    if kinds := rears_of(words):
        own = bouts[bouts["action"].isin(kinds)]
        found |= {
            "rear_count": len(own),
            "rear_s": sum(found[f"{kind}_s"] for kind in kinds),
            "rear_share": sum(found[f"{kind}_share"] for kind in kinds),
            "rear_latency_s": float(own["start_s"].min()) - first_s if len(own) else np.nan,
        }
    return found | {"unlabelled_s": float(spent[0]), "unlabelled_share": float(share[0])}


def _time_in_zones(frames: pd.DataFrame, zones: Sequence[str], hold: Array) -> dict[str, float]:
    """Seconds in each zone, and shares of the observed time."""
    observed_s = float(hold.sum())
    found = {}
    for zone, inside in zip(zones, inside_zones(frames, zones), strict=True):
        found[f"zone_{zone}_s"] = float(hold[inside].sum())
        found[f"zone_{zone}_share"] = (
            found[f"zone_{zone}_s"] / observed_s if observed_s > 0 else np.nan
        )
    return found


def _median(values: "pd.Series[Any]") -> float:
    return of_known(np.median, values.to_numpy(float))
