"""Append-only log of human corrections to a session: flips, joints, bouts and descriptions.

The files of a session are never written again. The folder `corrected` beside them holds
`corrections.json`, a log to which entries are only added (one entry may take back another), and the
tables that follow from the corrections that stand. The log states the hashes of the tables that it
was made on and the SHA-256 of its own content. `Session.open` reads the corrected tables;
`Session.open(path, raw=True)` reads the measured ones.
"""

from __future__ import annotations

import getpass
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter
from pydantic.dataclasses import dataclass

from liex_lab.catalog import sha256
from liex_lab.errors import SessionError, one_line
from liex_lab.runtime.places import safe_name
from liex_lab.sessions.verdict import ALSO, WHO

FOLDER = "corrected"
LOG = "corrections.json"
REPLAY = "corrected.rrd"
SCHEMA_VERSION = 3  # 2: species and age are described; 3: a correction was made again (redo)
FACTS = {
    "frames",
    "actions",
    "action_model",
    "unresolved_actions",
    "refused_bouts",
    "corrections",
}  # sections that may change
START = "session_start_time"
DESCRIBED = (*WHO, *ALSO, START)
_UNDO = "undo"


@dataclass(frozen=True)
class FlipSpan:
    """Head and tail are exchanged in a span of frames.

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
    """In one frame a joint lies at another position.

    Attributes:
        frame: the frame, the camera's count.
        joint: the joint's name.
        x_mm: position in the arena frame, mm.
        y_mm: position in the arena frame, mm.
        z_mm: height above the floor, mm.
        note: how the height was chosen, where the depth under the pixel did not give it.
    """

    frame: int
    joint: str
    x_mm: float
    y_mm: float
    z_mm: float
    note: str = ""  # logs of earlier versions lack it
    kind: Literal["joint"] = "joint"

    def __str__(self) -> str:
        """The sentence for a list of corrections."""
        return (
            f"{self.joint} of frame {self.frame} to ({self.x_mm:.1f}, {self.y_mm:.1f}, "
            f"{self.z_mm:.1f}) mm" + (f", {self.note}" if self.note else "")
        )


@dataclass(frozen=True)
class BoutEdit:
    """In a span of time the animal does something else than the ethogram says.

    Attributes:
        edit: what is done to the bout.
        action: what the animal does; '' for nothing that has a name.
        start_ns: start on the recording's clock, ns.
        stop_ns: stop, ns, exclusive.
        was: action of the bout that is edited, for the reader.
        was_start_ns: start of the bout that is edited, ns; it loses its time first.
        was_stop_ns: its stop, ns; equal to its start where there was none.

    Raises:
        ValueError: the edit is not known, or the span is empty.
    """

    edit: Literal["add", "rename", "recut", "delete"]
    action: str
    start_ns: int
    stop_ns: int
    was: str = ""
    was_start_ns: int = 0
    was_stop_ns: int = 0
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
    """A fact about the animal or the session that no measurement depends on.

    It applies to every measurement of the recording.

    Attributes:
        key: one of `DESCRIBED`.
        value: its value; '' if unknown.

    Raises:
        ValueError: the key is not known.
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


Correction = FlipSpan | JointMove | BoutEdit | Description
_CORRECTION: TypeAdapter[Correction] = TypeAdapter(
    Annotated[Correction, Field(discriminator="kind")]
)


