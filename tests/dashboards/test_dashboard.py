"""What the dashboard shows is what the folders hold; what it hands out runs nowhere; and not
everybody may ask.
"""

import io
import json
import shutil
import socket
import sys
import threading
import time
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pandas as pd
import pytest
from flask import Flask
from hypothesis import given, settings
from hypothesis import strategies as st
from liex_lab.dashboards.app import tables
from liex_lab.dashboards.app.data import (
    _FACTS,
    NO_POSE,
    SessionBouts,
    StudyData,
    raster,
)
from liex_lab.dashboards.app.pages import ethogram_rows, moved_to
from liex_lab.dashboards.app.server import (
    MOST_BYTES,
    address,
    guard,
    serve,
)
from liex_lab.pipelines.study.run import list_sessions
from typer.testing import CliRunner

from liex_lab import api, cli
from liex_lab.actions.vocabulary import PALETTE, action_colours
from liex_lab.errors import LiexError, SessionError
from liex_lab.sessions import Session
from liex_lab.sessions.verdict import Entry
from tests.dashboards import copies
from tests.dashboards.served import app_of

KEY = "sub-m003_ses-01"


@pytest.fixture(scope="module")
def data(study: Path) -> StudyData:
    return StudyData(*list_sessions(study))


def test_every_session_of_the_study_is_listed_with_its_state_and_quality(data: StudyData) -> None:
    table = data.overview().set_index("session")
    assert len(table) == 12
    assert table["state"].value_counts().to_dict() == {"done": 10, "failed": 1, "new": 1}
    failed = table[table["state"] == "failed"].iloc[0]
    assert (failed["reason"], failed["remedy"]) == ("frame 33 cannot be read", "copy it again")
    done = table.loc[KEY]
    assert (done["n_frames"], done["n_gaps"], done["n_missing"]) == (174, 1, 6)
    assert done["posed_share"] == pytest.approx(172 / 174)
    assert set(table["group"]) == set(copies.GROUPS)


def test_a_folder_of_sessions_needs_no_study_file_and_older_tables_are_no_sessions(
    walker: Session, tmp_path: Path
) -> None:
    one = Path(shutil.copytree(walker.path, tmp_path / "one.liex"))
    (one / "as_tracked").mkdir()
    shutil.copy(one / "session.json", one / "as_tracked")
    shutil.copytree(one, tmp_path / "two.liex")
    name, look = list_sessions(tmp_path)
    assert name == tmp_path.name
    keys = ["one.liex", "two.liex"]
    assert [(entry.key, entry.state) for entry in look()] == [(key, "done") for key in keys]
    with pytest.raises(LiexError, match="no study"):
        list_sessions(tmp_path / "nowhere")


def test_a_session_that_is_written_again_is_read_and_compared_again(
    walker: Session, tmp_path: Path
) -> None:
    data = StudyData(*list_sessions(copies.study(walker, tmp_path, 8)))
    assert set(data.overview()["n_gaps"].dropna()) == {1}
    before = data.stats("mean_speed_mm_s")
    assert data.stats("mean_speed_mm_s") is before
    folder = data.done[0].folder
    assert folder is not None
    about = json.loads((folder / "session.json").read_text())
    about["frames"]["n_gaps"] = 77
    (folder / "session.json").write_text(json.dumps(about))
    summary = pd.read_csv(folder / "summary.csv")
    summary.assign(mean_speed_mm_s=900.0).to_csv(folder / "summary.csv", index=False)
    assert set(data.overview()["n_gaps"].dropna()) == {1, 77}
    assert not data.stats("mean_speed_mm_s").equals(before)


