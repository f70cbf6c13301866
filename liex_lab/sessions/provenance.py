"""Provenance record of a session: recording, camera, animal, plan, software versions.

It is the part of session.json that is known before the first frame, and the metadata of every
Parquet file. Hashes are the first 16 hexadecimal digits of SHA-256 over sorted JSON.
"""

import hashlib
import json
import platform
import re
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError, SessionError, one_line, refuse
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.plan import Plan
from liex_lab.plan.sections import Factor, Period, SubjectFacts
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.timestamps import Gap
from liex_lab.runtime.durable import storable
from liex_lab.scene.floor import Floor
from liex_lab.scene.scene import UNKNOWN, Arena, Scene
from liex_lab.scene.zones import Zone

SCHEMA_VERSION = 8
_PACKAGES = (
    "liex_lab",
    "numpy",
    "scipy",
    "numba",
    "scikit-learn",
    "pandas",
    "pyarrow",
    "opencv-python-headless",
    "rerun-sdk",
    "mcap",
    "foxglove-sdk",
)


@dataclass(frozen=True)
class Provenance:
    """Facts about a recording and its measurement, known before the first frame is written.

    Attributes:
        name: the session's id.
        skeleton: the fitted skeleton.
        camera: the depth camera; the ideal one if lens or water were corrected.
        T_arena_camera: transform from the camera frame (mm) to the arena frame.
        floor_distance_mm: distance of the camera from the floor, mm.
        input_sha256: SHA-256 of the recording's bytes.
        plan_toml: the resolved plan, TOML text.
        format: the recording's format.
        profile: interpretation of the stored numbers, if a profile states it.
        measured: (n,) numbers of each frame that another program measured, by name.
        individual: the animal's name in the session.
        n_frames: expected number of frames; None if unknown.
        gaps: frames that the camera did not deliver, and moved timestamps.
        problems: sentences about the recording.
        truncated: whether the recording ends in the middle of a frame.
        subject: any of subject_id, group, cage, sex, batch, species and age (ISO 8601).
        session_start_time: ISO 8601 with time zone; empty if unknown.
        model: name and sha256 of the pose model.
        animal_size: spine_mm, its origin, and girth relative to the usual one for that length.
        optics: corrections of lens and water.
        arena: the shape of the floor.
        zones: the zones drawn on it.
        scene: floor, region, fixtures and number of moving animals; None if there is no floor.
        replay_depth: extent of the depth in the replay: 'animal', 'arena', 'all' or 'none'.
        replay_candidates: whether the replay includes every hypothesis of single frames.
        background: (H, W) uint16 mm, the still scene behind cut-outs; None if whole images are
            kept, or none.
    """

    name: str
    skeleton: Skeleton
    camera: Camera
    T_arena_camera: SE3
    floor_distance_mm: float
    input_sha256: str
    plan_toml: str = ""
    format: str = ""
    profile: dict[str, Any] = field(default_factory=dict)
    individual: str = "animal_1"
    n_frames: int | None = None
    gaps: Sequence[Gap] = ()
    problems: Sequence[str] = ()
    truncated: bool = False
    subject: dict[str, str] = field(default_factory=dict)
    session_start_time: str = ""
    model: dict[str, str] = field(default_factory=dict)
    animal_size: dict[str, Any] = field(default_factory=dict)
    optics: dict[str, Any] = field(default_factory=dict)
    arena: Arena = UNKNOWN
    zones: Sequence[Zone] = ()
    scene: Scene | None = None
    replay_depth: str = "all"
    replay_candidates: bool = False
    background: NDArray[np.uint16] | None = field(default=None, compare=False)
    measured: dict[str, NDArray[np.float64]] = field(default_factory=dict, compare=False)

    @staticmethod
    def of(
        recording: Recording, floor: Floor, skeleton: Skeleton, plan: Plan, **more: Any
    ) -> "Provenance":
        """Provenance of a recording, its floor and the plan.

        Args:
            recording: the open recording.
            floor: the floor found in it.
            skeleton: the fitted skeleton.
            plan: all settings of the run; its values override those in the recording.
            **more: further fields, or replacements for these.
        """
        entries = recording.metadata
        stated = plan.session
        subject = stated.model_dump(include=set(SubjectFacts.model_fields))
        subject["subject_id"] = stated.subject_id or entries.get("subject_id")
        known: dict[str, Any] = {
            "name": storable(stated.name or recording.name),
            "skeleton": skeleton,
            "camera": recording.camera,
            "T_arena_camera": floor.T_arena_camera,
            "floor_distance_mm": floor.distance_mm,
            "input_sha256": recording.digest(),
            "plan_toml": plan.to_toml(),
            "format": recording.format,
            "profile": dict(entries.get("profile", {})),
            "measured": recording.measurements,
            "individual": stated.individual,
            "n_frames": len(recording),
            "gaps": [*recording.gaps, *recording.faults],
            "problems": [storable(problem) for problem in recording.problems],
            "truncated": recording.truncated,
            "subject": {name: storable(str(value)) for name, value in subject.items() if value},
            "session_start_time": stated.session_start_time
            or entries.get("session_start_time")
            or "",
            "optics": recording.optics,
            "replay_depth": plan.replay.depth,
            "replay_candidates": plan.replay.candidates,
        }
        return Provenance(**{**known, **more})

    @property
    def calibration_hash(self) -> str:
        """Hash of the camera's parameters, its pose in the arena and its optical corrections."""
        place = {**self.camera.to_dict(), "T_arena_camera": self.T_arena_camera.matrix.tolist()}
        return _hash({**place, "optics": self.optics} if self.optics else place)

    @property
    def recording_id(self) -> str:
        """Id of the replay, equal for the same recording, plan and model.

        Rerun merges files with equal ids.
        """
        return f"{self.name}-{_hash([self.input_sha256, self.plan_toml, self.model])}"

    def table_metadata(self) -> dict[str, Any]:
        """Metadata of every Parquet file, besides its columns."""
        return {
            "version": package_version("liex_lab"),
            "schema_version": SCHEMA_VERSION,
            "calibration_hash": self.calibration_hash,
            "model_hash": self.model.get("sha256", ""),
            "axes": (
                "arena: x, y on the floor, z up from it; origin at the foot of the camera's "
                "perpendicular; mm"
            ),
            "joints": "on the body's mid-axis",
        }

    def document(self) -> dict[str, Any]:
        """The part of session.json that is known before the first frame."""
        return {
            "schema_version": SCHEMA_VERSION,
            "session_id": self.name,
            "individual": self.individual,
            "subject": dict(self.subject),
            "session_start_time": self.session_start_time or None,
            "versions": versions(),
            "input": {
                "name": self.name,
                "format": self.format,
                "sha256": self.input_sha256,
                "truncated": self.truncated,
                **({"profile": self.profile} if self.profile else {}),
            },
            "plan": tomllib.loads(self.plan_toml),
            "camera": {
                **self.camera.to_dict(),
                "T_arena_camera": self.T_arena_camera.matrix.tolist(),
                "floor_distance_mm": float(self.floor_distance_mm),
                "calibration_hash": self.calibration_hash,
                "optics": self.optics,
            },
            "arena": self.arena.to_dict(),
            "zones": [zone.to_dict() for zone in self.zones],
            **({} if self.scene is None else {"scene": self.scene.to_dict()}),
            "animal": {
                "name": self.skeleton.name,
                "joints": list(self.skeleton.names),
                "bones": [list(edge) for edge in self.skeleton.edges],
                "home_length_mm": self.skeleton.length,
                **self.animal_size,
            },
            "model": dict(self.model),
            "problems": list(self.problems),
        }


