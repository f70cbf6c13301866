"""The region of an arena as the plan of a recording states it: found, checked and saved there.

Of a study it may stand in the study's file (of all recordings, of an animal, of an arena, of one
recording) or in a plan that it names; of a session outside of a study a plan is written beside it.
A file is changed in place, with every comment kept (`liex_lab.plan.editing`), after all that it
would say was read as a run reads it, and is put in place whole.
"""

from __future__ import annotations

import math
import shlex
import shutil
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.errors import LiexError, PlanError, StudyError, one_line
from liex_lab.plan import Plan, known_plans
from liex_lab.plan.editing import with_value
from liex_lab.plan.study import STUDY_FILE, PlannedSession, Study
from liex_lab.runtime.text_files import decoded, parse_toml, read_toml

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from liex_lab.optics.camera import Camera
    from liex_lab.plan.sections import Region
    from liex_lab.sessions import Session

_MOST_CORNERS = 200
_REGION = ("arena", "region")
_N_PICTURES = 9  # of which each pixel's usual depth is shown


@dataclass(frozen=True)
class Place:
    """Where a region may stand.

    Attributes:
        name: all, arena, animal, recording or beside.
        title: whose region it is.
        file: the file; it need not be there.
        path: of the value in the file, see `editing.with_value`.
        stated: what stands there now; None where nothing does.
    """

    name: str
    title: str
    file: Path
    path: tuple[str | int, ...]
    stated: Any = None


