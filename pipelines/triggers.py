"""Triggers of a live recording: events of rules, sent as they happen, logged and compared later.

Every event is at once a line of the log NAME.triggers.jsonl. The session that is made of the
finished recording has them as the table `triggers`, compared with the events that the same rules
have in it.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import pandas as pd

from liex_lab.actions.labels import words_of
from liex_lab.behaviour.activity import Surroundings
from liex_lab.behaviour.body import KINDS
from liex_lab.behaviour.bouts import MouseRules, find_bouts
from liex_lab.behaviour.kinematics import Joints, measures
from liex_lab.behaviour.summary import kinematics_of_rows
from liex_lab.behaviour.triggers import (
    TOLERANCE_S,
    Agreement,
    Array,
    Onsets,
    Rule,
    usable_names,
    values_of,
    words_in,
)
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import SessionError, one_line
from liex_lab.exchange.senders import message, open_sender
from liex_lab.plan import Plan
from liex_lab.recordings.streaming import Arrival
from liex_lab.scene.scene import UNKNOWN, Arena
from liex_lab.scene.zones import Zone
from liex_lab.tables.rows import Rows, seconds
from liex_lab.tables.schema import TRIGGERS, table_columns, to_pandas
from liex_lab.tracking.track import Track
from liex_lab.tracking.tracker import FrameTracker

from .build import build_arena, build_recogniser, build_rules, build_zones, why_nameless

_WINDOW_S = 4.0  # before the latest frame, from which its action is recognised
_RATES_S = 0.5  # likewise its speeds
_ACTION_S = 0.1
_LATE_S = 0.5  # nothing is sent for a frame that waited longer, such as one of the learned scene's
OUTCOMES = ("sent", "withheld", "late", "failed")
_FACTS = ("rule", "count", "frame_index", "value", "latency_ms", "sent_time_ns", "outcome")


@dataclass(frozen=True)
class Triggers:
    """What triggers, and where its events are sent.

    Attributes:
        rules: texts, see `liex_lab.behaviour.triggers`.
        addresses: receivers, see `liex_lab.exchange.senders`.
        duration_s: a rule has to hold so long before an event; None is 0.1 s for a rule that names
            an action, as a recognised action may change its mind, and 0 for others.
        refractory_s: least time between two events of a rule.
        probability: of sending an event; the others are withheld and logged, as controls.
    """

    rules: tuple[str, ...]
    addresses: tuple[str, ...] = ()
    duration_s: float | None = None
    refractory_s: float = 0.0
    probability: float = 1.0


@dataclass
class _Watched:
    """What is known of one animal so far.

    Attributes:
        name: of the animal.
        window: its latest rows.
        onsets: finds the events, rule by rule.
        acting: whether each action is under way.
    """

    name: str
    window: Track
    onsets: list[Onsets]
    acting: dict[str, bool]


class TriggerWatch:
    """Applies rules to every frame of a live recording; sends and logs their events.

    Attributes:
        events: all so far, in order: the facts of a message and of the table `triggers`, and the
            places (N, 2) of all animals in the image, px.
        accounts: of each rule and animal, what became of its events and, once there is a session,
            their agreement with its own.
        problems: receivers that failed, and why.

    Args:
        stated: rules and receivers.
        plan: animal, actions, zones and seed.

    Raises:
        LiexError: a rule or an address cannot be used.
    """

    def __init__(self, stated: Triggers, plan: Plan) -> None:
        self._skeleton = skeleton = Skeleton.load(plan.animal.skeleton)
        self._recogniser = build_recogniser(plan, skeleton)
        self._thresholds = build_rules(plan)
        words: tuple[str, ...] = ()
        if self._recogniser is not None:
            words = self._recogniser.words
        elif not why_nameless(plan, skeleton):
            words = tuple(MouseRules().definitions())
        known = usable_names(skeleton, words, [zone.name for zone in build_zones(plan)])
        self._rules = [Rule.of_text(text, known) for text in dict.fromkeys(stated.rules)]
        self._names = {name for rule in self._rules for name in rule.names}
        self._acts = {name: words_in(name, words) for name in self._names & {*words, "rear"}}
        moving = {one.name for kind in KINDS for one in table_columns("kinematics", kind)}
        self._moves = bool(self._names & moving)
        self._stated, self._plan = stated, plan
        self._animals: list[_Watched] = []
        self._senders = {address: open_sender(address) for address in stated.addresses}
        self._rng = np.random.default_rng(plan.seed)
        self._log: TextIO | None = None
        self._first_ns = 0
        self._arena: Arena = UNKNOWN
        self._zones: tuple[Zone, ...] = ()
        self.events: list[dict[str, Any]] = []
        self.accounts: list[dict[str, Any]] = []
        self.problems: dict[str, str] = {}

    def begin(self, tracker: FrameTracker, individuals: Sequence[str]) -> None:
        """Start with a recording whose scene is learned: find its arena and zones.

        Args:
            tracker: of one of the animals.
            individuals: the names of all.
        """
        self._arena, self._zones = build_arena(tracker.scene, self._plan)
        self.follow(individuals)

    def follow(self, individuals: Sequence[str]) -> None:
        """Apply the rules to each of these animals."""
        self._animals = [
            _Watched(
                name,
                Track.empty(self._skeleton, np.zeros(0, np.int64)),
                [self._new_onsets(rule) for rule in self._rules],
                dict.fromkeys(self._acts, False),
            )
            for name in individuals
        ]

    def write_to(self, log: Path) -> None:
        """Write all events to this file, a line each.

        Raises:
            SessionError: the file exists.
        """
        log.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._log = log.open("x", encoding="utf-8", buffering=1)
        except FileExistsError:
            raise SessionError(
                f"{log} holds the triggers of an earlier recording; move it away, or state another "
                "folder with --out"
            ) from None

    def add(self, arrival: Arrival, recent: Sequence[Track]) -> None:
        """Apply the rules to the next frame.

        Args:
            arrival: the frame.
            recent: of each animal, the last rows of the online track, the frame's own the last.
        """
        if not self._animals[0].window.n_frames:
            self._first_ns = arrival.frame.time_ns
        time_s = 1e-9 * (arrival.frame.time_ns - self._first_ns)
        for animal, rows in zip(self._animals, recent, strict=True):
            older = animal.window[: int(np.searchsorted(animal.window.times_ns, rows.times_ns[0]))]
            animal.window = _since(Track.join([older, rows]), _WINDOW_S)
        for animal in self._animals:
            values = self._values(animal)
            for k, (rule, onsets) in enumerate(zip(self._rules, animal.onsets, strict=True)):
                on, off = rule.holds(values)
                if onsets.add(time_s, bool(on[0]), bool(off[0])):
                    self._fire(k, animal, arrival, time_s, float(values[rule.names[0]][0]))

    def close(self) -> None:
        """Close senders and log, and account for the events of each rule."""
        for sender in self._senders.values():
            sender.close()
        if self._log is not None:
            self._log.close()
        self.accounts = [
            self._account(rule, one.name, [e for e in self.events if e["individual"] == one.name])
            for one in self._animals
            for rule in self._rules
        ]

    def for_session(self, rows: Rows, measured: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
        """The table `triggers` and its notes, as `SessionWriter.close` takes them.

        Args:
            rows: the track of the finished session.
            measured: its tables of behaviour, by name.
        """
        words = words_of(measured["bouts"], rows.time_s)
        acts = {name: np.isin(words, kinds) for name, kinds in self._acts.items()}
        values = values_of(self._names, rows, dict(measured["kinematics"]), acts)
        first_ns = int(rows.track.times_ns[0])
        mine = self._events_of(rows)
        offset = np.full(len(mine), np.nan)
        accounts = []
        for rule in self._rules:
            session_s = self._new_onsets(rule).of_frames(rows.time_s, *rule.holds(values))
            own = [j for j, event in enumerate(mine) if event["rule"] == rule.text]
            live_s = np.array([1e-9 * (mine[j]["time_ns"] - first_ns) for j in own])
            found = Agreement.of(live_s, session_s)
            offset[own] = 1e3 * found.offset_s
            accounts.append(
                self._account(rule, rows.individual, mine)
                | {
                    "n_session": len(session_s),
                    "precision": found.precision,
                    "recall": found.recall,
                    "tolerance_s": TOLERANCE_S,
                    "missed_s": found.missed_s.round(4).tolist(),
                }
            )
        self.accounts = [
            *(one for one in self.accounts if one["individual"] != rows.individual),
            *accounts,
        ]
        block: dict[str, Any] = {name: [event[name] for event in mine] for name in _FACTS}
        block["time_s"] = [1e-9 * (event["time_ns"] - first_ns) for event in mine]
        block |= {"session_id": rows.session_id, "individual": rows.individual}
        table = to_pandas(TRIGGERS, block | {"session_offset_ms": offset})
        stated = {**asdict(self._stated), "seed": self._plan.seed}
        return {
            "results": {"triggers": table},
            "columns": TRIGGERS,
            "record": {"triggers": {"stated": stated, "rules": accounts}},
        }

    def _events_of(self, rows: Rows) -> list[dict[str, Any]]:
        """The events of the animal of a finished session, whatever it was named then: of all, it
        was the nearest one in the image.
        """
        track, names = rows.track, np.array([one.name for one in self._animals])
        own = []
        for event in self.events:
            row = min(int(np.searchsorted(track.times_ns, event["time_ns"])), track.n_frames - 1)
            off = np.linalg.norm(event["places_px"] - track.uv_px[row].mean(axis=0), axis=1)
            off = np.where(np.isfinite(off), off, 1e9 + (names != rows.individual))
            own += [event] if names[off.argmin()] == event["individual"] else []
        return own

    def _values(self, animal: _Watched) -> dict[str, Array]:
        """The values (1,) of all names in the latest frame; NaN if it is unclear whose they are."""
        window = animal.window
        if window.flag[-1] == "unclear":
            return dict.fromkeys(self._names, np.array([np.nan]))
        near = _since(window, _RATES_S)
        moved: dict[str, Array] = {}
        if self._moves:
            limits = self._thresholds.speed_half_window_s, self._thresholds.impossible_above_mm_s
            every = measures(Joints.of_track(near), seconds(near.times_ns), *limits)
            moved = {name: column[-1:] for name, column in every.items()}
        if self._acts:
            self._act(animal)
        return values_of(self._names, self._rows(window[-1:]), moved, animal.acting)

    def _act(self, animal: _Watched) -> None:
        """Decide on the actions in the latest frame.

        A recognised action begins where its probability exceeds 0.8 and ends below 0.2.
        """
        window, rows = animal.window, self._rows(animal.window)
        if self._recogniser is not None:
            found = self._recogniser.recognise(window, rows.wall_distance_mm)
            chance = dict(zip(found.words, found.probability[-1].tolist(), strict=True))
        else:
            moved = kinematics_of_rows(rows, self._thresholds, Surroundings())
            bouts = find_bouts(rows.frames_table, moved, self._thresholds)
            chance = {words_of(bouts, rows.time_s)[-1]: 1.0}
        for name, kinds in self._acts.items():
            p = sum(chance.get(kind, 0.0) for kind in kinds)
            if not np.isnan(p):  # else nothing was measured
                animal.acting[name] = bool(p > (0.2 if animal.acting[name] else 0.8))

    def _rows(self, track: Track) -> Rows:
        return Rows(track, np.arange(track.n_frames), "", "", (), self._arena, self._zones)

    def _new_onsets(self, rule: Rule) -> Onsets:
        least = _ACTION_S if self._acts.keys() & set(rule.names) else 0.0
        stated = self._stated.duration_s
        return Onsets(least if stated is None else stated, self._stated.refractory_s)

    def _fire(
        self, k: int, animal: _Watched, arrival: Arrival, time_s: float, value: float
    ) -> None:
        """Send an event, unless it is withheld or late, and log it."""
        own = (self._rules[k].text, animal.name)
        facts: dict[str, Any] = {
            "time_s": round(time_s, 6),
            "time_ns": int(arrival.frame.time_ns),
            "frame_index": int(arrival.frame.index),
            "rule": self._rules[k].text,
            "value": value,
            "count": 1 + sum((e["rule"], e["individual"]) == own for e in self.events),
            "individual": animal.name,
        }
        withheld = self._rng.random() >= self._stated.probability
        late = time.perf_counter() - arrival.at_s > _LATE_S
        outcome = "late" if late else "withheld" if withheld else "sent"
        for address, sender in self._senders.items() if outcome == "sent" else ():
            try:
                sender.send(message(facts))
            except Exception as error:  # other packages raise no common type; measuring goes on
                outcome = "failed"
                self.problems.setdefault(address, one_line(error))
        facts |= {
            "latency_ms": round(1e3 * (time.perf_counter() - arrival.at_s), 3),
            "sent_time_ns": time.time_ns(),
            "outcome": outcome,
        }
        places = [one.window.uv_px[-1].mean(axis=0) for one in self._animals]
        self.events.append(facts | {"places_px": np.array(places)})
        if self._log is not None:
            self._log.write(message(facts))

    @staticmethod
    def _account(
        rule: Rule, individual: str, events: Sequence[Mapping[str, Any]]
    ) -> dict[str, Any]:
        """What became of the events of a rule among those of an animal."""
        own = [event for event in events if event["rule"] == rule.text]
        sent = [event["latency_ms"] for event in own if event["outcome"] == "sent"]
        return {
            "rule": rule.text,
            "individual": individual,
            "n_events": len(own),
            **{f"n_{one}": sum(e["outcome"] == one for e in own) for one in OUTCOMES},
            "latency_p95_ms": float(np.quantile(sent, 0.95)) if sent else None,
        }


def _since(track: Track, seconds_before: float) -> Track:
    """The rows of a track since this time before its last one."""
    first = np.searchsorted(track.times_ns, track.times_ns[-1] - round(1e9 * seconds_before))
    return track[int(first) :]
