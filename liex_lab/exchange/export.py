"""Registry of export formats, the one function that writes them, and writers of tables and poses.

HDF5 files are made in memory and written at once. HDF5 does not handle a full disk: it tries to
write again at the interpreter's exit, with tracebacks of its own and sometimes a crash. Here the
only write to disk is Python's, which raises an ordinary error.
"""

from __future__ import annotations

import io
import json
import math
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from liex_lab.actions.vocabulary import INTERACTIONS
from liex_lab.errors import SessionError, did_you_mean, how_to_install
from liex_lab.exchange.skin_points import derived_points
from liex_lab.runtime import durable, text_files
from liex_lab.runtime.text_files import write_csv
from liex_lab.sessions import Session
from liex_lab.sessions.individuals import arena_name, individuals, individuals_of
from liex_lab.sessions.provenance import reading_from
from liex_lab.sessions.session import Array, PoseArrays

if TYPE_CHECKING:
    import h5py


# format -> (module and function of its writer, suffix of the name, description)
TARGETS: dict[str, tuple[str, str, str]] = {
    "nwb": (
        "nwb.write_nwb",
        ".nwb",
        "Neurodata Without Borders: poses (ndx-pose), rotations, actions (ndx-ethogram)",
    ),
    "boris": ("boris.write_boris", ".boris", "a BORIS project with the ethogram"),
    "dlc": (
        "export.write_dlc",
        "_dlc",
        "a folder with DeepLabCut's CSV tables, in millimetres and in pixels",
    ),
    "movement": (
        "export.write_movement",
        ".nc",
        "netCDF in movement's format of poses, with true times",
    ),
    "sleap": (
        "export.write_sleap",
        ".analysis.h5",
        "SLEAP's analysis file, in pixels of the depth image",
    ),
    "points": (
        "skin_points.write_points",
        "_points",
        "a folder with points on the skin, derived from the fitted body, and the tail's direction",
    ),
    "mabe": (
        "export.write_mabe",
        "_mabe.csv",
        "interactions in the form of the MABe challenge: agent, target, action, frames",
    ),
    "moseq": (
        "moseq.write_scalars",
        "_scalars_moseq.csv",
        "MoSeq's scalars by its definitions, in its own and in true millimetres, as CSV",
    ),
    "csv": (
        "export.write_csv_folder",
        "_csv",
        "a folder with every table as CSV, and columns.json",
    ),
    "xlsx": (
        "export.write_xlsx",
        ".xlsx",
        "an Excel workbook with every table as a sheet, and the description of every column",
    ),
}
ALIASES = {"deeplabcut": "dlc"}
WITH_POINTS = ("dlc", "movement", "sleap")  # formats of joints, or of points in their place
# formats of which one file holds all animals of an arena
TOGETHER = (*WITH_POINTS, "points", "mabe", "csv", "xlsx")


def export(
    session: Session | Sequence[Session],
    to: str,
    out: str | Path | None = None,
    *,
    overwrite: bool = False,
    points: bool = False,
) -> Path:
    """Write a session in another program's format; returns the file or folder.

    The sessions of several animals of one arena are written as individuals of one file, next to
    the sessions.

    It is written under another name and renamed, so it is never incomplete.

    Args:
        session: the session, or those of the animals of one arena.
        to: the format, a word of `TARGETS` or `ALIASES`.
        out: the output folder, created if missing; None uses the session's own, or of several the
            folder of the first one.
        overwrite: replace an existing file.
        points: write points on the skin (module `skin_points`) in place of the joints, under a
            name with `_points`; for dlc, movement and sleap.

    Raises:
        SessionError: the format is unknown, has no points or holds one animal a file, the sessions
            are not of one arena, the file exists, or packages are missing.
    """
    sessions = individuals([session] if isinstance(session, Session) else session)
    first, alone = sessions[0], len(sessions) == 1
    to = ALIASES.get(to, to)
    if to not in TARGETS:
        if to == "video":
            raise SessionError(
                "`liex_lab.api.export_video` writes a video (on the command line `liex export --to "
                "video`)"
            )
        hint = did_you_mean(to, [*TARGETS, *ALIASES, "video"])
        raise SessionError(
            f"there is no format '{to}' to export to: {hint}known are {', '.join(TARGETS)}, "
            f"{', '.join(ALIASES)} (the same as dlc) and video"
        )
    home, function = TARGETS[to][0].split(".")
    if points and to not in WITH_POINTS:
        raise SessionError(
            f"points in place of joints are written to {', '.join(WITH_POINTS)}, not to {to}; use "
            "one of these, or the format points for a table of them"
        )
    if not alone and to not in TOGETHER:
        raise SessionError(
            f"{to} holds one animal a file, and there are {len(sessions)}; export their sessions "
            "one by one"
        )
    ending = "_points" * points + TARGETS[to][1]
    folder = Path(out) if out is not None else first.path if alone else first.path.parent
    if folder.exists() and not folder.is_dir():
        raise SessionError(
            f"{folder} is a file, and exports go into a folder; name another one (--out, in "
            "Python out=)"
        )
    folder.mkdir(parents=True, exist_ok=True)
    path = durable.inside(folder, first.name if alone else arena_name(first), ending)
    if path.exists() and not overwrite:
        raise SessionError(
            f"{path} exists already; name another place (--out, in Python out=), or use "
            "--overwrite (in Python overwrite=True)"
        )
    try:
        write = getattr(import_module(f"liex_lab.exchange.{home}"), function)
        own = ([derived_points(one) for one in sessions],) if points else ()
        with durable.replacing(path, replace_folder=True) as part:
            write(sessions if to in TOGETHER else first, part, *own)
    except ImportError as error:
        raise SessionError(
            f"to write {to}, {error.name} is missing; {how_to_install('exchange')}"
        ) from None
    return path


