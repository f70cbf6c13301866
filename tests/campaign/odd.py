"""Odd recordings: each comes out right, or a sentence says why not (docs/reference/recordings.md).

A virtual mouse of known truth is written to disk in some odd way and measured by `liex run`. What
is flagged as trusted must be right, or the run must say what to distrust: in a refusal, in its exit
code, or in the note of its last line.
"""

import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from liex_lab.pipelines.evaluation.scenes import read_individuals
from numpy.typing import NDArray

from liex_lab.evaluation.scores import MeasuredIndividual
from liex_lab.optics.camera import Camera
from liex_lab.recordings import open_recording
from liex_lab.sessions import Session
from liex_lab.sessions.verdict import verdict_in
from liex_lab.simulation.recording import RenderedRecording
from tests.campaign.commands import ENDED, run
from tests.campaign.tally import Tally
from tests.recordings.writers import STEP_NS, even_times, write_png_folder, write_tiff_stack

Frames = NDArray[Any]
Array = NDArray[np.float64]
_ADDRESS = "synthetic:walk?seed=3&frames=240&sensor=primesense-qvga"
_PUSHED_PX = 25
_AT_FRAME = 120  # where something happens in the middle
_LIKE_PLAIN = 2.0  # times the plain recording's error is right, for some have one pose only
_WRONG_MM = 7.0  # and what is trusted and further off is wrong: 15 % of the spine
_MOST_WRONG = 0.01  # of the frames
_LONGEST_S = 60.0  # until the run measures


