"""Verification of a session, `liex verify`: its hashes, logs, model, plan, and reproducibility.

Every file is checked against its size and SHA-256 in session.json, replay and messages against
their own checksums and lengths. If the recording is given, it is measured again and the tables are
compared byte by byte, or else row by row.
"""

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from liex_lab.catalog import find_model, sha256
from liex_lab.errors import LiexError, SessionError
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.text_files import value_at
from liex_lab.sessions import Session, checkpoint, corrections

from .session import run_session

_NEEDED = (
    "schema_version",
    "session_id",
    "versions",
    "input.sha256",
    "plan.seed",
    "camera.calibration_hash",
    "animal",
    "model.sha256",
    "timings_s.total",
    "machine",
    "problems",
    "files",
)


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        state: `ok`; `wrong`: the session differs from its description; `note`: additional
            information.
        sentence: the finding.
    """

    state: str
    sentence: str


def verify_session(
    session: str | Path, recording: str | Path | None = None, *, progress: Progress = silent
) -> list[Finding]:
    """Check whether a session is unchanged since it was written; returns the findings.

    Compares the facts in session.json, the files with their SHA-256, the logs, the model and the
    corrections.

    Args:
        session: the session folder.
        recording: its recording, to check whether re-running reproduces the session, which takes as
            long as the first run. None skips this.
        progress: receives progress of the second run.

    Returns:
        One `Finding` per check; its state is ok, wrong or note.

    Raises:
        SessionError: there is no session.
    """
    opened = Session.open(session, raw=True)
    found = [
        *_provenance(opened),
        *_files(opened),
        *_logs(opened),
        *(() if opened.metadata.get("imported") else _model(opened)),
        *_corrections(opened),
    ]
    return [*found, *_again(opened, str(recording), progress)] if recording else found


def _provenance(session: Session) -> Iterator[Finding]:
    """Whether session.json has all that is needed to reproduce the session."""
    missing = [
        name
        for name in _NEEDED
        if value_at(session.metadata, name.split(".")) in (None, "", {})
        and not (name == "model.sha256" and session.metadata.get("imported"))
    ]
    if missing:
        yield Finding(
            "note",
            f"session.json lacks {', '.join(missing)}; it was written by an older liex_lab",
        )
    else:
        yield Finding("ok", "session.json describes how the session was made")
    if Plan.from_toml(session.plan, "plan.toml") != Plan.from_table(
        session.metadata.get("plan", {}), "session.json"
    ):
        yield Finding("wrong", "plan.toml is not the plan in session.json")


def _files(session: Session) -> Iterator[Finding]:
    """Check the size and hash of every file."""
    stated = session.metadata.get("files")
    if not isinstance(stated, dict):
        return
    wrong = _changed(session.path, stated)
    yield from (Finding("wrong", sentence) for sentence in wrong)
    if not wrong:
        yield Finding("ok", f"{len(stated)} files are as they were written")


def _changed(folder: Path, stated: Mapping[str, Any]) -> list[str]:
    """Errors in files of a folder with stated sizes and hashes."""
    wrong = []
    for name, facts in stated.items():
        file = folder / Path(name).name
        if not file.is_file():
            wrong.append(f"{name} is missing")
        elif file.stat().st_size != facts.get("bytes") or (
            "sha256" in facts and sha256(file) != facts["sha256"]
        ):
            wrong.append(f"{name} was changed")
    return wrong


def _corrections(session: Session) -> Iterator[Finding]:
    """Whether the log of corrections can be read and its tables are unchanged."""
    try:
        log = corrections.read_log(session.path)
    except SessionError as error:
        yield Finding("wrong", str(error))
        return
    if not log.standing:
        return
    if not corrections.applies(log, session.path, session.metadata):
        yield Finding(
            "note",
            "its corrections were made on another measurement; `liex correct apply` applies them",
        )
        return
    wrong = _changed(corrections.corrected_folder(session.path), log.files)
    yield from (
        Finding("wrong", f"of the corrected tables, {sentence}; see `liex correct apply`")
        for sentence in wrong
    )
    if not wrong:
        authors = ", ".join(sorted({entry.author for entry in log.standing}))
        counted = f"{len(log.standing)} corrections ({authors}) stand beside it"
        yield Finding("ok", f"{counted}, and their {len(log.files)} files are as they were written")


def _logs(session: Session) -> Iterator[Finding]:
    """Whether replay and messages are complete, by their own checksums and lengths."""
    try:
        n = sum(1 for _ in checkpoint.rrd_messages(session.path / "session.rrd"))
        n_depth = _depth_messages(session)
    except SessionError as error:
        yield Finding("wrong", str(error))
        return
    wanted = session.metadata.get("frames", {}).get("n_frames")
    if n_depth == 0 and value_at(session.metadata, ("plan", "replay", "depth")) == "none":
        yield Finding("ok", f"session.rrd ({n} messages) is whole; no depth was to be kept")
    elif n_depth != wanted:
        yield Finding(
            "wrong", f"session.mcap holds {n_depth} depth images and the session {wanted} frames"
        )
    else:
        yield Finding(
            "ok", f"session.rrd ({n} messages) and session.mcap ({n_depth} images) are whole"
        )


def _depth_messages(session: Session) -> int:
    """Number of depth images in the summary of session.mcap."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    try:
        with (session.path / "session.mcap").open("rb") as file:
            summary = make_reader(file).get_summary()
    except (McapError, ValueError, OSError, EOFError):
        summary = None
    if summary is None or summary.statistics is None:
        raise SessionError("session.mcap is damaged; run `liex run` on the recording again")
    depth = [
        number for number, channel in summary.channels.items() if channel.topic == "/camera/depth"
    ]
    return sum(summary.statistics.channel_message_counts.get(number, 0) for number in depth)


