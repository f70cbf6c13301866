"""A person states which of two animals is which: both sessions follow, or neither."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from liex_lab.dashboards.report.report import render
from liex_lab.pipelines.correct import correct_session
from liex_lab.pipelines.session import conclude
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.behaviour.interactions import Individual, find_interactions
from liex_lab.body.pose import Pose
from liex_lab.errors import SessionError
from liex_lab.geometry import SE3
from liex_lab.plan import Plan
from liex_lab.sessions import Session, SessionWriter, correcting, identities, rrd
from liex_lab.sessions.corrections import REPLAY, LogEntry, Roles, read_log, read_verdict
from liex_lab.sessions.verdict import Verdict
from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.identity import doubt, flag_unclear
from liex_lab.tracking.observations import Observations, reversed_pose
from liex_lab.tracking.track import Crossing, Subject
from tests.sessions.test_rrd import columns_of
from tests.sessions.walking_mouse import SPINE_MM, WalkingMouse, steady

N = 240
MOUSE = WalkingMouse(steady(8.0))
CROSSING = Crossing(60, 75, (0, 1), 0.4, "motion")
PLAN = Plan.load("mouse").with_settings(["actions.model=rules", "replay.depth=none"])
TABLES = ("frames", "poses", "rotations", "kinematics", "bouts", "interactions", "crossings")


def measured(radius_mm: float) -> Observations:
    mouse = replace(MOUSE, radius_mm=radius_mm)
    track, observed = mouse.track(), Observations.empty(mouse.skeleton, mouse.times_ns)
    pose = Pose(SE3(track.root_rotation, track.root_mm), track.angles_rad, track.scale)
    for h, either in enumerate((pose, reversed_pose(mouse.skeleton, pose))):
        observed.put_pose(h, either)
        observed.score[:, h], observed.error_mm[:, h], observed.n_px[:, h] = 1.0 + 3.0 * h, 2.0, 100
        observed.centroid_mm[:, h] = track.joints_mm.mean(axis=1)
    return observed


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sessions of two animals, one of them slightly longer, that may have been exchanged."""
    folder = tmp_path_factory.mktemp("pair")
    observed = [measured(150.0), measured(95.0)]
    subjects = [
        Subject(MOUSE.skeleton, MOUSE.camera, MOUSE.T_arena_camera, mm, 9.0, 0.5, (1.0,) * 5)
        for mm in (SPINE_MM, SPINE_MM - 2.0)
    ]
    tracked = [
        replace(track_whole(*one), crossings=(CROSSING,))
        for one in zip(subjects, observed, strict=True)
    ]
    for one in tracked:
        flag_unclear(one, np.zeros(N, np.bool_))
    names = ["animal1", "animal2"]
    people = [
        Individual.of_track(*one) for one in zip(names, (t.track for t in tracked), strict=True)
    ]
    together = find_interactions(MOUSE.times_s, people, PLAN.interactions)
    for k, name in enumerate(names):
        stated = [f"session.name=pair-{name}", f"session.individual={name}"]
        origin = MOUSE.provenance(
            name=f"pair-{name}",
            input_sha256="same",
            individual=name,
            plan_toml=PLAN.with_settings(stated).to_toml(),
        )
        with SessionWriter(folder / f"pair-{name}.liex", origin) as writer:
            for frames, _ in MOUSE.chunks(N):
                writer.add(frames, observed[k])
            verdict = Verdict.of(tracked[k], observed[k], doubts=[doubt([CROSSING])], n_measured=2)
            writer.note(verdict=verdict.to_dict())
            writer.take(tracked[k], observed[k], subjects[k])
            conclude(writer, PLAN, {}, together)
    return folder


