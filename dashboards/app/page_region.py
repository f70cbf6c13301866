"""Depth images of a scene, and the routes of the page on which a region is drawn.

The page's script draws. It requests JSON and PNG images here, and what it saves is checked and
written by the owner of the plans (`Regions`).
"""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from flask import Response, request
from numpy.typing import NDArray

from liex_lab.errors import SessionError
from liex_lab.optics.camera import Camera
from liex_lab.scene.background import usual_depth
from liex_lab.sessions import Session

from ..figures.animals import DepthImages
from ..report.contact_sheet import png, png_uri, scene_marks, shade, svg_marks
from .data import StudyData


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


class Scenes:
    """Depth images and facts of scenes.

    Args:
        data: the study.
        images: the depth images.
        regions: reads and writes regions; None writes none.
    """

    def __init__(self, data: StudyData, images: DepthImages, regions: Regions | None) -> None:
        self._data = data
        self._images = images
        self._regions = regions

    def about(self, key: str) -> dict[str, Any]:
        """Facts for the page: image size, marks, and where a region can be saved.

        Raises:
            LiexError: there is no such recording, or it cannot be read.
        """
        session = self._session(key)
        facts: dict[str, Any] = {"may_save": self._regions is not None, "places": []}
        facts["region"] = None
        if self._regions is not None:
            facts |= self._regions.about(key, session)
        camera = self._whole(key)[1] if session is None else session.camera
        marks = [] if session is None else scene_marks(session)
        found = [
            {"kind": mark.kind, "said": mark.label, "points": mark.points_px.round(1).tolist()}
            for mark in marks
        ]
        size = {"width": camera.width, "height": camera.height}
        return {**facts, **size, "measured": session is not None, "marks": found}

    def save(self, key: str) -> Any:
        """Check and save the requested region; returns the page's new facts.

        The request is JSON with place, corners (px) and was.

        Raises:
            LiexError: the region is invalid, or cannot be saved.
        """
        asked = request.get_json(silent=True)  # another site's form cannot send JSON
        if self._regions is None or not isinstance(asked, dict):
            return {"said": "no region is saved here"}, 403 if self._regions is None else 400
        place = str(asked.get("place"))[:40]
        corners, was = asked.get("corners"), asked.get("was")
        report = self._regions.save(key, self._session(key), place, corners, was)
        self._data.refresh()
        return {**self.about(key), "saved": report}

    def image(self, key: str) -> Response:
        """PNG of the usual depth of a session; with ?of=recording, of its recording.

        Raises:
            LiexError: there is no such recording, or it cannot be read.
        """
        session = self._session(key)
        if session is None or request.args.get("of") == "recording":
            depth = self._whole(key)[0]
        else:
            depth = self._usual(session)
        return Response(png(_shaded(depth)), mimetype="image/png")

    def scene(self, key: str) -> Response:
        """SVG of the usual depth of a session with its scene.

        Raises:
            SessionError: there is no such session.
        """
        session = self._data.session(key)
        return Response(scene_svg(session, self._usual(session)), mimetype="image/svg+xml")

    def _session(self, key: str) -> Session | None:
        """The results of the recording `key`; None if absent."""
        if key not in self._data.entries:
            raise SessionError(f"there is no recording '{key}'; see the list of sessions")
        return self._data.session(key) if key in {one.key for one in self._data.done} else None

    def _usual(self, session: Session) -> NDArray[np.uint16]:
        """(H, W) uint16 mm: the usual depth of the session's frames."""
        n = len(session.frames)
        # at most nine frames, for each pixel's usual depth
        rows = np.unique(np.linspace(0, n - 1, min(n, 9)).astype(int))
        depths = [self._images.depth(session, int(row)) for row in rows]
        empty = np.zeros((session.camera.height, session.camera.width), np.uint16)
        return usual_depth(np.stack([one for one in depths if one is not None] or [empty]))

    def _whole(self, key: str) -> tuple[NDArray[np.uint16], Camera]:
        if self._regions is None:
            raise SessionError(f"{key} was not measured yet, so there is no image of it")
        return self._regions.picture(key)


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
    return shade(depth, max(reach, 60.0))  # the least range, mm