class StatedRegions:
    """The regions of a study's recordings, or of the sessions in a folder.

    It may be used from several threads at once.

    Args:
        place: a study's .toml file, or a folder with a study.toml or sessions in it.
    """

    def __init__(self, place: str | Path) -> None:
        path = Path(place)
        self._study = path if path.is_file() or (path / STUDY_FILE).is_file() else None
        self._lock = threading.Lock()
        self._seen: dict[str, tuple[NDArray[np.uint16], Camera]] = {}

    @property
    def of_recordings(self) -> bool:
        """Whether recordings are known that were not measured: those of a study."""
        return self._study is not None

    def about(self, key: str, session: Session | None) -> dict[str, Any]:
        """What is told of the region of a recording.

        Args:
            key: its name in the study.
            session: its results; None where it was not measured.

        Returns:
            places (name, title, file, stated), place (the name of the one that counts), region
            (corners, px; None where none is stated), said (why it cannot be shown), recording (as
            commands name it), has_recording (whether its whole picture can be asked for).

        Raises:
            LiexError: there is no such recording, or the study cannot be read.
        """
        places = self._places(key, session)
        counts = next((one for one in reversed(places) if one.stated is not None), places[0])
        corners, said = None, ""
        try:
            corners = self._shown(counts, session)
        except LiexError as error:
            said = str(error)
        return {
            "places": [
                {"name": one.name, "title": one.title, "file": one.file.name, "stated": one.stated}
                for one in places
            ],
            "place": counts.name,
            "region": corners,
            "said": said,
            "recording": self._recording(key, session),
            "has_recording": self._study is not None and self._planned(key)[1].recording_exists,
        }

    def save(
        self,
        key: str,
        session: Session | None,
        place: str,
        corners: Sequence[Any] | None,
        was: Any,
    ) -> str:
        """State a region, or take it out; returns what was done and what to do next.

        Args:
            key: the recording's name in the study.
            session: its results; None where it was not measured.
            place: the name of the place.
            corners: (u, v) px; None takes out what is stated.
            was: what the person saw stated there.

        Raises:
            LiexError: the region is none, or the file cannot be changed.
        """
        with self._lock:
            places = self._places(key, session)
            found = next((one for one in places if one.name == place), None)
            if found is None:
                raise PlanError(f"there is no place '{place}' for the region of {key}")
            if found.stated != was:
                raise PlanError(
                    f"{found.file.name} was changed since this page was opened; load it again"
                )
            above = [one for one in places[places.index(found) + 1 :] if one.stated is not None]
            if above and corners is not None:
                raise PlanError(
                    f"{above[-1].file.name} states a region for {above[-1].title}, which would go "
                    "before this one; save it there, or take that one out first"
                )
            value = None if corners is None else self._checked(key, session, corners)
            text = with_value(self._text(found, session), found.path, value, found.file.name)
            self._check(found, text)
            _write(found.file, text)
        done = "states this region" if value is not None else "states no region any more"
        return f"{found.file.name} {done}; measure again: {self._next(key, session, found)}"

    def picture(self, key: str) -> tuple[NDArray[np.uint16], Camera]:
        """The usual depth of every pixel of a study's recording, in the whole picture.

        Args:
            key: the recording's name in the study.

        Returns:
            (H, W) uint16 mm, 0 where unread, and the camera.

        Raises:
            LiexError: it is no study's, or it cannot be read.
        """
        with self._lock:
            return self._seen_whole(key)

    def _seen_whole(self, key: str) -> tuple[NDArray[np.uint16], Camera]:
        from .build import build_recording

        planned = self._planned(key)[1]
        if key not in self._seen:
            whole = planned.plan.with_settings(["arena.region="])
            with build_recording(planned.recording, whole) as opened:
                self._seen = {key: (_usual(opened), opened.camera)}
        return self._seen[key]

    def _planned(self, key: str) -> tuple[int, PlannedSession, Study]:
        if self._study is None:
            raise StudyError(f"{key} is of no study, so that only its session is shown")
        study = Study.load(self._study)
        for k, one in enumerate(study.sessions):
            if one.id == key:
                return k, one, study
        raise StudyError(f"the study has no recording {key}; load the page again")

    def _places(self, key: str, session: Session | None) -> list[Place]:
        """Where the region may stand; a later one goes before an earlier one."""
        if self._study is not None:
            k, planned, study = self._planned(key)
            return _of_study(k, planned, study)
        if session is None:
            raise StudyError(f"there is no session {key}")
        file = session.path.with_name(f"{session.path.stem}.plan.toml")
        stated = None
        if file.is_file():
            stated = _at(_table(file), _REGION)
        else:
            try:
                stated = _at(parse_toml(session.plan), _REGION)
            except ValueError:
                stated = None
        return [Place("beside", "this recording, in a plan beside it", file, _REGION, stated)]

    def _shown(self, place: Place, session: Session | None) -> list[list[float]] | None:
        """The corners of what is stated, px."""
        from liex_lab.scene.floor import Floor
        from liex_lab.scene.region import region_corners_px

        if place.stated is None:
            return None
        region = _region(place.stated)
        if session is not None:
            normal = -np.asarray(session.T_arena_camera.rotation)[2]
            height_mm = float(session.T_arena_camera.translation[2])
            floor = Floor.from_plane(normal, height_mm, session.camera)
            return _plain(region_corners_px(region, session.camera, floor))
        if region.unit == "mm":
            raise PlanError(
                "a region is stated in millimetres on the floor; it can be shown once the "
                "recording is measured, and one that is drawn now replaces it"
            )
        return _plain(_px(region))

    def _checked(
        self, key: str, session: Session | None, corners: Sequence[Any]
    ) -> list[list[float]]:
        """The corners as they are written, if they are a region of the picture."""
        from liex_lab.recordings.frame import region_mask
        from liex_lab.scene.region import region_corners_px

        if not isinstance(corners, list) or len(corners) > _MOST_CORNERS:
            raise PlanError(f"a region is a list of at most {_MOST_CORNERS} corners [x, y]")
        region = _region(corners)
        camera = self._seen_whole(key)[1] if session is None else session.camera
        # says what is wrong where it is none
        region_mask(region_corners_px(region, camera, None), camera.width, camera.height)
        return [[round(float(value), 1) for value in corner] for corner in region.polygon or ()]

    def _text(self, place: Place, session: Session | None) -> str:
        try:
            return decoded(place.file.read_bytes())
        except FileNotFoundError:
            if session is not None and place.name == "beside":
                return session.plan
            raise PlanError(f"{place.file} is gone; load the page again") from None
        except (OSError, ValueError) as error:
            raise PlanError(f"{place.file} cannot be read ({one_line(error)})") from None

    def _check(self, place: Place, text: str) -> None:
        """Whether the file says what a run can take, for every recording that it is of."""
        if self._study is not None and place.path != _REGION:
            _ = Study.from_table(parse_toml(text), place.file).sessions  # every plan resolved
        else:
            Plan.from_toml(text, place.file.name)

    def _recording(self, key: str, session: Session | None) -> str:
        """The recording as a command names it."""
        from liex_lab.sessions.evidence import linked_recording

        if self._study is not None:
            return shlex.quote(self._planned(key)[1].recording)
        linked = linked_recording(session) if session is not None else None
        return shlex.quote(linked) if linked else "RECORDING"

    def _next(self, key: str, session: Session | None, place: Place) -> str:
        if self._study is not None:
            return f"liex cohort {shlex.quote(str(self._study))}"
        recording = self._recording(key, session)
        return f"liex run {recording} --plan {shlex.quote(str(place.file))}"


