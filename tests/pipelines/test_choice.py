"""Which plan a recording fits: refused with the one that fits, chosen where none was named, and
which hand it is.
"""

import gc
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines import choice
from liex_lab.pipelines.build import animal_of
from liex_lab.pipelines.choice import PlanFit, best, fit_plan, misfits_of

from liex_lab.errors import EstimationError, MisfitError
from liex_lab.optics.camera import KINECT_V2
from liex_lab.plan import Plan
from liex_lab.recordings.recording import Recording
from liex_lab.scene.hand_segmenter import HandSegmenter
from liex_lab.simulation.scenes.catalogue import film
from liex_lab.tracking.residual import SampleFit

GOOD = SampleFit(96, 96, 65.0, 2.0, 1.5, 0.8, 0.03)
FISH = replace(GOOD, spine_mm=30.0, error_mm=1.0, residual_mm=0.7)
HAND = replace(GOOD, spine_mm=180.0, error_mm=14.0, residual_mm=4.0)
HUGE = replace(HAND, spine_mm=743.0, error_mm=126.0)
RECORDING = Recording(
    name="r",
    format="toy",
    camera=KINECT_V2,
    times_ns=np.arange(3),
    read=lambda _: np.zeros((424, 512), np.float32),
)


@dataclass(frozen=True)
class Pretended:
    """Stands in for a tracker: the fit is all that is looked at."""

    sample_fit: SampleFit
    scene: Any
    doubtful_mm: float = 5.0


def looks(monkeypatch: pytest.MonkeyPatch, **fits: SampleFit | str | None) -> None:
    """What trackers of the bundled plans will say; a text is why there is none."""

    def build_tracker(recording: Recording, plan: Plan, _: Any = None) -> Pretended:
        mirrored = recording.optics.get("mirrored", False)
        found = fits.get(plan.animal.name + ("_mirrored" if mirrored else ""))
        if found is None or isinstance(found, str):
            raise EstimationError(found or "no animal was found; check the plan")
        hand = plan.animal.name == "hand"
        floor: Any = SimpleNamespace()
        no_doubts = SimpleNamespace(doubts=())
        return Pretended(found, HandSegmenter(KINECT_V2, floor, floor) if hand else no_doubts)

    monkeypatch.setattr(choice, "build_tracker", build_tracker)


def test_a_plan_that_fits_is_used_and_no_other_is_looked_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks(monkeypatch, mouse=GOOD)
    monkeypatch.setattr(choice, "try_plan", lambda *_: pytest.fail("another plan was looked at"))
    fitted = fit_plan(RECORDING, Plan.load("mouse"))
    assert fitted.plan == Plan.load("mouse")
    assert (fitted.misfits, fitted.notes) == ((), ())


def test_a_hand_of_743_mm_is_refused_and_the_plan_that_fits_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks(monkeypatch, hand=HUGE, mouse=GOOD)
    with pytest.raises(
        MisfitError,
        match=r"743 mm long and the plan expects 130 to 220.*'mouse' fits.*--plan mouse",
    ):
        fit_plan(RECORDING, Plan.load("hand"))


def test_nothing_found_by_the_named_plan_names_the_one_that_fits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks(monkeypatch, fish="no animal was found; check it", mouse=GOOD)
    with pytest.raises(MisfitError, match="no animal was found, while the plan 'mouse' fits"):
        fit_plan(RECORDING, Plan.load("fish"))


def test_where_no_plan_fits_what_was_wrong_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    looks(monkeypatch, mouse=replace(GOOD, error_mm=500.0))
    with pytest.raises(MisfitError, match=r"expected error of 500 mm.*no other bundled plan fits"):
        fit_plan(RECORDING, Plan.load("mouse"))
    looks(monkeypatch)
    with pytest.raises(EstimationError, match="no animal was found; check the plan") as raised:
        fit_plan(RECORDING, Plan.load("mouse"))
    assert not isinstance(raised.value, MisfitError)


def test_what_does_not_fit_is_measured_where_that_is_accepted_but_not_trusted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks(monkeypatch, hand=HUGE, mouse=GOOD)
    plan = Plan.load("hand").with_settings(
        ["estimation.accept_misfit=true", "recording.mirrored=false"]
    )
    fitted = fit_plan(RECORDING, plan)
    assert "743 mm" in fitted.misfits[0]
    assert fitted.tracker.doubtful_mm == 0.0


def test_a_plan_that_was_not_named_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    looks(monkeypatch, mouse=replace(GOOD, covered=0.2), fish=FISH)
    fitted = fit_plan(RECORDING, Plan.load("mouse"), settings=["seed=4"])
    assert fitted.plan == Plan.load("fish").with_settings(["seed=4"])
    assert fitted.notes == ("no plan was named, and fish fits",)


