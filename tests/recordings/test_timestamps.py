"""Time stamps: exact, strictly increasing, and honest about what was not."""

import shutil
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.errors import RecordingError
from liex_lab.recordings import Recording, open_recording
from liex_lab.recordings.timestamp_files import UNITS, name_times, read_stamps
from liex_lab.recordings.timestamps import (
    FAULTS,
    clock_doubts,
    find_gaps,
    frame_counts,
    from_rate,
    in_order_of_sensor,
    make_monotone,
    median_step,
    start_of_clock,
    start_of_day,
)
from liex_lab.tables import rows
from tests.recordings.writers import (
    depth_frames,
    write_camera,
    write_moseq_folder,
    write_png_folder,
)

stamps = st.lists(st.integers(-20, 20), min_size=1, max_size=9)


@given(stamps)
def test_settled_times_increase_and_stay_where_they_already_did(times: list[int]) -> None:
    given_ns = np.array(times, np.int64)
    found = make_monotone(given_ns)
    monotone, sentence = found.times_ns, found.problem
    np.testing.assert_array_equal(found.faults > 0, monotone != given_ns)
    assert np.all(np.diff(monotone) > 0)
    if np.all(np.diff(given_ns) > 0):
        np.testing.assert_array_equal(monotone, given_ns)
        assert sentence is None
    else:
        assert sentence is not None
        assert f"{(monotone != given_ns).sum()} of {len(times)}" in sentence


@given(stamps)
def test_no_other_choice_moves_fewer_stamps(times: list[int]) -> None:
    monotone = make_monotone(np.array(times, np.int64)).times_ns
    kept = int((monotone == times).sum())

    def can_stay(chosen: tuple[int, ...]) -> bool:
        """Room for the stamps between: at least one nanosecond each."""
        return all(times[b] - times[a] >= b - a for a, b in pairwise(chosen))

    assert kept == max(
        n for n in range(len(times) + 1) for c in combinations(range(len(times)), n) if can_stay(c)
    )


@pytest.mark.parametrize(
    ("stated", "spread"),
    [
        ([0, 33, 33, 99, 132], [0, 33, 66, 99, 132]),
        ([0, 33, 33, 33, 132], [0, 33, 66, 99, 132]),
        ([0, 33, 33, 34], [0, 16, 33, 34]),  # no room behind it
        ([0, 30, 60, 90, 5, 6], [0, 30, 60, 90, 120, 150]),
        ([900, 901, 60, 90, 120], [0, 30, 60, 90, 120]),
    ],
)
def test_stamps_that_are_moved_are_spread_evenly_between_those_that_stay(
    stated: list[int], spread: list[int]
) -> None:
    assert make_monotone(np.array(stated)).times_ns.tolist() == spread


@pytest.mark.parametrize("back", [10**6, 10**9, 3600 * 10**9])
@pytest.mark.parametrize("at", [5, 20, 35])
def test_a_clock_that_is_set_back_goes_on_as_after_a_missing_frame(back: int, at: int) -> None:
    step = 33_333_333 if back > 10**6 else 1000
    stated = np.arange(40, dtype=np.int64) * step
    stated[at:] -= back
    found = make_monotone(stated)
    expected = np.arange(40, dtype=np.int64) * step
    expected[at:] += step
    np.testing.assert_array_equal(found.times_ns, expected)
    assert [FAULTS[fault] for fault in found.faults[[at - 1, at]]] == ["", "clock_jumped"]
    assert f"at frame {at}" in str(found.problem)


def test_a_counter_that_wraps_every_minute_goes_on_each_time() -> None:
    step = 40_000_000
    stated = (np.arange(5000, dtype=np.int64) * step) % (60 * 10**9)
    found = make_monotone(stated)
    assert (found.faults == FAULTS.index("clock_jumped")).sum() == 3
    assert set(np.diff(found.times_ns).tolist()) == {step, 2 * step}


def test_a_few_frames_out_of_order_are_no_jump_of_the_clock() -> None:
    stated = np.arange(40, dtype=np.int64) * 100
    stated[[20, 21, 22]] = stated[[22, 20, 21]]
    found = make_monotone(stated)
    assert (found.times_ns != stated).sum() == 1
    assert {FAULTS[fault] for fault in found.faults} == {"", "stamp_out_of_order"}


