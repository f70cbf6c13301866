"""The region of an arena in a recording's plan: find, check and save it.

In a study it may be in the study's file (for all recordings, an animal, an arena, or one recording)
or in a plan that it names; for a session outside of a study a plan is written next to it. A file is
edited in place, with all comments kept; its new content is first parsed as a run would, and the
file is replaced as a whole.
"""

import math
import re
import shlex
import shutil
import threading
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError, PlanError, StudyError, expecting, one_line
from liex_lab.optics.camera import Camera
from liex_lab.plan import Plan, known_plans, plan, sections
from liex_lab.plan.study import STUDY_FILE, PlannedSession, Study
from liex_lab.recordings.frame import region_mask
from liex_lab.runtime import durable, text_files
from liex_lab.scene import background, zones
from liex_lab.scene.floor import Floor
from liex_lab.sessions import Session, evidence

from .build import build_recording

Keys = tuple[str | int, ...]  # keys, and indices of tables in lists


def with_value(text: str, path: Keys, value: Any, origin: str = "the file") -> str:
    """A TOML text with one value changed, added or removed.

    Args:
        text: the text.
        path: keys, and indices from 0 of tables in lists, as in ("sessions", 2, "set", "arena",
            "region").
        value: a table, list, text, number or bool; None removes it.
        origin: names the file in errors.

    Raises:
        PlanError: the text is not TOML, or is written in a form that cannot be edited in place.
    """
    with expecting(
        PlanError,
        f"{origin} should be a TOML file",
        tomllib.TOMLDecodeError,
        RecursionError,
        advice="correct it",
    ):
        wanted = tomllib.loads(text)
    try:
        _set(wanted, path, value)
    except (IndexError, TypeError, AttributeError):
        table = ".".join(map(str, path[:-1]))
        raise PlanError(f"there is no table {table} to change") from None
    _drop_empty(wanted, path[:-1])
    for made in _candidates(text, path, value):
        with suppress(tomllib.TOMLDecodeError, RecursionError):
            found = tomllib.loads(made)
            _drop_empty(found, path[:-1])
            if found == wanted:
                return made
    dotted = ".".join(str(part) for part in path if isinstance(part, str))
    what = f"removing {dotted}" if value is None else f"{dotted} = {plan.toml_value(value)}"
    raise PlanError(
        f"{origin} is written in a way that cannot be changed without losing something of it; "
        f"change it by hand: {what}"
    )


def _set(table: Any, path: Keys, value: Any) -> None:
    """Set a value of a nested table in place; None removes it."""
    for part in path[:-1]:
        if isinstance(part, str) and part not in table:
            if value is None:
                return
            table[part] = {}
        table = table[part]
    if value is None:
        table.pop(path[-1], None)
        return
    # tomlkit assigns comments above the next header to the table before them
    body = getattr(getattr(table, "value", None), "body", [])
    trailing: list[Any] = []
    while path[-1] not in table and body and body[-1][0] is None:
        trailing.insert(0, body.pop())
    table[path[-1]] = value
    body.extend(trailing)


def _drop_empty(table: Any, path: Keys) -> None:
    """Remove empty tables along a path, as they state nothing."""
    if path and (isinstance(path[0], int) or path[0] in table):
        _drop_empty(table[path[0]], path[1:])
        if table[path[0]] == {} and isinstance(table, dict):
            del table[path[0]]