def test_which_hand_it_is_is_found_by_the_error_that_is_half_as_large(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks(monkeypatch, hand=replace(HAND, error_mm=27.0), hand_mirrored=HAND)
    fitted = fit_plan(RECORDING, Plan.load("hand"))
    assert fitted.plan.recording.mirrored is True
    assert fitted.recording.optics["mirrored"]
    assert "left hand or mirrored images" in fitted.notes[0]
    looks(monkeypatch, hand=HAND, hand_mirrored=replace(HAND, error_mm=13.0))
    fitted = fit_plan(RECORDING, Plan.load("hand"))
    assert fitted.plan.recording.mirrored is False
    assert fitted.notes == ()


def test_a_recording_is_still_open_after_its_mirror_image_was_looked_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks(monkeypatch, hand=HAND, hand_mirrored=replace(HAND, error_mm=13.0))
    closed: list[bool] = []
    recording = Recording(
        name="r",
        format="toy",
        camera=KINECT_V2,
        times_ns=np.arange(3),
        read=lambda _: np.zeros((424, 512), np.float32),
        close=lambda: closed.append(True),
    )
    fit_plan(recording, Plan.load("hand"))
    gc.collect()
    assert not closed
    assert recording.frame(0).depth.shape == (424, 512)


@pytest.mark.parametrize("stated", [True, False])
def test_a_plan_that_states_the_hand_is_believed(
    monkeypatch: pytest.MonkeyPatch, stated: bool
) -> None:
    looks(monkeypatch, hand=replace(HAND, error_mm=27.0), hand_mirrored=HAND)
    plan = Plan.load("hand").with_settings([f"recording.mirrored={str(stated).lower()}"])
    assert fit_plan(RECORDING, plan).plan == plan


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"spine_mm": 140.0}, "140 mm long and the plan expects 40 to 115 mm"),
        ({"spine_mm": 16.0}, "16 mm long"),
        ({"n_found": 1}, "found in 1 of 96 frames"),
        ({"error_mm": 20.0}, "31% of its length"),
        ({"residual_mm": 15.0}, "lies 15 mm from what was read"),
        ({"residual_mm": float("nan")}, "hardly overlap"),
        ({"covered": 0.2}, "covers 20% of the observed outline"),
        ({"beside": 0.7}, "70% of its body lies beside"),
    ],
)
def test_each_kind_of_evidence_is_said_by_itself(wrong: dict[str, Any], says: str) -> None:
    plan = Plan.load("mouse")
    assert misfits_of(GOOD, plan) == ()
    found = misfits_of(replace(GOOD, **wrong), plan)
    assert len(found) == 1
    assert says in found[0]


def test_a_length_that_the_plan_states_is_not_questioned() -> None:
    plan = Plan.load("mouse").with_settings(["animal.spine_mm=140"])
    assert misfits_of(replace(GOOD, spine_mm=140.0), plan) == ()


def test_the_best_of_several_is_the_one_with_the_least_error_for_its_length() -> None:
    fish = PlanFit("fish", FISH)
    mouse = PlanFit("mouse", GOOD)
    assert best([fish, mouse]) is mouse
    assert best([fish, PlanFit("mouse", GOOD, ("it is too long",)), PlanFit("hand", None)]) is fish
    assert best([]) is None


@pytest.mark.nightly
def test_a_slim_mouse_beside_a_stout_one_of_its_length_is_counted() -> None:
    """The girth of the one that is measured says nothing of the other's."""
    recording = film("two-animals", 1003, 60, family="other")
    fit = choice.try_plan(recording, "mouse").fit
    assert fit is not None
    assert fit.n_animals == 2


@pytest.mark.parametrize(("name", "length_mm"), [("rat", 170.0), ("gecko", 62.0), ("pup", 24.0)])
def test_an_own_animal_has_its_name_and_its_limits_from_its_skeleton(
    name: str, length_mm: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toml = tmp_path / f"{name}.toml"
    toml.write_text(
        f'name = "{name}"\n[[joints]]\nname = "rump"\n[[joints]]\nname = "nose"\nparent = "rump"\n'
        f"offset_mm = [{length_mm}, 0.0, 0.0]\n"
    )
    plan = Plan.from_table({"animal": {"skeleton": str(toml)}})
    for same in (plan, plan.with_settings(["seed=3"]), Plan.from_toml(plan.to_toml())):
        animal = animal_of(same)
        assert animal.name == name
        limits = (animal.spine_min_mm, animal.spine_max_mm)
        assert limits == pytest.approx((0.6 * length_mm, 1.8 * length_mm))
    stated = plan.with_settings(["animal.spine_max_mm=500", "animal.name=Rex"])
    assert (animal_of(stated).spine_max_mm, animal_of(stated).name) == (500.0, "Rex")
    assert not misfits_of(replace(GOOD, spine_mm=0.9 * length_mm), plan)
    far = replace(GOOD, spine_mm=3.0 * length_mm)
    assert misfits_of(far, plan)
    monkeypatch.setattr(choice, "try_plan", lambda _, one: PlanFit(str(one), None, ("no",)))
    monkeypatch.setattr(
        choice, "build_tracker", lambda *_: Pretended(far, SimpleNamespace(doubts=()))
    )
    with pytest.raises(MisfitError, match=f"does not fit the plan of the {name}"):
        fit_plan(RECORDING, plan)
