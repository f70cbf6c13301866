"""Several arenas in one picture: each is the session that a run of its own would have made."""

import hashlib
from collections import Counter
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.arenas import run_arenas
from liex_lab.pipelines.build import propose_arenas, stated_corners
from liex_lab.pipelines.choice import fit_plan
from liex_lab.pipelines.doctor import examine
from liex_lab.pipelines.evaluation.scenes import read_individuals

from liex_lab.errors import EstimationError, MisfitError, PlanError, SessionError
from liex_lab.evaluation.scores import error_of
from liex_lab.plan import Plan
from liex_lab.plan.sections import Region, SeveralArenas
from liex_lab.recordings.frame import Depth
from liex_lab.recordings.recording import Recording
from liex_lab.sessions import Session, SessionWriter
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.scenes.catalogue import film
from tests.pipelines.conftest import measure

N_FRAMES = 40
measure_all = partial(run_arenas, report=False)
DIGEST = "0123456789abcdef" * 4


@cache
def images(scene: str = "two-arenas") -> tuple[RenderedRecording, np.ndarray]:
    """A rendered scene, and its pictures."""
    made = film(scene, 1001, N_FRAMES)
    return made, made.depths(0, N_FRAMES)


def recording(scene: str = "two-arenas", read: list[int] | None = None) -> Recording:
    """The scene as a recording that notes in `read` which frames are decoded."""
    made, depths = images(scene)

    def decode(index: int) -> Depth:
        if read is not None:
            read.append(index)
        return depths[index].copy()

    found = Recording(
        name=scene, format="memory", camera=made.camera, times_ns=made.times_ns.copy(), read=decode
    )
    found.files.known_digest = DIGEST
    return found


def several(*more: str) -> Plan:
    """The plan of the mouse with the two arenas of the scene."""
    made, _ = images()
    arenas = propose_arenas(made, Plan.load("mouse"))
    assert len(arenas) == 2
    facts = ({"name": "left", "subject_id": "m01"}, {"name": "right", "subject_id": "m02"})
    named = [one.model_copy(update=fact) for one, fact in zip(arenas, facts, strict=True)]
    table = Plan.load("mouse").model_dump(exclude_none=True)
    table["arenas"] = [one.model_dump(exclude_none=True) for one in named]
    return Plan.from_table(table).with_settings(["replay.depth=false", *more])


def listed(plan: Plan) -> list[SeveralArenas]:
    assert isinstance(plan.arenas, list)
    return plan.arenas


def corners(region: object) -> list[list[float]]:
    assert isinstance(region, Region)
    assert region.polygon is not None
    return region.polygon


def tables(session: Path) -> dict[str, str]:
    """Digests of a session's tables, for a difference between megabytes takes for ever to draw."""
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(session.iterdir())
        if path.suffix in {".parquet", ".csv"} or path.name in {"plan.toml", "observations.npz"}
    }


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sequence[Path], list[int]]:
    read: list[int] = []
    outcomes = measure_all(recording(read=read), several(), tmp_path_factory.mktemp("arenas"))
    assert [(one.name, one.error) for one in outcomes] == [("left", None), ("right", None)]
    return [one.session for one in outcomes if one.session is not None], read


def alone(session: Path, scene: str, out: Path, masked: bool) -> Path:
    """The session of one arena's region alone, stated in the plan or cut out beforehand."""
    plan = Plan.load(session / "plan.toml")
    assert plan.arenas is None
    assert session.name == f"{plan.session.name}.liex"
    whole = recording(scene)
    cut = whole.masked(corners(plan.arena.region)) if masked else whole
    return measure(cut, plan, out / str(masked))


@pytest.mark.nightly
def test_every_arena_is_the_session_of_the_same_arena_cut_out_and_run_alone(sessions, tmp_path):
    assert tables(alone(sessions[0][1], "two-arenas", tmp_path, True)) == tables(sessions[0][1])
    assert set(Counter(sessions[1]).values()) == {1}, "each frame is decoded once"


def test_each_arena_follows_its_own_animal(sessions):
    made, _ = images()
    measured = [read_individuals(Session.open(path))[0].joints_camera for path in sessions[0]]
    errors = [
        [float(np.nanmedian(error_of(own, animal.joints_camera))) for animal in made.animals]
        for own in measured
    ]
    assert sorted(int(np.argmin(row)) for row in errors) == [0, 1]
    assert max(min(row) for row in errors) < 6.0
    assert min(max(row) for row in errors) > 60.0