def _model(session: Session) -> Iterator[Finding]:

    stated = session.metadata.get("model", {})
    try:
        same = sha256(find_model(stated.get("name", ""))) == stated.get("sha256")
    except LiexError as error:
        yield Finding("note", f"its model is not here: {error}")
        return
    yield (
        Finding("ok", "its model is the one that is installed")
        if same
        else Finding(
            "note",
            f"it was made with another model {stated.get('name')} than the one that is installed",
        )
    )


def _again(session: Session, recording: str, progress: Progress) -> Iterator[Finding]:
    """Measure the recording again and compare the tables."""
    plan = Plan.from_toml(session.plan, "plan.toml")
    with open_recording(recording, fps=plan.recording.fps, topic=plan.recording.topic) as opened:
        if opened.digest(progress) != session.metadata["input"].get("sha256"):
            yield Finding("wrong", f"{recording} is not the recording that the session was made of")
            return
    with tempfile.TemporaryDirectory(prefix="liex-verify-") as scratch:
        plan = Plan.from_table(
            {
                **plan.model_dump(exclude_none=True),
                "session": {**plan.session.model_dump(exclude_none=True), "name": session.name},
            }
        )
        other = Session.open(run_session(recording, plan, scratch, report=False, progress=progress))
        tables = [
            path for path in sorted(session.path.iterdir()) if path.suffix in (".parquet", ".csv")
        ]
        differing = [path.name for path in tables if not _same_rows(path, other.path / path.name)]
        then, now = session.metadata.get("versions", {}), other.metadata["versions"]
    if not differing:
        yield Finding("ok", f"measured again, all {len(tables)} tables are the same")
        return
    changed = [
        f"{name} {then.get(name)}, now {v}" for name, v in now.items() if then.get(name) != v
    ]
    because = f"; versions changed: {', '.join(changed)}" if changed else ""
    yield Finding("wrong", f"measured again, it has other rows in {', '.join(differing)}{because}")


def _same_rows(path: Path, other: Path) -> bool:
    """Whether two tables have the same rows; their metadata, such as versions, may differ."""
    import pandas as pd

    if not other.is_file():
        return False
    if path.read_bytes() == other.read_bytes():
        return True
    # `equals` treats empty cells as equal
    return path.suffix == ".parquet" and pd.read_parquet(path).equals(pd.read_parquet(other))
