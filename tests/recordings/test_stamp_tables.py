"""Tables of time stamps as other programs write them: read exactly, or refused, or doubted."""

from __future__ import annotations

import tempfile
from decimal import Decimal
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.errors import RecordingError
from liex_lab.recordings.timestamp_files import UNITS, read_stamps

ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"]


def read(content: bytes, **how: object) -> tuple[list[int] | None, list[str], list[str]]:
    """Stamps, problems and doubts; None where the table is refused."""
    problems: list[str] = []
    doubts: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "depth_ts.txt"
        path.write_bytes(content)
        try:
            stamps = read_stamps(path, problems, doubts, **how)  # type: ignore[arg-type]
            return stamps.times(None, problems, doubts, None).tolist(), problems, doubts
        except RecordingError:
            return None, problems, doubts


def written(ns: int, unit: str, digits: int | None) -> str:
    """A time with as many digits as it takes, or with at least so many."""
    plain = f"{Decimal(ns) / UNITS[unit]:f}"
    whole, _, fraction = plain.partition(".")
    fraction = fraction.rstrip("0") if digits is None else fraction.ljust(digits, "0")
    return f"{whole}.{fraction}" if fraction else whole


@settings(max_examples=200, deadline=None)
@given(
    n=st.integers(5, 40),
    hz=st.sampled_from([12.5, 25.0, 29.97, 30.0, 60.0, 90.0, 200.0]),
    seed=st.integers(0, 2**32 - 1),
    start=st.sampled_from([0, 10**9, 1_709_647_282_123_456_789]),
    unit=st.sampled_from(list(UNITS)),
    digits=st.sampled_from([None, 3, 6]),
    order=st.permutations(["time", "counter", "constant", "flag", "name"]),
    n_columns=st.integers(1, 5),
    separator=st.sampled_from([";", "\t", ",", " "]),
    comma=st.booleans(),
    named=st.booleans(),
    encoding=st.sampled_from(ENCODINGS),
    line_end=st.sampled_from(["\n", "\r\n"]),
    quoted=st.booleans(),
)
def test_exact_times_come_back_exactly_from_any_table_or_are_refused_or_doubted(
    n: int,
    hz: float,
    seed: int,
    start: int,
    unit: str,
    digits: int | None,
    order: list[str],
    n_columns: int,
    separator: str,
    comma: bool,
    named: bool,
    encoding: str,
    line_end: str,
    quoted: bool,
) -> None:
    rng = np.random.default_rng(seed)
    grain = 1000 if rng.random() < 0.5 else 1
    step = (1e9 / hz) * (1 + 0.05 * rng.standard_normal(n)).clip(0.7, 1.3)
    step[rng.random(n) < 0.1] *= 3
    times = (start + np.cumsum(step.astype(np.int64))) // grain * grain
    columns = {
        "time": [written(int(t), unit, digits) for t in times],
        "counter": [str(100 + k) for k in range(n)],
        "constant": ["7"] * n,
        "flag": [str(f) for f in rng.integers(0, 2, n)],
        "name": [f"image_{k:04d}.png" for k in range(n)],
    }
    chosen = [name for name in order if name in {"time", *order[:n_columns]}]
    if comma:
        columns["time"] = [text.replace(".", ",") for text in columns["time"]]
    if quoted and separator != " ":
        columns = {name: [f'"{cell}"' for cell in cells] for name, cells in columns.items()}
    head = [f"time_{unit}" if name == "time" else name for name in chosen]
    rows = [head] * named + list(zip(*(columns[name] for name in chosen), strict=True))
    text = line_end.join(separator.join(row) for row in rows) + line_end
    found, _, doubts = read(text.encode(encoding), usual_ns=UNITS[unit])
    if found is None or doubts:
        assert comma  # whose meaning is not certain
        assert separator == "," or len(chosen) == 1
    else:
        assert found == times.tolist()
