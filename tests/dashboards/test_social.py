"""Who did what to whom, as figures: what the tables count stands in them."""

import pytest
from liex_lab.dashboards.app.data import StudyData
from liex_lab.dashboards.figures import social
from liex_lab.dashboards.figures.animals import SessionAnimal, session_animals
from liex_lab.dashboards.figures.style import drawing, image_bytes
from liex_lab.dashboards.report.report import render
from liex_lab.pipelines.study.run import list_sessions

from liex_lab.sessions import Session
from tests.dashboards.served import app_of
from tests.sessions.pair import write_pair
from tests.sessions.walking_mouse import WalkingMouse, steady, write


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> list[Session]:
    return write_pair(tmp_path_factory.mktemp("social"))


def animal(session: Session) -> SessionAnimal:
    (one,) = session_animals(session)
    return one


def test_matrix_and_network_show_numbers_and_times_of_the_totals(pair):
    totals = pair[0].interaction_totals.query("target != '' and count > 0")
    with drawing():
        matrix, network = (
            draw(animal(pair[0]))
            for draw in (social.interaction_matrix, social.interaction_network)
        )
        assert matrix is not None
        assert network is not None
        (axes,) = matrix.axes
        rows = [label.get_text() for label in axes.get_yticklabels()]
        assert rows == ["animal1 → animal2", "animal2 → animal1"]
        shown = {label.get_text() for label in axes.get_xticklabels()}
        assert shown == {word.replace("_", " ") for word in totals["action"]}
        said = sorted(text.get_text() for text in axes.texts)
        cells = totals[["count", "total_s"]].itertuples(index=False, name=None)
        assert said == sorted(f"{n}\n{s:.1f} s" for n, s in cells)
        texts = {text.get_text() for text in network.axes[0].texts}
        assert {"animal1", "animal2"} <= texts
        (share,) = totals.query("action == 'contact' and agent == 'animal1'")["share"]
        assert f"contact {share:.1%}" in texts
        again = social.interaction_matrix(animal(pair[1]))  # of the arena, so the same in each
        assert again is not None
        assert image_bytes(again, "svg") == image_bytes(matrix, "svg")


def test_the_report_of_several_has_them_and_that_of_one_has_not(pair, tmp_path):
    assert "what the first did to the second" in render(pair[0])
    alone = write(tmp_path / "circle.liex", WalkingMouse(steady(0.5)))
    with drawing():
        assert social.interaction_matrix(animal(alone)) is None
        assert social.interaction_network(animal(alone)) is None


def test_the_page_of_a_session_shows_interactions_and_leads_to_the_other_animal(pair):
    client = app_of(StudyData(*list_sessions(pair[0].path.parent))).test_client()
    page = client.get("/session/pair-animal1").text
    assert ">Interactions<" in page
    assert 'href="/session/pair-animal2"' in page
    assert 'src="/figure/pair-animal1/network.svg"' in page
    assert client.get("/figure/pair-animal1/network.svg").status_code == 200
    events = pair[0].interactions.query("target != ''")
    assert page.count(">animal2</td>") >= len(events.query("target == 'animal2'"))
