"""Model of the dashboard: a study's data, read lazily from session folders and cached.

The cache is kept until a session's files change (their time, size and inode). Group comparisons
come from `liex_lab.behaviour.cohort`.
"""

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from liex_lab.behaviour import cohort
from liex_lab.errors import LiexError, SessionError, one_line
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session, corrections, verdict
from liex_lab.tracking.track import DOUBTFUL

from ..figures.animals import Recent
from ..report.report import warnings

DONE = ("done", "changed")  # states of sessions with results
NO_POSE = "no pose or no frame"
OTHER = "other actions"
GREY = "#a3a39b"
NO_POSE_COLOUR = "#3a3f45"


@dataclass(frozen=True)
class SessionBouts:
    """A session's bouts.

    Attributes:
        spans_s: (n, 2) start and stop of each bout, s.
        words: the n actions.
        lost_s: (m, 2) start and stop of the spans without a pose, s.
        duration_s: length of the session, s.
        vocabulary: all possible actions, in the order of their colours in report and replay.
    """

    spans_s: np.ndarray
    words: list[str]
    lost_s: np.ndarray
    duration_s: float
    vocabulary: tuple[str, ...] = ()


Made = TypeVar("Made")
# pauses before reading again, while a correction replaces the tables
_PAUSES_S = (0.05, 0.2, 0.5)


