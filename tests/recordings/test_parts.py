"""A recording in several files reads as the one that it is, or is refused in a sentence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.study.status import input_stamp

from liex_lab.cli.options import as_one
from liex_lab.errors import RecordingError
from liex_lab.recordings import open_recording
from liex_lab.recordings.timestamps import DROPPED, JUMPED
from tests.recordings.writers import SMALL, cut, depth_frames, even_times, write_mcap_parts

N = 12
FRAMES = depth_frames(N)


def later(from_row: int, seconds: float) -> list[int]:
    """Even times with those of the rows from `from_row` on moved by some seconds."""
    return [t + round(1e9 * seconds) * (k >= from_row) for k, t in enumerate(even_times(N))]


@pytest.mark.parametrize(
    "named", ["cam1_*.mcap", "cam?_?.mcap", "{cam1_2.mcap,cam1_0.mcap,cam1_1.mcap}"]
)
def test_parts_read_as_the_recording_that_was_cut(tmp_path: Path, named: str) -> None:
    write_mcap_parts(tmp_path, FRAMES)
    with open_recording(tmp_path / named, strict=True) as parts:
        assert (parts.name, parts.format, len(parts)) == ("cam1", "mcap", N)
        np.testing.assert_array_equal(parts.times_ns, even_times(N))
        assert not parts.gaps
        assert not parts.problems
        for row in np.random.default_rng(3).permutation(N):
            np.testing.assert_array_equal(parts.frame(int(row)).depth, FRAMES[row])
        assert len(parts[4:6]) == 2
        np.testing.assert_array_equal(parts[4:6].frame(1).depth, FRAMES[5])


@pytest.mark.parametrize(("seconds", "reason"), [(1.0, DROPPED), (7200.0, JUMPED)])
def test_a_pause_between_files_is_a_gap_of_its_true_length(
    tmp_path: Path, seconds: float, reason: str
) -> None:
    write_mcap_parts(tmp_path, FRAMES, times_ns=later(5, seconds))
    with open_recording(tmp_path / "cam1_*.mcap") as parts:
        (gap,) = parts.gaps
        assert (gap.start_frame, gap.reason) == (5, reason)
        assert gap.stop_ns - gap.start_ns == pytest.approx(1e9 * seconds, rel=1e-6)
        said = "nothing was recorded for 2.00 h in 1 of 2 places between files"
        assert any(said in sentence for sentence in parts.problems) == (seconds > 60)


def test_what_is_no_recording_in_parts_is_refused_in_a_sentence(tmp_path: Path) -> None:
    def refused(match: str, folder: Path, named: str = "*.mcap") -> None:
        with pytest.raises(RecordingError, match=match):
            open_recording(folder / named, strict=True)

    refused("no file or folder matches", tmp_path, "cam2_*.mcap")
    for name, times, match in (
        ("overlap", later(5, -0.05), "cam1_2.mcap begins 0.017 s before the end of cam1_1.mcap"),
        ("again", [*even_times(6), *even_times(6)], "the clock was set back"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        write_mcap_parts(folder, FRAMES, (2, 5) if name == "overlap" else (6,), times)
        refused(match, folder)
    other = tmp_path / "other"
    other.mkdir()
    write_mcap_parts(other, FRAMES)
    write_mcap_parts(tmp_path, FRAMES[:2], (), later(0, 60.0), replace(SMALL, fx=70.0))
    (tmp_path / "cam1_0.mcap").rename(other / "cam2_0.mcap")
    refused("cam2_0.mcap has another camera than cam1_0.mcap: .* fx 70,", other)
    refused("there is no file", other, "{cam1_0.mcap,cam1_3.mcap}")


def test_a_folder_is_joined_only_if_its_files_continue_each_other(tmp_path: Path) -> None:
    write_mcap_parts(tmp_path, FRAMES, times_ns=later(5, 1.0))
    with open_recording(tmp_path) as parts:
        assert len(parts) == N
    for file in tmp_path.iterdir():
        file.unlink()
    write_mcap_parts(tmp_path, FRAMES, times_ns=later(5, 10.0))
    with pytest.raises(RecordingError, match=r"holds several recordings: 10\.0 s lie between"):
        open_recording(tmp_path)


def test_names_in_another_order_than_the_times_make_the_clock_doubtful(tmp_path: Path) -> None:
    write_mcap_parts(tmp_path, FRAMES)
    (tmp_path / "cam1_0.mcap").rename(tmp_path / "cam1_9.mcap")
    with open_recording(tmp_path / "*.mcap") as parts:
        assert parts.doubts == [
            "by its times cam1_9.mcap comes before cam1_1.mcap, and by its name after it: the "
            "clock may have been set back"
        ]
        np.testing.assert_array_equal(parts.frame(0).depth, FRAMES[0])


def test_what_is_whole_of_a_cut_part_is_read_if_asked_for_and_the_rest_is_a_gap(
    tmp_path: Path,
) -> None:
    write_mcap_parts(tmp_path, FRAMES, (2, 8))
    cut(tmp_path / "cam1_1.mcap", 0.6)
    with pytest.raises(RecordingError, match=r"cam1_1.mcap is cut short or damaged"):
        open_recording(tmp_path / "*.mcap", strict=True)
    with open_recording(tmp_path / "*.mcap") as parts:
        assert parts.truncated
        n_lost = N - len(parts)
        assert [gap.n_frames_missing for gap in parts.gaps] == [n_lost]
        assert 0 < n_lost < 6
        assert "cam1_1.mcap is cut or damaged" in parts.problems[0]
        np.testing.assert_array_equal(parts.frame(N - n_lost - 1).depth, FRAMES[-1])


@pytest.mark.parametrize("strict", [False, True])
def test_a_part_that_changed_after_the_recording_was_opened_is_not_read(
    tmp_path: Path, strict: bool
) -> None:
    write_mcap_parts(tmp_path, FRAMES)
    with open_recording(tmp_path / "*.mcap", strict=strict) as parts:
        (tmp_path / "cam1_1.mcap").write_bytes((tmp_path / "cam1_2.mcap").read_bytes())
        with pytest.raises(RecordingError, match="changed while it was measured"):
            parts.frame(3)


def test_files_on_the_command_line_are_one_recording(tmp_path: Path) -> None:
    write_mcap_parts(tmp_path, FRAMES)
    files = sorted(tmp_path.iterdir())
    assert as_one(files[:1]) == files[0]
    with open_recording(as_one(files)) as parts:
        assert (parts.name, len(parts), parts.sources) == ("cam1", N, tuple(files))
    with pytest.raises(RecordingError, match="expected in one folder"):
        as_one([files[0], tmp_path / "other" / "cam1_1.mcap"])


def test_a_study_knows_when_one_of_the_files_changed_or_is_gone(tmp_path: Path) -> None:
    write_mcap_parts(tmp_path, FRAMES)
    pattern = str(tmp_path / "cam1_*.mcap")
    stamps = [input_stamp(pattern)]
    cut(tmp_path / "cam1_1.mcap", 0.6)
    stamps.append(input_stamp(pattern))
    (tmp_path / "cam1_1.mcap").unlink()
    stamps.append(input_stamp(pattern))
    assert len({*stamps}) == 3
    assert input_stamp(str(tmp_path / "cam2_*.mcap")) == ""
    assert input_stamp(str(tmp_path / "{cam1_0.mcap,cam1_1.mcap}")) == ""
