"""`liex evaluate scenes`: the product is run as a user runs it, and its tables are held against the
truth.
"""

import numpy as np
import pytest
from liex_lab.pipelines.evaluation import scenes
from liex_lab.pipelines.evaluation.scenes import cases, evaluate_scenes

from liex_lab.errors import EstimationError, LiexError
from liex_lab.evaluation.scores import MeasuredIndividual
from liex_lab.simulation.scenes.catalogue import SEALED_FROM


@pytest.mark.slow
def test_a_mouse_in_a_plain_arena_is_measured(tmp_path):
    result = evaluate_scenes(["plain"], n_frames=30, figures=tmp_path)
    row = result["rows"]["plain"]
    assert (row["n_frames"], row["exit_code"], row["ratio_to_plain"]) == (30, 0, 1.0)
    assert row["found"] > 0.9
    assert row["mean_joint_error_mm"] < 8.0
    assert row["wrong_but_trusted"] < 0.2
    assert (tmp_path / "plain.png").read_bytes().startswith(b"\x89PNG")


def test_a_refused_run_says_its_sentence_and_ends_otherwise(monkeypatch):
    def refuse(*arguments, **settings):
        raise EstimationError("no floor was found")

    monkeypatch.setattr(scenes, "run_session", refuse)
    row = evaluate_scenes(["two-arenas"], n_frames=6)["rows"]["two-arenas"]
    assert (row["said"], row["exit_code"], row["found"]) == (["no floor was found"], 1, 0.0)
    assert row["ratio_to_plain"] is None


def test_each_row_stands_beside_the_plain_scene_of_the_same_animal(monkeypatch):
    def pretend(recording, plan):
        off = 3.0 if "-plain-" in recording.name else 6.0
        joints = recording.animals[0].joints_camera + np.array([off, 0.0, 0.0])
        return [MeasuredIndividual(joints, np.ones(len(joints), np.bool_))], [], 0

    monkeypatch.setattr(scenes, "run_product", pretend)
    told = []
    rows = evaluate_scenes(
        ["drift", "mouse-as-hand"],
        n_frames=6,
        n_recordings=2,
        progress=lambda k, n, what: told.append((k, n, what)),
    )["rows"]
    assert list(rows) == ["plain", "drift", "mouse-as-hand"]
    assert rows["drift"]["n_frames"] == 12
    assert rows["drift"]["ratio_to_plain"] == pytest.approx(2.0)
    assert rows["mouse-as-hand"]["ratio_to_plain"] is None
    assert rows["mouse-as-hand"]["wrong_but_trusted"] == 1.0
    assert told[0] == (0, 3, "scene plain")


def test_the_sealed_seeds_are_no_others_and_are_used_only_where_asked(monkeypatch):
    assert set(scenes.SEEDS).isdisjoint(scenes.SEALED_SEEDS)
    assert max(scenes.SEEDS) < SEALED_FROM <= min(scenes.SEALED_SEEDS)
    taken = []

    def row(name, case, seeds, n_frames, draw):
        taken.append(tuple(seeds))
        return {"mean_joint_error_mm": None}

    monkeypatch.setattr(scenes, "_measure_row", row)
    assert evaluate_scenes(["plain"])["seeds"] == [scenes.SEEDS[0]]
    assert evaluate_scenes(["plain"], sealed=True)["seeds"] == "sealed"
    assert taken == [scenes.SEEDS[:1], scenes.SEALED_SEEDS[:1]]


def test_slips_are_told():
    with pytest.raises(LiexError, match="there is no scene 'moon'; known are plain"):
        evaluate_scenes(["moon"])
    with pytest.raises(LiexError, match="1 to 12 recordings, got 13"):
        evaluate_scenes(["plain"], n_recordings=13)


def test_every_row_stands_beside_a_row():
    every = cases()
    assert {beside for _, _, beside in every.values()} <= {"", *every}
