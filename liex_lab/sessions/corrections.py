"""Append-only log of additions to a session: flips, joints, bouts, animals, descriptions, a clock.

The files of a session are never rewritten. Its folder `corrected` contains `corrections.json`, a
log to which entries are only appended (an entry may undo another), and the tables that result from
the active corrections. The log states the hashes of the tables it was made on and the SHA-256 of
its own content. `Session.open` reads the corrected tables; `Session.open(path, raw=True)` reads the
measured ones.

Corrections of identity (`Roles`) are in the logs of all animals of an arena. Their tables are
written to the folders `corrected.new` first; these are valid once every animal has one, so that the
last rename is the commit (two-phase commit).
"""

import getpass
import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter
from pydantic.dataclasses import dataclass

from liex_lab.catalog import sha256
from liex_lab.errors import SessionError, one_line, refuse
from liex_lab.runtime.durable import safe_name
from liex_lab.runtime.text_files import loose_json
from liex_lab.sessions.clock import ClockFit
from liex_lab.sessions.verdict import ALSO, SUBJECT, verdict_in

FOLDER = "corrected"
NEW = "corrected.new"
LOG = "corrections.json"
REPLAY = "corrected.rrd"
SCHEMA_VERSION = 5  # 2: species and age are described; 3: redo; 4: clock; 5: identities
FACTS = {
    "frames",
    "actions",
    "action_model",
    "unresolved_actions",
    "refused_bouts",
    "corrections",
    "sync",
    "problems",
    "verdict",
}  # sections that may change
START = "session_start_time"
DESCRIBED = (*SUBJECT, *ALSO, START)
_UNDO = "undo"
UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError)  # errors of damaged JSON


@dataclass(frozen=True)
class FlipSpan:
    """Exchange head and tail in a span of frames.

    Attributes:
        start_frame: first frame, the camera's count.
        stop_frame: the first frame after the span.
    """

    start_frame: int
    stop_frame: int
    kind: Literal["flip"] = "flip"

    def __str__(self) -> str:
        """The sentence for a list of corrections."""
        return f"head and tail exchanged in frames {self.start_frame} to {self.stop_frame - 1}"


@dataclass(frozen=True)
class JointMove:
    """Move a joint of one frame to another position.

    Attributes:
        frame: the frame, the camera's count.
        joint: the joint's name.
        x_mm: position in the arena frame, mm.
        y_mm: position in the arena frame, mm.
        z_mm: height above the floor, mm.
        note: how the height was chosen, if not from the depth under the pixel.
    """

    frame: int
    joint: str
    x_mm: float
    y_mm: float
    z_mm: float
    note: str = ""  # absent in logs of earlier versions
    kind: Literal["joint"] = "joint"

    def __str__(self) -> str:
        """The sentence for a list of corrections."""
        return (
            f"{self.joint} of frame {self.frame} to ({self.x_mm:.1f}, {self.y_mm:.1f}, "
            f"{self.z_mm:.1f}) mm" + (f", {self.note}" if self.note else "")
        )


@dataclass(frozen=True)
class BoutEdit:
    """Correct the action in a span of time.

    Attributes:
        edit: type of the edit.
        action: the correct action; '' for none.
        start_ns: start on the recording's clock, ns.
        stop_ns: stop, ns, exclusive.
        was: action of the edited bout, for the reader.
        was_start_ns: start of the edited bout, ns; its time is cleared first.
        was_stop_ns: its stop, ns; equal to its start if there was no bout.
        source: its author, as in the table `bouts`.

    Raises:
        ValueError: the edit is unknown, or the span is empty.
    """

    edit: Literal["add", "rename", "recut", "delete"]
    action: str
    start_ns: int
    stop_ns: int
    was: str = ""
    was_start_ns: int = 0
    was_stop_ns: int = 0
    source: Literal["human", "moseq"] = "human"
    kind: Literal["bout"] = "bout"

    def __post_init__(self) -> None:
        if self.stop_ns <= self.start_ns:
            raise ValueError(f"{self.edit} from {self.start_ns} to {self.stop_ns}")

    def __str__(self) -> str:
        """The sentence for a list of corrections."""
        seconds = f"{(self.stop_ns - self.start_ns) * 1e-9:.3f} s"
        if self.edit == "rename":
            return f"{self.was} of {seconds} is {self.action}"
        if self.edit == "delete":
            return f"no {self.was} for {seconds}"
        return f"{self.action} for {seconds}" + (" (new span)" if self.edit == "recut" else "")


