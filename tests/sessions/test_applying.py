"""Edits of an ethogram do what painting its frames would do; joints that are placed take the others
along.
"""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from liex_lab.pipelines.correct import edited_bouts, place_joints, spliced_bouts

from liex_lab.actions.ethogram import Ethogram
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import Camera
from liex_lab.sessions.corrections import BoutEdit, JointMove
from liex_lab.tables.rows import bout_rows
from liex_lab.tracking.track import Track

N = 40
TIMES = 1_700_000_000_000_000_000 + np.cumsum(np.random.default_rng(3).integers(30, 36, N)) * 10**6
FRAMES = pd.DataFrame(
    {
        "session_id": "s",
        "individual": "a",
        "frame_index": np.arange(100, 100 + N),
        "time_ns": TIMES,
        "time_s": (TIMES - TIMES[0]) * 1e-9,
    }
)
words = st.lists(st.sampled_from(["", "walk", "rear", "groom"]), min_size=N, max_size=N)
edits = st.lists(
    st.tuples(st.integers(0, N - 1), st.integers(1, 12), st.sampled_from(["", "run", "walk"])),
    max_size=6,
)


def bouts_of(frame_words: list[str]) -> pd.DataFrame:
    return bout_rows(Ethogram.of_words(frame_words, TIMES), FRAMES, "hash")


def words_in(bouts: pd.DataFrame) -> list[str]:
    """Frame by frame; no two bouts claim one."""
    out = [""] * N
    for row in bouts.to_dict("records"):
        for k in range(int(row["start_frame"]) - 100, int(row["stop_frame"]) - 100):
            assert out[k] == ""
            out[k] = str(row["action"])
    return out


@settings(max_examples=15, deadline=None)
@given(words, edits)
def test_edits_paint_the_frames_that_they_name_and_no_others(
    before: list[str], spans: list[tuple[int, int, str]]
) -> None:
    wanted, what = list(before), []
    for start, length, word in spans:
        stop = min(start + length, N)
        wanted[start:stop] = [word] * (stop - start)
        stop_ns = int(TIMES[stop]) if stop < N else int(TIMES[-1]) + 40 * 10**6
        what.append(BoutEdit("add" if word else "delete", word, int(TIMES[start]), stop_ns))
    after = edited_bouts(bouts_of(before), what, FRAMES)
    assert words_in(after) == wanted
    assert (np.diff(after["start_s"]) > 0).all()
    np.testing.assert_allclose(after["stop_s"] - after["start_s"], after["duration_s"], atol=1e-9)
    said = after["source"] == "human"
    assert set(after.loc[said, "model_hash"]) <= {""}
    assert set(after.loc[~said, "model_hash"]) <= {"hash"}


@settings(max_examples=15, deadline=None)
@given(words, words, st.sets(st.integers(0, N - 1), min_size=1))
def test_splicing_takes_some_frames_from_another_ethogram(
    one: list[str], other: list[str], rows: set[int]
) -> None:
    mixed = spliced_bouts(bouts_of(one), bouts_of(other), np.array(sorted(rows)), FRAMES)
    assert words_in(mixed) == [other[k] if k in rows else one[k] for k in range(N)]


def test_a_word_that_goes_on_across_a_seam_is_one_bout() -> None:
    walking = ["walk"] * N
    mixed = spliced_bouts(bouts_of(walking), bouts_of(walking), np.arange(10, 20), FRAMES)
    assert len(mixed) == 1


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_of_any_animal_a_joint_that_is_placed_is_there_and_the_bones_are_as_long_as_before(
    animal: str,
) -> None:
    skeleton = Skeleton.load(animal)
    track = Track.empty(skeleton, TIMES[:3], "")
    rng = np.random.default_rng(4)
    bent = np.clip(
        rng.normal(0.0, 0.15, (3, skeleton.n_joints, 3)),
        skeleton.limits[..., 0],
        skeleton.limits[..., 1],
    )
    bent[:, 0] = 0.0
    track.root_rotation[:], track.root_mm[:] = (
        so3.exp(rng.normal(0.0, 0.4, (3, 3))),
        rng.normal(0.0, 20.0, (3, 3)),
    )
    track.angles_rad[:], track.scale[:] = bent * skeleton.axes, 1.1
    track.joints_mm[:] = Pose(track.root, track.angles_rad, track.scale).joints(skeleton)
    before = track.joints_mm.copy()
    off = 0.04 * skeleton.length
    target = before[1, -1] + off * np.array([0.6, 0.0, 0.8])
    move = JointMove(101, skeleton.names[-1], *target.tolist())
    rows = place_joints(
        track, np.arange(100, 103), [move], Camera(500, 500, 320, 240, 640, 480), SE3.identity()
    )
    assert rows.tolist() == [1]
    assert np.linalg.norm(track.joints_mm[1, -1] - target) < 0.1 * off
    np.testing.assert_array_equal(track.joints_mm[[0, 2]], before[[0, 2]])
    posed = Pose(track.root, track.angles_rad, track.scale).joints(skeleton)
    np.testing.assert_allclose(posed, track.joints_mm, atol=1e-6)
    assert np.linalg.norm(track.joints_mm[1] - before[1], axis=-1).mean() < off, (
        "the others moved less"
    )
