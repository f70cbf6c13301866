"""Depth images of a scene, and the routes of the page on which a region is drawn.

The page's script draws. It requests JSON and PNG images here, and what it saves is checked and
written by the owner of the plans (`Regions`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from flask import Flask, Response, jsonify, request
from numpy.typing import NDArray

from liex_lab.errors import LiexError, PlanError, SessionError
from liex_lab.scene.background import usual_depth
from liex_lab.sessions import Session

from ..report.contact_sheet import Mark, png_uri, scene_marks, shade, svg_marks
from .data import StudyData
from .frames import Frames

if TYPE_CHECKING:
    from liex_lab.optics.camera import Camera

_N_PICTURES = 9  # the frames from which each pixel's usual depth is computed
_LEAST_REACH_MM = 60.0


class Regions(Protocol):
    """Reads and writes the regions of recordings."""

    @property
    def of_recordings(self) -> bool:
        """Whether recordings without results are available."""

    def about(self, key: str, session: Session | None) -> dict[str, Any]:
        """Facts about the region of the recording `key`, whose results are `session`."""

    def save(
        self,
        key: str,
        session: Session | None,
        place: str,
        corners: Sequence[Any] | None,
        was: Any,
    ) -> str:
        """Save a region of `corners` (px) for the recording `key` in `place`; it contained
        `was`.
        """

    def picture(self, key: str) -> tuple[NDArray[np.uint16], Camera]:
        """The usual depth (mm) of every pixel of the recording `key`, and its camera."""


class _Scenes:
    """Depth images and facts of scenes."""

    def __init__(self, data: StudyData, frames: Frames, regions: Regions | None) -> None:
        self._data = data
        self._frames = frames
        self._regions = regions

    def session(self, key: str) -> Session | None:
        """The results of the recording `key`; None if absent."""
        if key not in self._data.entries:
            raise SessionError(f"there is no recording '{key}'; see the list of sessions")
        return self._data.session(key) if key in {one.key for one in self._data.done} else None

    def about(self, key: str) -> dict[str, Any]:
        """Facts for the page: image size, marks, and where a region can be saved."""
        session = self.session(key)
        told: dict[str, Any] = {"may_save": self._regions is not None, "places": [], "region": None}
        if self._regions is not None:
            told |= self._regions.about(key, session)
        if session is None:
            _, camera = self._whole(key)
            marks: list[Mark] = []
        else:
            camera = session.camera
            marks = scene_marks(session)
        found = [{"kind": one.kind, "said": one.said, "points": _rounded(one)} for one in marks]
        size = {"width": camera.width, "height": camera.height}
        return {**told, **size, "measured": session is not None, "marks": found}

    def save(self, key: str, asked: dict[str, Any]) -> dict[str, Any]:
        """Check and save the requested region; returns the page's new facts."""
        if self._regions is None:
            raise PlanError("no region is saved here")
        corners = asked.get("corners")
        place = str(asked.get("place"))[:40]
        session = self.session(key)
        said = self._regions.save(key, session, place, corners, asked.get("was"))
        self._data.refresh()
        return {**self.about(key), "saved": said}

    def picture(self, key: str, of: str) -> NDArray[np.uint16]:
        """(H, W) uint16 mm: the usual depth of the session, or of its recording."""
        session = self.session(key)
        return self._whole(key)[0] if session is None or of == "recording" else self.usual(key)

    def usual(self, key: str) -> NDArray[np.uint16]:
        """(H, W) uint16 mm: the usual depth of the session's frames."""
        session = self._data.session(key)
        n = len(session.frames)
        rows = np.unique(np.linspace(0, n - 1, min(n, _N_PICTURES)).astype(int))
        found = [self._frames.depth(key, session, int(row)) for row in rows]
        kept = [one for one in found if one is not None]
        camera = session.camera
        return usual_depth(
            np.stack(kept) if kept else np.zeros((1, camera.height, camera.width), np.uint16)
        )

    def _whole(self, key: str) -> tuple[NDArray[np.uint16], Any]:
        if self._regions is None:
            raise SessionError(f"{key} was not measured yet, so there is no picture of it")
        return self._regions.picture(key)


def add_scenes(server: Flask, data: StudyData, frames: Frames, regions: Regions | None) -> None:
    """Add the routes of scenes and regions; they are protected by the server's guard.

    Without `regions`, no region can be saved.
    """
    scenes = _Scenes(data, frames, regions)

    def told(make: Callable[[], Any]) -> Response:
        """JSON of the result of `make`, or status 400 with a message."""
        try:
            return jsonify(make())
        except LiexError as error:
            answer = jsonify({"said": str(error)})
            answer.status_code = 400
            return answer

    def drawn(make: Callable[[], str | bytes], kind: str) -> Response:
        """The image that `make` returns, or status 400 with a message."""
        try:
            return Response(make(), mimetype=kind)
        except LiexError as error:
            return Response(str(error), 400, mimetype="text/plain")

    @server.get("/region/<path:key>/about")
    def region_about(key: str) -> Response:
        """Facts about the recording `key`."""
        return told(lambda: scenes.about(key))

    @server.get("/region/<path:key>/picture.png")
    def region_picture(key: str) -> Response:
        """The whole depth image of `key`; with ?of=recording, the depth image of its recording."""
        of = request.args.get("of", "")
        return drawn(lambda: _png(scenes.picture(key, of)), "image/png")

    @server.get("/region/<path:key>/scene.svg")
    def region_scene(key: str) -> Response:
        """The depth image of the session `key` with its scene."""
        return drawn(lambda: scene_svg(data.session(key), scenes.usual(key)), "image/svg+xml")

    @server.post("/region/<path:key>/save")
    def region_save(key: str) -> Response:
        """Save a region of the recording `key`: JSON with place, corners (px) and was."""
        asked = request.get_json(silent=True)  # another site's form cannot send JSON
        if regions is None or not isinstance(asked, dict):
            answer = jsonify({"said": "no region is saved here"})
            answer.status_code = 403 if regions is None else 400
            return answer
        return told(lambda: scenes.save(key, asked))


def scene_svg(session: Session, depth: NDArray[np.uint16]) -> str:
    """The whole depth image of a session with its scene drawn over it.

    Args:
        session: the opened session.
        depth: (H, W) uint16 mm, 0 where unread.
    """
    h, w = depth.shape
    marks = svg_marks(scene_marks(session), 0, 0, w, h, w / 200.0)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {w} {h}" width="{w}" height="{h}">'
        f'<image href="{png_uri(_shaded(depth))}" width="{w}" height="{h}"/>{marks}</svg>'
    )


def _shaded(depth: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Colours over the full depth range of an image, including walls and rims."""
    read = depth[depth > 0]
    reach = float(np.ptp(np.percentile(read, [3.0, 95.0]))) if len(read) else 0.0
    return shade(depth, max(reach, _LEAST_REACH_MM))


def _png(depth: NDArray[np.uint16]) -> bytes:
    import cv2

    done, png = cv2.imencode(".png", np.ascontiguousarray(_shaded(depth)[..., ::-1]))
    if not done:
        raise SessionError("the picture cannot be made")
    return bytes(png)


def _rounded(mark: Mark) -> list[list[float]]:
    return [[round(float(u), 1), round(float(v), 1)] for u, v in mark.points_px]
