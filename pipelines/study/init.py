"""A study file to begin from, made of the recordings found in a folder: `liex cohort init`.

Animals and sessions are named after BIDS-like folders (`sub-m01`, `ses-01_date-20260821`) where
there are such, else after folders and files.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

from liex_lab.errors import StudyError
from liex_lab.plan.study import DERIVED, RAW, STUDY_FILE, Study
from liex_lab.runtime.durable import write_whole

_FILES = (".mcap", ".bag", ".db3", ".oni", ".tar.gz", ".tgz", ".avi", ".mkv")
_FOLDERS = (
    "camera.toml",
    "raytrix.toml",
    "depth.dat",
    "depth.avi",
    "depth.mkv",
)  # what marks a folder as a recording
_SKIPPED = {"derivatives", "thumbnails"}
_HEADER = """\
# A study of liex_lab: which animals, in which groups, recorded in which sessions. Correct what is wrong here, then
#     liex cohort {file} --dry-run      says what will be done, and why
#     liex cohort {file}                does it, goes on after any interruption, and leaves out what is done
# Paths count from this file's folder and stay in it. Nothing is ever written into {raw}.
# [set], and `set` of an animal or a session, change values of the plan: set = {{ animal.spine_mm = 65 }}
"""  # noqa: E501


def begin_study(folder: str | Path, overwrite: bool = False) -> Path:
    """Write FOLDER/study.toml with every recording below FOLDER/rawdata, or else below FOLDER.

    Animal and session are taken from folder names such as sub-m01 and ses-01_date-20260821 where
    there are such, otherwise from the recording's own name.

    Args:
        folder: the study's folder.
        overwrite: replace a study file that is there already.

    Returns:
        The path of the study file.

    Raises:
        StudyError: there is no such folder, no recording in it, or a study file already.
    """
    root = Path(folder)
    if not root.is_dir():
        raise StudyError(
            f"a study begins in a folder with recordings, but {root} is none; check the path"
        )
    file = root / STUDY_FILE
    if file.exists() and not overwrite:
        raise StudyError(
            f"{file} exists already; change it by hand, or say "
            "--overwrite (in Python overwrite=True)"
        )
    raw = root / RAW if (root / RAW).is_dir() else root
    found = find_recordings(raw)
    if not found:
        raise StudyError(
            f"no recording was found below {raw}; a study needs at least one, see `liex run --help`"
        )
    named = name_sessions(found, raw)
    text = _text(root, named)
    write_whole(file, text)
    Study.load(file)
    return file


def find_recordings(folder: Path) -> list[Path]:
    """Every recording below a folder, in order of name; results and hidden files are left out.

    Args:
        folder: searched with all folders in it; one that is a recording itself is not looked into.
    """
    found = []
    for inside, folders, names in os.walk(folder):
        here = Path(inside)
        folders[:] = sorted(
            name
            for name in folders
            if name[0] != "."
            and name not in _SKIPPED
            and not name.endswith((".liex", ".part"))
            and not (here / name / "session.json").exists()
        )
        if here != folder and any(name in names for name in _FOLDERS):
            found.append(here)
            folders.clear()
            continue
        found += [
            here / name
            for name in sorted(names)
            if name.lower().endswith(_FILES) and name[0] != "."
        ]
    return found


def name_sessions(recordings: list[Path], raw: Path) -> list[tuple[str, str, Path]]:
    """(animal, session, recording) for each recording, no pair of names twice.

    Names that differ by capitals alone are one, as they are to some file systems.

    Args:
        recordings: paths below `raw`.
        raw: the folder that the names count from.
    """
    named = []
    taken = set()
    spelled: dict[str, str] = {}  # some file systems take M1 and m1 for one, so here they are one
    for path in recordings:
        parts = path.relative_to(raw).parts
        stem = path.name if path.is_dir() else path.name.split(".")[0]
        animal = next((part[4:] for part in parts if part.startswith("sub-")), None)
        session = next((part[4:] for part in parts if part.startswith("ses-")), None)
        if animal is None:
            animal = parts[0] if len(parts) > 1 and not parts[0].startswith("ses-") else stem
        animal = spelled.setdefault(_letters(animal).lower(), _letters(animal))
        session = _pairs(session or (stem if _letters(stem) != animal else "01"))
        base = session
        k = 1
        while (animal.lower(), session.lower()) in taken:
            k += 1
            session = f"{base}_rec-{k}"
        taken.add((animal.lower(), session.lower()))
        named.append((animal, session, path))
    return named


def _letters(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9]", "", text)[:64] or "animal"


def _pairs(text: str) -> str:
    """A session's name: as it is where it is made of key-value pairs, otherwise its letters and
    digits.
    """
    first, *pairs = text.split("_")
    whole = re.fullmatch(r"[A-Za-z0-9]{1,32}", first) and len(pairs) <= 5
    kept = all(re.fullmatch(r"[A-Za-z0-9]{1,32}-[A-Za-z0-9]{1,64}", pair) for pair in pairs)
    return text if whole and kept else _letters(text)[:32]


def _text(root: Path, named: list[tuple[str, str, Path]]) -> str:
    """The study file."""
    lines = [
        _HEADER.format(file=STUDY_FILE, raw=RAW),
        f"name = {_quoted(root.resolve().name or 'study')}",
    ]
    lines += [
        'plan = "mouse"                 # a bundled plan (see `liex info`), or a .toml file in '
        "this folder",
        f'results = "{DERIVED}"',
        'shared = "off"                 # "subject": an animal has one size and shape',
        "",
        "[set]",
        "",
    ]
    for animal in dict.fromkeys(animal for animal, _, _ in named):
        lines += [
            "[[animals]]",
            f"id = {_quoted(animal)}",
            'group = ""                     # cage, sex, batch too',
            "",
        ]
    for animal, session, path in named:
        lines += [
            "[[sessions]]",
            f"animal = {_quoted(animal)}",
            f"session = {_quoted(session)}",
            f"recording = {_quoted(path.relative_to(root).as_posix())}",
            "",
        ]
    return "\n".join(lines).rstrip() + "\n"


def _quoted(text: str) -> str:
    """A TOML string; JSON's escapes are TOML's, but for DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