# Every table of a session as CSV, for programs that do not read Parquet.


def _tables_of(sessions: Sequence[Session]) -> list[str]:
    """Names of the Parquet tables of some sessions, corrected ones included."""
    files = {
        name
        for session in sessions
        for name in (*(file.name for file in session.path.glob("*.parquet")), *session.log.files)
    }
    return sorted(name.removesuffix(".parquet") for name in files if name.endswith(".parquet"))


def _table_of(sessions: Sequence[Session], name: str) -> pd.DataFrame:
    """The rows of all animals; a table of the whole arena is the same in each of its sessions."""
    held = [one for one in sessions if one.has(f"{name}.parquet")]
    table = held[0].table(name)
    if len(sessions) > 1 and "individual" not in table:
        return table.assign(session_id=arena_name(held[0]))
    return pd.concat([table, *(one.table(name) for one in held[1:])], ignore_index=True)


def write_csv_folder(sessions: Sequence[Session], path: Path) -> None:
    """Write a new folder with one file per table, numbers in full precision, and columns.json."""
    path.mkdir()
    for table in _tables_of(sessions):
        text_files.write_csv(_table_of(sessions, table), durable.inside(path, table, ".csv"))
    rows = [session for session in sessions if session.has("summary.csv")]
    if len(rows) == 1:  # its own numbers as they are written
        with reading_from(rows[0].file("summary.csv")) as summary:
            text_files.copy_harmless(summary, path / "summary.csv")
    elif rows:
        text_files.write_csv(pd.concat([one.summary for one in rows]), path / "summary.csv")
    shutil.copyfile(sessions[0].file("columns.json"), path / "columns.json")


# What one animal did to another, in the form of the MABe challenge of 2025.


def write_mabe(sessions: Sequence[Session], path: Path) -> None:
    """Write the interactions as CSV: agent_id, target_id, action, start_frame, stop_frame.

    Animals are numbered from 1 in the order of the arena, as in the points' mabe.csv; stop_frame is
    exclusive. Words that MABe lacks are ours. `isolated`, which has no target, is left out.

    Raises:
        SessionError: the session is of one animal.
    """
    first = sessions[0]
    if not first.has("interactions.parquet"):
        raise SessionError(
            f"the session {first.path} is of one animal, which has no interactions; measure "
            "several with `liex run --set animal.count=2`"
        )
    found = first.interactions.query("target != ''")
    number = {name: k for k, name in enumerate(individuals_of(first), 1)}
    words = {word: one.mabe or word for word, one in INTERACTIONS.items()}
    table = {f"{role}_id": found[role].map(number) for role in ("agent", "target")}
    table["action"] = found["action"].map(words)
    write_csv(pd.DataFrame(table).join(found[["start_frame", "stop_frame"]]), path)


# Every table of a session as one Excel workbook, one sheet per table, on request.


MAX_ROWS = 1_048_576  # of a sheet, its headings included
_UNWRITABLE = re.compile("[\\0-\\x08\\x0b\\x0c\\x0e-\\x1f\\ud800-\\udfff\\ufffe\\uffff]")  # in XML


