"""Sessions on disk are compared by group, and what cannot be is told."""

import json
import os
import shutil
from functools import partial
from pathlib import Path

import pandas as pd
import pytest
from liex_lab.pipelines.compare import compare_groups, find_sessions
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.behaviour import cohort
from liex_lab.behaviour.cohort import collect
from liex_lab.errors import SessionError
from liex_lab.sessions import Session
from liex_lab.sessions.folder import write_failure
from liex_lab.sessions.verdict import OTHER_ANIMAL
from liex_lab.tables.schema import CROSSINGS, from_pandas, table_columns, write_table
from tests.sessions.pair import write_pair
from tests.sessions.walking_mouse import WalkingMouse, steady, write

compare = partial(compare_groups, figures=False)
RHYTHM = table_columns("rhythm")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five slow mice and five that are twice as fast, one session each."""
    folder = tmp_path_factory.mktemp("study")
    for k in range(10):
        mouse = WalkingMouse(steady(1.0), speed_mm_s=100.0 + 3 * k + 100.0 * (k >= 5))
        subject = {"subject_id": f"m{k}", "group": "fast" if k >= 5 else "control"}
        write(folder / f"sub-m{k}" / f"s{k}.liex", mouse, name=f"s{k}", subject=subject)
    return folder


def test_the_groups_of_a_folder_are_compared_and_why_nothing_is_tested_is_said_once(
    study, tmp_path
):
    measures = ("mean_speed_mm_s", "rear_share", "pause_share")
    asked = [f"--measure={name}" for name in measures]
    ran = CliRunner().invoke(cli.app, ["compare", str(study), "--out", str(tmp_path), *asked])
    assert ran.exit_code == 0, ran.output
    stats = pd.read_parquet(tmp_path / "stats.parquet").set_index("measure")
    assert set(stats["contrast"]) == {"fast - control"}
    assert stats.loc["mean_speed_mm_s", "estimate"] == pytest.approx(115.0, rel=1e-2)
    assert stats.loc["mean_speed_mm_s", "p"] == pytest.approx(2 / 252)
    assert "mean_speed_mm_s" in ran.output
    assert "0.0079" in ran.output
    assert ran.output.count("every unit has the same value") == 1
    assert "not tested: rear_share, pause_share\n" in ran.output
    assert "nan" not in ran.output
    assert len(pd.read_csv(tmp_path / "sessions.csv")) == 10
    assert "unit of comparison is the animal" in (tmp_path / "methods.txt").read_text()
    assert (tmp_path / "columns.json").is_file()


def test_the_usual_measures_are_those_with_values(study, tmp_path):
    stats = compare([study], tmp_path)["stats"]
    assert {"distance_m", "mean_speed_mm_s", "walk_share"} <= set(stats["measure"])
    assert "outer_half_share" not in set(stats["measure"])  # nobody knows where the walls are
    assert "unlabelled_share" not in set(stats["measure"])


def test_rhythms_and_zones_are_compared_as_the_summary_is(study, tmp_path):
    copied = shutil.copytree(study, tmp_path / "study")
    for k, folder in enumerate(sorted(copied.glob("*/*.liex"))):
        hours = pd.DataFrame({"session_id": [f"s{k}"], "individual": "animal_1"})
        values = {"interdaily_stability": 0.5 + 0.01 * k, "m10_onset_h": 23.0}
        rhythm = hours.reindex(columns=[one.name for one in RHYTHM]).assign(**values)
        rhythm["not_measured"] = ""
        write_table(folder / "rhythm.parquet", RHYTHM, from_pandas(rhythm), {})
        facts = json.loads((folder / "session.json").read_text(encoding="utf-8"))["files"]
        edit_json(folder, files=facts | {"rhythm.parquet": {"bytes": 1}})
        summary = pd.read_csv(folder / "summary.csv").assign(zone_nest_share=0.1 * (k >= 5))
        summary.to_csv(folder / "summary.csv", index=False)
    stats = compare([copied], tmp_path / "out")["stats"].set_index("measure")
    assert stats.loc["interdaily_stability", "estimate"] == pytest.approx(0.05)
    assert stats.loc["interdaily_stability", "p"] == pytest.approx(2 / 252)
    assert stats.loc["zone_nest_share", "estimate"] == pytest.approx(0.1)
    assert "relative_amplitude" not in stats.index  # without a value
    asked = compare([copied], tmp_path / "asked", ["period_h"])["stats"]
    assert asked["refused"].str.len().all()
    with pytest.raises(SessionError, match="m10_onset_h"):  # of the clock: no mean of 23 h and 1 h
        compare([copied], tmp_path / "onset", ["m10_onset_h"])


def test_each_period_is_compared_with_the_first_within_the_animal(study, tmp_path):
    copied = shutil.copytree(study, tmp_path / "study")
    columns = table_columns("periods")
    for k, folder in enumerate(sorted(copied.glob("*/*.liex"))):
        table = pd.DataFrame(columns=[one.name for one in columns], index=range(2)).assign(
            session_id=f"s{k}", individual="animal_1", period=["baseline", "after"]
        )
        table["mean_speed_mm_s"] = [100.0 * k, 100.0 * k + 7.0 + (k >= 5) + 0.01 * k]
        write_table(folder / "periods.parquet", columns, from_pandas(table), {})
        facts = json.loads((folder / "session.json").read_text(encoding="utf-8"))["files"]
        edit_json(folder, files=facts | {"periods.parquet": {"bytes": 1}})
    stats = compare([copied], tmp_path / "out")["stats"].set_index("measure")
    row = stats.loc["after_minus_baseline_mean_speed_mm_s"]
    assert row["estimate"] == pytest.approx(1.05)
    said = (tmp_path / "out" / "results.txt").read_text()
    assert "After minus baseline mean speed was 0.105 cm/s higher in fast" in said


def test_a_list_of_the_animals_overrules_the_sessions(study, tmp_path):
    table = tmp_path / "animals.csv"
    table.write_text(
        "subject_id,group,cage\n" + "".join(f"m{k},{'ab'[k % 2]},c{k // 2}\n" for k in range(10))
    )
    row = compare([study], tmp_path / "out", ["distance_m"], animals=table)["stats"].iloc[0]
    assert row["contrast"] == "b - a"
    # every cage holds one of each, so only those two change places
    assert "5 b and 5 a animals within their blocks can be arranged in 32 ways" in row["refused"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("subject_id,group\nm0,a\n", "does not list the animal 'm1'"),
        ("name,group\nm0,a\n", "should have a column subject_id"),
        ("", "should have a column subject_id"),
    ],
)
def test_a_list_that_does_not_fit_is_told(study, tmp_path, text, sentence):
    (tmp_path / "animals.csv").write_text(text)
    with pytest.raises(SessionError, match=sentence):
        compare([study], tmp_path / "out", animals=tmp_path / "animals.csv")
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_compared_is_told(study, tmp_path):
    with pytest.raises(SessionError, match="there is no session in"):
        compare([tmp_path], tmp_path / "out")
    with pytest.raises(SessionError, match="is not a folder"):
        find_sessions([tmp_path / "nowhere"])
    with pytest.raises(SessionError, match="no session's summary has the column 'sped'"):
        compare([study], tmp_path / "out", ["sped"])
    with pytest.raises(SessionError, match="one of them 'wild'"):
        compare([study], tmp_path / "out", reference="wild")
    with pytest.raises(SessionError, match="needs two groups"):
        compare([study / "sub-m0"], tmp_path / "out")
    with pytest.raises(SessionError, match="the engine is one of"):
        compare([study], tmp_path / "out", engine="anova")


def link_tree(source: Path, target: Path) -> Path:
    """A copy of a session that shares its files, but for session.json."""
    shutil.copytree(source, target, copy_function=os.link)
    edit_json(target)
    return target


def edit_json(folder: Path, **facts: object) -> None:
    file = folder / "session.json"
    document = json.loads(file.read_text())
    file.unlink()  # it may be a link to another session's
    file.write_text(json.dumps(document | facts))


@pytest.fixture
def accounted(study, tmp_path) -> Path:
    """The study with one session of each kind: excluded, failed, not measured, doubted."""
    place = tmp_path
    text = 'results = "results"\n'
    for k in range(10):
        text += f'[[animals]]\nid = "m{k}"\n[[sessions]]\nanimal = "m{k}"\nsession = "01"\n'
        text += f'recording = "r{k}.mcap"\n' + 'exclude = "fell asleep"\n' * (k == 9)
        if k != 8:
            link_tree(study / f"sub-m{k}/s{k}.liex", place / f"results/sub-m{k}/ses-01/behav")
    (place / "study.toml").write_text(text)
    write_failure(place / "results/sub-m7/ses-01/behav", {"reason": "no animal was found"})
    (place / "results/sub-m7/ses-01/behav/session.json").unlink()
    edit_json(place / "results/sub-m1/ses-01/behav", verdict={"cautions": ["12 poses"]})
    fish = {"look_at_it": True, "reasons": ["it is a fish"]}
    edit_json(place / "results/sub-m2/ses-01/behav", verdict=fish)
    return place


def test_every_session_of_a_study_is_accounted_for(accounted):
    for place in ("study.toml", "results"):
        found = compare([accounted / place], accounted / "out", ["distance_m"])
        said = found["sessions"]
        assert said == (
            "10 sessions in the study, 7 compared: m1 has cautions; m2 needs review; m7 failed; "
            "m8 not measured; m9 excluded"
        )
        assert "m2: it is a fish" in found["check"]
        for name in ("methods.txt", "results.txt"):
            assert said in (accounted / "out" / name).read_text()
        assert "n = 2 fast, 5 control (animals)" in (accounted / "out/results.txt").read_text()


def test_only_trusted_leaves_out_sessions_that_need_review(accounted):
    found = compare([accounted / "results"], accounted / "out", ["distance_m"], only_trusted=True)
    assert (
        "10 sessions in the study, 6 compared: m1 has cautions; m2 left out, needs review; "
        in (found["sessions"])
    )
    assert found["check"] == []
    assert found["stats"]["n_reference"].tolist() == [4]


def test_a_failed_session_in_a_folder_without_a_study_is_accounted_for(study, tmp_path):
    for k in range(10):
        link_tree(study / f"sub-m{k}" / f"s{k}.liex", tmp_path / f"s{k}.liex")
    write_failure(tmp_path / "s10.liex", {"reason": "no animal was found"})
    link_tree(tmp_path / "s1.liex", tmp_path / "s10.liex.outdated")
    found = compare([tmp_path], tmp_path / "out", ["distance_m"])
    assert found["sessions"] == "11 sessions in the study, 10 compared: s10 failed"


def test_a_recording_that_is_there_twice_counts_once(study, tmp_path):
    for k in range(10):
        link_tree(study / f"sub-m{k}" / f"s{k}.liex", tmp_path / f"s{k}.liex")
    link_tree(tmp_path / "s1.liex", tmp_path / "twin.liex")
    # as from another container: other bytes, the same depth
    stored = json.loads((tmp_path / "twin.liex" / "session.json").read_text())["input"]
    edit_json(tmp_path / "twin.liex", input=stored | {"sha256": "1" * 64})
    found = compare([tmp_path], tmp_path / "out", ["distance_m"])
    assert found["sessions"].endswith("10 compared: twin same recording as s1")
    assert found["check"] == ["twin is the same recording as s1, and is not counted"]
    assert found["stats"]["n_sessions"].tolist() == [10]
    other = write(
        tmp_path / "z.liex",
        WalkingMouse(steady(1.0), speed_mm_s=103.0),
        name="s1",
        subject={"subject_id": "m99", "group": "fast"},
    )
    with pytest.raises(SessionError, match="same recording, but of the animals m99 and m1"):
        compare([tmp_path], tmp_path / "out", ["distance_m"])
    assert other.name == "s1"


def test_sessions_that_count_shares_otherwise_are_told(study, tmp_path):
    for k in range(10):
        link_tree(study / f"sub-m{k}" / f"s{k}.liex", tmp_path / f"s{k}.liex")
    for k in (0, 1):
        edit_json(tmp_path / f"s{k}.liex", schema_version=7)
    (said,) = compare([tmp_path], tmp_path / "out", ["walk_share"])["check"]
    assert said.startswith(
        "s0, s1 are of an earlier version of liex_lab, which counted lost frames"
    )
    for k in range(10):
        edit_json(tmp_path / f"s{k}.liex", schema_version=7)
    assert compare([tmp_path], tmp_path / "out", ["walk_share"])["check"] == []


def test_two_days_of_one_mouse_are_told_as_possible_pseudo_replication(study, tmp_path):
    for k in range(4):
        mouse = WalkingMouse(steady(1.0), speed_mm_s=100.0 + 3 * k)
        who = {"subject_id": f"m0{k // 2}day{k % 2}", "group": "ab"[k // 2]}
        write(tmp_path / f"s{k}.liex", mouse, name=f"s{k}", subject=who)
    said = compare([tmp_path], tmp_path / "out", ["distance_m"])["check"]
    for text in (" ".join(said), *((tmp_path / "out" / name).read_text() for name in TEXTS)):
        assert "possible pseudo-replication: the animals m00day0, m00day1 may be one" in text


TEXTS = ("methods.txt", "results.txt")


def test_a_recording_of_another_animal_is_told(accounted):
    told = {"cautions": [f"{OTHER_ANIMAL}, m7 instead of m3"]}
    edit_json(accounted / "results/sub-m3/ses-01/behav", verdict=told)
    found = compare([accounted], accounted / "out", ["distance_m"])
    assert f"m3: {OTHER_ANIMAL}, m7 instead of m3" in found["check"]
    text = (accounted / "study.toml").read_text()
    (accounted / "study.toml").write_text(text.replace("r3.mcap", "m4_day1.mcap"))
    found = compare([accounted], accounted / "out", ["distance_m"])
    assert any(
        "the study names the animal m3, and the recording's" in one for one in found["check"]
    )


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four arenas of two mice each, two of either group."""
    folder = tmp_path_factory.mktemp("pairs")
    for k, name in enumerate("wxyz"):
        group = "drug" if k > 1 else "control"
        sha256 = f"{k}" * 64
        write_pair(folder / name, 0.8 + 0.1 * k, group, input_sha256=sha256)
    return folder


