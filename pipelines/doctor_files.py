"""What `liex doctor` does where files leave something out: it guesses, and says what to write.

Pictures in a folder often do not say what camera took them, when, or which of two kinds is meant. A
run refuses them; a diagnosis goes on with what is likely and says so.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from liex_lab.errors import SeveralKindsError, UnknownCameraError, UnknownTimesError
from liex_lab.optics.camera import of_size, preset
from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress, silent

from .build import open_planned
from .choice import USUAL, Proposal

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording

_USUAL_HZ = 30.0
_USUAL_FOCAL = 0.9  # of a picture's width: depth cameras see 55 to 65 degrees of it
_GUESS = ["camera.fx=1.0", "camera.fy=1.0", "camera.cx=0.0", "camera.cy=0.0"]


def open_anyhow(
    path: str | Path, plan: Plan, progress: Progress = silent
) -> tuple[Recording, list[str]]:
    """Open a recording, with a guess for what it leaves out.

    Args:
        path: a file, folder or address of a recording.
        plan: how it is opened.
        progress: told while an archive is unpacked or an index made.

    Returns:
        The recording, and sentences that say what is missing and the lines to write.

    Raises:
        RecordingError: there is nothing in it that can be read.
    """
    missing: list[str] = []
    guessed = plan
    pattern = None
    unknown_camera = False
    for _ in range(4):  # each time one thing more is guessed
        try:
            recording = open_planned(path, guessed, progress, pattern)
        except UnknownCameraError:
            if unknown_camera:
                raise
            unknown_camera = True
            guessed = guessed.with_settings(_GUESS)
        except UnknownTimesError:
            missing.append(
                f"the times of the pictures are not known, and {_USUAL_HZ:g} frames/s were assumed "
                f"here; write fps = {_USUAL_HZ:g} (your camera's rate) under [camera] in "
                "camera.toml, or timestamps.csv with a line time_ns and then one time per picture"
            )
            guessed = guessed.with_settings([f"recording.fps={_USUAL_HZ}"])
        except SeveralKindsError as error:
            pattern = error.pattern
            missing.append(
                f"pictures of several kinds lie here, and {pattern} was looked at; choose with the "
                f'line pattern = "{pattern}" under [camera] in camera.toml'
            )
        else:
            break
    else:
        recording = open_planned(path, guessed, progress, pattern)
    if unknown_camera:
        missing.insert(0, _guess_camera(recording))
    return recording, missing


def _guess_camera(recording: Recording) -> str:
    """Give the recording the likeliest camera for its pictures' size; returns what to write."""
    width = recording.width
    height = recording.height
    names = of_size(width, height)
    focal = preset(names[0], width, height).fx if names else round(_USUAL_FOCAL * width, 1)
    like = f"those of a {names[0]}" if names else "those of many a depth camera"
    cx = (width - 1) / 2
    cy = (height - 1) / 2
    recording.camera = replace(
        recording.camera, fx=focal, fy=focal, cx=cx, cy=cy, source="assumed: not stated"
    )
    choice = f"say --set camera.preset={'|'.join(names)}, or " if names else ""
    return (
        f"the camera is not known, so all lengths here are guesses with {like}; {choice}write "
        f"camera.toml with the lines [camera], fx = {focal:g}, fy = {focal:g}, cx = {cx:g}, "
        f"cy = {cy:g} (your camera's numbers, in pixels) and unit_mm = 1.0 (millimetres per stored "
        "step)"
    )


def next_command(
    path: str | Path,
    proposal: Proposal,
    missing: list[str],
    n_arenas: int = 0,
    plan: str | None = None,
    options: Sequence[str] = (),
) -> str:
    """What to type next; empty where no plan was looked for.

    Args:
        path: the recording.
        proposal: which plan fits.
        missing: what the files leave out, to be written first.
        n_arenas: arenas that were seen in the picture, of which each is to be a session.
        plan: the plan that was given, as it was typed; None where none was.
        options: further options that were given and that a run takes, too.
    """
    if not proposal.says:
        return ""
    where = shlex.quote(str(path))
    if missing or proposal.plan is None:
        given = shlex.join([*(["--plan", plan] if plan else []), *options])
        again = f"liex doctor {where} {given}".rstrip()
        if missing:
            return f"write what is missing, then {again}"
        return f"{again} again, once what is said above is corrected"
    named = plan if plan and proposal.is_given else proposal.plan
    chosen = ["--plan", named] if plan or named != USUAL else []
    several = ["--set", "arenas=auto"] if n_arenas > 1 else []
    return shlex.join(["liex", "run", str(path), *chosen, *several, *options])
