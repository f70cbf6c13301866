"""The NYU protocol: published figures to the last digit, and what it means to be given the root."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines.evaluation import nyu

from liex_lab.recordings.formats.images.nyu import PALM, POINTS, NyuReference

PAPER = {
    "liex": (14.507, 15.62),
    "v2v_posenet": (8.419, 8.586),
    "deepprior": (20.75, 21.49),
    "generalized_feedback": (10.894, 11.517),
}


@pytest.fixture(scope="module")
def folder(reference_data: Path) -> Path:
    return reference_data / "hand_nyu"


@pytest.fixture(scope="module")
def reference(folder: Path) -> NyuReference:
    return NyuReference.load(folder)


@pytest.mark.parametrize("method", PAPER)
def test_published_answers_have_the_published_errors(
    method: str, folder: Path, reference: NyuReference
) -> None:
    expected: dict[str, Any] = json.loads((folder / "expected.json").read_text())["results"][method]
    found = nyu.nyu_errors(reference.answers[method], reference.truth)
    assert found["root_estimated_mm_14"] == pytest.approx(
        expected["mean_joint_error_mm_14"], abs=1e-5
    )
    assert found["root_estimated_mm_13"] == pytest.approx(
        expected["mean_joint_error_mm_13_without_palm"], abs=1e-5
    )
    moved = expected["mean_joint_error_mm_13_after_moving_palm_onto_palm"]
    assert found["root_given_mm_13"] == pytest.approx(moved, abs=1e-5)
    assert found["median_mm_14"] == pytest.approx(expected["median_joint_error_mm_14"], abs=1e-5)
    np.testing.assert_allclose(
        list(found["per_point_mm"].values()), expected["per_joint_mean_mm"], atol=1e-5
    )
    for name, theirs in (("max", "max"), ("mean", "mean")):
        shares = expected[f"fraction_of_frames_{theirs}_error_below_mm"]
        assert found[f"share_{name}_error_below_mm"] == pytest.approx(shares, abs=1e-5)
    assert (
        round(found["root_estimated_mm_14"], 3),
        round(found["root_estimated_mm_13"], 2),
    ) == pytest.approx(PAPER[method], abs=0.006)


def random_hands(n: int) -> np.ndarray:
    return np.random.default_rng(0).normal(0.0, 60.0, (n, len(POINTS), 3)) + np.array(
        [0.0, 0.0, 800.0]
    )


def test_the_palm_alone_counts_only_where_it_is_counted() -> None:
    truth = random_hands(30)
    answer = truth.copy()
    answer[:, PALM] += [0.0, 0.0, 14.0]
    found = nyu.nyu_errors(answer, truth)
    assert (found["root_estimated_mm_14"], found["root_estimated_mm_13"]) == pytest.approx(
        (1.0, 0.0)
    )
    assert found["root_given_mm_13"] == pytest.approx(14.0)


def test_lost_frames_are_told_and_not_averaged() -> None:
    truth = random_hands(10)
    answer = truth + np.array([2.0, 0.0, 0.0])
    answer[3, 5] = np.nan
    found = nyu.nyu_errors(answer, truth)
    assert (found["lost_rate"], found["root_estimated_mm_14"]) == pytest.approx((0.1, 2.0))
    assert nyu.nyu_errors(np.full_like(truth, np.nan), truth) == {"n_frames": 10, "lost_rate": 1.0}


def test_the_frames_in_the_folder_are_found_by_their_numbers(folder: Path) -> None:
    truth = NyuReference.load(folder)
    numbers = nyu.frame_numbers_in(folder, len(truth.truth))
    assert numbers.tolist() == [1]
    same = nyu.nyu_errors(truth.answers["liex"][numbers - 1], truth.truth[numbers - 1])
    assert same["root_given_mm_14"] == pytest.approx(7.8645, abs=5e-4)


def test_ten_hands_are_shown_with_the_answers_of_all_and_ours_where_it_was_measured() -> None:
    truth = random_hands(95)
    answers = {"v2v_posenet": truth + np.array([3.0, 0.0, 4.0]), "somebody": truth + 9.0}
    ours = np.stack([truth[0] + 1.0, np.full((14, 3), np.nan)])
    shown = nyu.shown_hands(NyuReference(truth, answers), np.array([1, 10]), ours)
    assert list(shown) == ["liex_lab", "v2v_posenet", "somebody"]
    frames = [1, 10, 20, 29, 39, 48, 58, 67, 77, 86]
    for hands in shown.values():
        assert [one["head"] for one in hands] == [f"frame {k}" for k in frames]
        for k, one in zip(frames, hands, strict=True):
            np.testing.assert_array_equal(one["truth"], truth[k - 1])
    assert ["pose" in one for one in shown["liex_lab"]] == [True] + 9 * [False]
    assert all("pose" in one for one in shown["somebody"])
    labels = nyu.shown_hands(NyuReference(truth[:3], {}), np.zeros(0, int), ours[:0])["labels"]
    assert [one["head"] for one in labels] == ["frame 1", "frame 2", "frame 3"]
