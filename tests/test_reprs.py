"""What the objects of the Python interface say of themselves: short, in people's words."""

from pathlib import Path

import liex_lab
from liex_lab.plan.study import Study
from tests.conftest import REPOSITORY


def test_plans_skeletons_transforms_recordings_and_studies_are_one_line(tmp_path: Path) -> None:
    plan = liex_lab.Plan()
    table = {
        "name": "pilot",
        "animals": [{"id": "m01", "group": "drug"}, {"id": "m02", "group": "vehicle"}],
        "sessions": [{"animal": "m01", "session": "1", "recording": "synthetic:walk"}],
    }
    study = Study.from_table(table, tmp_path / "study.toml")
    with liex_lab.open_recording(REPOSITORY / "datasets" / "mouse_walk.mcap") as recording:
        for shown, text in (
            (plan, "<Plan for the mouse, default settings>"),
            (
                plan.with_settings(["animal.spine_mm=65", "seed=3"]),
                "<Plan for the mouse; changed settings: seed=3, animal.spine_mm=65.0>",
            ),
            (
                liex_lab.Skeleton.load("mouse"),
                "<Skeleton mouse: 5 joints (rump, loin, chest, neck, nose), 52.8 mm long",
            ),
            (liex_lab.SE3.identity(4, 2), "<SE3: a batch of 4 x 2 rigid transforms>"),
            (recording, "<Recording mouse_walk: 150 frames of 320 x 240, mcap>"),
            (study, "<Study pilot: 2 animals in the groups drug, vehicle, 1 session, "),
        ):
            assert repr(shown).startswith(text)
            assert "\n" not in repr(shown)