class StudyData:
    """A study, read lazily; all public methods are thread-safe.

    Attributes:
        name: name of the study.
        entries: key -> state of each session, in the study's order.
    """

    def __init__(self, name: str, list_entries: Callable[[], Sequence[verdict.Entry]]) -> None:
        self.name = name
        self._list_entries = list_entries
        self._lock = threading.RLock()
        self._facts: dict[str, tuple[Any, dict[str, Any]]] = {}
        self._stats: dict[Any, pd.DataFrame] = {}
        self._whole: tuple[Any, pd.DataFrame] | None = None
        # sessions whose tables stay in memory
        self._open = Recent(6)
        self.entries: dict[str, verdict.Entry] = {}
        self.refresh()

    def refresh(self) -> None:
        """Update the list of sessions and their states."""
        self.entries = {entry.key: entry for entry in self._list_entries()}

    def warm(self, progress: Progress = silent) -> None:
        """Read the data of the first page; a thread then reads those of the other pages."""
        entries = self.done
        for k, entry in enumerate(entries):
            progress(k, len(entries), "reading sessions")
            self._facts_of(entry)
        threading.Thread(target=self.collected, daemon=True).start()

    @property
    def done(self) -> list[verdict.Entry]:
        """The sessions with results."""
        return [one for one in self.entries.values() if one.state in DONE and one.folder]

    def session(self, key: str) -> Session:
        """An opened session; the same object until its folder changes.

        Raises:
            SessionError: the study has no measured session `key`.
        """
        entry = self.entries.get(key)
        if entry is None or entry.folder is None or entry.state not in DONE:
            raise SessionError(
                f"the study has no measured session '{key}'; see the list of its sessions"
            )
        return self._open.get(key, _stamp(entry.folder), partial(Session.open, entry.folder))

    def read(self, key: str, make: Callable[[Session], Made]) -> Made:
        """The result of `make`, repeated while a correction replaces the session's tables.

        Args:
            key: its name in the study.
            make: reads the opened session.

        Raises:
            SessionError: the study has no such session, or its tables cannot be read.
        """
        for pause_s in _PAUSES_S:
            session = self.session(key)
            try:
                return make(session)
            except SessionError:
                time.sleep(pause_s)
        return make(self.session(key))

    def overview(self) -> pd.DataFrame:
        """One row per session: subject, state, and quality (the columns `QUALITY`)."""
        measured = {entry.key: facts["quality"] for entry, facts in self._measured()}
        rows = [
            {
                "session": entry.key,
                **{name: entry.subject.get(name, "") for name in verdict.SUBJECT},
                "state": entry.state,
                "reason": entry.reason,
                "remedy": entry.remedy,
                **measured.get(entry.key, {}),
            }
            for entry in self.entries.values()
        ]
        return pd.DataFrame(
            rows, columns=["session", *verdict.SUBJECT, "state", "reason", "remedy", *QUALITY]
        )

    def ethograms(self, keys: Iterable[str]) -> dict[str, SessionBouts]:
        """The ethograms of measured sessions by key; unreadable ones are left out."""
        found = {entry.key: facts["ethogram"] for entry, facts in self._measured()}
        return {key: found[key] for key in keys if isinstance(found.get(key), SessionBouts)}

    def collected(self) -> pd.DataFrame:
        """One row per measured session, as needed by `cohort.compare`, with its `key`.

        The animals and groups of the study override those of the session. `attrs["check"]` has
        sentences on possible mistakes in their names.
        """
        measured = self._measured()
        state = [(entry.key, self._facts[entry.key][0], entry.subject) for entry, _ in measured]
        with self._lock:
            if self._whole is not None and self._whole[0] == state:
                return self._whole[1]
        tables = [
            facts["summary"].assign(key=entry.key, **{k: v for k, v in entry.subject.items() if v})
            for entry, facts in measured
            if isinstance(facts["summary"], pd.DataFrame)
        ]
        whole = pd.DataFrame(columns=["key", "session_id", *verdict.SUBJECT])
        if tables:
            whole, notes = cohort.unified(pd.concat(tables, ignore_index=True))
            whole.attrs["check"] = notes
        with self._lock:
            self._whole = (state, whole)
            self._stats.clear()
        return whole

    def stats(self, measure: str, reference: str | None = None) -> pd.DataFrame:
        """The table `stats` of the usual measures and this one, with p corrected for all of them.

        It is kept until a session changes.

        Args:
            measure: a column of the summaries.
            reference: compare each group with this one only; None compares all pairs.
        """
        table = self.collected()
        measures = cohort.usual_measures(table)
        wanted = measures if measure in measures else [*measures, measure]
        asked = (tuple(wanted), reference)
        with self._lock:
            if asked not in self._stats:
                self._stats[asked] = cohort.compare(table, wanted, reference)
            return self._stats[asked]

    def described(self, measure: str) -> tuple[str, str]:
        """Unit and meaning of a column of the summaries, from the first session that has it.

        Returns:
            Two empty texts if no session has it.
        """
        for columns in self._columns():
            if measure in columns.index:
                return str(columns.loc[measure, "unit"] or ""), str(columns.loc[measure, "meaning"])
        return "", ""

    def units(self) -> dict[str, str]:
        """The unit of every measure, from the columns of one session; "" for dimensionless ones."""
        for columns in self._columns():
            return {str(name): str(unit or "") for name, unit in columns["unit"].items()}
        return {}

    def _columns(self) -> Iterator[pd.DataFrame]:
        """The columns of the summaries of the sessions: unit and meaning by name."""
        for entry in self.done:
            with suppress(LiexError):
                columns = self.session(entry.key).columns
                summary = columns[columns["table"] == "summary"].set_index("name")
                yield summary.astype(object).where(summary.notna(), "")

    def _measured(self) -> list[tuple[verdict.Entry, dict[str, Any]]]:
        """Every measured session with its facts."""
        done = self.done
        # threads; most of the time is spent opening files
        with ThreadPoolExecutor(4) as pool:
            return list(zip(done, pool.map(self._facts_of, done), strict=True))

    def _facts_of(self, entry: verdict.Entry) -> dict[str, Any]:
        """What the study's pages show of a session (`_FACTS`); kept until its folder changes."""
        folder = entry.folder
        assert folder is not None
        stamp, session = _stamp(folder), None
        known = self._facts.get(entry.key)
        if known is not None and known[0] == stamp:
            return known[1]
        facts = {}
        for what, read in _FACTS.items():  # all at once, since opening checks the whole session
            try:
                session = session or Session.open(folder)
                facts[what] = read(session)
            except LiexError as error:
                facts[what] = {"damage": str(error)}
            except Exception as error:  # one bad session must not break the study's pages
                reason = f"{type(error).__name__}: {one_line(error)}"
                remedy = "check it with `liex verify`"
                facts[what] = {"damage": f"{folder} cannot be shown ({reason}); {remedy}"}
        self._facts[entry.key] = (stamp, facts)
        return facts