@dataclass(frozen=True)
class Entry:
    """One line of the log: a correction, an undo of one, or an undo of an undo, which is a redo.

    Attributes:
        number: of the entry, from 1.
        author: who made it.
        made_at: when, ISO 8601 with time zone.
        what: the correction; None if the entry takes another one back.
        undoes: number of the entry that is taken back, a correction or an undo; 0 for a correction.
    """

    number: int
    author: str
    made_at: str
    what: Correction | None
    undoes: int = 0

    def to_dict(self) -> dict[str, Any]:
        """The entry as corrections.json keeps it."""
        about = {"number": self.number, "author": self.author, "made_at": self.made_at}
        if self.what is None:
            return {**about, "kind": _UNDO, "undoes": self.undoes}
        return {**about, "kind": self.what.kind, **asdict(self.what)}

    @staticmethod
    def from_dict(entry: Mapping[str, Any]) -> Entry:
        """The entry that `to_dict` made into a table.

        Raises:
            ValueError: a value cannot be used, or the kind is not known.
            KeyError: a key is missing.
            TypeError: a value is of another type.
        """
        about = (int(entry["number"]), str(entry["author"]), str(entry["made_at"]))
        if entry["kind"] == _UNDO:
            return Entry(*about, None, int(entry["undoes"]))
        return Entry(*about, _CORRECTION.validate_python(entry))


@dataclass(frozen=True)
class Log:
    """All entries, first to last, and what they were applied to.

    Attributes:
        made_of: which poses and bouts they correct, see `basis`.
        entries: the entries in the order in which they were made.
        files: bytes and SHA-256 of each corrected table by name.
        facts: sections that session.json would have instead, a subset of `FACTS`.

    Raises:
        ValueError: a file lies outside of the folder, or a section is not one of `FACTS`.
    """

    made_of: str
    entries: tuple[Entry, ...] = ()
    files: dict[str, dict[str, Any]] = field(default_factory=dict)
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if any(safe_name(name) != name for name in self.files):
            raise ValueError("files outside of its folder")
        if not set(self.facts) <= FACTS:
            raise ValueError(f"facts of {', '.join(sorted(set(self.facts) - FACTS))}")

    @property
    def standing(self) -> tuple[Entry, ...]:
        """The corrections that nobody took back, in the order in which they were made."""
        gone = set(self.undos.values())
        return tuple(
            entry for entry in self.entries if entry.what is not None and entry.number not in gone
        )

    @property
    def undos(self) -> dict[int, int]:
        """The undos that no redo took back, by number: the number of the correction of each."""
        found: dict[int, int] = {}
        for entry in self.entries:
            if entry.undoes in found:  # a redo
                del found[entry.undoes]
            elif entry.what is None:
                found[entry.number] = entry.undoes
        return found

    @property
    def redoable(self) -> tuple[int, Correction] | None:
        """The undo that a redo takes back, by its number, and the correction that returns.

        It is the last undo that stands; a new correction after it leaves none.
        """
        whats = {entry.number: entry.what for entry in self.entries if entry.what is not None}
        number, undone = max(self.undos.items(), default=(0, 0))
        return (number, whats[undone]) if number > max(whats, default=0) else None

    def corrections(self, kind: type[Any]) -> list[Any]:
        """The standing corrections of one kind."""
        return [entry.what for entry in self.standing if isinstance(entry.what, kind)]

    @property
    def described(self) -> dict[str, str]:
        """What is known of animal and session, by the words of `DESCRIBED`; '' is unknown."""
        return {one.key: one.value for one in self.corrections(Description)}

    @property
    def touched(self) -> tuple[Entry, ...]:
        """The standing corrections of what was measured: all but descriptions."""
        return tuple(one for one in self.standing if not isinstance(one.what, Description))

    def added(self, what: Sequence[Correction], undo: Sequence[int] = (), author: str = "") -> Log:
        """The log with further entries: first those that take others back, then new corrections.

        Args:
            what: new corrections.
            undo: numbers of standing entries to take back, or of the undo that `redoable` names.
            author: who makes them; "" takes who is logged in.

        Raises:
            SessionError: an entry to take back does not stand.
        """
        known = {entry.number for entry in self.standing}
        redoable = self.redoable
        for number in undo:
            if number not in known and (redoable is None or number != redoable[0]):
                told = ", ".join(str(n) for n in sorted(known)) or "none"
                raise SessionError(
                    f"there is no correction {number} to take back; those that stand are {told}"
                )
        author = author or author_name()
        now = datetime.now(UTC).isoformat(timespec="seconds")
        first = 1 + max((entry.number for entry in self.entries), default=0)
        wanted = [*((None, number) for number in dict.fromkeys(undo)), *((one, 0) for one in what)]
        new = [Entry(number, author, now, *one) for number, one in enumerate(wanted, first)]
        return Log(self.made_of, (*self.entries, *new), self.files, self.facts)

    def to_json(self) -> str:
        """The content of corrections.json, with its own hash in it."""
        undos = {entry.number for entry in self.entries if entry.what is None}
        redone = any(entry.undoes in undos for entry in self.entries)
        document = {
            "schema_version": SCHEMA_VERSION if redone else 2,  # which earlier versions read
            "made_of": self.made_of,
            "entries": [entry.to_dict() for entry in self.entries],
            "files": self.files,
            "facts": self.facts,
        }
        plain = json.loads(json.dumps(document, default=str, allow_nan=False))
        return json.dumps({**plain, "sum": _sum(plain)}, indent=1, ensure_ascii=False) + "\n"