def test_animals_of_one_arena_are_one_unit_and_interactions_measures_of_the_arena(pairs, tmp_path):
    measures = ["distance_m", "pair_contact_share", "pair_leave_per_min"]
    found = compare([pairs], tmp_path, measures)
    assert found["sessions"] == "8 sessions in the study, 8 compared"
    stats = found["stats"].set_index("measure")
    assert stats["unit"].eq("cage").all()
    assert stats["n_group"].eq(2).all()
    assert stats["n_animals"].eq(8).all()
    table = pd.read_csv(tmp_path / "sessions.csv")
    assert table["cage"].nunique() == table["arena"].nunique() == 4
    first = Session.open(pairs / "w" / "pair-animal1.liex").interaction_totals
    both = first.query("action == 'leave' and target != ''")["per_min"].sum()
    own = table.query("subject_id.str.startswith('w_')")
    assert own["pair_leave_per_min"].tolist() == pytest.approx([both, both])
    mutual = first.query("action == 'contact'")["share"].unique()
    assert own["pair_contact_share"].unique() == pytest.approx(mutual)
    assert "pair_leave_per_min" in set(compare([pairs], tmp_path)["stats"]["measure"])


def test_statistics_per_animal_are_refused_where_animals_may_have_been_exchanged(pairs, tmp_path):
    table = collect([Session.open(one) for one in sorted(pairs.glob("*/*.liex"))])
    doubtful = table.assign(exchanged=table["arena"].str.startswith("pair 3"))
    measures = ["distance_m", "pair_contact_share"]
    alone, together = cohort.compare(doubtful, measures).to_dict("records")
    assert "may have been exchanged" in alone["refused"]
    assert "--only-trusted" in alone["refused"]
    assert "exchanged" not in together["refused"]
    assert together["unit"] == "cage"
    mixed = table.assign(group=["a", "b"] * 4)
    of_animal, of_arena = cohort.compare(mixed, measures).to_dict("records")
    assert of_animal["unit"] == "animal"  # within the arenas, as blocks
    assert "of the arena is the same for all its animals" in of_arena["refused"]
    two = table.assign(cage=[f"c{k % 2}" for k in range(8)])
    kept, notes = cohort.unified(two)
    assert kept["cage"].equals(table["arena"])
    assert sum("the arena counts as their cage" in note for note in notes) == 4


def test_a_session_with_likely_exchanges_says_so_in_its_row(pairs, tmp_path):
    shutil.copytree(pairs / "w", tmp_path / "w")
    folder = tmp_path / "w" / "pair-animal1.liex"
    about = json.loads((folder / "session.json").read_text())
    about["files"]["crossings.parquet"] = {"bytes": 1}
    (folder / "session.json").write_text(json.dumps(about))
    session = Session.open(folder)
    names = [column.name for column in CROSSINGS]
    row = pd.DataFrame([dict.fromkeys(names, "")]).assign(start_s=0.0, stop_s=0.1, p_swap=0.3)
    row = row.assign(start_frame=0, stop_frame=3)
    row.to_parquet(folder / "crossings.parquet")
    assert collect([session])["exchanged"].tolist() == [True]
