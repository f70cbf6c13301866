"""An ethogram as rows of the table `bouts`."""

from __future__ import annotations

import numpy as np
import pandas as pd

from liex_lab.actions.ethogram import Ethogram


def bout_rows(ethogram: Ethogram, frames: pd.DataFrame, model_hash: str) -> pd.DataFrame:
    """The columns that every table `bouts` has, from the table `frames` of the ethogram's times."""
    times_ns, index = frames["time_ns"].to_numpy(np.int64), frames["frame_index"].to_numpy(np.int64)
    first = int(times_ns[0]) if len(times_ns) else 0
    start_ns = np.array([bout.start_ns for bout in ethogram], np.int64)
    stop_ns = np.array([bout.stop_ns for bout in ethogram], np.int64)
    count = np.append(index, index[-1:] + 1)
    n = len(ethogram)
    return pd.DataFrame({
        "session_id": pd.Series([frames["session_id"].iloc[0]] * n, dtype="str"),
        "individual": pd.Series([frames["individual"].iloc[0]] * n, dtype="str"),
        "action": pd.Series([bout.action for bout in ethogram], dtype="str"),
        "start_s": (start_ns - first) * 1e-9, "stop_s": (stop_ns - first) * 1e-9,
        "duration_s": (stop_ns - start_ns) * 1e-9,
        "start_frame": count[np.searchsorted(times_ns, start_ns)],
        "stop_frame": count[np.searchsorted(times_ns, stop_ns)],
        "score": np.array([bout.score for bout in ethogram], float),
        "source": pd.Series([ethogram.source] * n, dtype="str"),
        "model_hash": pd.Series([model_hash] * n, dtype="str"),
    })  # fmt: skip
