"""A region drawn over the depth picture in a real browser, and the plan that then states it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from liex_lab.plan import Plan
from liex_lab.scene.floor import Floor
from liex_lab.scene.scene import Arena, Fixture, Scene
from tests.conftest import REPOSITORY
from tests.dashboards.conftest import Watched
from tests.dashboards.served import Served
from tests.sessions.walking_mouse import FLOOR_MM, SMALL, WalkingMouse, steady, write

KEY = "walker"
CORNERS = [(12.0, 10.0), (92.0, 8.0), (95.0, 70.0), (9.0, 66.0)]
LEVEL = Floor.from_plane(np.array([0.0, 0.0, 1.0]), FLOOR_MM, SMALL)
HOUSE = Scene(LEVEL, fixtures=(Fixture((120.0, -40.0), 62.0, 9000.0),))


@pytest.fixture
def served(tmp_path: Path) -> Served:
    plan = Plan.load("mouse").to_toml()
    write(
        tmp_path / "study" / f"{KEY}.liex",
        WalkingMouse(steady(2.0)),
        name=KEY,
        arena=Arena("round", (0, 0), 220.0),
        scene=HOUSE,
        plan_toml=plan,
    )
    return Served(tmp_path / "study")


def opened(served: Served, page: Page) -> None:
    page.goto(f"{served.address}/arena/{KEY}")
    page.wait_for_selector("#region.is-open")
    page.locator(".region-stage").scroll_into_view_if_needed()


def on_screen(page: Page, u: float, v: float) -> tuple[float, float]:
    """Where a pixel's centre is: the picture is fitted into its box, so by its own size alone."""
    box = page.locator(".region-stage").bounding_box()
    assert box is not None
    scale = min(box["width"] / SMALL.width, box["height"] / SMALL.height)
    left = box["x"] + (box["width"] - scale * SMALL.width) / 2
    top = box["y"] + (box["height"] - scale * SMALL.height) / 2
    return left + (u + 0.5) * scale, top + (v + 0.5) * scale


def click(page: Page, u: float, v: float) -> None:
    page.mouse.click(*on_screen(page, u, v))


def corners(page: Page) -> list[list[float]]:
    text = page.locator("#region-corners").input_value()
    return [[float(value) for value in one.split(",")] for one in text.split()]


def test_a_polygon_is_clicked_dragged_undone_closed_and_saved_as_a_run_takes_it(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    opened(served, page)
    save = page.get_by_role("button", name="Save into the plan")
    expect(save).to_be_disabled()
    for corner in CORNERS:
        click(page, *corner)
    np.testing.assert_allclose(corners(page), CORNERS, atol=0.3)
    click(page, 50.0, 40.0)
    page.keyboard.press("u")
    click(page, *CORNERS[0])  # on the first corner: closed
    expect(save).to_be_enabled()
    page.mouse.move(*on_screen(page, *CORNERS[1]))
    page.mouse.down()
    page.mouse.move(*on_screen(page, 80.0, 15.0), steps=4)
    page.mouse.up()
    drawn = [CORNERS[0], (80.0, 15.0), *CORNERS[2:]]
    np.testing.assert_allclose(corners(page), drawn, atol=0.3)
    click(page, 52.0, 68.0)  # on the lowest side: a corner more
    assert len(corners(page)) == 5
    page.keyboard.press("Delete")
    np.testing.assert_allclose(corners(page), drawn, atol=0.3)
    line = page.locator("#region-command").inner_text()
    save.click()
    expect(page.locator(".region-said")).to_contain_text("walker.plan.toml states this region")
    file = served.study / "walker.plan.toml"
    region = Plan.load(file).arena.region
    assert region is not None
    np.testing.assert_allclose(np.array(region.polygon), drawn, atol=0.3)
    told = " ".join(f"{u:g},{v:g}" for u, v in region.polygon or ())
    assert line.endswith(f"--region '{told}'")
    opened(served, page)  # what the plan states is there again
    assert corners(page) == region.polygon
    watched.nothing_went_wrong()


def test_a_region_is_drawn_by_keys_alone_and_a_crossing_one_is_refused(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    opened(served, page)
    page.locator(".region-stage").focus()
    for keys in (["Shift+ArrowLeft"] * 3, ["Shift+ArrowRight"] * 6, ["Shift+ArrowDown"] * 2):
        for key in keys:
            page.keyboard.press(key)
        page.keyboard.press("Enter")
    page.keyboard.press("c")
    assert corners(page) == [[23.0, 40.0], [83.0, 40.0], [83.0, 60.0]]
    page.keyboard.press("n")
    page.keyboard.press("ArrowUp")
    assert corners(page)[0] == [23.0, 39.0]
    page.locator("#region-corners").fill("10,10 90,60 90,10 10,60")
    page.get_by_role("button", name="Save into the plan").focus()
    page.get_by_role("button", name="Save into the plan").click()
    expect(page.locator(".region-said.is-wrong")).to_contain_text("sides 1 and 3 of its polygon")
    assert not (served.study / "walker.plan.toml").exists()
    assert len(watched.complaints) == 1  # the browser's own, of an answer 400


def test_the_scene_is_drawn_over_the_picture_of_a_session(served: Served, watched: Watched) -> None:
    page = watched.page
    page.goto(f"{served.address}/session/{KEY}")
    scene = page.locator("img.scene")
    scene.scroll_into_view_if_needed()
    expect(scene).to_have_js_property("naturalWidth", SMALL.width)
    drawn = page.request.get(f"{served.address}/region/{KEY}/scene.svg").text()
    assert "62 mm" in drawn
    assert 'class="outline"' in drawn
    assert 'class="fixture"' in drawn
    page.get_by_role("link", name="Draw the region of the arena").click()
    page.wait_for_selector("#region.is-open .scene-line")
    watched.nothing_went_wrong()


def test_a_region_is_saved_by_nobody_without_the_token_and_by_no_form_of_another_site(
    served: Served, watched: Watched
) -> None:
    address = f"{served.address}/region/{KEY}/save"
    form = watched.page.request.post(address, form={"place": "beside"})
    assert (form.status, form.json()["said"]) == (400, "no region is saved here")
    asked = {"place": "beside", "corners": CORNERS, "was": None}
    foreign = {"Origin": "http://elsewhere.example"}
    assert watched.page.request.post(address, data=asked, headers=foreign).status == 403
    assert not (served.study / "walker.plan.toml").exists()


def test_the_doctor_takes_what_the_page_says(served: Served, watched: Watched) -> None:
    page = watched.page
    opened(served, page)
    page.locator("#region-corners").fill("20,20 300,20 300,220 20,220")
    page.locator("#region-corners").blur()
    line = page.locator("#region-command").inner_text()
    assert line == "liex doctor RECORDING --region '20,20 300,20 300,220 20,220'"
    command = [
        sys.executable,
        "-m",
        "liex_lab",
        "doctor",
        "synthetic:walk?frames=60&sensor=primesense-qvga",
    ]
    corners = line.split("'")[1]
    ran = subprocess.run(
        [*command, "--region", corners], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert "only a region is inspected" in ran.stdout, ran.stdout + ran.stderr
    watched.nothing_went_wrong()