@settings(max_examples=15)
@given(
    edges=st.lists(st.floats(0, 10), min_size=2, max_size=14, unique=True),
    n=st.integers(1, 40),
    words=st.lists(st.sampled_from(["a", "b", "c"]), min_size=7, max_size=7),
)
def test_each_part_of_the_time_has_the_colour_of_what_fills_most_of_it(
    edges: list[float], n: int, words: list[str]
) -> None:
    spans = np.array(sorted(edges)[: len(edges) // 2 * 2]).reshape(-1, 2)
    one = SessionBouts(spans[1:], words[: len(spans) - 1], spans[:1], 10.0)
    found = raster(one, ["a", "b", "c"], 0.0, 10.0, n)
    for k, place in enumerate(found):
        low, high = 10.0 * k / n, 10.0 * (k + 1) / n
        seconds = dict.fromkeys([0, 1, 2, -2], 0.0)
        for kind, (a, b) in zip([-2, *("abc".index(w) for w in one.words)], spans, strict=True):
            seconds[kind] += max(min(b, high) - max(a, low), 0.0)
        if place == -1:
            assert max(seconds.values()) < 1e-9
        else:
            assert seconds[place] >= max(seconds.values()) - 1e-9


def test_ethograms_and_budgets_name_a_group_once_and_every_colour_has_a_meaning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = [
        Entry(key, "done", folder=tmp_path, subject={"group": group})
        for key, group in (("a", "drug"), ("b", "drug"), ("c", "vehicle"))
    ]
    shown = StudyData("x", lambda: entries)
    ones = {
        key: SessionBouts(
            np.array([[0.0, 2.0]]), ["walk"], np.array([[3.0, 4.0]]), end_s, ("walk",)
        )
        for key, end_s in (("a", 4.0), ("b", 5.0), ("c", 4.0))
    }
    shares = {"walk_share": 0.5, "unlabelled_share": 0.3, "sit_share": 0.2}
    monkeypatch.setattr(shown, "ethograms", lambda keys: ones)
    monkeypatch.setattr(shown, "collected", lambda: pd.DataFrame({"key": list(ones)} | shares))
    with app_of(shown).test_request_context("/ethograms"):
        page = ethogram_rows(shown)
    rows = page["entries"]
    assert [row["group"] for row in rows] == ["drug", "", "vehicle"]
    bars = [(bar["word"], bar["at"], bar["at"] + bar["width"]) for bar in rows[0]["bars"]]
    assert bars == [("walk", 0, 40.0), ("unlabelled", 40.0, 60.0), (NO_POSE, 60.0, 80.0)]
    budget = {part["word"]: part["width"] for part in rows[0]["shares"]}
    assert budget == pytest.approx({"walk": 50.0, "unlabelled": 30.0})
    assert set(page["legend"]) == {"walk", "unlabelled", NO_POSE}


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ([0.0333, 1.7, 2.41], ["0.03", "1.70", "2.41"]),
        ([0.1, 0.1], ["0.100", "0.100"]),
        ([1.0, float("nan"), 12.0], ["1", "–", "12"]),
        ([1234.5, 2345.6], ["1,234", "2,346"]),
    ],
)
def test_numbers_of_a_column_have_the_same_digits(values: list[float], shown: list[str]) -> None:
    table = tables.Table(pd.DataFrame({"a": values}), {"a": "a"})
    filled = tables.fill(table)
    assert [row[0]["text"] for row in filled["rows"]] == shown


def test_no_two_actions_share_a_colour() -> None:
    own = action_colours([f"w{k}" for k in range(len(PALETTE))])
    assert len(set(own.values())) == len(PALETTE)
    words = ["rear", "run", "walk", "pause"]
    assert action_colours(["walk", "rear", "unheard"], action_colours(words)) == {
        "walk": action_colours(words)["walk"],
        "rear": action_colours(words)["rear"],
        "unheard": PALETTE[0],
    }


def test_names_are_text_on_every_page(data: StudyData) -> None:
    browser = app_of(data).test_client()
    for path in ("/", "/ethograms", "/groups?measure=mean_speed_mm_s", f"/session/{KEY}"):
        page = browser.get(path).text
        assert "drug&lt;/b&gt; %{y}" in page
        assert "<b>drug" not in page
    sentence = browser.get("/table?name=<i>x").text
    assert "&lt;i&gt;x" in sentence


def test_the_groups_are_compared_as_liex_compare_does(data: StudyData) -> None:
    stats = data.stats("mean_speed_mm_s").set_index("measure")
    row = stats.loc["mean_speed_mm_s"]
    assert abs(row["estimate"]) == pytest.approx(40.0, abs=15.0)
    assert (row["n_animals"], row["n_sessions"]) == (6, 10)
    assert "measure" in tables.STATS
    assert (
        len(stats) > 3
    )  # the family that p is corrected for is not the one measure that is looked at


def test_rows_are_found_by_words_and_sorted_with_the_unknown_last(data: StudyData) -> None:
    table = tables.find(data, "sessions")
    assert tables.arranged(table, "m003 DONE", "", False)["session"].tolist() == [
        KEY,
        "sub-m003_ses-02",
    ]
    rows = tables.arranged(table, "", "predicted_error_mm", True)
    assert set(rows["state"].tail(2)) == {"failed", "new"}
    assert tables.arranged(table, "nobody", "", False).empty


def test_a_table_in_a_spreadsheet_computes_nothing_and_is_whole() -> None:
    rows = pd.DataFrame(
        {"name": ['=HYPERLINK("http://x")', "-2+3", "plain", None], "=x": [1.5, -2.0, 3.0, np.nan]}
    )
    found = pd.read_csv(io.StringIO("".join(tables.as_csv(rows))))
    assert found["name"].tolist()[:3] == ['\'=HYPERLINK("http://x")', "'-2+3", "plain"]
    assert list(found.columns) == ["name", "'=x"]
    assert found["'=x"].tolist()[:3] == [1.5, -2.0, 3.0]