QUALITY = (
    "duration_min",
    "n_frames",
    "posed_share",
    "doubtful_share",
    "n_gaps",
    "n_missing",
    "predicted_error_mm",
    "n_flips",
    "flips_s",
    "warnings",
    "damage",
)


def shown_words(ethograms: Iterable[SessionBouts]) -> list[str]:
    """The actions of some ethograms, by decreasing total time."""
    seconds: dict[str, float] = {}
    for one in ethograms:
        for word, (start, stop) in zip(one.words, one.spans_s, strict=True):
            seconds[word] = seconds.get(word, 0.0) + float(stop - start)
    return sorted(seconds, key=lambda word: (-seconds[word], word))


def raster(
    one: SessionBouts, words: Sequence[str], start_s: float, stop_s: float, n: int
) -> np.ndarray:
    """(n,) the word with the most time in each of n equal bins of a span.

    Args:
        one: the ethogram.
        words: the words to count.
        start_s: beginning of the span, s.
        stop_s: its end, s.
        n: number of bins.

    Returns:
        Index into `words`; -1 if none of them occurs, -2 if most of the bin has no pose.
    """
    place = {word: k for k, word in enumerate(words)}
    seconds = np.zeros((len(words) + 1, n))
    step = (stop_s - start_s) / n
    kinds = [place.get(word, -1) for word in one.words] + [len(words)] * len(one.lost_s)
    for kind, (a, b) in zip(kinds, np.concatenate([one.spans_s, one.lost_s]), strict=True):
        low, high = (float(np.clip((at - start_s) / step, 0, n)) for at in (a, b))
        if kind < 0 or high <= low:
            continue
        first = int(low)
        last = min(int(np.ceil(high)), n) - 1
        seconds[kind, first : last + 1] += 1.0
        seconds[kind, first] -= low - first
        seconds[kind, last] -= last + 1 - high
    # a bout that continues across a gap is not observed there
    seconds[:-1] = np.minimum(seconds[:-1], 1.0 - seconds[-1])
    best = seconds.argmax(axis=0)
    best[best == len(words)] = -2
    best[seconds.max(axis=0) <= 0.0] = -1
    return best


def _stamp(folder: Path) -> Any:
    """Times, sizes and inodes; they change when the session is rewritten or corrected."""
    stamps: dict[str, tuple[int, int, int]] = {}
    for path in (folder / "session.json", corrections.corrected_folder(folder) / corrections.LOG):
        with suppress(OSError):
            found = path.stat()
            stamps[path.name] = (found.st_mtime_ns, found.st_size, found.st_ino)
    return stamps


def _quality(session: Session) -> dict[str, Any]:
    frames = session.metadata["frames"]
    n = max(int(frames["n_frames"]), 1)
    error = session.table("frames", ["predicted_error_mm"])["predicted_error_mm"]
    flips = session.flips
    return {
        "duration_min": frames["duration_s"] / 60.0,
        "n_frames": frames["n_frames"],
        "posed_share": frames["n_observed"] / n,
        "doubtful_share": sum(frames["flags"].get(flag, 0) for flag in DOUBTFUL) / n,
        "n_gaps": frames["n_gaps"],
        "n_missing": frames["n_missing"],
        "predicted_error_mm": float(error.median()),
        "n_flips": len(flips),
        "flips_s": float((flips["stop_s"] - flips["start_s"]).sum()),
        "warnings": len(warnings(session)),
        "damage": "",
    }


def _ethogram(session: Session) -> SessionBouts:
    bouts = session.table("bouts", ["action", "start_s", "stop_s"])
    gaps = session.table("gaps", ["start_s", "stop_s", "n_frames_missing"])
    lost = gaps[gaps["n_frames_missing"] > 0]
    return SessionBouts(
        bouts[["start_s", "stop_s"]].to_numpy(float),
        [str(word) for word in bouts["action"]],
        lost[["start_s", "stop_s"]].to_numpy(float),
        float(session.metadata["frames"]["duration_s"]),
        tuple(session.metadata.get("actions") or {}),
    )


def _summary(session: Session) -> pd.DataFrame | None:
    return cohort.collect([session]) if session.has("summary.csv") else None


_FACTS: dict[str, Callable[[Session], Any]] = {
    "quality": _quality,
    "ethogram": _ethogram,
    "summary": _summary,
}
