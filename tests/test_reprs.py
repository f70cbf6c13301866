"""What the objects of the Python interface say of themselves: short, in people's words."""

from pathlib import Path

import liex_lab
from liex_lab.plan.study import Study
from tests.conftest import REPOSITORY


def test_a_plan_says_what_is_unlike_the_defaults() -> None:
    plan = liex_lab.Plan()
    assert repr(plan) == "<Plan for the mouse, default settings>"
    changed = plan.with_settings(["animal.spine_mm=65", "seed=3"])
    assert repr(plan.with_settings(["arenas=auto"])) == (
        "<Plan for the mouse; changed settings: arenas=auto>"
    )
    assert repr(changed) == ("<Plan for the mouse; changed settings: seed=3, animal.spine_mm=65.0>")


def test_skeletons_transforms_and_recordings_are_one_line() -> None:
    assert repr(liex_lab.Skeleton.load("mouse")).startswith(
        "<Skeleton mouse: 5 joints (rump, loin, chest, neck, nose), 52.8 mm long"
    )
    assert repr(liex_lab.SE3.identity()) == (
        "<SE3: rotated by 0.0 degrees, moved by (0.0, 0.0, 0.0) mm>"
    )
    assert repr(liex_lab.SE3.identity(4, 2)) == "<SE3: a batch of 4 x 2 rigid transforms>"
    with liex_lab.open_recording(REPOSITORY / "datasets" / "mouse_walk.mcap") as recording:
        assert repr(recording) == "<Recording mouse_walk: 150 frames of 320 x 240, mcap>"


def test_a_study_says_its_animals_and_groups(tmp_path: Path) -> None:
    table = {
        "name": "pilot",
        "animals": [{"id": "m01", "group": "drug"}, {"id": "m02", "group": "vehicle"}],
        "sessions": [{"animal": "m01", "session": "1", "recording": "synthetic:walk"}],
    }
    study = Study.from_table(table, tmp_path / "study.toml")
    assert repr(study) == (
        f"<Study pilot: 2 animals in the groups drug, vehicle, 1 session, {study.path}>"
    )
