"""Many workers, simulated from the times of few, and the report of a session repeated until it is
long.
"""

import numpy as np
import pytest
from liex_lab.pipelines.evaluation.scale import evaluate_report, repeat_session, simulate

from liex_lab.sessions import Session
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(steady(4.0), rear_s=(1.0, 2.0), lost=(20, 21))


def test_workers_gain_until_the_scheduler_is_the_limit() -> None:
    found = simulate([100.0, 120.0], scheduler_s=0.5, workers=(1, 2, 10, 1000))
    assert found["1"] == pytest.approx(3600 / 110.5, rel=0.02)
    assert found["2"] == pytest.approx(2 * found["1"], rel=0.02)
    assert found["10"] == pytest.approx(10 * found["1"], rel=0.05)
    assert found["1000"] <= 3600 / 0.5


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return write(tmp_path_factory.mktemp("short") / "circle.liex", MOUSE)


def test_the_tables_of_a_repeated_session_repeat(session, tmp_path) -> None:
    n_frames, seconds = repeat_session(session, tmp_path / "long.liex", 10.0)
    long = Session.open(tmp_path / "long.liex")
    assert (n_frames, len(long.frames), len(long.poses)) == (360, 360, 1800)
    assert seconds == pytest.approx(12.0, abs=1e-6)
    assert np.ptp(np.diff(long.frames["time_ns"])) <= 2
    rears = long.bouts[long.bouts["action"] == "rear"]
    np.testing.assert_allclose(np.diff(rears["start_s"]), 4.0, atol=1e-6)
    assert long.summary["rear_count"][0] == 3
    once, thrice = (s.summary["distance_m"][0] for s in (session, long))
    assert 0 <= thrice - 3 * once < 2 * 0.3, "it jumps back to where it began twice"


def test_the_report_of_a_long_session_is_measured(session) -> None:
    found = evaluate_report(session.path, minutes=1.0)
    assert found["frames"] == 1800
    assert 0 < found["seconds"] < 60
    assert 50 < found["peak_memory_mb"] < 1000
    assert 0.01 < found["report_mb"] < 8
