"""Figures say what the tables say: times, lengths, and every n."""

import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from liex_lab.dashboards.figures import groups, places, sets, times
from liex_lab.dashboards.figures.animals import DepthImages, SessionAnimal, session_animals
from liex_lab.dashboards.figures.style import (
    drawing,
    image_bytes,
    joined,
    on_page,
)
from matplotlib.colors import to_hex

from liex_lab.actions.vocabulary import action_colours
from liex_lab.api import compare_groups, draw_figures
from liex_lab.behaviour.activity import Around
from liex_lab.errors import PlaceError, SessionError
from liex_lab.scene.scene import Arena
from liex_lab.sessions import Session
from tests.sessions.walking_mouse import FLOOR_MM, WalkingMouse, steady, write

BOWL = Arena("round", (0.0, 0.0), 220.0)


@pytest.fixture(scope="module")
def session(walker: Session) -> Session:
    return Session.open(walker.path)


@pytest.fixture(scope="module")
def animal(session: Session) -> SessionAnimal:
    (one,) = session_animals(session)
    return one


def text_of(figure: Any) -> str:
    """Every text of a figure."""
    with drawing():
        svg = image_bytes(figure, "svg").decode()
    return " | ".join(re.findall(r"<text[^>]*>([^<]*)</text>", svg))


def numbers(pattern: str, figure: Any) -> list[int]:
    return [int(n.replace(",", "")) for n in re.findall(pattern, text_of(figure))]


def test_the_time_on_the_map_is_the_observed_time(session, animal):
    found = places.occupancy_of(animal)
    assert found.observed_s == pytest.approx(session.summary["observed_s"].iloc[0], rel=1e-6)
    assert f"{found.observed_s:.1f} s observed" in text_of(places.occupancy_map(animal))


def test_every_n_of_a_title_is_that_of_the_table(session, animal):
    posed = int(np.isfinite(session.kinematics["x_mm"]).sum())
    assert posed == 172
    assert numbers(r"n = ([\d,]+) frames", places.occupancy_map(animal)) == [posed]
    assert numbers(r"n = ([\d,]+) frames", places.trajectory(animal)) == [posed]
    assert numbers(r"n = ([\d,]+) bouts?", times.ethogram(animal)) == [len(session.bouts)]
    assert numbers(r"n = ([\d,]+) bouts?", times.time_budget(animal)) == [len(session.bouts)]
    n = int(session.table("transitions")["n"].sum())
    assert numbers(r"n = ([\d,]+) transitions?", times.transitions(animal)) == [n]
    known = int(np.isfinite(session.kinematics["speed_mm_s"]).sum())
    assert numbers(r"n = ([\d,]+) frames", times.speed_distribution(animal)) == [known]


def test_a_scale_bar_is_as_long_as_it_says(animal):
    with drawing():
        figure = places.trajectory(animal)
        axes = figure.axes[0]
        (bar,) = [line for line in axes.get_lines() if line.get_gid() == "scale-bar"]
        (said,) = [text.get_text() for text in axes.texts if text.get_text().endswith("mm")]
        (mm,) = re.findall(r"([\d.]+) mm", said)
        assert np.ptp(bar.get_xdata()) == pytest.approx(float(mm))
        # and on paper it is that long in the measure of the walls
        (walls,) = [line for line in axes.get_lines() if line.get_gid() == "arena"]
        paper = axes.transData.transform(np.column_stack(walls.get_data()))
        bar_px = np.ptp(axes.transData.transform(np.column_stack(bar.get_data()))[:, 0])
        assert np.ptp(paper[:, 0]) / bar_px == pytest.approx(2 * 220.0 / float(mm), rel=0.01)


def test_an_action_has_its_colour_in_every_figure(session, animal):
    colours = action_colours(animal.words)
    seen_words = set(session.bouts["action"])
    with drawing():
        for draw in (times.ethogram, times.time_budget, times.activity, times.transitions):
            svg = image_bytes(draw(animal), "svg").decode().lower()
            assert all(colours[str(word)].lower() in svg for word in seen_words), draw


