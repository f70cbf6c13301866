"""Tables of time stamps as other programs write them: read exactly, or refused, or doubted."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.errors import RecordingError
from liex_lab.recordings import Recording, open_recording
from liex_lab.recordings.timestamp_files import UNITS, read_stamps
from liex_lab.recordings.timestamps import (
    clock_doubts,
    frame_counts,
    make_monotone,
    median_step,
)
from tests.recordings.writers import depth_frames, write_camera, write_moseq_folder

ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"]


def read(content: bytes, **how: object) -> tuple[list[int] | None, list[str], list[str]]:
    """Stamps, problems and doubts; None where the table is refused."""
    problems: list[str] = []
    doubts: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "depth_ts.txt"
        path.write_bytes(content)
        try:
            stamps = read_stamps(path, doubts, **how)  # type: ignore[arg-type]
            times = stamps.times(None, problems, doubts, None)
            settled = make_monotone(times)
            doubts += clock_doubts(median_step(settled.times_ns), settled.faults)
            return times.tolist(), problems, doubts
        except RecordingError:
            return None, problems, doubts


def written(ns: int, unit: str, digits: int | None) -> str:
    """A time with as many digits as it takes, or with at least so many."""
    plain = f"{Decimal(ns) / UNITS[unit]:f}"
    whole, _, fraction = plain.partition(".")
    fraction = fraction.rstrip("0") if digits is None else fraction.ljust(digits, "0")
    return f"{whole}.{fraction}" if fraction else whole


@settings(max_examples=150, deadline=None)
@given(
    n=st.integers(12, 40),
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


N = 30
DROPPED = (20, 21, 22, 25)
# three frames are missing before frame 11
MS = [1000.0 + 33.333 * (k + 3 * (k > 10)) for k in range(N)]
NS = [round(1000 * ms) * 1000 for ms in MS]
FRAMES = depth_frames(N)


def moseq(folder: Path, lines: list[str] | bytes, **camera: Any) -> Recording:
    """A session whose depth_ts.txt has these lines."""
    shutil.rmtree(folder, ignore_errors=True)
    write_camera(write_moseq_folder(folder, FRAMES), **camera)
    content = lines if isinstance(lines, bytes) else "".join(f"{line}\n" for line in lines).encode()
    (folder / "depth_ts.txt").write_bytes(content)
    return open_recording(folder)


def images(
    folder: Path,
    table: list[str],
    dropped: Sequence[int] = (),
    name: str = "depth_{:06d}",
    **camera: Any,
) -> Recording:
    """Depth images with a table of time stamps; some of the images are not there."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for k in set(range(N)) - set(dropped):
        assert cv2.imwrite(str(folder / f"{name.format(k)}.png"), FRAMES[k])
    write_camera(folder, **camera)
    if table:
        (folder / "timestamps.csv").write_text("\n".join(table), encoding="utf-8")
    return open_recording(folder)


@pytest.mark.parametrize(
    "line",
    ["{k} {ms:f}", "{k}\t{ms:f}", "{k},{ms:f}", "{ms:f},{k}", "7 {k} {ms:f}", "{k};{ms:.3f};x"],
)
@pytest.mark.parametrize("first", [0, 1, 100, 65_520])
def test_a_counter_beside_the_times_is_not_taken_for_them(
    tmp_path: Path, line: str, first: int
) -> None:
    lines = [line.format(k=(first + k) % 65_536, ms=ms) for k, ms in enumerate(MS)]
    with moseq(tmp_path / "s", lines, fps=30.0) as recording:
        assert recording.times_ns.tolist() == NS
        assert recording.doubts == []


@pytest.mark.parametrize("n", [10, 33, 1000])
@pytest.mark.parametrize("unit_ns", [10**3, 10**6, 10**9])
@pytest.mark.parametrize("named", [False, True])
def test_integers_that_rise_by_one_are_never_times(n: int, unit_ns: int, named: bool) -> None:
    lines = ["time_ms"] * named + [f"{k + 1} 0" for k in range(n)]
    found, _, doubts = read("\n".join(lines).encode(), usual_ns=unit_ns)
    assert found is None or "counts by one: a frame counter, not times" in doubts[0]


@pytest.mark.parametrize("step", [8, 16])
def test_a_counter_alone_gives_the_gaps_at_a_stated_rate_or_a_doubt(
    tmp_path: Path, step: int
) -> None:
    numbers = [str((k + 3 * (k > 10) + 2**step - 20) % 2**step) for k in range(N)]
    with moseq(tmp_path / "s", numbers) as recording:
        assert "state fps = 30.0" in recording.doubts[0]
    with moseq(tmp_path / "s", numbers, fps=30.0) as recording:  # as the sentence says
        assert recording.doubts == []
        assert [(gap.start_frame, gap.n_frames_missing) for gap in recording.gaps] == [(11, 3)]