@pytest.fixture
def reports(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Sessions whose reports were written, instead of the reports."""
    found: list[Path] = []
    monkeypatch.setattr("liex_lab.pipelines.correct.write_views", found.append)
    return found


@pytest.fixture
def pair(written: Path, tmp_path: Path, reports: list[Path]) -> list[Path]:
    shutil.copytree(written, tmp_path / "pair")
    return [tmp_path / "pair" / f"pair-animal{k}.liex" for k in (1, 2)]


def opened(pair: list[Path], **how: Any) -> list[Session]:
    return [Session.open(path, **how) for path in pair]


def exchange(pair: list[Path], *span_s: float) -> list[Session]:
    one, other = opened(pair)
    correct_session(pair[0], [identities.swap(one, other, *span_s)], author="ada", report=False)
    return opened(pair)


def joints(session: Session) -> np.ndarray:
    return session.pose_arrays().xyz_mm


def test_every_table_of_both_animals_follows_and_can_be_taken_back(
    pair: list[Path], reports: list[Path]
) -> None:
    raw = opened(pair)
    assert all("40%" not in one.metadata["verdict"]["sentence"] for one in raw)
    assert all("60% certain" in read_verdict(path)["sentence"] for path in pair)
    now = exchange(pair, 2.2)
    for one, was, other in zip(now, raw, raw[::-1], strict=True):
        np.testing.assert_allclose(joints(one)[:30], joints(was)[:30], atol=1e-3)
        np.testing.assert_allclose(joints(one)[90:], joints(other)[90:], atol=0.1)
        assert {f"{name}.parquet" for name in TABLES} <= {*one.log.files}
        assert set(one.frames["individual"]) == {was.metadata["individual"]}
        speed = one.kinematics["speed_mm_s"].to_numpy()[90:-9]
        np.testing.assert_allclose(speed, other.kinematics["speed_mm_s"][90:-9], rtol=0.02)
        (met,) = one.crossings.to_dict("records")
        assert (met["p_swap"], met["decided_by"], met["reviewed_by"]) == (0.0, "human", "ada")
        assert met["reviewed_at"] == one.log.shared[0].made_at
        assert (one.frames["flag"] == "").sum() > (was.frames["flag"] == "").sum()
        assert "certain" not in read_verdict(one.path)["sentence"]
        assert "174 frames were measured as animal" in one.metadata["problems"][-1]
    assert reports == [pair[1]], "the caller writes its own"
    pd.testing.assert_frame_equal(now[0].interactions.iloc[:, 1:], now[1].interactions.iloc[:, 1:])
    correct_session(pair[1], undo=[1], author="bob", report=False)
    for one, was in zip(opened(pair), raw, strict=True):
        assert not one.log.shared
        for name in TABLES:
            pd.testing.assert_frame_equal(one.table(name), was.table(name))
        assert "60% certain" in read_verdict(one.path)["sentence"]
    correct_session(pair[0], undo=[2], report=False)  # made again
    for one, before in zip(opened(pair), now, strict=True):
        assert len(one.log.shared) == 1
        np.testing.assert_array_equal(joints(one), joints(before))


def test_the_corrected_replay_shows_the_other_animal_where_it_is_now(pair: list[Path]) -> None:
    file = f"corrected/{REPLAY}"
    entity = rrd.corrected_entity(f"{rrd.ANIMALS}/animal2/joints")
    exchange(pair, 2.2)
    for _ in range(2):  # after the exchange, and after an action of one animal alone
        one, other = opened(pair)
        there = [row for row in columns_of(one, entity, file)["Points3D:positions"] if row]
        now = joints(other)[np.isfinite(joints(other)).all(axis=(1, 2))] / 1000.0
        np.testing.assert_allclose(np.array(there), now, atol=1e-6)
        lane = rrd.corrected_entity(rrd.TOGETHER + r"/animal2\ to\ animal1")
        assert columns_of(one, lane, file)
        correct_session(pair[0], [correcting.add_bout(one, "run", 4.0, 4.5)], report=False)


def test_the_report_lists_what_is_open_and_what_was_reviewed(pair: list[Path]) -> None:
    page = render(opened(pair)[0])
    assert "may have been exchanged in 1 crossing, most likely at 2.00 s (probability 0.40)" in page
    assert "<td>animal1, animal2</td><td>0.40</td><td>motion</td><td>–</td>" in page
    assert "liex correct swap SESSION1 SESSION2" in page
    page = render(exchange(pair, 2.2)[0])
    assert "may have been exchanged in 1 crossing" not in page
    assert "<td>animal1, animal2</td><td>0.00</td><td>human</td><td>ada</td>" in page
    assert "liex correct swap SESSION1 SESSION2" not in page


def test_a_crossing_that_was_checked_is_certain_in_both(
    pair: list[Path], reports: list[Path]
) -> None:
    ran = CliRunner().invoke(
        cli.app, ["correct", "crossing", str(pair[0]), "--at", "2.1", "--by", "ada"]
    )
    assert ran.exit_code == 0, ran.output
    for one, was in zip(opened(pair), opened(pair, raw=True), strict=True):
        np.testing.assert_array_equal(joints(one), joints(was))
        assert one.crossings["p_swap"].tolist() == [0.0]
        assert one.crossings["reviewed_by"].tolist() == ["ada"]
        assert (was.frames["flag"][60:75] == "unclear").all()
        assert one.path in reports
        assert (one.frames["flag"] == "").all()
    with pytest.raises(SessionError, match=r"holds 7 s; crossings begin at 2.000"):
        correcting.parse_correction(opened(pair)[0], "crossing 7")


class Killed(BaseException):
    """As if the process had been killed."""


def test_a_process_killed_at_any_time_leaves_both_exchanged_or_neither(
    pair: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = "liex_lab.pipelines.correct"
    monkeypatch.setattr(f"{quick}.corrected_track", lambda *_: None)
    monkeypatch.setattr(f"{quick}._together", lambda *_: None)
    monkeypatch.setattr(f"{quick}._apply", lambda _, log, *__: log)
    rename, done = Path.rename, []
    for k in range(1, 20):
        calls = iter(range(1, 100))

        def counted(path: Path, to: Path, k: int = k, calls: Any = calls) -> Path:
            if next(calls) == k:
                raise Killed
            return rename(path, to)

        monkeypatch.setattr(Path, "rename", counted)
        try:
            exchange(pair, 2.2)
            break
        except Killed:
            monkeypatch.setattr(Path, "rename", rename)
        counts = [len(one.log.shared) for one in opened(pair)]
        assert counts[0] == counts[1], k
        done.append(counts[0])
    monkeypatch.setattr(Path, "rename", rename)
    assert {0, 1} <= {*done}
    correct_session(pair[1], report=False)
    assert [len(one.log.shared) for one in opened(pair)] == [max(done) + 1] * 2


def test_what_was_corrected_before_in_these_frames_is_taken_back_first(pair: list[Path]) -> None:
    one = Session.open(pair[1])
    correct_session(pair[1], [correcting.add_bout(one, "groom", 1.0, 1.5, new_word=True)])
    assert len(exchange(pair, 3.0)[0].log.shared) == 1
    with pytest.raises(SessionError, match=r"of the present one \(1 in `liex correct list`\)"):
        exchange(pair, 0.5, 1.2)
    assert not list(pair[0].parent.glob("*/corrected.*"))
    one, other = opened(pair)
    both = [correcting.flip_span(one, 1.0, 1.2), identities.swap(one, other, 0.9, 1.5)]
    with pytest.raises(SessionError, match="of the present one"):
        correct_session(pair[0], both, report=False)
    flip = correcting.flip_span(Session.open(pair[1]), 4.0, 5.0)
    correct_session(pair[1], [flip], report=False)  # of the animal that it is now
    tip = joints(Session.open(pair[1]))[140, -1]
    rump = joints(Session.open(pair[0], raw=True))[140, 0]
    assert np.linalg.norm(tip - rump) < 5.0
    with pytest.raises(SessionError, match=r"of the present one \(3 in"):
        correct_session(pair[0], undo=[1], report=False)


def test_whoever_has_an_exchange_alone_is_notified(pair: list[Path]) -> None:
    exchange(pair, 3.0)
    shutil.rmtree(pair[1] / "corrected")
    (note,) = correcting.disagreements(Session.open(pair[0]))
    assert note.startswith("pair-animal2.liex does not have the same exchanges")
    correct_session(pair[0], report=False)
    assert correcting.disagreements(Session.open(pair[0])) == []
    assert len(Session.open(pair[1]).log.shared) == 1


def test_bad_input_gives_a_sentence(pair: list[Path], tmp_path: Path) -> None:
    one, other = opened(pair)
    other.metadata = {**other.metadata, "input": {"sha256": "another"}}
    cases = [
        (lambda: identities.swap(one, one, 1.0), "was given twice"),
        (lambda: identities.swap(one, other, 1.0), "were measured in two recordings"),
        (lambda: exchange(pair, 9.0), "in a session of 0 to 7.967 s"),
        (lambda: exchange(pair, 3.0, 2.0), "from a time to a later one"),
        (lambda: correcting.parse_correction(one, "swap animal3 1"), "there is no animal3 in"),
    ]
    for attempt, message in cases:
        with pytest.raises(SessionError, match=message):
            attempt()
    other = Session.open(pair[1])
    other.metadata = {**other.metadata, "plan": {"animal": {"count": 3}}}
    with pytest.raises(SessionError, match="measured with different plans"):
        identities.swap(one, other, 1.0)
    far = Session.open(shutil.copytree(pair[1], tmp_path / "far.liex"))
    with pytest.raises(SessionError, match="does not lie beside"):
        identities.swap(one, far, 1.0)
    shutil.copytree(pair[1], pair[1].with_name("copy.liex"))
    with pytest.raises(SessionError, match=r"each once; .* holds animal2 .copy.liex., animal1"):
        exchange(pair, 1.0)
    alone = Session.open(pair[0])
    alone.metadata = {**alone.metadata, "verdict": {}}
    with pytest.raises(SessionError, match="is the only animal that was measured"):
        correcting.parse_correction(alone, "crossing 2")
    assert not (pair[0] / "corrected").exists()


def test_exchanges_that_are_made_at_once_are_numbered(pair: list[Path]) -> None:
    one, other = opened(pair)
    twice = [identities.swap(one, other, 1.0), identities.swap(one, other, 1.0)]
    correct_session(pair[0], twice, report=False)
    assert [
        [entry.what.serial for entry in read_log(path).shared]  # type: ignore[union-attr]
        for path in pair
    ] == [[1, 2]] * 2
    (met,) = Session.open(pair[1]).crossings.to_dict("records")
    assert met["p_swap"] == 0.4, "nobody reviewed it"


def test_exchanges_of_several_animals_compose_in_their_order() -> None:
    rng = np.random.default_rng(2)
    names, index = ["animal1", "animal2", "animal3"], np.arange(5, 25)
    swaps, wanted = [], [[0, 1, 2] for _ in index]
    for serial in range(8):
        a, b = rng.choice(3, 2, replace=False)
        start, stop = np.sort(rng.integers(0, 30, 2))
        swaps.append(Roles((names[a], names[b]), int(start), int(stop) + 1, (), serial))
        for frame, order in zip(index, wanted, strict=True):
            if start <= frame <= stop:
                order[a], order[b] = order[b], order[a]
    entries = [LogEntry(k, "", "", one) for k, one in enumerate(swaps)]
    np.testing.assert_array_equal(identities.shown(entries, names, index), wanted)
    assert read_log(Path("nowhere")).shared == ()