@given(
    st.integers(0, 2**32 - 1),
    st.floats(0.0, 0.2),
    st.sampled_from([12_500_000, 33_333_333, 33_366_667, 66_666_667]),
    st.sampled_from([1, 1_000_000]),
)
def test_gaps_count_every_missing_pulse_whatever_the_jitter(
    seed: int, jitter: float, period_ns: int, rounding_ns: int
) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(60, 400))
    missing = np.where(rng.random(n) < 0.1, rng.choice([1, 2, 5, 60, 400], n), 0)
    pulse = np.arange(n) + np.cumsum(missing) - missing[0]
    room = jitter * period_ns - min(rounding_ns / 2, jitter * period_ns)
    stamps = np.rint(pulse * period_ns + rng.uniform(-room, room, n)).astype(np.int64)
    stamps = stamps // rounding_ns * rounding_ns  # a recorder that writes whole milliseconds
    before = np.zeros(n, np.int64)
    for gap in find_gaps(stamps, median_step(stamps)):
        before[gap.start_frame] = gap.n_frames_missing
    np.testing.assert_array_equal(np.arange(n) + np.cumsum(before), pulse)


STEP = 33_333_333


@given(
    st.sets(st.integers(0, 18), max_size=8),
    st.integers(0, 2**60),
    st.sets(st.integers(1, 58), max_size=4),
    st.integers(0, 2**32),
)
def test_neighbours_recorded_in_the_wrong_order_get_their_own_stamps_again(
    swapped: set[int], start: int, lost: set[int], seed: int
) -> None:
    """Also beside lost frames, and with stamps that jitter."""
    jitter = np.random.default_rng(seed).integers(-STEP // 6, STEP // 6, 60)
    right = np.delete(start + np.arange(60) * STEP + jitter, sorted(lost))
    order = np.arange(len(right))
    for k in swapped:
        order[[3 * k, 3 * k + 1]] = order[[3 * k + 1, 3 * k]]
    order = order[order < len(right)]
    found = in_order_of_sensor(right[order])
    np.testing.assert_array_equal(found.times_ns, right)
    np.testing.assert_array_equal(order[found.order], np.arange(len(right)))
    assert not found.faults.any()
    n = len(swapped)
    assert found.problem is None if not n else f"{n} pair" in str(found.problem)


@pytest.mark.parametrize("move", [(20, 22), (20, 24), (3, 10)])
def test_a_late_frame_goes_where_its_stamp_belongs(move: tuple[int, int]) -> None:
    right = np.arange(60, dtype=np.int64) * STEP
    stated = np.insert(np.delete(right, move[0]), move[1], right[move[0]])
    found = in_order_of_sensor(stated)
    np.testing.assert_array_equal(found.times_ns, right)
    assert "were recorded in the wrong order" in str(found.problem)


@given(st.integers(8, 50), st.floats(0.1, 1000.0), st.sampled_from(["back", "wild", "repeated"]))
def test_clocks_that_are_not_sound_are_treated_as_before(at: int, steps: float, how: str) -> None:
    stated = np.arange(60, dtype=np.int64) * STEP
    if how == "back":  # for good
        stated[at:] -= int(steps * STEP)
    elif how == "wild":
        stated[at] += int((9 + steps) * STEP) * (-1) ** at
    else:
        stated[at] = stated[at - 1]
    found = in_order_of_sensor(stated)
    before = make_monotone(stated)
    np.testing.assert_array_equal(found.order, np.arange(60))
    np.testing.assert_array_equal(found.times_ns, before.times_ns)
    np.testing.assert_array_equal(found.faults, before.faults)
    assert found.problem == before.problem


def test_clocks_in_noise_stay_within_what_an_integer_holds() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        wild = np.sort(rng.integers(-(2**61), 2**61, (4, 10)), axis=1).ravel()
        assert np.all(np.diff(make_monotone(wild).times_ns) > 0)


def test_a_recording_lists_what_its_clock_did(tmp_path: Path) -> None:
    step = 33_000_000
    # two frames were left out, and an hour passed, or somebody set the clock
    times = [k * step + 2 * step * (k > 19) + 3600 * 10**9 * (k > 29) for k in range(40)]
    times[10] = times[9]
    folder = write_png_folder(tmp_path, depth_frames(40), times_ns=times)
    with open_recording(folder) as recording:
        told = sorted((gap.start_frame, gap.reason, gap.n_frames_missing) for gap in recording.gaps)
        assert told == [(20, "camera_dropped", 2), (30, "clock_jumped", 1)]
        (fault,) = recording.faults
        assert recording.times_ns[10] == 10 * step  # where it would have been
        assert (fault.start_frame, fault.stop_frame) == (10, 11)
        assert (fault.n_frames_missing, fault.reason) == (0, "stamp_repeated")
        assert recording[15:].faults == []
        assert [gap.start_frame for gap in recording[15:].gaps] == [5, 15]
    times = [k * step - 10**10 * (k > 19) for k in range(40)]
    with open_recording(write_png_folder(tmp_path, depth_frames(40), times_ns=times)) as recording:
        (gap,) = recording.gaps
        assert (gap.start_frame, gap.reason, gap.n_frames_missing) == (20, "clock_jumped", 1)
        assert recording.faults == []


@pytest.mark.parametrize(
    ("names", "first", "steps", "moment"),
    [
        (
            ["f_20121214T142255.814212.tif", "f_20121214T142256.068683.tif"],
            1355494975_814212000,
            [254_471_000],
            False,
        ),
        (
            ["2024-05-01_10-00-00.123.png", "2024-05-01_10-00-00.456.png"],
            1714557600_123000000,
            [333_000_000],
            False,
        ),
        (
            ["1305031102.175304.png", "1305031102.211214.png"],
            1305031102_175304000,
            [35_910_000],
            True,
        ),
        (["d_1700000000123.png", "d_1700000000156.png"], 1700000000_123000000, [33_000_000], True),
        (
            ["1700000000123456_a.png", "1700000000156789_a.png"],
            1700000000_123456000,
            [33_333_000],
            True,
        ),
        (
            ["1700000000123456789.png", "1700000000156789012.png"],
            1700000000_123456789,
            [33_332_223],
            True,
        ),
    ],
)
def test_stamps_in_names_are_read_as_people_write_them(
    names: list[str], first: int, steps: list[int], moment: bool
) -> None:
    found = name_times(names)
    assert found is not None
    assert (int(found[0][0]), np.diff(found[0]).tolist(), found[1]) == (first, steps, moment)


@pytest.mark.parametrize(
    "names",
    [
        [],
        ["frame_0.png", "frame_1.png"],
        ["frame_0000000000001.png", "frame_0000000000002.png"],
        ["1305031102.175304.png", "last.png"],
        ["20121399T142255.814212.png"],
        ["1305031102.175_1305031103.175.png"],
        ["20240501.png"],
        ["20240501_101010.png"],
    ],
)
def test_names_that_only_count_hold_no_stamps(names: list[str]) -> None:
    assert name_times(names) is None


def test_gaps_are_steps_of_more_than_one_and_a_half_medians() -> None:
    times = np.cumsum([0, 10, 10, 10, 30, 10, 15, 10, 16, 10]).astype(np.int64)
    first, second = find_gaps(times, median_step(times))
    assert (first.start_frame, first.stop_frame, first.n_frames_missing) == (4, 4, 2)
    assert (first.start_ns, first.stop_ns) == (
        40,
        60,
    )  # from when the next frame was due until the one that came
    assert (second.start_frame, second.n_frames_missing) == (8, 1)
    assert find_gaps(times[:1], 0) == []


def test_a_rate_gives_stamps_that_do_not_drift() -> None:
    times = from_rate(100_001, 30.0)
    assert times[-1] == round(100_000 / 30 * 1e9)
    assert np.diff(times).max() - np.diff(times).min() <= 1


def times_of(path: Path, content: str | bytes, **how: Any) -> list[int]:
    """Stamps of a table that are read without a doubt."""
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    doubts: list[str] = []
    times = read_stamps(path, doubts, **how).times(None, [], doubts, None)
    assert doubts == []
    return times.tolist()


@pytest.mark.parametrize(
    ("text", "unit", "ns"),
    [
        ("666649624.5888", "ms", 666649624588800),
        ("1760000000.123456789", "s", 1760000000123456789),
        ("-1.5", "s", -1_500_000_000),
        ("1.76e9", "s", 1_760_000_000 * 10**9),
    ],
)
def test_decimal_times_are_exact(tmp_path: Path, text: str, unit: str, ns: int) -> None:
    assert times_of(tmp_path / "a.csv", f"time_{unit}\n{text}\n") == [ns]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "missing"),
        (b"1\n2\n", "time_ns or time_s"),
        (b"time_ns\n1\nnan\n", "'nan' on line 3"),
        (b"time_s\n1\n1e30\n", "'1e30' on line 3"),
        (b"time_s\n1\ninf\n", "'inf' on line 3"),
        (b"time_s\n" + b"x" * 500, "..."),
        (b"frame,time_ns\n1\n", "'' on line 2"),
        (b"\xff\xfe\x00\x01\x02", "utf-16"),
        (b"time_s\n1\n\xe4\x80\n", "not text in UTF-8 or UTF-16 (line 3"),
    ],
)
def test_a_wrong_csv_is_told_in_a_sentence(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "timestamps.csv"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"timestamps\.csv") as error:
        read_stamps(path, []).times(None, [], [], None)
    assert says in str(error.value)
    assert len(str(error.value)) < 400 + len(str(tmp_path))


