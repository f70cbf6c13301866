"""Registry of export formats and the one function that writes them."""

from __future__ import annotations

import difflib
from importlib import import_module
from pathlib import Path

from liex_lab.errors import SessionError, how_to_install
from liex_lab.runtime.durable import replacing
from liex_lab.runtime.places import inside
from liex_lab.sessions import Session

# format -> (module and function of its writer, suffix of the name, description)
TARGETS: dict[str, tuple[str, str, str]] = {
    "nwb": (
        "nwb.write_nwb",
        ".nwb",
        "Neurodata Without Borders: poses (ndx-pose), rotations, actions (ndx-ethogram)",
    ),
    "boris": ("boris.write_boris", ".boris", "a BORIS project with the ethogram"),
    "dlc": (
        "pose_files.write_dlc",
        "_dlc",
        "a folder with DeepLabCut's CSV tables, in millimetres and in pixels",
    ),
    "movement": (
        "pose_files.write_movement",
        ".nc",
        "netCDF as movement keeps poses, true times",
    ),
    "sleap": (
        "pose_files.write_sleap",
        ".analysis.h5",
        "SLEAP's analysis file, in pixels of the depth picture",
    ),
    "csv": (
        "tables.write_csv_folder",
        "_csv",
        "a folder with every table as CSV, and columns.json",
    ),
    "xlsx": (
        "tables.write_xlsx",
        ".xlsx",
        "an Excel workbook with every table as a sheet, and what every column means",
    ),
}
ALIASES = {"deeplabcut": "dlc"}


def export(
    session: Session, to: str, out: str | Path | None = None, *, overwrite: bool = False
) -> Path:
    """Write a session in another program's format; returns the file or folder.

    It is written under another name and renamed, so it is never incomplete.

    Args:
        session: the session.
        to: the format, a word of `TARGETS` or `ALIASES`.
        out: the output folder, created if missing; None uses the session's own.
        overwrite: replace an existing file.

    Raises:
        SessionError: the format is unknown, the file exists, or packages are missing.
    """
    to = ALIASES.get(to, to)
    if to not in TARGETS:
        if to == "video":
            raise SessionError(
                "`liex_lab.api.export_video` writes a video (on the command line `liex export --to "
                "video`)"
            )
        near = difflib.get_close_matches(to, [*TARGETS, *ALIASES, "video"], 1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise SessionError(
            f"there is no format '{to}' to export to: {hint}known are {', '.join(TARGETS)}, "
            f"{', '.join(ALIASES)} (the same as dlc) and video"
        )
    home, function = TARGETS[to][0].split(".")
    ending = TARGETS[to][1]
    folder = session.path if out is None else Path(out)
    if folder.exists() and not folder.is_dir():
        raise SessionError(
            f"{folder} is a file, and exports go into a folder; name another one (--out, in "
            "Python out=)"
        )
    folder.mkdir(parents=True, exist_ok=True)
    path = inside(folder, session.name, ending)
    if path.exists() and not overwrite:
        raise SessionError(
            f"{path} exists already; name another place (--out, in Python out=), or say "
            "--overwrite (in Python overwrite=True)"
        )
    try:
        write = getattr(import_module(f"liex_lab.exchange.{home}"), function)
        with replacing(path, replace_folder=True) as part:
            write(session, part)
    except ImportError as error:
        raise SessionError(
            f"to write {to}, {error.name} is missing; {how_to_install('exchange')}"
        ) from None
    return path