@dataclass(frozen=True)
class Shown:
    """What a camera shows of the mouse.

    Attributes:
        frames: (n, H, W) depth, mm or in steps of `unit_mm`.
        camera: as it is stated.
        joints: (n, J, 3) true joints, mm, in the camera frame that the statement implies.
        times_ns: of each frame, as stored.
        more: what else its camera.toml says.
    """

    frames: Frames
    camera: Camera
    joints: Array
    times_ns: Sequence[int] = ()
    more: dict[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """A folder of pictures, or one TIFF of pictures that no PNG holds."""
        if self.frames.dtype != np.uint16:
            return write_tiff_stack(folder / "odd.tif", self.frames, self.camera)
        times = self.times_ns or even_times(len(self.frames))
        return write_png_folder(folder, self.frames, self.camera, times, **self.more)


def plain() -> Shown:
    """The mouse as a camera shows it usually."""
    with open_recording(_ADDRESS) as recording:
        assert isinstance(recording, RenderedRecording)
        frames = np.round(recording.depths(0, len(recording))).astype(np.uint16)
        return Shown(frames, replace(recording.camera, source="stated"), recording.joints_camera)


def _rows(rows: Sequence[int] | slice) -> Callable[[Shown], Shown]:
    return lambda s: replace(s, frames=s.frames[rows], joints=s.joints[rows])


def _stamped(times: Callable[[NDArray[np.int64]], Any]) -> Callable[[Shown], Shown]:
    """Other time stamps, from numbers of frames."""
    return lambda s: replace(s, times_ns=[int(t) for t in times(np.arange(len(s.frames)))])


def _unread(share: float) -> Callable[[Shown], Shown]:
    def odd(shown: Shown) -> Shown:
        gone = np.random.default_rng(1).random(shown.frames.shape) < share
        return replace(shown, frames=np.where(gone, 0, shown.frames).astype(np.uint16))

    return odd


def _not_numbers(shown: Shown) -> Shown:
    rng = np.random.default_rng(2)
    frames = shown.frames.astype(np.float32)
    for value in (np.nan, np.inf, -np.inf, -5.0):
        frames[rng.random(frames.shape) < 0.02] = value
    return replace(shown, frames=frames)


def _filled(depth_mm: int) -> Callable[[Shown], Shown]:
    return lambda s: replace(s, frames=np.full_like(s.frames, depth_mm))


def _every(k: int) -> Callable[[Shown], Shown]:
    """Only every k-th pixel of rows and columns."""

    def odd(shown: Shown) -> Shown:
        camera, frames = shown.camera, shown.frames[:, k // 2 :: k, k // 2 :: k]
        small = Camera(
            camera.fx / k,
            camera.fy / k,
            (camera.cx - k // 2) / k,
            (camera.cy - k // 2) / k,
            frames.shape[2],
            frames.shape[1],
        )
        return replace(shown, frames=frames, camera=small)

    return odd


def _full_hd(shown: Shown) -> Shown:
    """1920 x 1080, each pixel six by six times, without what does not fit above and below."""
    n_lost = (6 * shown.camera.height - 1080) // 12
    frames = shown.frames[:, n_lost : n_lost + 180].repeat(6, axis=1).repeat(6, axis=2)
    camera = shown.camera
    cx, cy = 6 * camera.cx + 2.5, 6 * (camera.cy - n_lost) + 2.5
    return replace(
        shown, frames=frames, camera=Camera(6 * camera.fx, 6 * camera.fy, cx, cy, 1920, 1080)
    )


def _portrait(shown: Shown) -> Shown:
    """Turned by a quarter, clockwise."""
    frames = np.ascontiguousarray(np.rot90(shown.frames, -1, axes=(1, 2)))
    one = shown.camera
    camera = Camera(one.fy, one.fx, one.height - 1 - one.cy, one.cx, one.height, one.width)
    x, y, z = np.moveaxis(shown.joints, -1, 0)
    return replace(shown, frames=frames, camera=camera, joints=np.stack([-y, x, z], axis=-1))


def _focal(factor: float) -> Callable[[Shown], Shown]:
    return lambda s: replace(
        s, camera=replace(s.camera, fx=factor * s.camera.fx, fy=factor * s.camera.fy)
    )


def _unit(factor: float) -> Callable[[Shown], Shown]:
    return lambda s: replace(s, more={"unit_mm": factor})


def _asleep(share: float) -> Callable[[Shown], Shown]:
    """Still for a share of the time, then it walks; the camera's noise goes on."""

    def odd(shown: Shown) -> Shown:
        n_still = round(share * len(shown.frames))
        noise = np.random.default_rng(3).normal(0.0, 1.0, shown.frames.shape)
        rows = np.maximum(np.arange(len(shown.frames)) - n_still, 0)
        frames = shown.frames[rows]
        noisy = np.where(frames > 0, frames + np.round(noise), 0).clip(0, 65535).astype(np.uint16)
        still = (np.arange(len(frames)) < n_still)[:, None, None]
        return replace(shown, frames=np.where(still, noisy, frames), joints=shown.joints[rows])

    return odd


def _fast(shown: Shown) -> Shown:
    """500 frames/s of a mouse that moves in every 16th of them; the camera's noise goes on."""
    rows = np.arange(len(shown.frames)) // 16 + 100
    noise = np.random.default_rng(4).normal(0.0, 1.0, shown.frames.shape)
    frames = np.where(shown.frames[rows] > 0, shown.frames[rows] + np.round(noise), 0)
    return replace(
        shown,
        frames=frames.clip(0, 65535).astype(np.uint16),
        joints=shown.joints[rows],
        times_ns=[int(k) * 2_000_000 for k in range(len(rows))],
    )


def _pushed(shown: Shown) -> Shown:
    """The camera is turned in the middle; the truth after it lies elsewhere in its pictures."""
    frames = shown.frames.copy()
    frames[_AT_FRAME:] = np.roll(frames[_AT_FRAME:], _PUSHED_PX, axis=2)
    joints = shown.joints.copy()
    joints[_AT_FRAME:, :, 0] += _PUSHED_PX * joints[_AT_FRAME:, :, 2] / shown.camera.fx
    return replace(shown, frames=frames, joints=joints)


def _none(shown: Shown) -> Shown:
    return shown


ODD: dict[str, Callable[[Shown], Shown]] = {
    "1 frame": _rows(slice(100, 101)),
    "2 frames": _rows(slice(100, 102)),
    "3 frames": _rows(slice(100, 103)),
    "no depth at all": _filled(0),
    "the same depth everywhere": _filled(700),
    "readings that are NaN, infinite, negative": _not_numbers,
    "half of the pixels unread": _unread(0.5),
    "64 x 48 pixels": _every(5),
    "1920 x 1080 pixels": _full_hd,
    "portrait": _portrait,
    "2 frames/s": _stamped(lambda k: k * 500_000_000),
    "500 frames/s": _fast,
    "the clock runs 17 times too fast": _stamped(lambda k: k * 2_000_000),
    "stamps backwards": _stamped(lambda k: (len(k) - k) * STEP_NS),
    "every stamp twice": _stamped(lambda k: (k // 2) * 2 * STEP_NS),
    "the clock jumps by a day": _stamped(lambda k: k * STEP_NS + (k >= _AT_FRAME) * 86_400 * 10**9),
    "negative stamps": _stamped(lambda k: k * STEP_NS - 10**12),
    "stamps near 2^62": _stamped(lambda k: k * STEP_NS + 2**62),
    "microseconds taken for nanoseconds": _stamped(lambda k: k * STEP_NS // 1000),
    "one frame of another size in the middle": _none,
    "unit ten times too small": _unit(0.1),
    "unit ten times too large": _unit(10.0),
    "focal length 1.3 times too large": _focal(1.3),
    "asleep for 80 %": _asleep(0.8),
    "the camera is pushed by 25 px": _pushed,
    "the recording grows during the run": _none,
    "it disappears during the run": _none,
    "it is rewritten during the run": _none,
}


def odd() -> Tally:
    """Every odd recording once."""
    tally = Tally()
    scratch = Path(tempfile.mkdtemp(prefix="liex-odd-"))
    usual = plain()
    told: dict[str, Any] = {"plain": _measure(usual, "plain", scratch)}
    for name, make in ODD.items():
        told[name] = found = _measure(make(usual), name, scratch)
        tally.fault(
            name,
            found["seconds"] if found["code"] not in ENDED else 0.0,
            wrong=_wrong(found, told["plain"]["median_mm"]),
            traceback=found["traceback"],
            said=found["said"],
        )
    tally.more["recordings"] = told
    shutil.rmtree(scratch)
    return tally


def _measure(shown: Shown, name: str, scratch: Path) -> dict[str, Any]:
    """What `liex run` makes of it."""
    folder = scratch / "recording"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.rmtree(scratch / "out", ignore_errors=True)
    path = shown.write(folder)
    if "another size" in name:
        import cv2

        assert cv2.imwrite(str(folder / f"frame_{_AT_FRAME}.png"), shown.frames[0][::2, ::2])
    with _changed(folder, scratch / "out", name):
        ended = run("run", path, "--out", scratch / "out")
    found: dict[str, Any] = {
        "code": ended.code,
        "seconds": round(ended.seconds, 1),
        "traceback": ended.traceback,
        "said": ended.said.strip()[-600:],
        "n_frames": len(shown.frames),
    }
    for place in (scratch / "out").glob("*.liex"):
        session = Session.open(place)
        verdict = verdict_in(session.metadata)
        (one,) = read_individuals(session)
        sure = _errors_mm(one, shown.joints)
        found |= {
            "trusted": int(one.trusted.sum()),
            "animal": session.metadata["animal"]["name"],
            "median_mm": round(min(float(np.median(sure)), 999.0), 2) if len(sure) else None,
            "wrong_but_trusted": int((sure > _WRONG_MM).sum()),
            "sentence": verdict["sentence"],
            "notes": [*verdict["reasons"], *verdict["cautions"], *_odd_problems(session)],
        }
    return found


def _odd_problems(session: Session) -> list[str]:
    """The session's problems, without what is said of names of actions."""
    return [one for one in session.metadata["problems"] if "recogniser" not in one]


def _errors_mm(one: MeasuredIndividual, true: Array) -> Array:
    """Mean error of the joints in each frame that is trusted; infinite for another animal's."""
    if one.joints_camera.shape[1] != true.shape[1]:
        return np.full(int(one.trusted.sum()), np.inf)
    n = min(len(one.joints_camera), len(true))
    off = np.linalg.norm(one.joints_camera[:n] - true[:n], axis=2).mean(axis=1)
    return cast("Array", off[one.trusted[:n]])


def _wrong(found: dict[str, Any], plain_mm: float) -> str:
    """What is wrong with it, where nothing was said of it; "" where nothing is."""
    if found["code"] not in ENDED or (found["code"] and "notes" not in found):
        return "" if "liex:" in found["said"] else "it ended without a sentence"
    if "median_mm" not in found:
        return "it ended well without a session"
    told = bool(found["notes"])
    error = cast("float | None", found["median_mm"])
    if error is not None and error > _LIKE_PLAIN * plain_mm and not told:
        return f"{error} mm off, and nothing said"
    if found["wrong_but_trusted"] > _MOST_WRONG * found["n_frames"] and not told:
        return f"{found['wrong_but_trusted']} frames are wrong and trusted, and nothing said"
    if found["trusted"] < 0.5 * found["n_frames"] and not told:
        return f"{found['trusted']} frames are trusted, and nothing said"
    return ""


@contextmanager
def _changed(folder: Path, out: Path, name: str) -> Iterator[None]:
    """Something becomes of the recording when its frames begin to be measured."""

    def change() -> None:
        until = time.monotonic() + _LONGEST_S
        while not list(out.glob("*.part")) and time.monotonic() < until:
            time.sleep(0.05)
        pictures = sorted(folder.glob("*.png"))
        if "grows" in name:
            for k in range(10):
                shutil.copy(pictures[k], folder / f"frame_{len(pictures) + k}.png")
        elif "disappears" in name:
            shutil.rmtree(folder)
        elif "rewritten" in name:
            for one, other in zip(pictures, pictures[::-1], strict=True):
                one.write_bytes(other.read_bytes())

    changing = threading.Thread(target=change)
    if "during the run" in name:
        changing.start()
    try:
        yield
    finally:
        if changing.ident is not None:
            changing.join()