def test_a_start_needs_a_zone_to_be_a_moment() -> None:
    assert start_of_day("2017-01-25T10:42:07.1734698-05:00") == "2017-01-25T10:42:07.173469-05:00"
    assert {start_of_day(day) for day in ("2017-01-25T10:42:07", "yesterday", None)} == {None}
    assert start_of_clock(1_760_000_000 * 10**9) == "2025-10-09T08:53:20+00:00"
    assert start_of_clock(666_649_624_588_800) is None  # a week since some machine was switched on


@pytest.mark.parametrize(
    ("step_ns", "said"),
    [
        (33_333_333, ""),
        (2_000_000, ""),  # 500 frames/s
        (500_000_000, ""),  # 2 frames/s
        (33_333, "30,000 frames/s"),  # microseconds, written as nanoseconds
        (33_333_333_333, "0.030 frames/s"),
        (0, ""),
    ],
)
def test_a_rate_that_no_camera_has_is_doubted(step_ns: int, said: str) -> None:
    found = clock_doubts(step_ns, np.zeros(50, np.uint8))
    assert [said in one for one in found] == ([True] if said else [])


def test_a_clock_that_often_stands_still_is_doubted() -> None:
    moved = make_monotone(np.repeat(np.arange(20, dtype=np.int64) * 66_000_000, 2))
    assert "20 of 40 time stamps are repeated" in clock_doubts(33_000_000, moved.faults)[0]
    few = make_monotone(np.r_[0:30, 29].astype(np.int64) * 33_000_000)
    assert clock_doubts(33_000_000, few.faults) == ()