@dataclass(frozen=True)
class Description:
    """A fact about the animal or the session that does not affect measurements.

    It applies to every measurement of the recording.

    Attributes:
        key: one of `DESCRIBED`.
        value: its value; '' if unknown.

    Raises:
        ValueError: the key is unknown.
    """

    key: str
    value: str
    kind: Literal["description"] = "description"

    def __post_init__(self) -> None:
        if self.key not in DESCRIBED:
            raise ValueError(f"{self.key} = {self.value}")

    def __str__(self) -> str:
        """The sentence for a list of corrections."""
        return f"{self.key} is {self.value or 'not known'}"


@dataclass(frozen=True)
class Roles:
    """State which of the animals of one arena is which in a span of frames.

    Attributes:
        animals: the two that are exchanged, by their names in the column `individual`; none for a
            crossing that is right as it is.
        start_frame: first frame, the camera's count.
        stop_frame: the first frame after the span.
        sessions: names of the folders of all animals of the arena, which have the same parent.
        serial: number among these corrections in the arena, from 1; 0 until it is in a log.
    """

    animals: tuple[str, ...]
    start_frame: int
    stop_frame: int
    sessions: tuple[str, ...]
    serial: int = 0
    kind: Literal["roles"] = "roles"

    def __str__(self) -> str:
        """The sentence for a list of corrections."""
        what = f"{' and '.join(self.animals)} exchanged" if self.animals else "crossing is right"
        return f"{what} in frames {self.start_frame} to {self.stop_frame - 1}"


Correction = FlipSpan | JointMove | BoutEdit | Description | ClockFit | Roles
_CORRECTION: TypeAdapter[Correction] = TypeAdapter(
    Annotated[Correction, Field(discriminator="kind")]
)


@dataclass(frozen=True)
class LogEntry:
    """One entry of the log: a correction, the undo of one, or the undo of an undo, which is a redo.

    Attributes:
        number: of the entry, from 1.
        author: its author.
        made_at: its time, ISO 8601 with time zone.
        what: the correction; None for an undo or redo.
        undoes: number of the undone entry, a correction or an undo; 0 for a correction.
    """

    number: int
    author: str
    made_at: str
    what: Correction | None
    undoes: int = 0

    def to_dict(self) -> dict[str, Any]:
        """The entry as stored in corrections.json."""
        about = {"number": self.number, "author": self.author, "made_at": self.made_at}
        if self.what is None:
            return {**about, "kind": _UNDO, "undoes": self.undoes}
        return {**about, "kind": self.what.kind, **asdict(self.what)}

    @staticmethod
    def from_dict(entry: Mapping[str, Any]) -> "LogEntry":
        """Inverse of `to_dict`.

        Raises:
            ValueError: a value is invalid, or the kind is unknown.
            KeyError: a key is missing.
            TypeError: a value is of another type.
        """
        about = (int(entry["number"]), str(entry["author"]), str(entry["made_at"]))
        if entry["kind"] == _UNDO:
            return LogEntry(*about, None, int(entry["undoes"]))
        return LogEntry(*about, _CORRECTION.validate_python(entry))


