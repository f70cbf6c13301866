"""A study file template from the recordings in a folder: `liex cohort init`.

Names of animals and sessions come from the recordings' metadata, BIDS-like folders (`sub-m01`,
`ses-01_date-20260821`), other folders and file names, see `plan.study`. Duplicate recordings are
listed once; files that one camera wrote one after the other are one session.
"""

import hashlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path

from liex_lab.errors import RecordingError, StudyError, refuse
from liex_lab.plan.plan import toml_value
from liex_lab.plan.study import (
    CONTAINER,
    DERIVED,
    RAW,
    STUDY_FILE,
    Study,
    find_subject,
    letters,
    same,
)
from liex_lab.recordings.formats.images.folder import natural_key
from liex_lab.recordings.open import open_recording, stated_subject
from liex_lab.recordings.parts import join_parts
from liex_lab.runtime.durable import named_files, write_whole
from liex_lab.runtime.progress import Progress, silent

_DEPTHS = ("depth.dat", "depth.avi", "depth.mkv")  # each marks its folder as a recording
_EXTRACTION = re.compile(r"results_\d\d\.h5$")  # of MoSeq
_COMPARED_BYTES = 1 << 20  # compared at the beginning and the end of files of the same size
_MOST_LISTED = 4  # sessions of an animal
Named = tuple[str, str, Path, str]  # animal, session, recording, origin of the animal's name
_HEADER = """\
# A study of liex_lab: which animals, in which groups, recorded in which sessions. Correct what is wrong here, then
#     liex cohort {file} --dry-run      shows what will be done, and why
#     liex cohort {file}                does it, goes on after any interruption, and leaves out what is done
# Paths count from this file's folder and stay in it. Nothing is ever written into {raw}.
# A session of several animals in one arena lists them, the largest first: animals = ["m01", "m02"]
# [set], and `set` of an animal or a session, change values of the plan: set = {{ animal.spine_mm = 65 }}
"""  # noqa: E501
_SETTINGS = f"""\
plan = "mouse"                 # a bundled plan (see `liex info`), or a .toml file in this folder
results = "{DERIVED}"
shared = "off"                 # "subject": an animal has one size and shape

[set]
"""
_ANIMAL = """\
[[animals]]
id = {id}  # named by: {origins}
group = ""                     # cage, sex, batch too
"""
_SESSION = """\
[[sessions]]
animal = {}
session = {}
recording = {}
"""


def begin_study(
    folder: str | Path,
    overwrite: bool = False,
    *,
    echo: Callable[[str], object] = lambda _: None,
    progress: Progress = silent,
) -> Path:
    """Write FOLDER/study.toml with every recording below FOLDER/rawdata, or else below FOLDER.

    Args:
        folder: the study's folder.
        overwrite: replace an existing study file.
        echo: called with each line of a summary: the animals with their sessions, and notes to
            check.
        progress: called recording by recording.

    Returns:
        The path of the study file.

    Raises:
        StudyError: there is no such folder, no recording in it, or a study file already.
    """
    root = Path(folder)
    file = root / STUDY_FILE
    refuse(
        StudyError,
        (
            not root.is_dir(),
            f"{root} is not a folder; a study begins in a folder with recordings",
        ),
        (
            file.exists() and not overwrite,
            f"{file} exists already; edit it, or use --overwrite (in Python overwrite=True)",
        ),
    )
    raw = root / RAW if (root / RAW).is_dir() else root
    found = find_recordings(raw)
    if not found:
        raise StudyError(
            f"no recording was found below {raw}; a study needs at least one, see `liex run --help`"
        )
    twins = find_twins(found)
    stated: dict[Path, str] = {}
    listed = join_series([one for one in found if one not in twins])
    for path in listed:
        progress(len(stated), len(listed), "reading subjects")
        stated[path] = stated_subject(path, progress)
    named, notes = name_sessions(stated, raw)
    notes += [
        f"{one.relative_to(root).as_posix()} is the same recording as "
        f"{other.relative_to(root).as_posix()}, and is left out"
        for one, other in twins.items()
    ]
    write_whole(file, _text(root, named, notes))
    Study.load(file)
    for line in (*_listed(named), *notes):
        echo(line)
    return file