ROUNDINGS_NS = {1_000_000: (10.0, 700.0), 10_000_000: (10.0, 45.0), 15_625_000: (10.0, 35.0)}


@given(st.data())
def test_rounded_stamps_give_the_true_rate_and_every_gap(data: st.DataObject) -> None:
    """Whole milliseconds, ticks of 10 ms and of Windows' clock; gaps of 1 to 100 frames."""
    unit, (low, high) = data.draw(st.sampled_from([*ROUNDINGS_NS.items()]))
    hz = data.draw(st.floats(low, high) | st.sampled_from([30.0, 15.0, 29.97]))
    n = data.draw(st.integers(300, 600))
    gaps = data.draw(
        st.dictionaries(st.integers(1, (n - 5) // 25), st.integers(1, 100), max_size=5)
    )
    lost = np.zeros(n, np.int64)
    for k, n_lost in gaps.items():
        lost[25 * k :] += n_lost
    true_ns = (np.arange(n) + lost) * 1e9 / hz + data.draw(st.integers(0, 10**9))
    times = np.round(true_ns / unit).astype(np.int64) * unit
    step = median_step(times)
    assert 1e9 / step == pytest.approx(hz, rel=1e-3)
    found = {gap.start_frame // 25: gap.n_frames_missing for gap in find_gaps(times, step)}
    assert found == gaps
    seconds = (times - times[0]) * 1e-9
    assert rows.median_step(seconds) == pytest.approx(step * 1e-9)
    assert np.flatnonzero(rows.gap_follows(seconds)[:-1]).tolist() == [
        25 * k - 1 for k in sorted(gaps)
    ]


def test_stamps_of_a_clock_that_cannot_be_told_keep_their_median_step() -> None:
    bursts = np.cumsum(np.tile([100_000, 100_000, 100_000, 133_033_333], 30))
    assert median_step(bursts) == 100_000, "which is doubted"
    wild = np.cumsum(np.random.default_rng(3).integers(1, 10**8, 400))
    assert median_step(wild) == int(np.median(np.diff(wild)))


# Tables of time stamps as other programs write them: read exactly, or refused, or doubted.


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


@settings(max_examples=40, deadline=None)
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
