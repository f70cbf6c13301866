"""The picture in README.md is made of the report's own figures."""

from __future__ import annotations

from pathlib import Path

from liex_lab.dashboards.picture import page

from tests.sessions.walking_mouse import WalkingMouse, steady, write


def test_the_page_holds_frames_way_and_curves(tmp_path: Path) -> None:
    html = page(write(tmp_path / "circle.liex", WalkingMouse(steady(2.0), rear_s=(0.5, 1.2))))
    assert html.count('<image href="data:image/png') == 4 + 1  # and the trajectory's bar of colours
    assert html.count("<svg") == 4 + 3
    assert all(word in html for word in ("Trajectory", "Nose height", "Ethogram", "0.00 s"))