def join_series(recordings: Sequence[Path]) -> list[Path]:
    """Replace files that one camera wrote one after the other by a pattern of their names.

    Their names differ by a number or a time at the end, and no more than two seconds lie between
    the end of one and the beginning of the next.

    Args:
        recordings: files or folders.

    Returns:
        Patterns, and the recordings that are whole by themselves.
    """
    found = list(recordings)
    for number in (r"\d+(?=\D*$)", r"(?<=[_.T-])\d[\d_.T-]*(?=\D*$)"):
        alike: dict[Path, list[Path]] = {}
        for path in found:
            pattern = path.with_name(re.sub(number, "*", path.stem) + path.suffix)
            alike.setdefault(pattern, []).append(path)
        found = []
        for pattern, paths in alike.items():
            paths.sort(key=lambda path: natural_key(path.name))
            whole = sorted(named_files(pattern)) == sorted(paths)
            series = len(paths) > 1 and whole and all(map(_follows, paths[:-1], paths[1:]))
            found += [pattern] if series else paths
    return found


def _follows(one: Path, other: Path) -> bool:
    """Whether a recording goes on in another one."""
    try:
        with join_parts([one, other], partial(open_recording, strict=True), unbroken=True):
            return True
    except RecordingError:
        return False


def _listed(named: Sequence[Named]) -> list[str]:
    """The animals with their sessions, for the user to check."""
    animals = list(dict.fromkeys(animal for animal, *_ in named))
    counts = f"{len(named)} recording{'s' * (len(named) != 1)}, {len(animals)} animal"
    lines = [f"{counts}{'s' * (len(animals) != 1)}: is that so?"]
    for one in animals:
        own = [session for animal, session, *_ in named if animal == one]
        more = f" and {len(own) - _MOST_LISTED} more" if len(own) > _MOST_LISTED else ""
        lines.append(f"    {one}: {', '.join(own[:_MOST_LISTED])}{more}")
    return lines


def find_twins(recordings: Sequence[Path]) -> dict[Path, Path]:
    """Duplicate recordings: the one to leave out, and the one to keep.

    Two recordings are duplicates if they are in one folder and their names differ only by the
    suffix, like an archive and its unpacked folder, or if their largest files have the same size,
    beginning and end.
    """
    kept: dict[object, Path] = {}
    twins: dict[Path, Path] = {}
    packed = (".gz", ".tgz", ".mkv", ".avi")  # the folder or container next to it is preferred
    ranks = {path: (path.suffix.lower() in packed, len(path.name), path) for path in recordings}
    for path in sorted(recordings, key=ranks.__getitem__):  # copies have longer names
        keys = ((path.parent, CONTAINER.sub("", path.name).lower()), _content(path))
        twin = next((kept[key] for key in keys if key in kept), path)
        twins |= {path: twin} if twin != path else {}
        kept |= {key: twin for key in keys if key}
    return twins