def test_every_table_of_a_session_can_be_had(data: StudyData) -> None:
    browser = app_of(data).test_client()
    session = data.session(KEY)
    for name in tables.session_tables(data, KEY):
        answer = browser.get(f"/session-csv/{KEY}/{name}.csv")
        assert answer.status_code == 200
        rows = session.summary if name == "summary" else session.table(name)
        assert answer.text.count("\n") == len(rows) + 1
    for name in ("sessions", "summaries", "stats/mean_speed_mm_s", f"bouts/{KEY}"):
        assert browser.get(tables.csv_address(name)).status_code == 200
    beside = f"/session-csv/{KEY}/../session.csv"
    for gone in (beside, "/session-csv/nobody/frames.csv", "/csv/secrets.csv", "/report/x"):
        assert browser.get(gone).status_code == 404


def test_steps_go_to_the_next_frame_bout_and_flag(data: StudyData) -> None:
    session: Session = data.session(KEY)
    times = session.frames["time_s"].to_numpy()
    assert moved_to(session, times[3], "frame", 1) == times[4]
    assert moved_to(session, times[0], "frame", -1) == times[0]
    starts = sorted(session.bouts["start_s"])
    assert moved_to(session, starts[0], "bout", 1) == starts[1]
    assert moved_to(session, 0.0, "flag", 1) == pytest.approx(times[150])
    assert moved_to(session, times[-1], "flag", 1) == times[-1]


def test_this_machine_alone_may_ask_and_no_other_site(data: StudyData) -> None:
    browser = app_of(data).test_client()
    assert browser.get("/", headers={"Host": "127.0.0.1:8050"}).status_code == 200
    assert browser.get("/", headers={"Host": "evil.example:8050"}).status_code == 403
    sent = {"Host": "127.0.0.1:8050", "Origin": "http://evil.example"}
    assert browser.post("/refresh", headers=sent).status_code == 403
    policy = browser.get("/").headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "http" not in policy


def test_on_another_address_a_token_is_asked_for(data: StudyData) -> None:
    app = app_of(data, token="right", alone=False)
    browser = app.test_client()
    for path in (
        "/",
        "/csv/sessions.csv",
        "/table?name=sessions",
        "/assets/desk.mjs",
        "/?token=wrong",
    ):
        assert browser.get(path, headers={"Host": "lab:1"}).status_code == 401
    let_in = browser.get("/session/a?token=right&t=1.5", headers={"Host": "lab:1"})
    assert let_in.status_code == 302
    assert "HttpOnly" in let_in.headers["Set-Cookie"]
    assert let_in.headers["Location"] == "/session/a?t=1.5"
    assert browser.get("/csv/sessions.csv", headers={"Host": "lab:1"}).status_code == 200
    assert browser.get("/csv/sessions.csv", headers={"Host": "lab:2"}).status_code == 401  # another
    assert address("0.0.0.0", 5, "right") == f"http://{socket.gethostname()}:5/?token=right"
    assert address("127.0.0.1", 5, "") == "http://127.0.0.1:5/"


def test_what_no_page_sends_is_answered_with_a_sentence_and_no_traceback(
    data: StudyData, capsys: pytest.CaptureFixture[str]
) -> None:
    corrections: list[object] = []
    app = app_of(data, correct=lambda *asked: corrections.append(asked))

    @app.get("/broken")
    def broken() -> str:
        raise ZeroDivisionError

    browser, address = app.test_client(), f"/desk/{KEY}/correct"
    large = browser.post(address, data=b"0" * (MOST_BYTES + 1), content_type="application/json")
    assert large.status_code == 413
    assert "at most 4 MB" in large.text
    for body in (b"{", b"[]", b"null", b'{"sentence": 3, "at_s": 1}', b'{"by": "me"}', b"\xff"):
        answer = browser.post(address, data=body, content_type="application/json")
        assert answer.status_code == 400
        assert "Traceback" not in answer.text
    assert corrections == []
    assert browser.get("/broken").status_code == 500
    told = capsys.readouterr()
    assert "Traceback" not in told.err + told.out
    assert "dashboard: /broken could not be answered (ZeroDivisionError" in told.err


