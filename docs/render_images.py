"""Render the images of README.md and of the manual: `python docs/render_images.py`.

It measures the bundled sample and some virtual animals. It needs Chromium and, for the replay,
Vulkan; .ci/run lists the packages.
"""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from readme_figure import photograph

import liex_lab
from liex_lab.api import run_demo, run_session

REPOSITORY = Path(__file__).resolve().parents[1]
STATIC = REPOSITORY / "docs" / "_static"
DEMO = REPOSITORY / "dashboards" / "assets" / "demo.png"
ANIMALS = (
    ("mouse", "synthetic:walk?seed=3&frames=150&sensor=kinect-v2", 20),
    ("fish", "synthetic:swim?seed=2&frames=60", 40),
    ("hand", "synthetic:gesture?seed=2&frames=60", 30),
)


def save_small(path: Path, rgb: Any, n_colours: int = 96) -> None:
    """Write a PNG with a small palette, so that a clone stays small.

    Args:
        path: the PNG.
        rgb: (H, W, 3) uint8.
        n_colours: size of its palette.
    """
    from PIL import Image

    Image.fromarray(np.ascontiguousarray(rgb)).quantize(n_colours, dither=0).save(
        path, optimize=True
    )


def relief(depth: Any) -> Any:
    """Depth as grey levels, nearer is lighter, slopes shaded; (H, W) in 0 to 1.

    Args:
        depth: (H, W) mm, 0 where unread.
    """
    read = depth > 0
    low, high = np.percentile(depth[read], [1, 99])
    height = np.where(read, (high - depth) / max(high - low, 1.0), np.nan)
    smooth = cv2.GaussianBlur(np.nan_to_num(height).astype(np.float32), (0, 0), 1.0)
    shade = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) + cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    return np.clip(0.2 + 0.7 * height + 0.08 * shade, 0, 1)


def draw_animals(folder: Path) -> None:
    """A frame of each bundled animal as the camera sees it, with the skeleton that was measured.

    Args:
        folder: where the sessions are put.
    """
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
    for axis, (name, address, row) in zip(axes, ANIMALS, strict=True):
        plan = liex_lab.Plan.load(name).with_settings(["replay.depth=false"])
        session = liex_lab.Session.open(run_session(address, plan, folder, overwrite=True))
        skeleton = liex_lab.Skeleton.load(name)
        uv = session.poses[["u_px", "v_px"]].to_numpy(float).reshape(-1, skeleton.n_joints, 2)[row]
        depth = liex_lab.open_recording(address).frame(row).depth
        middle = (uv.min(axis=0) + uv.max(axis=0)) / 2
        half = (1.1 if name == "mouse" else 0.75) * np.ptp(uv, axis=0).max()
        left, top = np.maximum(middle - half, 0).astype(int)
        right, bottom = (middle + half).astype(int)
        cut = depth[top : bottom + 1, left : right + 1]
        near = np.abs(cut - np.median(cut[cut > 0])) < 6 * half if name == "hand" else cut > 0
        axis.imshow(
            relief(np.where(near, cut, 0)),
            cmap=mpl.colormaps["gray"].with_extremes(bad="black"),
            extent=(left - 0.5, left + cut.shape[1] - 0.5, top + cut.shape[0] - 0.5, top - 0.5),
            interpolation="nearest",
        )
        for child, parent in enumerate(skeleton.parents):
            if parent >= 0:
                axis.plot(*uv[[parent, child]].T, color="#E69F00", linewidth=1.6)
        axis.plot(*uv.T, "o", color="#D55E00", markersize=3.5)
        axis.set_title(f"{name}: {skeleton.n_joints} joints", fontsize=10)
        axis.set_axis_off()
    figure.canvas.draw()
    save_small(STATIC / "animals.png", np.asarray(figure.canvas.buffer_rgba())[..., :3])


def draw_examples(folder: Path) -> None:
    """The first figure of each example that a page of the manual shows.

    Args:
        folder: where the sessions are put.
    """
    os.chdir(folder)
    for script in sorted((REPOSITORY / "docs" / "examples").glob("plot_[1-5]_*.py")):
        plt.close("all")
        runpy.run_path(str(script))
        figure = plt.figure(plt.get_fignums()[0])
        figure.set_dpi(100)
        figure.canvas.draw()
        rgb = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
        save_small(STATIC / f"{script.stem}.png", rgb, 32)


def shoot_replay(session: Path, moment: int = 120) -> None:
    """The replay as Rerun shows it, without a screen.

    Args:
        session: the session folder.
        moment: the frame.
    """
    from rerun.experimental import ViewerClient

    os.environ["RERUN_ANALYTICS"] = "0"
    found = importlib.util.find_spec("rerun_cli")
    assert found is not None
    assert found.origin is not None
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program = str(Path(found.origin).parent / "rerun")
    with ViewerClient.spawn(
        headless=True, port=port, hide_welcome_screen=True, executable_path=program
    ) as viewer:
        viewer.open(str(session / "session.rrd"))
        for _ in range(5):  # chunks load on demand: the first screenshots may be incomplete
            viewer.set_time("frame", sequence=moment, play_state="paused")
            png = viewer.take_screenshot()
            time.sleep(0.7)
    whole = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    small = cv2.resize(whole, (1200, 675), interpolation=cv2.INTER_AREA)
    save_small(STATIC / "replay.png", small[..., ::-1])


def shoot_pages(session: Path, at_s: float = 3.9) -> None:
    """The beginning of a report, and the page to correct in, as a browser shows them.

    Args:
        session: the session folder.
        at_s: the moment that the page is opened at, s.
    """
    from playwright.sync_api import sync_playwright

    command = [sys.executable, "-m", "liex_lab", "dashboard", str(session.parent), "--port", "0"]
    served = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert served.stdout is not None
        address = re.search(r"(http://[^/]+)/\S*", served.stdout.readline())
        assert address is not None
        with sync_playwright() as driver:
            browser = driver.chromium.launch(
                executable_path=shutil.which("chromium"), args=["--no-sandbox"]
            )
            page = browser.new_page(viewport={"width": 1180, "height": 860})
            page.set_default_timeout(120_000)
            page.goto((session / "report.html").as_uri())
            page.screenshot(path=STATIC / "report.png")  # all colours: every action has its own
            page.goto(address[0])  # with the token, which is a cookie from then on
            page.goto(f"{address[1]}/session/{session.stem}?t={at_s}")
            page.wait_for_selector("#desk.is-open")
            page.wait_for_load_state("networkidle")
            page.wait_for_timeout(2000)  # the view glides to the animal
            page.locator("#desk").screenshot(path=STATIC / "desk.png")
            browser.close()
    finally:
        served.terminate()
        served.wait()


def main() -> None:
    """Make all of them."""
    with tempfile.TemporaryDirectory(prefix="liex-") as name:
        folder = Path(name)
        draw_animals(folder)
        draw_examples(folder)
        session = run_demo(folder)
        shutil.copyfile(photograph(session, folder / "demo.png"), DEMO)  # every colour of it
        shoot_pages(session)
        shoot_replay(session)
    for path in (*sorted(STATIC.glob("*.png")), DEMO):
        print(path, path.stat().st_size)


if __name__ == "__main__":
    main()