def _content(path: Path) -> tuple[object, ...]:
    """Size and hash of beginning and end of a recording's largest file; () if it is empty."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    sizes = [(file.name in _DEPTHS, file.stat().st_size, file) for file in files]
    _, size, largest = max(sizes, default=(False, 0, path))
    if not size:
        return ()
    with largest.open("rb") as opened:
        ends = opened.read(_COMPARED_BYTES)
        opened.seek(max(size - _COMPARED_BYTES, 0))
        return size, hashlib.sha256(ends + opened.read()).hexdigest()


def find_recordings(folder: Path) -> list[Path]:
    """Every recording below a folder, in order of name, without results and hidden files.

    Folders that are recordings are not searched. Extractions by MoSeq count only if there is no
    recording, since most lie beside the one that they were made of.
    """
    found, extractions = [], []
    for inside, folders, names in os.walk(folder):
        here = Path(inside)
        files = [
            name
            for name in sorted(names)
            if name.lower().endswith(
                (".mcap", ".bag", ".db3", ".oni", ".tar.gz", ".tgz", ".mkv", ".avi")
            )
        ]
        # these, too, if the folder has no files of depth
        noted = not set(names).isdisjoint(("camera.toml", "raytrix.toml")) and not files
        one_recording = here != folder and (noted or not set(names).isdisjoint(_DEPTHS))
        found += [here] if one_recording else [here / name for name in files if name[0] != "."]
        extractions += [here / name for name in sorted(names) if _EXTRACTION.search(name)]
        folders[:] = sorted(
            name
            for name in folders
            if not one_recording
            and name[0] != "."
            and name not in {"derivatives", "thumbnails"}
            and not name.endswith((".liex", ".part"))
            and not (here / name / "session.json").exists()
        )
    return found or extractions


def name_sessions(stated: Mapping[Path, str], raw: Path) -> tuple[list[Named], list[str]]:
    """Animal and session of each recording, each pair unique, and notes to check.

    Names that differ only in capitals, spaces, _ or - are one animal.

    Args:
        stated: recordings below `raw`, and the animal's name in the metadata of each; may be empty.
        raw: the folder that names are relative to.

    Returns:
        Animal, session, recording and origin of the animal's name (metadata, folder or file name;
        '' for none), in the recordings' order; and notes as sentences.
    """
    named: list[Named] = []
    taken = set()
    spelled: dict[str, str] = {}
    notes = []
    for path, name in stated.items():
        found = find_subject(path, name, raw)
        by_name = find_subject(path, "", raw)
        if by_name.origin and same(by_name.id) != same(found.id):
            notes.append(
                f"{path.relative_to(raw).as_posix()}: its metadata name the animal {found.id} and "
                f"its {by_name.origin} {by_name.id}"
            )
        animal = spelled.setdefault(found.id.lower(), found.id)
        if animal != found.id:
            notes.append(f"{animal} and {found.id} are taken for one animal, {animal}")
        base = _pairs(found.session or "01")
        tries = (f"{base}_rec-{k}" if k > 1 else base for k in count(1))
        session = next(one for one in tries if (animal, one.lower()) not in taken)
        taken.add((animal, session.lower()))
        named.append((animal, session, path, found.origin))
    if unknown := [animal for animal, _, _, origin in named if not origin]:
        notes.append(
            f"nothing names the animal of {', '.join(unknown[:_MOST_LISTED])}"
            f"{' and others' if len(unknown) > _MOST_LISTED else ''}: each recording is listed as "
            "an animal of its own, which counts one mouse several times if it was recorded more "
            "than once; state the animal of each session in the study file"
        )
    return named, list(dict.fromkeys(notes))


def _pairs(text: str) -> str:
    """A session's name: unchanged if made of key-value pairs, otherwise its letters and digits."""
    kept = re.fullmatch(r"[A-Za-z0-9]{1,32}(?:_[A-Za-z0-9]{1,32}-[A-Za-z0-9]{1,64}){0,5}", text)
    return text if kept else letters(text)[:32]


def _text(root: Path, named: Sequence[Named], notes: Sequence[str]) -> str:
    """The study file."""
    blocks = [
        "\n".join(
            [
                _HEADER.format(file=STUDY_FILE, raw=RAW),
                *(f"# note: {note}" for note in notes),
                f"name = {toml_value(root.resolve().name or 'study')}",
                _SETTINGS,
            ]
        )
    ]
    for one in dict.fromkeys(animal for animal, *_ in named):
        origins = dict.fromkeys(o or "nothing, so check it" for a, _, _, o in named if a == one)
        blocks.append(_ANIMAL.format(id=toml_value(one), origins=", ".join(origins)))
    for animal, session, path, _ in named:
        texts = (toml_value(text) for text in (animal, session, path.relative_to(root).as_posix()))
        blocks.append(_SESSION.format(*texts))
    return "\n".join(blocks)