def test_silent_connections_are_closed_and_keep_nobody_from_being_answered(
    data: StudyData, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("liex_lab.dashboards.app.server._IDLE_S", 1)
    ports: list[int] = []
    ready = threading.Event()

    def told(port: int) -> None:
        ports.append(port)
        ready.set()

    serving = (app_of(data), "127.0.0.1", 0, told)
    threading.Thread(target=serve, args=serving, daemon=True).start()
    assert ready.wait(20)
    before = threading.active_count()
    silent = [socket.create_connection(("127.0.0.1", ports[0])) for _ in range(120)]
    try:
        with urlopen(f"http://127.0.0.1:{ports[0]}/assets/tables.mjs", timeout=30) as answer:
            assert answer.status == 200
        assert threading.active_count() <= before + 1
        for one in silent:
            one.settimeout(30.0)
        assert [one.recv(1) for one in silent] == [b""] * 120
    finally:
        for one in silent:
            one.close()


def test_what_is_being_answered_is_waited_for_when_the_server_ends(
    data: StudyData, monkeypatch: pytest.MonkeyPatch
) -> None:
    app, began, done = app_of(data), threading.Event(), threading.Event()

    @app.get("/slow")
    def slow() -> str:
        began.set()
        time.sleep(0.5)
        done.set()
        return "done"

    def interrupt(port: int) -> None:
        asking = f"http://127.0.0.1:{port}/slow"
        threading.Thread(target=lambda: urlopen(asking).read(), daemon=True).start()
        assert began.wait(10)
        raise KeyboardInterrupt

    serve(app, "127.0.0.1", 0, interrupt)
    assert done.is_set()


def test_the_token_is_new_each_time_on_this_machine_as_elsewhere(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[dict[str, object]] = []
    monkeypatch.setattr(
        "liex_lab.dashboards.app.server.make_app", lambda data, **how: made.append(how)
    )
    monkeypatch.setattr(
        "liex_lab.dashboards.app.server.serve", lambda app, host, port, told: told(port)
    )
    monkeypatch.setattr(StudyData, "warm", lambda self, progress: None)
    said: list[str] = []
    for host in ("127.0.0.1", "0.0.0.0", "0.0.0.0"):
        api.serve_dashboard(study, host=host, port=5, echo=said.append)
    assert [how["alone"] for how in made] == [True, False, False]
    assert made[0]["show_replay"] is not None
    assert len({how["token"] for how in made}) == 3
    assert all(len(str(how["token"])) >= 32 for how in made)
    assert made[1]["show_replay"] is None  # a viewer would open where nobody looks
    assert said[1].endswith(str(made[1]["token"]))


def test_without_flask_a_sentence_says_what_to_install(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "waitress.server", None)
    for name in [name for name in sys.modules if name.startswith("liex_lab.dashboards.app.server")]:
        monkeypatch.delitem(sys.modules, name)
    ran = CliRunner().invoke(cli.app, ["dashboard", str(study)])
    assert isinstance(ran.exception, LiexError)
    assert "pip install '.[dashboard]'" in str(ran.exception)


def test_a_session_that_cannot_be_read_in_any_way_is_a_sentence_in_its_row(
    own: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaks(session: Session) -> object:
        raise ZeroDivisionError("a\nslip")

    monkeypatch.setitem(_FACTS, "quality", breaks)
    shown = StudyData(*list_sessions(own.path.parent))
    (damage,) = shown.overview()["damage"]
    assert "cannot be shown (ZeroDivisionError: a)" in damage
    assert "liex verify" in damage


@pytest.mark.parametrize("origin", ["http://[", "//", "\\"])
def test_an_origin_that_is_no_address_is_refused(origin: str) -> None:
    server = Flask("test")
    guard(server, "")
    answer = server.test_client().get("/", headers={"Origin": origin, "Host": "127.0.0.1"})
    assert answer.status_code == 403


def test_a_report_that_is_a_link_elsewhere_is_not_shown(own: Session, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    browser = app_of(StudyData(*list_sessions(own.path.parent))).test_client()
    address, report = f"/report/{own.name}", own.path / "report.html"
    assert browser.get(address).text == report.read_text(encoding="utf-8")
    report.unlink()
    report.symlink_to(tmp_path / "secret")
    assert browser.get(address).status_code == 404


def test_a_session_that_is_corrected_while_it_is_read_is_read_again(
    data: StudyData, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("liex_lab.dashboards.app.data._PAUSES_S", (0.0, 0.0, 0.0))
    asked: list[Session] = []

    def replaced_once(session: Session) -> int:
        asked.append(session)
        if len(asked) == 1:
            raise SessionError("its table is gone")
        return len(session.frames)

    assert data.read(KEY, replaced_once) == 174
    assert len(asked) == 2

    def damaged(session: Session) -> int:
        raise SessionError("it is damaged")

    with pytest.raises(SessionError, match="it is damaged"):
        data.read(KEY, damaged)