@dataclass(frozen=True)
class Log:
    """All entries, first to last, and their results.

    Attributes:
        made_of: the poses and bouts they correct, see `basis`.
        entries: the entries in the order in which they were made.
        files: bytes and SHA-256 of each corrected table by name.
        facts: replacements for sections of session.json, a subset of `FACTS`.

    Raises:
        ValueError: a file is outside of the folder, or a section is not one of `FACTS`.
    """

    made_of: str
    entries: tuple[LogEntry, ...] = ()
    files: dict[str, dict[str, Any]] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        others = sorted(set(self.facts) - FACTS)
        refuse(
            ValueError,
            (any(safe_name(name) != name for name in self.files), "files outside of its folder"),
            (others, f"facts of {', '.join(others)}"),
        )

    @property
    def standing(self) -> tuple[LogEntry, ...]:
        """The active corrections, not undone, in the order in which they were made."""
        gone = set(self.undos.values())
        return tuple(
            entry for entry in self.entries if entry.what is not None and entry.number not in gone
        )

    @property
    def undos(self) -> dict[int, int]:
        """The active undos, not redone: number of each and of its correction."""
        found: dict[int, int] = {}
        for entry in self.entries:
            if entry.undoes in found:  # a redo
                del found[entry.undoes]
            elif entry.what is None:
                found[entry.number] = entry.undoes
        return found

    @property
    def redoable(self) -> tuple[int, Correction] | None:
        """The undo that a redo would undo, by its number, and the correction that returns.

        It is the last active undo; None after a new correction.
        """
        whats = {entry.number: entry.what for entry in self.entries if entry.what is not None}
        number, undone = max(self.undos.items(), default=(0, 0))
        return (number, whats[undone]) if number > max(whats, default=0) else None

    def corrections(self, kind: type[Any]) -> list[Any]:
        """The active corrections of one kind."""
        return [entry.what for entry in self.standing if isinstance(entry.what, kind)]

    @property
    def shared(self) -> tuple[LogEntry, ...]:
        """The active corrections of identity, which the logs of all animals of an arena have."""
        found = [one for one in self.standing if isinstance(one.what, Roles)]
        return tuple(sorted(found, key=lambda one: one.what.serial))  # type: ignore[union-attr]

    def beside(self, session: Path) -> list[Path]:
        """The sessions of all animals of an arena, with the one of this log.

        Args:
            session: its folder.
        """
        whats = [one.what for one in self.entries if isinstance(one.what, Roles)]
        names = dict.fromkeys(Path(name).name for what in whats for name in what.sessions)
        return [session.parent / name for name in names]

    @property
    def described(self) -> dict[str, str]:
        """Facts about animal and session, by the keys of `DESCRIBED`; '' is unknown."""
        return {one.key: one.value for one in self.corrections(Description)}

    @property
    def touched(self) -> tuple[LogEntry, ...]:
        """The active corrections of measurements: all except descriptions and clocks."""
        other = (Description, ClockFit)
        return tuple(one for one in self.standing if not isinstance(one.what, other))

    @property
    def clock(self) -> ClockFit | None:
        """The other clock that the session's times are put on: the last one; None if absent."""
        return next(iter(reversed(self.corrections(ClockFit))), None)

    def added(
        self, what: Sequence[Correction], undo: Sequence[int] = (), author: str = ""
    ) -> "Log":
        """The log with further entries: first undos and redos, then new corrections.

        Args:
            what: new corrections.
            undo: numbers of active corrections to undo, or the undo in `redoable`.
            author: their author; "" for the current user.

        Raises:
            SessionError: an entry to undo is not active.
        """
        known = {entry.number for entry in self.standing}
        redoable = self.redoable
        for number in undo:
            if number not in known and (redoable is None or number != redoable[0]):
                active = ", ".join(str(n) for n in sorted(known)) or "none"
                raise SessionError(
                    f"there is no correction {number} to take back; those that stand are {active}"
                )
        serial = max((e.what.serial for e in self.entries if isinstance(e.what, Roles)), default=0)
        what = [
            replace(one, serial=serial + k) if isinstance(one, Roles) and not one.serial else one
            for k, one in enumerate(what, 1)
        ]
        author = author or author_name()
        now = datetime.now(UTC).isoformat(timespec="seconds")
        first = 1 + max((entry.number for entry in self.entries), default=0)
        wanted = [*((None, number) for number in dict.fromkeys(undo)), *((one, 0) for one in what)]
        new = [LogEntry(number, author, now, *one) for number, one in enumerate(wanted, first)]
        return Log(self.made_of, (*self.entries, *new), self.files, self.facts)

    def to_json(self) -> str:
        """The content of corrections.json, including its own hash."""
        undos = {entry.number for entry in self.entries if entry.what is None}
        redone = any(entry.undoes in undos for entry in self.entries)
        clocked = any(isinstance(entry.what, ClockFit) for entry in self.entries)
        identified = any(isinstance(entry.what, Roles) for entry in self.entries)
        document = {
            # readable by earlier versions
            "schema_version": SCHEMA_VERSION
            if identified
            else 4
            if clocked
            else 3
            if redone
            else 2,
            "made_of": self.made_of,
            "entries": [entry.to_dict() for entry in self.entries],
            "files": self.files,
            "facts": self.facts,
        }
        plain = json.loads(json.dumps(document, default=str, allow_nan=False))
        return json.dumps({**plain, "sum": _sum(plain)}, indent=1, ensure_ascii=False) + "\n"


