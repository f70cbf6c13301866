"""`liex evaluate several`: tables of a pretended run against the truth of rendered groups."""

import numpy as np
import pytest
from liex_lab.pipelines.evaluation import several
from liex_lab.pipelines.evaluation.several import evaluate_several

from liex_lab.behaviour.interactions import Individual, find_interactions
from liex_lab.errors import LiexError
from liex_lab.evaluation.scores import MeasuredIndividual
from liex_lab.plan.sections import InteractionThresholds
from liex_lab.simulation.scenes.catalogue import SEALED_FROM


def test_two_animals_near_the_truth_score_high_and_an_exchange_is_a_swap(monkeypatch):
    exchange = [False]

    def pretend(recording, plan):
        T = recording.T_arena_camera
        joints = [T.inverse() @ one.joints + [2.0, 0.0, 0.0] for one in recording.stage.actors]
        if exchange[0]:
            joints[0][150:], joints[1][150:] = joints[1][150:], joints[0][150:].copy()
        trusted = np.ones(len(recording), np.bool_)
        animals = [
            Individual(f"animal{k}", recording.skeleton, T @ one, trusted, trusted, trusted)
            for k, one in enumerate(joints, 1)
        ]
        found = find_interactions(
            (recording.times_ns - recording.times_ns[0]) * 1e-9, animals, InteractionThresholds()
        )
        own = [MeasuredIndividual(one, trusted, interactions=found.events) for one in joints]
        return own, [], 0

    monkeypatch.setattr(several, "run_product", pretend)
    row = evaluate_several(n_frames=300, n_recordings=1)["rows"]["all"]
    assert row["idf1"] == row["found"] == 1.0
    assert row["hota"] > 0.9
    assert (row["swaps"], row["abstained"]) == (0, 0.0)
    assert row["joint_error_apart_mm"] == pytest.approx(2.0)
    assert row["interactions_measured"]["f1"] == row["interactions_true"]["f1"]
    exchange[0] = True
    row = evaluate_several(n_frames=300, n_recordings=1)["rows"]["all"]
    assert row["swaps"] == 1
    assert row["idf1"] == pytest.approx(0.5)


def test_one_animal_of_two_is_half_found_and_has_no_interactions(monkeypatch):
    def pretend(recording, plan):
        joints = recording.T_arena_camera.inverse() @ recording.stage.actors[1].joints
        return [MeasuredIndividual(joints, np.ones(len(joints), np.bool_))], ["two in view"], 0

    monkeypatch.setattr(several, "run_product", pretend)
    result = evaluate_several(n_frames=300, n_recordings=2)
    row = result["rows"]["all"]
    assert row["found"] == pytest.approx(0.5)
    assert row["idf1"] == pytest.approx(2 / 3)
    assert row["interactions_measured"] is None
    assert row["contact_s"] >= 0
    assert result["said"] == ["two in view"]
    assert set(result["rows"]) == {"all", "equal", "15 % apart", "builds: train"}


def test_seeds_are_apart_and_wrong_numbers_are_refused():
    assert max(several.SEEDS) < SEALED_FROM <= min(several.SEALED_SEEDS)
    with pytest.raises(LiexError, match="1 to 48 recordings of 2 to 4 animals, got 1 of 5"):
        evaluate_several(5, n_recordings=1)