def _candidates(text: str, path: Keys, value: Any) -> Iterator[str]:
    """Texts that may state the value, smallest change first."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    spelled = None if value is None else plan.toml_value(value)
    if spelled is not None:  # `Plan.to_toml` writes `# key =` for an unset value
        header, key = (re.escape(name) for name in (".".join(map(str, path[:-1])), str(path[-1])))
        unset = rf"(^\[{header}\](?:(?!^\[).)*?^)# {key} =[ \t]*(?=\r?$)"
        stated = f"{path[-1]} = {spelled}"
        yield re.sub(unset, lambda found: found[1] + stated, text, count=1, flags=re.M | re.S)
    for clear in (False, True):  # a table in several lines is removed first
        with suppress(TOMLKitError, LookupError, TypeError, ValueError, AttributeError):
            document = tomlkit.parse(text)
            if clear:
                _set(document, path, None)
            _set(document, path, spelled and tomlkit.value(spelled))
            made = tomlkit.dumps(document)
            yield re.sub(r"(?<!\r)\n", "\r\n", made) if "\r\n" in text else made


_MOST_CORNERS = 200
_REGION = ("arena", "region")


@dataclass(frozen=True)
class Place:
    """A value that may state a region.

    Attributes:
        name: all, arena, animal, recording or beside.
        title: the recordings that the region applies to.
        file: the file; it may not exist yet.
        path: of the value in the file, see `with_value`.
        stated: the current value; None if absent.
    """

    name: str
    title: str
    file: Path
    path: tuple[str | int, ...]
    stated: Any = None


class StatedRegions:
    """The regions of a study's recordings, or of the sessions in a folder. Thread-safe.

    Args:
        place: a study's .toml file, or a folder with a study.toml or sessions in it.
    """

    def __init__(self, place: str | Path) -> None:
        path = Path(place)
        self._study = path if path.is_file() or (path / STUDY_FILE).is_file() else None
        self._lock = threading.Lock()
        self._usual: dict[str, tuple[NDArray[np.uint16], Camera]] = {}

    @property
    def of_recordings(self) -> bool:
        """Whether unmeasured recordings are included, as in a study."""
        return self._study is not None

    def about(self, key: str, session: Session | None) -> dict[str, Any]:
        """Facts about the region of a recording.

        Args:
            key: its name in the study.
            session: its results; None if it was not measured.

        Returns:
            places (name, title, file, stated), place (the name of the one that applies), region
            (corners, px; None if none is stated), message (why it cannot be displayed), recording
            (its name in commands), has_recording (whether its whole image is available), zones
            (name, part, corners of the zones drawn in pixels).

        Raises:
            LiexError: there is no such recording, or the study cannot be read.
        """
        places = self._places(key, session)
        counts = next((one for one in reversed(places) if one.stated is not None), places[0])
        corners, message = None, ""
        try:
            corners = self._shown(counts, session)
        except LiexError as error:
            message = str(error)
        return {
            "places": [
                {"name": one.name, "title": one.title, "file": one.file.name, "stated": one.stated}
                for one in places
            ],
            "place": counts.name,
            "region": corners,
            "message": message,
            "zones": [
                {"name": zone.name, "part": zone.part or "centre", "corners": zone.polygon}
                for zone in self._zones(key, session)[0]
                if zone.unit == "px" and zone.polygon
            ],
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
        """State or remove a region; returns a message on the change and the next command.

        Args:
            key: the recording's name in the study.
            session: its results; None if it was not measured.
            place: name of the `Place` to change.
            corners: (u, v) px; None removes the stated region.
            was: the value that the user was shown, to detect other changes.

        Raises:
            LiexError: the region is not valid, or the file cannot be changed.
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
            # valid for a run, for every recording that it applies to: all plans are resolved
            if self._study is not None and found.path != _REGION:
                _ = Study.from_table(text_files.parse_toml(text), found.file).sessions
            else:
                Plan.from_toml(text, found.file.name)
            try:
                with durable.replacing(found.file) as part:
                    part.write_bytes(text.encode("utf-8"))
                    if found.file.is_file():
                        shutil.copymode(found.file, part)
            except OSError as error:
                raise PlanError(
                    f"{found.file} cannot be written ({error.strerror or one_line(error)}); put "
                    "the lines below into it yourself, or free the place"
                ) from None
        done = "states this region" if value is not None else "states no region any more"
        return f"{found.file.name} {done}; measure again: {self._again(key, session, found)}"

    def _again(self, key: str, session: Session | None, place: Place) -> str:
        """The command that measures again what a place applies to."""
        if self._study is not None:
            return f"liex cohort {shlex.quote(str(self._study))}"
        return f"liex run {self._recording(key, session)} --plan {shlex.quote(str(place.file))}"

    def save_zone(
        self, key: str, session: Session | None, name: str, part: str, corners: Any
    ) -> str:
        """Add a zone to the file of zones, or replace or remove the one of its name.

        A file that does not exist is made, and stated as arena.zones for all recordings that share
        the plan. The other zones and comments of the file stay.

        Args:
            key: the recording's name in the study.
            session: its results; None if it was not measured.
            name: of the zone.
            part: of the animal that counts, see `scene.zones.Part`.
            corners: (u, v) px; None removes the zone.

        Returns:
            A message on the change and the next command.

        Raises:
            LiexError: the zone is not valid, or a file cannot be changed.
        """
        import tomlkit

        with self._lock:
            _, file, place = self._zones(key, session)
            if corners is not None:
                corners = self._checked(key, session, corners)
            text = text_files.decoded(file.read_bytes()) if file.is_file() else ""
            document = tomlkit.parse(text)
            drawn = document.setdefault("zones", tomlkit.aot())
            same = [k for k, one in enumerate(drawn) if one.get("name") == name]
            for k in reversed(same):
                del drawn[k]
            if corners is not None:
                part_of = {} if part == "centre" else {"part": part}
                zone = {"name": name, "unit": "px", "polygon": corners} | part_of
                drawn.append(tomlkit.item(zone))
            if any_left := len(drawn) > 0:
                zones.zones_of(text_files.parse_toml(tomlkit.dumps(document)), file.name)
            else:
                del document["zones"]
            stated = str(file.resolve() if self._study is None else file.name)
            plan_text = with_value(
                self._text(place, session),
                place.path,
                (place.stated or stated) if any_left else None,
                place.file.name,
            )
            for path, content in ((file, tomlkit.dumps(document)), (place.file, plan_text)):
                with durable.replacing(path) as new:
                    new.write_bytes(content.encode("utf-8"))
        done = "holds" if corners is not None else "no longer holds"
        again = self._again(key, session, place)
        return f"{file.name} {done} the zone {name}; measure again: {again}"

    def _zones(
        self, key: str, session: Session | None
    ) -> tuple[tuple[zones.DrawnZone, ...], Path, Place]:
        """The zones of a recording, their file, and the value that states it."""
        first = self._places(key, session)[0]
        of_arena = ("set", "arena") if first.name == "arena" else ()
        path = (*first.path[:-1], *of_arena, "zones")
        name = (
            f"{session.path.stem}.zones.toml" if self._study is None and session else "zones.toml"
        )
        stated = None
        with suppress(FileNotFoundError, PlanError):
            table = text_files.parse_toml(self._text(first, session))
            stated = text_files.value_at(table, path)
        place = replace(first, path=path, stated=stated)
        file = first.file.with_name(name) if stated is None else first.file.parent / str(stated)
        found = zones.read_zones(file) if stated is not None and file.is_file() else ()
        return found, file, place

    def depth_image(self, key: str) -> tuple[NDArray[np.uint16], Camera]:
        """The usual depth of every pixel of a study's recording, in the whole image.

        Returns:
            (H, W) uint16 mm, 0 where unread, and the camera.

        Raises:
            LiexError: the recording is not in a study, or cannot be read.
        """
        with self._lock:
            return self._usual_depth(key)

    def _usual_depth(self, key: str) -> tuple[NDArray[np.uint16], Camera]:

        planned = self._planned(key)[1]
        if key not in self._usual:
            whole = planned.plan.with_settings(["arena.region="])
            with build_recording(planned.recording, whole) as opened:
                # number of sampled frames for each pixel's usual depth
                sample = np.clip(np.rint(background.sample_frames(opened, 9)), 0, 65_535)
                self._usual = {
                    key: (background.usual_depth(sample.astype(np.uint16)), opened.camera)
                }
        return self._usual[key]

    def _planned(self, key: str) -> tuple[int, PlannedSession, Study]:
        if self._study is None:
            raise StudyError(f"{key} is of no study, so that only its session is shown")
        study = Study.load(self._study)
        for k, one in enumerate(study.sessions):
            if one.id == key:
                return k, one, study
        raise StudyError(f"the study has no recording {key}; load the page again")

    def _places(self, key: str, session: Session | None) -> list[Place]:
        """The values that may state the region; later ones override earlier ones."""
        if self._study is not None:
            k, planned, study = self._planned(key)
            return _of_study(k, planned, study)
        if session is None:
            raise StudyError(f"there is no session {key}")
        file = session.path.with_name(f"{session.path.stem}.plan.toml")
        stated = None
        with suppress(ValueError):
            stated = text_files.value_at(
                _table(file) if file.is_file() else text_files.parse_toml(session.plan), _REGION
            )
        return [Place("beside", "this recording, in a plan beside it", file, _REGION, stated)]

    def _shown(self, place: Place, session: Session | None) -> list[list[float]] | None:
        """The corners of the stated region, px; None if absent."""
        if place.stated is None:
            return None
        region = _region(place.stated)
        if region.unit == "px":
            return _plain(zones.region_corners_px(region))
        if session is None:
            raise PlanError(
                "a region is stated in millimetres on the floor; it can be shown once the "
                "recording is measured, and one that is drawn now replaces it"
            )
        normal = -np.asarray(session.T_arena_camera.rotation)[2]
        height_mm = float(session.T_arena_camera.translation[2])
        floor = Floor.from_plane(normal, height_mm, session.camera)
        return _plain(zones.region_corners_px(region, session.camera, floor))

    def _checked(
        self, key: str, session: Session | None, corners: Sequence[Any]
    ) -> list[list[float]]:
        """The rounded corners, if they form a region of the image; raises PlanError otherwise."""
        if not isinstance(corners, list) or len(corners) > _MOST_CORNERS:
            raise PlanError(f"a region is a list of at most {_MOST_CORNERS} corners [x, y]")
        region = _region(corners)
        camera = self._usual_depth(key)[1] if session is None else session.camera
        # raises an error if it is not valid
        region_mask(zones.region_corners_px(region), camera.width, camera.height)
        return [[round(float(value), 1) for value in corner] for corner in region.polygon or ()]

    def _text(self, place: Place, session: Session | None) -> str:
        try:
            return text_files.decoded(place.file.read_bytes())
        except FileNotFoundError:
            if session is not None and place.name == "beside":
                return session.plan
            raise PlanError(f"{place.file} is gone; load the page again") from None
        except (OSError, ValueError) as error:
            raise PlanError(f"{place.file} cannot be read ({one_line(error)})") from None

    def _recording(self, key: str, session: Session | None) -> str:
        """The recording's name in a command."""
        if self._study is not None:
            return shlex.quote(self._planned(key)[1].recording)
        linked = evidence.linked_recording(session) if session is not None else None
        return shlex.quote(linked) if linked else "RECORDING"