def write_xlsx(sessions: Sequence[Session], path: Path) -> None:
    """Write a workbook: the summary first, then every table, and the descriptions of the columns.

    Args:
        sessions: of the animals of one arena.
        path: the file to write.

    Raises:
        SessionError: a table is longer than a sheet can be, or there is not enough space for
            temporary files.
    """
    from openpyxl import Workbook

    names = _tables_of(sessions)
    cells = 0
    for name in names:  # before anything is written
        files = [one.file(f"{name}.parquet") for one in sessions if one.has(f"{name}.parquet")]
        footers = [pq.read_metadata(file) for file in files]
        n_rows = sum(one.num_rows for one in footers)
        cells += n_rows * footers[0].num_columns
        if n_rows >= MAX_ROWS:
            raise SessionError(
                f"a sheet of Excel has at most {MAX_ROWS:,} rows and the table {name} has "
                f"{n_rows + 1:,} with its headings; export it as csv"
            )
    # openpyxl writes uncompressed sheets into the folder for temporary files, and crashes if it
    # becomes full
    folder = Path(tempfile.gettempdir())
    # at most 60 bytes per cell of an uncompressed sheet (40 are typical), and 2 MB for the rest
    needed = cells * 60 + (1 << 21)
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise SessionError(
            f"the workbook's sheets need {needed / 1e6:,.0f} MB in {folder} while they are "
            f"written, which has {free / 1e6:,.0f} MB left; make room there, name another "
            "folder in the variable TMPDIR, or export as csv"
        )
    book = Workbook(write_only=True)
    if rows := [session.summary for session in sessions if session.has("summary.csv")]:
        _add(book, "summary", pd.concat(rows))
    for name in names:
        _add(book, name, _table_of(sessions, name))
    _add(book, "columns", sessions[0].columns)
    # openpyxl crashes on a full disk, so the workbook is made in memory
    packed = io.BytesIO()
    book.save(packed)
    path.write_bytes(packed.getbuffer())


def _add(book: Any, name: str, table: pd.DataFrame) -> None:
    sheet = book.create_sheet(name)
    sheet.freeze_panes = "A2"
    sheet.append([_cell(sheet, str(column)) for column in table.columns])
    for row in table.itertuples(index=False, name=None):
        sheet.append([_cell(sheet, value) for value in row])


def _cell(sheet: Any, value: Any) -> Any:
    """A value for Excel: empty if missing, text if Excel has no type for it."""
    from openpyxl.cell import WriteOnlyCell

    if hasattr(value, "item"):
        value = value.item()
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return None
    # Excel has 15 digits; a longer integer, such as a time in ns, is text
    if isinstance(value, float) or (isinstance(value, int) and abs(value) < 10**15):
        return value
    text = str(value)
    if text in ("NaT", "<NA>"):
        return None
    # a cell has at most 32,767 characters
    cell = WriteOnlyCell(sheet, value=_UNWRITABLE.sub("\ufffd", text)[:32_767])
    cell.data_type = "s"
    return cell


# Writers of pose files for DeepLabCut, SLEAP and movement.


@contextmanager
def hdf5_file(path: Path) -> Iterator[h5py.File]:
    """An empty HDF5 file to fill, written to `path` if the block ends without an error.

    Raises:
        OSError: it cannot be written there.
    """
    import h5py

    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        yield file
    path.write_bytes(memory.getbuffer())


# DeepLabCut's CSV tables: three header rows (scorer, bodyparts, coords), then one row per frame. A
# fourth one, individuals, follows the scorer if there are several animals.


SCORER = "liex_lab"


def write_dlc(
    sessions: Sequence[Session], path: Path, points: Sequence[PoseArrays] | None = None
) -> None:
    """Write a new folder with both tables, the times and the bouts."""
    poses = points or [session.pose_arrays() for session in sessions]
    path.mkdir()
    solid = [one.xyz_mm for one in poses]
    write_csv(dlc_table(poses, solid, "xyz"), path / "poses_3d.csv", index=True)
    flat = [np.concatenate([one.uv_px, one.likelihood[..., None]], axis=-1) for one in poses]
    write_csv(dlc_table(poses, flat, ("x", "y", "likelihood")), path / "poses_2d.csv", index=True)
    # true times, for formats without times
    rows = zip(poses[0].frame_index, poses[0].time_s, poses[0].pulse_index, strict=True)
    lines = [f"{index},{time:.9f},{pulse}" for index, time, pulse in rows]
    text = "\n".join(["frame_index,time_s,pulse_index", *lines])
    (path / "times.csv").write_text(text + "\n", encoding="utf-8")
    write_csv(_table_of(sessions, "bouts"), path / "bouts.csv")


