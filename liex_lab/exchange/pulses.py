"""Times of events in files of other instruments: rising edges of a TTL line, in seconds.

CSV and NumPy are read here, NWB by pynwb, Open Ephys and SpikeGLX by neo, Harp by harp-data.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.errors import (
    LiexError,
    MissingPackageError,
    did_you_mean,
    how_to_install,
    one_line,
    refuse,
)
from liex_lab.runtime import text_files

_TIMES = ("time_s", "timestamp_s", "timestamps_s", "time", "timestamp", "timestamps")
_LEVEL = "level"


def read_pulses(path: str | Path, channel: str = "") -> Array:
    """Times of the rising edges, or of the events, in a file of another instrument.

    Args:
        path: .csv, .tsv or .txt (a column of times; `level`, 0 or 1, marks edges), .npy or .npz of
            times, .nwb, a folder of Open Ephys (binary format), a .bin of SpikeGLX with its .meta,
            or a .bin of one Harp register.
        channel: the column, array, NWB object or line; "" if there is one.

    Returns:
        (n,) s, in the order of the file.

    Raises:
        LiexError: the file cannot be read, or it has several channels of which none is chosen.
        MissingPackageError: its reader is not installed.
    """
    source = Path(path)
    kind = "folder" if source.is_dir() else source.suffix.lower()
    if kind == ".bin" and source.with_suffix(".meta").is_file():
        kind = ".meta"
    if kind not in _READERS or not source.exists():
        raise LiexError(
            f"events are read from {', '.join(key for key in _READERS if key[0] == '.')} files and "
            f"folders of Open Ephys, and {source} is "
            f"{'of another kind' if source.exists() else 'not there'}; name such a file"
        )
    read, extra = _READERS[kind]
    try:
        return np.asarray(read(source, channel), float)
    except LiexError as error:
        raise LiexError(f"{source}: {error}") from None
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"to read {source}, {error.name} is missing; {how_to_install(extra)}"
        ) from None
    except Exception as error:  # other packages raise no specific type
        raise LiexError(
            f"{source} should hold times of events, but: {one_line(error)}; docs/howto/sync.md "
            "lists the forms that are read"
        ) from None


def _chosen(channel: str, known: Any, what: str, usual: tuple[str, ...] = ()) -> str:
    """The named channel, or the only one; raises LiexError if it is unknown or not stated."""
    names = [str(name) for name in known]
    named = channel or next((name for name in usual if name in names), "")
    if not named and len(names) == 1:
        return names[0]
    listed = f"it has {', '.join(names[:20]) or 'none'}"
    refuse(
        LiexError,
        (not named, f"it is not clear which {what} holds the pulses; state --channel: {listed}"),
        (
            named not in names,
            f"there is no {what} '{named}': {did_you_mean(named, names)}{listed}",
        ),
    )
    return named


def rises(level: Any) -> NDArray[np.bool_]:
    """Where a level goes from low to high; low and high are parted halfway."""
    values = np.asarray(level, float)
    high = values > 0.5 * (np.nanmin(values) + np.nanmax(values))
    return high & ~np.append(high[:1], high[:-1])


def _csv(path: Path, channel: str) -> Any:
    table = text_files.read_texts(path)
    if all(_number(name) is not None for name in table.columns):  # no line of names
        table.loc[-1] = table.columns
        table = table.sort_index().set_axis([str(k) for k in range(table.shape[1])], axis=1)
    times = _chosen(channel, [n for n in table if n != _LEVEL], "column", _TIMES)
    columns = table.map(_number).astype(float)
    return columns[times][rises(columns[_LEVEL])] if _LEVEL in columns else columns[times]


def _number(text: str) -> float | None:
    """A cell as a number, with a decimal point or comma; None for any other."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return None


def _numpy(path: Path, channel: str) -> Any:
    held = np.load(path, allow_pickle=False)
    times = held if path.suffix == ".npy" else held[_chosen(channel, held, "array", _TIMES)]
    if times.ndim != 1:
        raise LiexError(f"times are one row of numbers, and this is an array {times.shape}")
    return times


def _nwb(path: Path, channel: str) -> Any:
    import pynwb

    with pynwb.NWBHDF5IO(path, "r") as file:
        found = {
            one.name: one
            for one in file.read().objects.values()
            if isinstance(one, pynwb.TimeSeries | pynwb.epoch.TimeIntervals)
        }
        one = found[_chosen(channel, found, "series or table of intervals")]
        if isinstance(one, pynwb.epoch.TimeIntervals):
            return one["start_time"][:]
        level = np.asarray(one.data[:])
        times = (
            one.timestamps[:]
            if one.timestamps is not None
            else (one.starting_time or 0.0) + np.arange(len(level)) / one.rate
        )
        # a series of events has a time for each, and one of samples has levels
        return times[rises(level)] if level.ndim == 1 and np.ptp(level) > 0 else times


def _neo(reader: str) -> Callable[[Path, str], Any]:
    """Rising edges by a reader of neo."""

    def read(path: Path, channel: str) -> Any:
        import neo.rawio

        raw = getattr(neo.rawio, reader)(path if path.is_dir() else path.parent)
        raw.parse_header()
        n = sum(raw.segment_count(k) for k in range(raw.block_count()))
        if n != 1:
            raise LiexError(f"it holds {n} recordings, and one is expected; name the folder of one")
        lines: dict[str, Any] = {}
        for k, name in enumerate(raw.header["event_channels"]["name"]):
            stamps, _, labels = raw.get_event_timestamps(0, 0, k)
            times = raw.rescale_event_timestamp(stamps, "float64", k)
            for label in np.unique(labels):
                line = str(label) if str(label).startswith(name) else f"{name} {label}"
                lines[line] = times[labels == label]
        rising = [line for line in lines if not line.endswith(" OFF")]
        return np.sort(lines[_chosen(channel, rising, "line")])

    return read


def _harp(path: Path, channel: str) -> Any:
    import harp.data

    table = harp.data.read(path)
    values = table.iloc[:, 0].to_numpy(np.int64)
    bits = [str(k) for k in range(64) if ((values >> k) & 1).any()]
    bit = int(_chosen(channel, bits, "bit"))
    # a message is sent at each change: a first one that is high is a rise
    return table.index.to_numpy(float)[rises(np.append(0, (values >> bit) & 1))[1:]]


# of each kind of file: its reader, and the extra with its package
_READERS: dict[str, tuple[Callable[[Path, str], Any], str]] = {
    ".csv": (_csv, ""),
    ".tsv": (_csv, ""),
    ".txt": (_csv, ""),
    ".npy": (_numpy, ""),
    ".npz": (_numpy, ""),
    ".nwb": (_nwb, "exchange"),
    "folder": (_neo("OpenEphysBinaryRawIO"), "sync"),
    ".meta": (_neo("SpikeGLXRawIO"), "sync"),
    ".bin": (_harp, "sync"),
}
