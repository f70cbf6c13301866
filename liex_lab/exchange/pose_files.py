"""Writers of pose files for DeepLabCut, SLEAP and movement.

HDF5 files are made in memory and written at once. HDF5 does not handle a full disk: it tries to
write again at the interpreter's exit, with tracebacks of its own and sometimes a crash. Here the
only write to disk is Python's, which raises an ordinary error.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from liex_lab.runtime.text_files import write_csv
from liex_lab.sessions import Session
from liex_lab.sessions.session import Array, PoseArrays

if TYPE_CHECKING:
    import h5py


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


# DeepLabCut's CSV tables: three header rows (scorer, bodyparts, coords), then one row per frame.


SCORER = "liex_lab"


def write_dlc(session: Session, path: Path) -> None:
    """Write a new folder with both tables, the times and the bouts."""
    poses = session.pose_arrays()
    path.mkdir()
    write_csv(dlc_table(poses, poses.xyz_mm, "xyz"), path / "poses_3d.csv", index=True)
    flat = np.concatenate([poses.uv_px, poses.likelihood[..., None]], axis=-1)
    write_csv(dlc_table(poses, flat, ("x", "y", "likelihood")), path / "poses_2d.csv", index=True)
    # true times, for formats without times
    rows = zip(poses.frame_index, poses.time_s, poses.pulse_index, strict=True)
    lines = [f"{index},{time:.9f},{pulse}" for index, time, pulse in rows]
    text = "\n".join(["frame_index,time_s,pulse_index", *lines])
    (path / "times.csv").write_text(text + "\n", encoding="utf-8")
    write_csv(session.bouts, path / "bouts.csv")


def dlc_table(poses: PoseArrays, values: Array, coords: str | tuple[str, ...]) -> pd.DataFrame:
    """Data frame with DeepLabCut's columns: scorer, bodyparts, coords.

    Args:
        poses: the session's poses, for joints and frame index.
        values: (n, J, k) values.
        coords: names of the k coordinates; a str is one letter each.

    Returns:
        (n, J k) table, indexed by the frame index of the recording.
    """
    columns = pd.MultiIndex.from_product(
        [[SCORER], list(poses.joints), list(coords)], names=["scorer", "bodyparts", "coords"]
    )
    return pd.DataFrame(values.reshape(len(values), -1), index=poses.frame_index, columns=columns)


# SLEAP's analysis file (HDF5), in its own order of axes (Matlab's).


def write_sleap(session: Session, path: Path) -> None:
    """Write one track with every recorded frame as an .analysis.h5 file.

    Pixel coordinates are SLEAP's, from the centre of the top-left pixel.
    """
    import h5py

    poses = session.pose_arrays()
    observed = np.isfinite(poses.uv_px[:, :, 0])
    order = {
        "tracks": ("track", "xy", "node", "frame"),
        "point_scores": ("track", "node", "frame"),
        "track_occupancy": ("frame", "track"),
        "instance_scores": ("track", "frame"),
        "tracking_scores": ("track", "frame"),
    }
    mean_score = np.where(
        observed.any(axis=1), np.nanmean(np.where(observed, poses.likelihood, 0.0), axis=1), np.nan
    )
    arrays = {
        "tracks": poses.uv_px.transpose(2, 1, 0)[None],
        "point_scores": poses.likelihood.T[None],
        "track_occupancy": observed.any(axis=1, keepdims=True).astype(np.uint8),
        "instance_scores": mean_score[None],
        "tracking_scores": np.where(observed.any(axis=1), 1.0, np.nan)[None],
        "time_s": poses.time_s,
        "pulse_index": poses.pulse_index,
    }
    edges = [(poses.joints[a], poses.joints[b]) for a, b in poses.bones]
    texts = {"node_names": poses.joints, "track_names": (poses.individual,), "edge_names": edges}
    with hdf5_file(path) as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values, compression="gzip", compression_opts=4)
            if name in order:
                file[name].attrs["dims"] = json.dumps(order[name])
        for name, words in texts.items():
            file.create_dataset(name, data=np.array(words, dtype=object), dtype=h5py.string_dtype())
        file.create_dataset("edge_inds", data=np.array(poses.bones, np.int64).reshape(-1, 2))
        for name, value in (("labels_path", ""), ("video_path", session.metadata["input"]["name"])):
            file.create_dataset(name, data=value, dtype=h5py.string_dtype())
        file.create_dataset("video_ind", data=0)
        file.create_dataset(
            "provenance", data=json.dumps({"software": "liex_lab"}), dtype=h5py.string_dtype()
        )
        file.attrs["preset"] = "matlab"
        file.attrs["format"] = "analysis"


# Poses data set of the Python package movement as netCDF; xarray and `movement.io` open it.


def write_movement(session: Session, path: Path) -> None:
    """Write netCDF 4 (.nc)."""
    # in memory, see `hdf5_file`
    path.write_bytes(session.to_xarray().to_netcdf(engine="h5netcdf"))