@cache
def package_version(name: str) -> str:
    """Installed version of a package, or 'unknown' if it runs from a plain folder.

    Args:
        name: the package's name in pip.
    """
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, by name."""
    return {
        "python": platform.python_version(),
        **{name: package_version(name) for name in _PACKAGES},
    }


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


# Schema of session.json: guarantees for every part of the program once a session is open.


THUMBNAILS = "thumbnails"  # folder of a session
_MOST_BYTES = 1 << 28
_MOST_FRAMES = 1 << 31
_MOST_PX = 1 << 15


Name = Annotated[str, Field(max_length=4096)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=_MOST_FRAMES)]
Focal = Annotated[float, Field(gt=1e-3, lt=1e7)]
Size = Annotated[int, Field(gt=0, le=_MOST_PX)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True)


class _Input(_Section):
    name: Name
    format: str
    sha256: str
    truncated: bool
    profile: dict[str, Any] = {}


class _Camera(_Section):
    fx: Focal
    fy: Focal
    cx: Finite
    cy: Finite
    width: Size
    height: Size
    source: str
    T_arena_camera: list[list[Finite]]
    floor_distance_mm: Finite
    optics: dict[str, Any] | None = None


class _Shape(_Section):
    kept: bool
    n_frames: Count
    average_residual_mm: Finite | None = None
    residual_mm: Finite | None = None
    why: str = ""
    shared_by: str = ""
    unlike: bool = False
    places: list[Finite] = []
    width: list[Factor] = []
    width_sd: list[Finite] = []
    height: list[Factor] = []
    height_sd: list[Finite] = []
    joints_moved: list[Annotated[list[Finite], Field(min_length=3, max_length=3)]] = []

    @model_validator(mode="after")
    def _fit(self) -> "_Shape":
        columns = (self.width, self.width_sd, self.height, self.height_sd)
        known = self.residual_mm is not None and self.average_residual_mm is not None
        refuse(
            ValueError,
            (
                any(len(column) != len(self.places) for column in columns),
                f"has not as many widths and heights as its {len(self.places)} places",
            ),
            (
                self.kept and not ((known or self.shared_by) and self.places and self.joints_moved),
                "is kept, but its residuals or its places are missing",
            ),
        )
        return self


class _Animal(_Section):
    name: Name
    joints: Annotated[list[Name], Field(min_length=1, max_length=1000)]
    bones: list[Annotated[list[int], Field(min_length=2, max_length=2)]]
    home_length_mm: Finite
    spine_mm: Finite | None = None
    origin: str | None = None
    shape: _Shape | None = None

    @model_validator(mode="after")
    def _fit(self) -> "_Animal":
        n = len(self.joints)
        refuse(
            ValueError,
            (len(set(self.joints)) != n, "names a joint twice"),
            (
                any(not 0 <= joint < n for bone in self.bones for joint in bone),
                f"has a bone between joints that do not exist, it has {n}",
            ),
        )
        return self


class _Model(_Section):
    name: str = ""
    sha256: str = ""


class _Thumbnail(_Section):
    file: str
    frame_index: int
    left_px: int
    top_px: int
    width_px: Size
    height_px: Size

    @model_validator(mode="after")
    def _stay(self) -> "_Thumbnail":
        if PurePosixPath(self.file).parts[:-1] != (THUMBNAILS,):
            raise ValueError("is an image outside of the session")
        return self


class _WholeImage(_Thumbnail):
    beside_px: Annotated[list[Finite], Field(min_length=2, max_length=2)]


class _FrameCounts(_Section):
    n_frames: Count
    n_observed: Count
    flags: dict[str, Count]
    n_missing: Annotated[int, Field(ge=0)]
    n_gaps: Count
    duration_s: Finite
    observed_s: Finite
    fps_median: Finite | None


class _Refusal(_Section):
    action: str
    start_s: Finite
    stop_s: Finite
    named: str | None
    why: str


class _Refusals(_Section):
    bouts: list[_Refusal] = []


class _Recogniser(_Section):
    sha256: str = ""
    labels: str = ""
    n_recordings: Count = 0
    clock_hz: Finite | None = None


class _HandMade(_Section):
    n: Count = 0
    authors: list[str] = []


class _Verdict(_Section):
    look_at_it: bool = False
    accepted: bool = False
    reasons: list[str] = []
    cautions: list[str] = []
    sentence: str = ""


class _Facts(_Section):
    bytes: Annotated[int, Field(ge=0)]
    sha256: str = ""


class Document(_Section):
    """The sections of session.json that are read, with their types."""

    schema_version: Annotated[int, Field(ge=1)]
    session_id: Name
    individual: Name
    subject: dict[str, str]
    session_start_time: str | None
    versions: dict[str, str | None]
    input: _Input
    plan: dict[str, Any]
    camera: _Camera
    arena: dict[str, Any] | None = None
    zones: list[dict[str, Any]] = []
    animal: _Animal
    model: _Model
    problems: list[str]
    actions: dict[str, str] = {}
    rules: dict[str, Finite | list[Period]] | None = None
    no_actions: str = ""
    thumbnails: list[_Thumbnail] = []
    whole_picture: _WholeImage | None = None
    files: dict[str, _Facts] = {}
    frames: _FrameCounts
    depth_unit_mm: Finite = 1.0
    timings_s: dict[str, Finite]
    frames_per_s: Finite
    peak_memory_mb: Finite | None = None
    interruptions: Count = 0
    action_model: _Recogniser | None = None
    unresolved_actions: dict[str, str] | None = None
    refused_bouts: _Refusals | None = None
    corrections: _HandMade | None = None
    verdict: _Verdict | None = None


def read_document(path: Path) -> dict[str, Any]:
    """Read and validate a session.json.

    Args:
        path: the file.

    Returns:
        Its content, unchanged, if it satisfies `Document`.

    Raises:
        SessionError: it is damaged, or was written by a newer version.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"it is larger than {_MOST_BYTES >> 20} MB")
        text = path.read_text(encoding="utf-8")
        found = json.loads(text, parse_constant=_no_number)
        if not isinstance(found, dict):
            raise TypeError("a JSON object is expected")
        version = found.get("schema_version")
        if isinstance(version, int) and version > SCHEMA_VERSION:
            raise SessionError(
                f"{path.parent} was written by a newer liex_lab (session schema {version}, this "
                f"one reads up to {SCHEMA_VERSION}); upgrade with `pip install -U liex_lab`"
            )
        Document.model_validate(found)
        Camera.from_dict(found["camera"])
        SE3.from_matrix(found["camera"]["T_arena_camera"])
        Arena.from_dict(found.get("arena") or {"kind": "open"})
        for zone in found.get("zones", []):
            Zone.from_dict(zone)
        if "\\u" in text:
            json.dumps(found, ensure_ascii=False).encode()  # fails for half of a character
            nul = re.search(r"(?<!\\)(?:\\\\)*\\u0000", text)
            if nul:
                raise ValueError("it holds a NUL character")
    except (OSError, ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
        raise SessionError(
            f"{path} is damaged and cannot be read ({one_line(error)}); run `liex run` on the "
            "recording again"
        ) from None
    return found


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"it holds {text} for a number")


# Error translation for reading files of a session: every error becomes one sentence.


@contextmanager
def reading_from(path: Path) -> Iterator[Path]:
    """Within the block, convert any error to a SessionError that names the file as damaged.

    A LiexError is passed on unchanged.

    Args:
        path: the file that is read in the block, and the value of the `with` statement.

    Raises:
        SessionError: any error in the block.
    """
    try:
        yield path
    except LiexError:
        raise
    except Exception as error:
        raise SessionError(
            f"{path} is damaged and cannot be read ({type(error).__name__}: {one_line(error)}); "
            "run `liex run` on the recording again"
        ) from None
