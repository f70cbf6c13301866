"""SLEAP's analysis file (HDF5), in its own order of axes, which is Matlab's.

The format has two coordinates: joints are in pixels of the depth picture. It has no times and no
actions: true times stand beside SLEAP's own data sets as `time_s` (s) and `pulse_index`, which its
readers leave alone. Scores of points are `Poses.likelihood`.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from liex_lab.sessions import Session

from .hdf5 import hdf5_file


def write(session: Session, path: Path) -> None:
    """Write one track with every recorded frame.

    Pixels are counted as SLEAP counts them, from the centre of the top-left one.

    Args:
        session: the session.
        path: the .analysis.h5 file to write.
    """
    import h5py

    poses = session.pose_arrays()
    seen = np.isfinite(poses.uv_px[:, :, 0])
    order = {
        "tracks": ("track", "xy", "node", "frame"),
        "point_scores": ("track", "node", "frame"),
        "track_occupancy": ("frame", "track"),
        "instance_scores": ("track", "frame"),
        "tracking_scores": ("track", "frame"),
    }
    mean_score = np.where(
        seen.any(axis=1), np.nanmean(np.where(seen, poses.likelihood, 0.0), axis=1), np.nan
    )
    arrays = {
        "tracks": poses.uv_px.transpose(2, 1, 0)[None],
        "point_scores": poses.likelihood.T[None],
        "track_occupancy": seen.any(axis=1, keepdims=True).astype(np.uint8),
        "instance_scores": mean_score[None],
        "tracking_scores": np.where(seen.any(axis=1), 1.0, np.nan)[None],
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