def test_a_rear_is_shaded_in_the_colour_of_its_name_and_the_curve_keeps_its_own(session, animal):
    with drawing():
        figure = times.curves(animal)
    assert figure is not None
    (axes,) = [one for one in figure.axes if "Nose height" in one.get_title(loc="left")]
    rears = session.bouts[session.bouts["action"].str.startswith("rear")]
    colours = action_colours(animal.words)
    shades = [to_hex(patch.get_facecolor()) for patch in axes.patches]
    assert shades == [colours[word].lower() for word in rears["action"]]
    assert len(shades) == 1
    assert to_hex(axes.get_lines()[0].get_color()) not in shades


def test_bars_ways_and_shares_are_those_of_the_tables(session, animal):
    with drawing():
        ethogram, budget, speed = (
            draw(animal) for draw in (times.ethogram, times.time_budget, times.speed_distribution)
        )
    word = str(session.bouts["action"].iloc[0])
    own = session.bouts[session.bouts["action"] == word]
    (bars,) = [c for c in ethogram.axes[0].collections if c.get_gid() == f"bouts of {word}"]
    drawn = sorted(
        (path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in bars.get_paths()
    )
    np.testing.assert_allclose(drawn, own[["start_s", "stop_s"]].to_numpy(float))
    row = session.summary.iloc[0]
    shares = [100.0 * row[f"{word}_share"] for word in [*animal.words, "unlabelled"]]
    np.testing.assert_allclose([bar.get_width() for bar in budget.axes[0].patches], shares)
    _, metres, _ = times.walked(animal)
    assert metres[-1] == pytest.approx(row["distance_m"], rel=1e-6)
    assert (np.diff(metres) >= 0).all()
    assert sum(bar.get_height() for bar in speed.axes[0].patches) == pytest.approx(100.0)


def test_a_long_curve_keeps_its_peaks_and_its_holes():
    values = np.zeros(100_000)
    values[54_321] = 9.0
    values[20_000:30_000] = np.nan
    rows = times.kept_rows(values, 1200)
    assert len(rows) < 2600
    assert 54_321 in rows
    assert np.isnan(values[rows]).sum() > 100


def test_bouts_nearer_than_a_hair_are_one_bar():
    spans = [(0.0, 1.0), (1.01, 1.02), (5.0, 6.0)]
    assert joined(spans, 0.05) == [(0.0, 1.02), (5.0, 6.0)]
    assert joined(spans, 0.0) == spans


def test_the_arenas_floor_is_at_height_zero_and_a_fixture_as_high_as_it_is(session):
    camera = session.camera
    depth = np.full((camera.height, camera.width), round(FLOOR_MM), np.uint16)
    depth[20:30, 40:50] = round(FLOOR_MM) - 60
    heights, x_mm, y_mm = places.arena_heights(session, [depth, depth])
    known = heights[np.isfinite(heights)]
    assert np.median(known) == pytest.approx(0.0, abs=0.6)
    assert np.nanmax(heights) == pytest.approx(60.0, abs=1.0)
    assert (np.diff(x_mm) > 0).all()
    assert (np.diff(y_mm) > 0).all()


def test_the_region_and_where_the_animal_hid_are_drawn_on_the_floor(session):
    from matplotlib.figure import Figure

    camera = session.camera
    foot = [camera.cx, camera.cy]
    aside = [camera.cx + 0.1 * camera.fx, camera.cy]
    gaps = pd.DataFrame(
        {
            "reason": ["hidden", "tracker_lost", "hidden"],
            "x_mm": [30.0, 50.0, np.nan],
            "y_mm": [-20.0, 1.0, np.nan],
            "start_s": [2.0, 0.0, 4.0],
            "stop_s": [3.5, 1.0, 5.0],
        }
    )
    animal: Any = SimpleNamespace(
        camera=camera,
        T_arena_camera=session.T_arena_camera,
        metadata={"scene": {"region_px": [foot, aside, [camera.cx, 0.0]]}},
        gaps=gaps,
    )
    axes = Figure().add_subplot()
    places.draw_region(axes, animal)
    places.draw_hidden(axes, animal)
    (region,) = [line for line in axes.get_lines() if line.get_gid() == "region"]
    corners = np.column_stack(region.get_data())
    np.testing.assert_allclose(corners[0], 0.0, atol=1e-6)  # below the camera
    assert np.hypot(*corners[1]) == pytest.approx(0.1 * FLOOR_MM, rel=1e-3)
    (hid,) = [line for line in axes.get_lines() if line.get_gid() == "hidden"]
    np.testing.assert_allclose(np.column_stack(hid.get_data()), [[30.0, -20.0]])
    assert [text.get_text() for text in axes.texts] == ["hidden 1.5 s"]


def test_the_animal_is_not_in_the_map_of_the_arena(session):
    with closing(DepthImages()) as images:
        depths = [images.depth(session, row) for row in range(0, 174, 20)]
    heights, _, _ = places.arena_heights(session, [one for one in depths if one is not None])
    assert np.nanmax(heights) < 15.0  # the mouse is 25 mm high


def test_what_the_tables_say_twice_is_the_same_bytes(session, tmp_path):
    asked: Any = {
        "only": ["occupancy", "transitions"],
        "formats": ("svg", "pdf", "png", "pages"),
    }
    first, again = (draw_figures(session.path, out=tmp_path / name, **asked) for name in "ab")
    assert len(first["files"]) == 7
    for one, other in zip(first["files"], again["files"], strict=True):
        assert one.read_bytes() == other.read_bytes(), one.name
    assert first["files"][-1] == tmp_path / "a" / "figures.pdf"
    assert b"/Count 2" in first["files"][-1].read_bytes()
    svg = (tmp_path / "a" / "occupancy.svg").read_text(encoding="utf-8")
    assert "Occupancy, walker" in svg
    assert ">nest &lt;1&gt;</text>" in svg  # a text that can be edited
    assert 'width="252.' in svg  # 89 mm in points
    assert "Date" not in svg
    pdf = (tmp_path / "a" / "occupancy.pdf").read_bytes()
    assert b"/Type3" not in pdf
    assert b"CreationDate" not in pdf


def test_a_report_made_again_draws_anew_what_lies_beside_it(session, tmp_path):
    names = {"occupancy.pdf", "figures.pdf", "onsets.png"}
    for name in names:
        (tmp_path / name).write_bytes(b"of the tables before a correction")
    (tmp_path / "mine.pdf").write_bytes(b"mine")
    sets.for_the_page(session, tmp_path)
    drawn = {path.name for path in tmp_path.iterdir() if path.suffix != ".svg"}
    assert drawn == {"occupancy.pdf", "figures.pdf", "mine.pdf"}  # no onsets are to be drawn
    assert (tmp_path / "occupancy.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "figures.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "mine.pdf").read_bytes() == b"mine"


def test_a_plan_asks_for_the_formats_beside_every_report(session, own, tmp_path, monkeypatch):
    usually = {path.suffix for path in (session.path / "figures").iterdir()}
    assert usually == {".svg", ".pdf"}
    monkeypatch.setattr(sets, "OF_SESSION", {"speed": sets.OF_SESSION["speed"]})
    own.metadata["plan"]["report"] = {"figures": ["svg", "png"]}
    sets.for_the_page(own, tmp_path)
    assert {path.name for path in tmp_path.glob("speed*")} == {"speed.svg", "speed.png"}


def test_every_figure_has_something_to_show_of_a_usual_session(session, tmp_path):
    found = draw_figures(session.path, formats=["svg"], out=tmp_path)
    # it takes five bouts, another instrument, light and dark, or several animals
    empty = {"onsets", "events", "sync", "actogram", "interactions", "network"}
    assert set(found["empty"]) == empty
    assert {path.stem for path in found["files"]} == set(sets.OF_SESSION) - empty


def test_a_link_in_the_place_of_a_figure_is_not_written_through(session, tmp_path):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (tmp_path / "mine").symlink_to(theirs)
    with pytest.raises(PlaceError, match="symbolic link"):
        draw_figures(session.path, only=["speed"], out=tmp_path / "mine")
    assert not list(theirs.iterdir())


def test_a_dollar_in_a_name_is_a_dollar(animal):
    with drawing():
        svg = image_bytes(times.ethogram(replace(animal, subject="a$b$ <c>")), "svg")
    assert "a$b$ &lt;c&gt;" in svg.decode()
    assert "a$b$ &lt;c&gt;" in on_page(svg, "x", "y <z>")
    assert 'aria-label="y &lt;z&gt;"' in on_page(svg, "x", "y <z>")


def test_an_empty_session_is_a_sentence_and_no_file(tmp_path):
    lost = write(tmp_path / "lost.liex", WalkingMouse(steady(1.0), lost=tuple(range(30))))
    with pytest.raises(SessionError, match=r"nothing to draw of occupancy: no pose was found"):
        draw_figures(lost.path, only=["occupancy"], out=tmp_path / "none")
    assert not (tmp_path / "none").exists()
    found = draw_figures(lost.path, formats=["svg"], out=tmp_path / "some")
    assert {"occupancy", "trajectory", "speed", "curves"} <= set(found["empty"])


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"only": ["occupanzy"]}, "did you mean 'occupancy'"),
        ({"formats": ["jpg"]}, "svg, pdf, png, pages, got 'jpg'"),
    ],
)
def test_a_wrong_name_is_a_sentence(session, tmp_path, asked, said):
    with pytest.raises(SessionError, match=said):
        draw_figures(session.path, out=tmp_path / "none", **asked)
    assert not (tmp_path / "none").exists()


