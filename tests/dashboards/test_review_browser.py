"""A blinded review in a real browser: clips named by keys, left in the middle, gone on with, and
the agreement at the end.
"""

import json

from playwright.sync_api import Page, expect

from tests.dashboards.conftest import Watched
from tests.dashboards.served import Served

N_CLIPS = 8


def begin(served: Served, page: Page, rater: str) -> None:
    page.goto(f"{served.address}/review")
    page.locator("#review-rater").fill(rater)
    page.locator("#review-name").fill("first look")
    page.locator("#review-n").fill(str(N_CLIPS))
    page.get_by_role("button", name="Begin, or go on").click()
    page.wait_for_selector("#review .desk-stage")


def rate(page: Page, keys: dict[int, str], order: list[int], first: int, stop: int) -> None:
    for k in range(first, stop):
        expect(page.locator(".desk-now")).to_have_text(f"Clip {k + 1} of {N_CLIPS}")
        page.keyboard.press(keys[order[k]])


def test_clips_are_named_blindly_by_two_and_agree_as_they_should(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    asked: list[str] = []
    page.on("response", lambda got: asked.append(got.text()) if _of_clips(got.url) else None)
    begin(served, page, "Ada <b>L.</b>")
    (file,) = (served.study.parent / "reviews").glob("*.review.json")
    review = json.loads(file.read_text())
    words, clips = review["words"], review["clips"]
    assert len(clips) == N_CLIPS
    right = {
        k: str(words.index(clip["program"]) + 1) if clip["program"] else "0"
        for k, clip in enumerate(clips)
    }
    orders = {}
    for rater in ("Ada <b>L.</b>", "Bob"):
        told = page.request.get(
            f"{served.address}/reviews/first look/state", params={"rater": rater}
        ).json()
        assert sorted(told["order"]) == list(range(N_CLIPS))
        assert "agreements" not in told
        orders[rater] = told["order"]
    assert orders["Bob"] != orders["Ada <b>L.</b>"]
    rate(page, right, orders["Ada <b>L.</b>"], 0, 3)
    expect(page.locator(".desk-now")).to_have_text(f"Clip 4 of {N_CLIPS}")
    begin(served, page, "Ada <b>L.</b>")  # left in the middle
    rate(page, right, orders["Ada <b>L.</b>"], 3, N_CLIPS)
    expect(page.locator("h2")).to_have_text(f"Ada <b>L.</b> has named all {N_CLIPS} clips")
    expect(page.locator("tbody tr")).to_have_count(1)
    expect(page.locator("td.kappa")).to_have_text("1.00")
    wrong = dict(right)  # Bob calls two clips something else
    for k in range(2):
        wrong[k] = "1" if right[k] != "1" else "2"
    page.get_by_role("button", name="Another rater").click()
    begin(served, page, "Bob")
    rate(page, wrong, orders["Bob"], 0, N_CLIPS)
    expect(page.locator("tbody tr")).to_have_count(3)
    assert "75 %" in page.locator("tbody tr").first.inner_text()
    kappas = page.locator("td.kappa").all_inner_texts()
    assert kappas[1] == "1.00"
    assert kappas[0] == kappas[2]
    assert 0.3 < float(kappas[0]) < 0.75
    secrets = {"sub-m", "control", "drug", "program", "group", "subject"}
    assert asked
    assert [text for text in asked if any(one in text for one in secrets)] == []
    watched.nothing_went_wrong()


def _of_clips(address: str) -> bool:
    """Whether an answer is about a clip, in words: it may not tell whose."""
    return "/clip/" in address and not address.split("?")[0].endswith((".png", "/times"))