def _of_study(k: int, planned: PlannedSession, study: Study) -> list[Place]:
    table, at = study.table, text_files.value_at
    one = table.sessions[k]
    named = one.plan or table.plan
    where: tuple[str, Path, Keys, Any] = (
        "every recording of the study",
        study.path,
        ("set", *_REGION),
        at(table.set, _REGION),
    )
    if one.arena:
        j = [arena.name for arena in table.arenas].index(one.arena)
        where = (
            f"every recording in the arena {one.arena}",
            study.path,
            ("arenas", j, "region"),
            table.arenas[j].region.model_dump(exclude_none=True),
        )
    elif named not in known_plans() and where[-1] is None:
        file = study.inside(named, "plan")
        title = f"every recording that is measured by {file.name}"
        where = title, file, _REGION, at(_table(file), _REGION)
    places = [Place("arena" if one.arena else "all", *where)]
    stated = at(planned.animal.set, _REGION)
    if stated is not None:
        of_animal = ("animals", table.animals.index(planned.animal), "set", *_REGION)
        title = f"every recording of {planned.animal.id}"
        places.append(Place("animal", title, study.path, of_animal, stated))
    own = ("sessions", k, "set", *_REGION)
    return [*places, Place("recording", "this recording", study.path, own, at(one.set, _REGION))]


def _region(stated: Any) -> sections.Region:
    """A region as a plan parses it.

    Raises:
        PlanError: it is not valid.
    """
    region = Plan.from_table({"arena": {"region": stated}}, "the region").arena.region
    if region is None:
        raise PlanError("a region takes three or more corners [x, y]")
    return region


def _plain(corners: Any) -> list[list[float]]:
    return [[round(float(u), 1), round(float(v), 1)] for u, v in corners if math.isfinite(u + v)]


def _table(file: Path) -> dict[str, Any]:
    try:
        return text_files.read_toml(file)
    except (OSError, ValueError) as error:
        raise PlanError(f"{file.name} cannot be read as a plan ({one_line(error)})") from None
