"""Whole depth images for a session's replay, `liex show --depth all`.

A session keeps cut-outs of the depth; the linked recording has all of it. Its images are written
into a separate replay, which Rerun displays together with the session's.
"""

from dataclasses import replace
from pathlib import Path

from liex_lab.errors import LiexError, SessionError
from liex_lab.plan import Plan
from liex_lab.recordings.depth_kernels import to_millimetres
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session, cutouts, evidence, rrd

from .build import build_recording

_CHUNK = 32  # frames in memory at a time


def whole_images(
    session: str | Path, out: Path, recording: str | None = None, progress: Progress = silent
) -> Path:
    """Write the whole depth images of a session's recording into a replay.

    Args:
        session: the session folder.
        out: the .rrd file to write.
        recording: path of the recording, if it has moved since the session was measured.
        progress: called while the recording is hashed and read.

    Returns:
        `out`.

    Raises:
        SessionError: the session does not link to its recording, the recording is missing, or it
            has another hash.
        RecordingError: the recording cannot be read.
    """
    opened = Session.open(session, raw=True)
    origin = replace(
        evidence.provenance_of(opened, evidence.skeleton_of(opened)), replay_depth=cutouts.ALL
    )
    with _recording_of(opened, recording, progress) as images:
        replay = rrd.ReplayWriter(out, origin)
        try:
            for frames in images.chunks(_CHUNK):
                replay.add(
                    [frame.index for frame in frames],
                    [frame.time_ns for frame in frames],
                    [to_millimetres(frame.depth) for frame in frames],
                )
                progress(frames[-1].index + 1, len(images), "reading whole images")
            replay.flushed()
        finally:
            replay.abandon()
    return out


def _recording_of(session: Session, stated: str | None, progress: Progress) -> Recording:
    """The recording of a session, opened with the session's plan after its hash is checked."""
    where = stated or evidence.linked_recording(session)
    if where is None:
        raise SessionError(
            f"{session.path} does not link to its recording, like sessions of earlier versions; "
            "name it with --recording"
        )
    if not where.startswith("synthetic:") and not Path(where).exists():
        raise SessionError(
            f"full depth images are missing: the recording of {session.path.name} is not at "
            f"{where} any more; name it with --recording"
        )
    recording = build_recording(where, Plan.from_toml(session.plan, "plan.toml"), progress)
    try:
        if recording.digest(progress) != session.metadata["input"]["sha256"]:
            raise SessionError(
                f"full depth images are missing: {where} is not the recording that "
                f"{session.path.name} was made of, its hash is another one; name the right one "
                "with --recording"
            )
    except LiexError:
        recording.close()
        raise
    return recording