def _sum(document: Mapping[str, Any]) -> str:
    """SHA-256 of a log's content without its own `sum`.

    What is read and merged into session.json's sections was then written by liex_lab.
    """
    stated = {key: value for key, value in document.items() if key != "sum"}
    return hashlib.sha256(json.dumps(stated, sort_keys=True).encode()).hexdigest()


def author_name() -> str:
    """Name of who is logged in, as far as the system tells; else 'unknown'."""
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return "unknown"


def corrected_folder(session: Path) -> Path:
    """Folder of a session's corrections; while it is being replaced, the previous one."""
    folder = session / FOLDER
    old = session / f"{FOLDER}.old"
    return old if old.is_dir() and not folder.is_dir() else folder


def basis(session: Path, metadata: Mapping[str, Any]) -> str:
    """Fingerprint of what the corrections of a session are made on: its own poses, bouts and flips.

    Args:
        session: the session folder.
        metadata: the content of session.json, which may state the hashes.

    Returns:
        The first 16 hexadecimal digits of each table's SHA-256, joined by '-'.
    """
    stated = metadata.get("files") or {}
    found = []
    for name in ("poses.parquet", "bouts.parquet", "flips.parquet"):
        facts = stated.get(name) if isinstance(stated, dict) else None
        found.append(
            str(facts["sha256"])
            if isinstance(facts, dict) and "sha256" in facts
            else sha256(session / name)
        )
    return "-".join(one[:16] for one in found)


def read_log(session: Path) -> Log:
    """Read the corrections of a session; an empty log where there are none.

    Raises:
        SessionError: the log is damaged or was written by a later version.
    """
    path = corrected_folder(session) / LOG
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
        entries = tuple(Entry.from_dict(entry) for entry in document["entries"])
        made_of = str(document["made_of"])
        return Log(made_of, entries, document.get("files", {}), document.get("facts", {}))
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        OverflowError,
        RecursionError,
    ) as error:
        raise SessionError(
            f"{path} is damaged ({type(error).__name__}: {one_line(error)}); restore a copy of it, "
            f"or remove the folder {FOLDER} to continue with what was measured"
        ) from None


def applies(log: Log, session: Path, metadata: Mapping[str, Any]) -> bool:
    """Whether the log has corrections that stand, and they were made on these poses and bouts."""
    return bool(log.standing) and log.made_of == basis(session, metadata)


def with_description(metadata: Mapping[str, Any], described: Mapping[str, str]) -> dict[str, Any]:
    """The content of session.json with what was described since.

    Args:
        metadata: the content of session.json.
        described: see `Log.described`.
    """
    found = dict(metadata)
    subject = {name: value for name, value in described.items() if name != START}
    if subject:
        subject = {**metadata.get("subject", {}), **subject}
        found["subject"] = {name: value for name, value in subject.items() if value}
    if START in described:
        found[START] = described[START] or None
    return found