def _of_study(k: int, planned: PlannedSession, study: Study) -> list[Place]:
    table = study.table
    one = table.sessions[k]
    named = one.plan or table.plan
    arenas = [arena.name for arena in table.arenas]
    places = []
    if one.arena:
        j = arenas.index(one.arena)
        stated = table.arenas[j].region.model_dump(exclude_none=True)
        title = f"every recording in the arena {one.arena}"
        places.append(Place("arena", title, study.path, ("arenas", j, "region"), stated))
    elif named in known_plans() or _at(table.set, _REGION) is not None:
        path: tuple[str | int, ...] = ("set", *_REGION)
        title = "every recording of the study"
        places.append(Place("all", title, study.path, path, _at(table.set, _REGION)))
    else:
        file = study.inside(named, "plan")
        title = f"every recording that is measured by {file.name}"
        places.append(Place("all", title, file, _REGION, _at(_table(file), _REGION)))
    stated = _at(planned.animal.set, _REGION)
    if stated is not None:
        m = table.animals.index(planned.animal)
        title = f"every recording of {planned.animal.id}"
        places.append(Place("animal", title, study.path, ("animals", m, "set", *_REGION), stated))
    own = ("sessions", k, "set", *_REGION)
    places.append(Place("recording", "this recording", study.path, own, _at(one.set, _REGION)))
    return places


def _region(stated: Any) -> Region:
    """A region as a plan has it.

    Raises:
        PlanError: it is none.
    """
    region = Plan.from_table({"arena": {"region": stated}}, "the region").arena.region
    if region is None:
        raise PlanError("a region takes three or more corners [x, y]")
    return region


def _px(region: Region) -> Any:
    from liex_lab.optics.camera import Camera
    from liex_lab.scene.region import region_corners_px

    return region_corners_px(region, Camera(1.0, 1.0, 0.0, 0.0, 1, 1), None)


def _plain(corners: Any) -> list[list[float]]:
    return [[round(float(u), 1), round(float(v), 1)] for u, v in corners if math.isfinite(u + v)]


def _at(table: Any, path: Sequence[str]) -> Any:
    for part in path:
        table = table.get(part) if isinstance(table, dict) else None
    return table


def _table(file: Path) -> dict[str, Any]:
    try:
        return read_toml(file)
    except (OSError, ValueError) as error:
        raise PlanError(f"{file.name} cannot be read as a plan ({one_line(error)})") from None


def _usual(recording: Any) -> NDArray[np.uint16]:
    """Each pixel's median over frames of a whole recording, of those that read it."""
    from liex_lab.scene.background import sample_frames, usual_depth

    sample = sample_frames(recording, _N_PICTURES)
    return usual_depth(np.clip(np.rint(sample), 0, 65_535).astype(np.uint16))


def _write(file: Path, text: str) -> None:
    """Put the file in place whole, with the rights that it has.

    Raises:
        PlanError: it cannot be.
    """
    from liex_lab.runtime.durable import replacing

    try:
        with replacing(file) as part:
            part.write_bytes(text.encode("utf-8"))
            if file.is_file():
                shutil.copymode(file, part)
    except OSError as error:
        raise PlanError(
            f"{file} cannot be written ({error.strerror or one_line(error)}); put the lines below "
            "into it yourself, or free the place"
        ) from None