@pytest.mark.nightly
def test_an_arena_without_an_animal_stops_no_other(tmp_path):
    made, depths = images()
    plan = several()
    right = recording().masked(corners(listed(plan)[1].region))
    still = np.where(right.frame(0).depth > 0, np.median(depths, axis=0), 0).astype(np.float32)

    def emptied(depth: Depth) -> Depth:
        return np.where(still > 0, still, depth)

    seen = recording().viewed_by(made.camera, emptied, {})
    left, empty = measure_all(seen, plan, tmp_path)
    assert left.session is not None
    assert empty.session is None
    assert isinstance(empty.error, EstimationError)


@pytest.mark.nightly
def test_an_interrupted_run_of_several_arenas_goes_on(sessions, tmp_path, monkeypatch):
    monkeypatch.setattr("liex_lab.sessions.checkpoint.EVERY_S", 0.0, raising=False)
    add = SessionWriter.add

    def tire(self, frames, *arguments, **settings):
        if frames[0].index and self.path.name.endswith("right.liex"):
            raise KeyboardInterrupt
        add(self, frames, *arguments, **settings)

    with monkeypatch.context() as tired:
        tired.setattr(SessionWriter, "add", tire)
        with pytest.raises(KeyboardInterrupt):
            measure_all(recording(), several(), tmp_path)
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".part", ".part"]
    outcomes = measure_all(recording(), several(), tmp_path)
    for one, before in zip(outcomes, sessions[0], strict=True):
        assert one.session is not None
        assert tables(one.session) == tables(before)
    with pytest.raises(SessionError, match="exists already"):
        measure_all(recording(), several(), tmp_path)


def test_arenas_that_overlap_are_refused(tmp_path):
    plan = several()
    twice = [one.model_copy(update={"region": listed(plan)[0].region}) for one in listed(plan)]
    with pytest.raises(PlanError, match="the arenas left and right overlap in"):
        measure_all(recording(), plan.model_copy(update={"arenas": twice}), tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_arena_outside_of_the_picture_is_refused(tmp_path):
    table = {"arenas": [{"name": "far", "region": {"rectangle": [[9000, 9000], [9100, 9100]]}}]}
    with pytest.raises(PlanError, match=r"the arena far: .*outside the image"):
        measure_all(recording(), Plan.from_table(table), tmp_path)


def test_a_plan_of_several_arenas_is_not_run_as_one(tmp_path):
    with pytest.raises(PlanError, match="lists several arenas"):
        measure(recording(), several(), tmp_path)


def test_one_arena_is_not_proposed_as_several():
    plain = film("plain", 1001, N_FRAMES)
    assert propose_arenas(plain, Plan.load("mouse")) == []
    with pytest.raises(PlanError, match="fewer than two are found"):
        measure_all(plain, Plan.load("mouse").with_settings(["arenas=auto"]), "nowhere")


def test_a_region_in_millimetres_on_the_floor_is_the_one_in_the_picture(tmp_path):
    made, _ = images()
    state = f"arena.floor={{point = [0, 0, {made.floor.distance_mm / made.floor.normal[2]}], "
    state += f"normal = {made.floor.normal.tolist()}}}"
    region = "arena.region={circle = {centre = [-150, 10], radius = 120}, unit = 'mm'}"
    plan = Plan.load("mouse").with_settings([state, region])
    corners = np.array(stated_corners(made, plan, plan.arena.region))
    rays = made.camera.unproject(corners, 1.0)
    depth = made.floor.distance_mm / (rays @ made.floor.normal)
    place = made.floor.T_arena_camera @ (rays * depth[:, None])
    np.testing.assert_allclose(np.hypot(place[:, 0] + 150.0, place[:, 1] - 10.0), 120.0, atol=1e-6)
    assert Plan.from_toml(plan.to_toml()) == plan


@pytest.mark.nightly
def test_the_doctor_proposes_several_arenas_and_says_what_to_run_next():
    found = examine(
        "synthetic:scene?name=two-arenas&seed=1001&frames=40", propose=True, named=False
    )
    assert found["arenas"].count("[[arenas]]") == 2
    text = "\n".join(found["arenas"])
    assert Plan.from_toml(text).arenas is not None
    assert found["next"].endswith("--set arenas=auto")
    assert not any("animals are in view at once" in problem for problem in found["problems"])


@pytest.mark.slow
def test_the_doctor_says_what_is_wrong_with_a_region_and_looks_all_the_same():
    plan = Plan.load("mouse").with_settings(
        ["arena.region=[[9000, 9000], [9100, 9000], [9000, 9100]]"]
    )
    found = examine("synthetic:walk?frames=20", plan)
    assert any("outside the image" in problem for problem in found["problems"])
    assert found["floor_mm"] is not None


@pytest.mark.nightly
def test_an_empty_arena_is_said_to_hold_no_animal():
    with pytest.raises(MisfitError, match="no animal was found") as caught:
        fit_plan(film("empty", 1001, N_FRAMES), Plan.load("mouse"))
    assert caught.value.exit_code == 4