def dlc_table(
    poses: Sequence[PoseArrays], values: Sequence[Array], coords: str | tuple[str, ...]
) -> pd.DataFrame:
    """Data frame with DeepLabCut's columns: scorer, individuals (if several), bodyparts, coords.

    Args:
        poses: of each animal, for its name, joints and frame index.
        values: of each animal (n, J, k).
        coords: names of the k coordinates; a str is one letter each.

    Returns:
        (n, A J k) table, indexed by the frame index of the recording.
    """
    names = ["scorer", "individuals", "bodyparts", "coords"]
    levels = [[SCORER], [one.individual for one in poses], list(poses[0].joints), list(coords)]
    columns = pd.MultiIndex.from_product(levels, names=names)
    return pd.DataFrame(
        np.stack(values, axis=1).reshape(len(values[0]), -1),
        index=poses[0].frame_index,
        columns=columns.droplevel("individuals") if len(poses) == 1 else columns,
    )


# SLEAP's analysis file (HDF5), in its own order of axes (Matlab's).


def write_sleap(
    sessions: Sequence[Session], path: Path, points: Sequence[PoseArrays] | None = None
) -> None:
    """Write a track of each animal with every recorded frame as an .analysis.h5 file.

    Pixel coordinates are SLEAP's, from the centre of the top-left pixel.
    """
    import h5py

    every = points or [session.pose_arrays() for session in sessions]
    poses = every[0]
    uv_px, likelihood = (
        np.stack([getattr(one, name) for one in every]) for name in ("uv_px", "likelihood")
    )
    observed = np.isfinite(uv_px[..., 0])
    there = observed.any(axis=-1)
    order = {
        "tracks": ("track", "xy", "node", "frame"),
        "point_scores": ("track", "node", "frame"),
        "track_occupancy": ("frame", "track"),
        "instance_scores": ("track", "frame"),
        "tracking_scores": ("track", "frame"),
    }
    mean_score = np.where(there, np.nanmean(np.where(observed, likelihood, 0.0), axis=-1), np.nan)
    arrays = {
        "tracks": uv_px.transpose(0, 3, 2, 1),
        "point_scores": likelihood.transpose(0, 2, 1),
        "track_occupancy": there.T.astype(np.uint8),
        "instance_scores": mean_score,
        "tracking_scores": np.where(there, 1.0, np.nan),
        "time_s": poses.time_s,
        "pulse_index": poses.pulse_index,
    }
    edges = [(poses.joints[a], poses.joints[b]) for a, b in poses.bones]
    tracks = [one.individual for one in every]
    texts = {"node_names": poses.joints, "track_names": tracks, "edge_names": edges}
    with hdf5_file(path) as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values, compression="gzip", compression_opts=4)
            if name in order:
                file[name].attrs["dims"] = json.dumps(order[name])
        for name, words in texts.items():
            file.create_dataset(name, data=np.array(words, dtype=object), dtype=h5py.string_dtype())
        file.create_dataset("edge_inds", data=np.array(poses.bones, np.int64).reshape(-1, 2))
        for name, value in (
            ("labels_path", ""),
            ("video_path", sessions[0].metadata["input"]["name"]),
        ):
            file.create_dataset(name, data=value, dtype=h5py.string_dtype())
        file.create_dataset("video_ind", data=0)
        file.create_dataset(
            "provenance", data=json.dumps({"software": "liex_lab"}), dtype=h5py.string_dtype()
        )
        file.attrs["preset"] = "matlab"
        file.attrs["format"] = "analysis"


# Poses data set of the Python package movement as netCDF; xarray and `movement.io` open it.


def write_movement(
    sessions: Sequence[Session], path: Path, points: Sequence[PoseArrays] | None = None
) -> None:
    """Write netCDF 4 (.nc)."""
    import xarray

    own = points or repeat(None)
    every = [one.to_xarray(keypoints) for one, keypoints in zip(sessions, own, strict=False)]
    data = every[0]
    if len(every) > 1:
        how: Any = {"coords": "minimal", "compat": "override", "combine_attrs": "override"}
        data = xarray.concat(every, "individuals", data_vars="all", join="exact", **how)
        data.attrs["source_file"] = arena_name(sessions[0])
    # in memory, see `hdf5_file`
    path.write_bytes(data.to_netcdf(engine="h5netcdf"))