def test_of_several_animals_each_has_its_figures(session):
    """Rows of another animal are not drawn as this one's."""
    frames = pd.concat([session.frames, session.frames.assign(individual="mouse_2")])
    moved = session.kinematics
    moved = pd.concat([moved, moved.assign(individual="mouse_2", x_mm=np.nan, y_mm=np.nan)])
    both = Session(session.path, session.metadata)
    both.__dict__.update(frames=frames, kinematics=moved)
    first = SessionAnimal(both, "mouse_1", alone=False)
    second = SessionAnimal(both, "mouse_2", alone=False)
    assert places.occupancy_of(first).n == 172
    assert places.occupancy_of(second).n == 0
    assert "walker, mouse_1" in text_of(places.occupancy_map(first))


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two groups of three mice; those of the second are faster."""
    folder = tmp_path_factory.mktemp("study")
    for group, speed in (("control", 150.0), ("drug", 250.0)):
        for k in range(3):
            mouse = WalkingMouse(steady(2.0), speed_mm_s=speed + 10.0 * k, rear_s=(0.5, 1.2))
            name = f"{group}{k}"
            facts = {"subject_id": name, "group": group}
            write(folder / f"{name}.liex", mouse, name=name, subject=facts, arena=BOWL)
    return folder


def test_curves_about_events_are_means_of_subjects_by_group(monkeypatch):
    def around(animal: Any) -> list[Any]:
        values = np.full(61, animal.speed)
        return [
            ("Speed", "cm/s", "tone", Around(np.linspace(-1, 2, 61), values, values, values, 9))
        ]

    monkeypatch.setattr(groups, "around_events", around)
    stated = [("a", "m1", 10.0), ("a", "m1", 20.0), ("a", "m2", 35.0), ("b", "m3", 50.0)]
    animals: Any = [SimpleNamespace(group=g, label=m, speed=v) for g, m, v in stated]
    with drawing():
        figure = groups.events_by_group(animals)
    assert figure is not None
    heights = [line.get_ydata()[0] for line in figure.axes[0].lines if len(line.get_xdata()) == 61]
    assert heights == [15.0, 35.0, 25.0, 50.0, 50.0], "two subjects and their mean, then one"
    assert "a, n = 2 subjects" in text_of(figure)
    monkeypatch.setattr(groups, "around_events", lambda _: [])
    assert groups.events_by_group(animals) is None


@pytest.mark.slow
def test_a_comparison_draws_every_animal_and_figures_no_longer_compared_are_removed(
    study, tmp_path
):
    place = tmp_path / "cmp"
    found = compare_groups([study], place, ["mean_speed_mm_s", "rear_count"])
    names = {path.name for path in found["figures"]}
    assert {"compare_mean_speed_mm_s.svg", "compare_mean_speed_mm_s.pdf", "effects.svg"} <= names
    assert {"occupancy_groups.svg", "occupancy_subjects.svg", "distances.svg"} <= names
    table, stats, sessions = sets.read_comparison(place)
    assert len(sessions) == 6
    with drawing():
        figure = groups.comparison(
            table, stats, "mean_speed_mm_s", "mm/s", table.attrs["accounted"]
        )
    assert figure is not None
    left, right = figure.axes
    for group in ("control", "drug"):
        (marks,) = [one for one in left.collections if one.get_gid() == f"animals {group}"]
        own = table.loc[table["group"] == group, "mean_speed_mm_s"]
        np.testing.assert_allclose(sorted(marks.get_offsets()[:, 1]), sorted(0.1 * own))  # cm/s
    (interval,) = [line for line in right.get_lines() if line.get_gid() == "interval 0"]
    row = stats[stats["measure"] == "mean_speed_mm_s"].iloc[0]
    np.testing.assert_allclose(interval.get_xdata(), [0.1 * row["ci_low"], 0.1 * row["ci_high"]])
    said = text_of(figure)
    assert "mean speed, n = 3 drug, 3 control (animals)" in said
    assert "drug - control | n = 3 drug, | 3 control (animals)" in said
    assert "mean speed, cm/s" in said
    assert "6 sessions in the study, 6 compared" in said
    assert f"g {row['effect_size']:.2f}" in said
    own = place / "figures" / "compare_with_last_year.txt"
    own.write_text("a user's")
    compare_groups([study], place, ["rear_count"])
    draw_figures(place, only=["rear_count"], formats=["png"])
    names = {path.name for path in (place / "figures").glob("compare_*")}
    assert names == {own.name, *(f"compare_rear_count.{kind}" for kind in ("svg", "pdf", "png"))}


def test_sessions_of_one_name_stay_in_their_own_groups(tmp_path):
    """Two folders hold a session called m each, one of either group."""
    mouse = WalkingMouse(steady(1.0))
    both = [
        write(tmp_path / group / "m.liex", mouse, name="m", subject={"group": group})
        for group in ("drug", "control")
    ]
    table = pd.DataFrame({"session_id": "m", "individual": "mouse", "group": ["drug", "control"]})
    table["individual"] = [str(one.metadata["individual"]) for one in both]
    assert [one.group for one in sets._grouped(both, table)] == ["drug", "control"]
    assert sets._grouped(both[1:], table) == []  # the other has gone: whose row is whose?


def test_the_mean_of_a_group_counts_every_subject_alike(study):
    sessions = [Session.open(path) for path in sorted(study.glob("*.liex"))]
    animal = [one for session in sessions for one in session_animals(session)]
    both = groups.by_group(animal)
    assert {name: len(subjects) for name, subjects in both.items()} == {"control": 3, "drug": 3}
    text = text_of(groups.occupancy_by_group(animal))
    assert "control, n = 3 subjects" in text
    each = np.mean(
        [places.occupancy_of(one).observed_s for one in both["control"].values() for one in one]
    )
    assert f"mean of {each:.1f} s each" in text


def test_a_study_has_its_figures(study, tmp_path):
    found = draw_figures(study, formats=["svg"], out=tmp_path)
    assert {path.stem for path in found["files"]} == set(sets.OF_STUDY) - {"events_groups"}
    assert "n = 6 sessions" in (tmp_path / "ethograms.svg").read_text(encoding="utf-8")


def test_a_damaged_comparison_is_a_sentence(study, tmp_path):
    (tmp_path / sets.COMPARISON_FILE).write_text("{", encoding="utf-8")
    with pytest.raises(SessionError, match="compare again"):
        draw_figures(tmp_path)