@pytest.mark.parametrize(
    ("per_s", "origin"),
    [
        (1, 0),
        (10**6, 0),
        (10**7, 0),
        (10**9, 0),
        (10**7, 116_444_736 * 10**9),
        (10**7, 621_355_968 * 10**9),
    ],
)
def test_a_clock_whose_date_leaves_one_unit_is_read_in_it(
    tmp_path: Path, per_s: int, origin: int
) -> None:
    start = 1_709_647_282 * 10**9
    stamps = [Decimal(start + ns) * per_s / 10**9 + origin for ns in NS]
    with moseq(tmp_path / "s", [f"{stamp:f}" for stamp in stamps]) as recording:
        assert recording.times_ns.tolist() == [start + ns for ns in NS]
        assert any("were taken as" in problem for problem in recording.problems)
        assert recording.doubts == []


def test_a_unit_that_is_not_known_is_doubted_until_it_is_stated(tmp_path: Path) -> None:
    lines = [str(ns // 1000) for ns in NS]
    with moseq(tmp_path / "s", lines) as recording:
        assert "another unit" in (*recording.doubts, *recording.clock_doubts)[0]
        assert any('time_column = 0 and time_unit = "us"' in said for said in recording.problems)
    with moseq(tmp_path / "s", lines, time_column=0, time_unit="us") as recording:
        assert (recording.times_ns.tolist(), recording.doubts) == (NS, [])


@pytest.mark.parametrize("n", [2, 3, 5, 11])
@pytest.mark.parametrize("line", ["{},{}", "{},33{}", "{},0"])
def test_fractions_that_rise_by_chance_in_a_few_rows_are_doubted(n: int, line: str) -> None:
    lines = [line.format(1000 + 33 * k, k + 1) for k in range(n)]
    found, _, doubts = read("\n".join(lines).encode(), usual_ns=10**6)
    assert found is None or any("a comma may be a decimal sign" in doubt for doubt in doubts)


@pytest.mark.parametrize("line", ['"{:,.3f}"', "{:,.3f}", "{:,.0f}\t0", "0;{:,.0f}"])
def test_separators_of_thousands_are_refused(tmp_path: Path, line: str) -> None:
    lines = [line.format(900 + 1000 * k) for k in range(N)]
    with pytest.raises(RecordingError, match="without separators of thousands"):
        moseq(tmp_path / "s", [lines[0], *lines])


START = datetime(2024, 10, 27, 0, 59, 59, 200_000, UTC)  # before summer time ends


def stamp(k: int, form: str) -> str:
    """Local time in Berlin with seven digits, as Bonsai writes it."""
    utc = START + timedelta(microseconds=33_333 * k)
    hours = 2 if utc < datetime(2024, 10, 27, 1, tzinfo=UTC) else 1
    local = utc + timedelta(hours=hours * (form != "Z"))
    zone = {"zone": f"+0{hours}:00", "Z": "Z"}.get(form, "")
    text = f"{local:%Y-%m-%dT%H:%M:%S}.{local.microsecond:06d}4{zone}"
    return text.replace("T", " ").replace(".", ",") if form == "comma" else text


@pytest.mark.parametrize("form", ["zone", "Z"])
@pytest.mark.parametrize(
    ("head", "line", "how"),
    [
        ("", "{t}", {}),
        ("", "{t},{k}", {}),
        ("Value,Timestamp", "{k},{t}", {}),
        ("Value;Timestamp", "{k};{t}", {"time_column": "Timestamp"}),
        ("Value\tTimestamp", "{k}\t{t}", {"time_column": "Timestamp", "time_unit": "s"}),
        ("", "{k} {t}", {"time_column": 1}),
    ],
)
def test_dates_with_a_zone_are_instants_across_the_end_of_summer_time(
    tmp_path: Path, form: str, head: str, line: str, how: dict[str, Any]
) -> None:
    table = [head] * bool(head) + [line.format(t=stamp(k, form), k=k) for k in range(N)]
    with images(tmp_path / "r", table, **how) as recording:
        first = 1_729_990_799_200_000_400
        assert recording.times_ns.tolist() == [first + 33_333_000 * k for k in range(N)]
        assert recording.metadata["session_start_time"] == "2024-10-27T00:59:59.200000+00:00"
        assert recording.doubts == []


def test_dates_without_a_zone_are_doubted_where_they_jump_by_an_hour(tmp_path: Path) -> None:
    with images(tmp_path / "r", [stamp(k, "comma") for k in range(N)]) as recording:
        assert any("no time zone and jump by an hour" in doubt for doubt in recording.doubts)
        assert "session_start_time" not in recording.metadata
    with images(tmp_path / "r", [stamp(k, "comma") for k in range(25, N + 25)]) as recording:
        assert set(np.diff(recording.times_ns).tolist()) == {33_333_000}
        assert recording.doubts == []


def test_a_time_of_day_continues_after_midnight(tmp_path: Path) -> None:
    day = datetime(2024, 1, 1, 23, 59, 59, 500_000)
    table = [f"{day + timedelta(microseconds=33_333 * k):%H:%M:%S.%f}" for k in range(N)]
    with images(tmp_path / "r", ["clock", *table]) as recording:
        assert set(np.diff(recording.times_ns).tolist()) == {33_333_000}


@pytest.mark.parametrize(
    ("head", "line"),
    [
        ("filename,time_ms", "depth_{k:06d}.png,{ms}"),
        ("time_ms,path", "{ms},C:\\data\\DEPTH_{k:06d}.PNG"),
        ("time_ms;image", "{ms};../r/depth_{k:06d}"),
        ("file\ttime_ms", "color_{k}.jpg\t{ms}"),
        ("frame,time_ms", "{k},{ms}"),
        ("time_ms,x,number", "{ms},7,{k}.0"),
        ("index,time_ms", "{one},{ms}"),
    ],
)
def test_rows_are_matched_to_images_by_the_name_or_number_beside_them(
    tmp_path: Path, head: str, line: str
) -> None:
    rows = [line.format(k=k, one=k + 1, ms=f"{33.333 * k:.3f}") for k in range(N)]
    left = [k for k in range(N) if k not in DROPPED]
    with images(tmp_path / "r", [head, *rows], DROPPED) as recording:
        assert recording.times_ns.tolist() == [33_333_000 * k for k in left]
        assert [(gap.start_frame, gap.n_frames_missing) for gap in recording.gaps] == [
            (20, 3),
            (22, 1),
        ]
        assert recording.doubts == []
    with images(tmp_path / "r", [head, *(rows[k] for k in left)]) as recording:  # rows are missing
        assert recording.times_ns.tolist() == [33_333_000 * k for k in left]
        np.testing.assert_array_equal(recording.frame(20).depth, FRAMES[23])
        assert any("26 belong together" in problem for problem in recording.problems)


def test_rows_that_cannot_be_matched_are_doubted_where_their_number_differs(tmp_path: Path) -> None:
    rows = ["time_ms", *(f"{33.333 * k:.3f}" for k in range(N))]
    with images(tmp_path / "r", rows, DROPPED) as recording:
        assert any("do not hold equally many frames" in doubt for doubt in recording.doubts)
    with images(tmp_path / "r", rows) as recording:
        assert recording.doubts == []
    stamped = [f"{ms:f} 0" for ms in MS]
    with moseq(tmp_path / "s", [*stamped, *(f"{3000 + k}" for k in range(N))]) as recording:
        assert any("do not hold equally many frames" in doubt for doubt in recording.doubts)


def test_frame_numbers_of_the_camera_do_not_shift_images_that_were_numbered_anew(
    tmp_path: Path,
) -> None:
    numbers = [k + 3 * (k > 10) for k in range(N)]
    rows = ["frame,time_ms", *(f"{k},{33.333 * k:.3f}" for k in numbers)]
    with images(tmp_path / "r", rows) as recording:
        assert recording.times_ns.tolist() == [33_333_000 * k for k in numbers]


@pytest.mark.parametrize("name", ["depth_{:06d}", "frame_{}", "cam2_{}_20240305", "{:03d}"])
def test_numbers_that_are_missing_in_names_are_gaps_at_a_stated_rate(
    tmp_path: Path, name: str
) -> None:
    with images(tmp_path / "r", [], DROPPED, name, fps=30.0) as recording:
        assert [(gap.start_frame, gap.n_frames_missing) for gap in recording.gaps] == [
            (20, 3),
            (22, 1),
        ]
    every_third = [k for k in range(N) if k % 3]
    with images(tmp_path / "r", [], every_third, name, fps=30.0) as recording:
        assert recording.gaps == []


@given(
    steps=st.lists(st.sampled_from([1, 1, 1, 1, 1, 1, 1, 1, 1, 2, 4]), min_size=3, max_size=60),
    first=st.integers(0, 300),
    every=st.integers(1, 7),
    bits=st.sampled_from([8, 16, 62]),
)
def test_a_counter_is_unwound_and_only_a_counter_counts(
    steps: list[int], first: int, every: int, bits: int
) -> None:
    places = np.append(0, np.cumsum(steps))
    found = frame_counts(
        (first + places * every) % 2**bits if every == 1 else first + places * every
    )
    if steps.count(1) >= 0.75 * len(steps):
        assert found is not None
        assert found.tolist() == places.tolist()
    jittered = np.cumsum(np.array(steps) * 33 + np.arange(len(steps)) % 3)
    assert frame_counts(jittered, 1) is None