def _sum(document: Mapping[str, Any]) -> str:
    """SHA-256 of a log's content without its own `sum`.

    It proves that content merged into session.json was written by liex_lab.
    """
    stated = {key: value for key, value in document.items() if key != "sum"}
    return hashlib.sha256(json.dumps(stated, sort_keys=True).encode()).hexdigest()


def author_name() -> str:
    """Name of the current user, if the system provides it; else 'unknown'."""
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return "unknown"


def corrected_folder(session: Path) -> Path:
    """Folder of a session's corrections; while it is being replaced, the previous one."""
    folder = session / FOLDER
    old = session / f"{FOLDER}.old"
    new = session / NEW
    if new.is_dir() and _is_valid(new):
        return new
    return old if old.is_dir() and not folder.is_dir() else folder


def _is_valid(new: Path) -> bool:
    """Whether all animals of an arena have the corrections of identity of one of them."""
    log = _read(new / LOG)
    wanted = [one.what for one in log.shared]
    return all(
        any(
            [one.what for one in _read(beside / folder / LOG).shared] == wanted
            for folder in (NEW, FOLDER, f"{FOLDER}.old")
        )
        for beside in log.beside(new.parent)
    )


def basis(session: Path, metadata: Mapping[str, Any]) -> str:
    """Fingerprint of the tables that corrections are based on: the session's poses, bouts and
    flips.

    Args:
        session: the session folder.
        metadata: the content of session.json, which may state the hashes.

    Returns:
        The first 16 hexadecimal digits of each table's SHA-256, joined by '-'.
    """
    stated = metadata.get("files") or {}
    hashes = [
        stated.get(name, {}).get("sha256") or sha256(session / name)
        for name in ("poses.parquet", "bouts.parquet", "flips.parquet")
    ]
    return "-".join(one[:16] for one in hashes)


def read_log(session: Path) -> Log:
    """Read the corrections of a session; an empty log if there are none.

    Raises:
        SessionError: the log is damaged or was written by a later version.
    """
    return _read(corrected_folder(session) / LOG)


def _read(path: Path) -> Log:
    """The log in a file, see `read_log`."""
    if not path.is_file():
        return Log("")
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        version = int(document["schema_version"])
        if version > SCHEMA_VERSION:
            raise SessionError(
                f"{path} was written by a newer liex_lab (schema {version}, this one reads up to "
                f"{SCHEMA_VERSION}); upgrade with `pip install -U liex_lab`"
            )
        if document["sum"] != _sum(document):
            raise ValueError("its sum does not fit, so it was changed")
        entries = tuple(LogEntry.from_dict(entry) for entry in document["entries"])
        made_of = str(document["made_of"])
        return Log(made_of, entries, document.get("files", {}), document.get("facts", {}))
    except (*UNREADABLE, OverflowError, RecursionError) as error:
        raise SessionError(
            f"{path} is damaged ({type(error).__name__}: {one_line(error)}); restore a copy of it, "
            f"or remove the folder {FOLDER} to continue with what was measured"
        ) from None


def applies(log: Log, session: Path, metadata: Mapping[str, Any]) -> bool:
    """Whether the log has active corrections that were made on these poses and bouts."""
    return bool(log.standing) and log.made_of == basis(session, metadata)


def read_verdict(session: Path) -> Mapping[str, Any]:
    """The verdict on the session in a folder, as in `verdict_in`; that of its corrections if any.

    Args:
        session: the session folder.
    """
    document = loose_json(session / "session.json")
    with suppress(SessionError):
        log = read_log(session)
        if "verdict" in log.facts and applies(log, session, document):
            document = {**document, **log.facts}
    return verdict_in(document)


def with_description(metadata: Mapping[str, Any], described: Mapping[str, str]) -> dict[str, Any]:
    """The content of session.json with descriptions applied.

    Args:
        metadata: the content of session.json.
        described: see `Log.described`.
    """
    found = dict(metadata)
    subject = {name: value for name, value in described.items() if name != START}
    if subject:
        known = {**metadata.get("subject", {}), **subject}
        found["subject"] = {name: value for name, value in known.items() if value}
    if START in described:
        found[START] = described[START] or None
    return found
