"""Scores of several animals: identity as TrackEval scores it, swaps, errors, interactions."""

import numpy as np
import pytest

from liex_lab.evaluation import several

# seed, IDF1 and HOTA by TrackEval 1.3.0 (`metrics.Identity`, `metrics.HOTA`) of `distances`
TRACKEVAL = (
    (5, 0.583840139, 0.461222189),
    (6, 0.581151832, 0.459118013),
    (7, 0.607111882, 0.470758090),
)


def distances(seed: int = 5, n: int = 200) -> np.ndarray:
    """Three true animals and three individuals, which exchange, disappear and err."""
    rng = np.random.default_rng(seed)
    true = np.cumsum(rng.normal(0.0, 4.0, (n, 3, 2)), axis=0) + rng.uniform(0, 120, (1, 3, 2))
    own = true + rng.normal(0.0, 4.0, true.shape)
    own[60:120, [0, 1]] = own[60:120, [1, 0]]
    own[90:, 2] += 14.0
    own[150:170, 0] = np.nan
    own[rng.random((n, 3)) < 0.05] = np.nan
    return np.linalg.norm(true[:, :, None] - own[:, None], axis=-1)


def figures(distance: np.ndarray) -> dict[str, float | None]:
    return several.track_figures(several.track_counts(distance, np.arange(len(distance)) / 30.0))


def test_idf1_and_hota_are_those_of_trackeval():
    for seed, idf1, hota in TRACKEVAL:
        found = figures(distances(seed))
        assert found["idf1"] == pytest.approx(idf1, abs=1e-6)
        assert found["hota"] == pytest.approx(hota, abs=1e-6)


def test_hota_of_a_case_by_hand():
    # one animal, matched at 6 mm (similarity 0.8) in 3 of 4 frames: 16 thresholds hold
    distance = np.array([6.0, 6.0, 6.0, np.nan])[:, None, None]
    found = figures(distance)
    assert found["idf1"] == pytest.approx(2 * 3 / (4 + 3))
    assert found["hota"] == pytest.approx(16 / 19 * 0.75)


def test_counts_of_recordings_add_up_to_those_of_one_with_identities_of_its_own():
    parts = [distances(seed) for seed in (5, 6)]
    whole = np.full((400, 6, 6), np.nan)
    for k, part in enumerate(parts):
        rows, animals = slice(200 * k, 200 * (k + 1)), slice(3 * k, 3 * (k + 1))
        whole[rows, animals, animals] = part
    time_s = np.arange(200) / 30.0
    added = several.summed(several.track_counts(part, time_s) for part in parts)
    # each true animal of the whole is absent in half of the frames, which the score does not know
    assert added["idtp"] == several.track_counts(whole, np.arange(400) / 30.0)["idtp"]


def test_a_track_that_goes_over_to_another_animal_is_a_swap():
    apart = np.where(np.eye(2, dtype=bool), 2.0, 200.0)[None].repeat(90, axis=0)
    time_s = np.arange(90) / 30.0
    assert several.track_counts(apart, time_s)["swaps"] == 0
    both = apart.copy()
    both[40:] = both[40:, ::-1]
    assert several.track_counts(both, time_s)["swaps"] == 1
    near = apart.copy()  # the other animal is nearer for a while, and its own is within 15 mm
    near[40:60] = [[12.0, 6.0], [6.0, 12.0]]
    assert several.track_counts(near, time_s)["swaps"] == 0
    one = apart[:, :, :1].copy()  # a single animal is measured
    one[40:60] = one[40:60, ::-1]
    assert several.track_counts(one, time_s)["swaps"] == 2
    alone = several.track_figures(several.track_counts(apart[:, :, :1], time_s))
    assert alone["found"] == pytest.approx(0.5)
    assert alone["idf1"] == pytest.approx(2 / 3)
    nothing = several.track_figures(several.track_counts(apart[:, :, :0], time_s))
    assert (nothing["idf1"], nothing["hota"]) == (0.0, 0.0)


def test_crossings_are_calibrated_against_the_exchanges_in_them():
    distance = np.where(np.eye(2, dtype=bool), 2.0, 200.0)[None].repeat(90, axis=0)
    distance[25:35] = np.nan
    distance[60:] = distance[60:, ::-1]
    crossings = np.array([[25.0, 35.0, 0.02], [58.0, 62.0, 0.6], [80.0, 82.0, 0.05]])
    found = several.crossing_figures(several.crossing_counts(distance, crossings))
    assert (found["crossings"], found["unsaid_swaps"]) == (3, 0)
    assert found["swap_calibration"] == pytest.approx((0.07 + 0.4) / 3)
    sure = several.crossing_figures(several.crossing_counts(distance, crossings * [1, 1, 0.01]))
    assert sure["unsaid_swaps"] == 1
    assert several.crossing_figures({})["swap_calibration"] is None


def test_errors_are_apart_or_in_contact_and_huddles_are_no_abstentions():
    distance = np.where(np.eye(2, dtype=bool), 2.0, 200.0)[None].repeat(10, axis=0)
    distance[6:] = np.where(np.eye(2, dtype=bool), 6.0, 200.0)
    touching = np.zeros((10, 2), bool)
    touching[6:] = True
    trusted = np.ones((10, 2), bool)
    trusted[[2, 8], 1] = False
    resting = np.zeros(10, bool)
    resting[8] = True
    found = several.pose_counts(distance, touching, trusted, resting, 65.0)
    assert found["apart_mm"] / found["n_apart"] == 2.0
    assert found["contact_mm"] / found["n_contact"] == 6.0
    assert (found["abstained"], found["n_asked"]) == (1, 18)


def test_deeds_are_scored_by_frames_and_direction():
    truth = [(0, 1, "follow", 0, 60), (1, 0, "nose_to_nose", 60, 90)]
    right = several.deed_figures(several.deed_counts(truth, truth, 100))
    assert (right["macro_f1"], right["direction"]) == (1.0, 1.0)
    turned = [(1, 0, "follow", 0, 60), (0, 1, "nose_to_nose", 60, 90)]
    found = several.deed_figures(several.deed_counts(truth, turned, 100))
    assert found["f1"] == {"follow": 0.0, "nose_to_nose": 1.0}
    assert found["direction"] == 0.0
    late = [(0, 1, "follow", 20, 80)]
    found = several.deed_figures(several.deed_counts(truth, late, 100))
    assert found["f1"]["follow"] == pytest.approx(2 / 3)
