"""Provenance record of a session: recording, camera, animal, plan, software versions.

It is the part of session.json that is known before the first frame, and the metadata of every
Parquet file. Hashes are the first 16 hexadecimal digits of SHA-256 over sorted JSON.
"""

from __future__ import annotations

import hashlib
import json
import platform
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import SessionError
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.places import storable
from liex_lab.scene.outline import UNKNOWN, Arena

if TYPE_CHECKING:
    from liex_lab.plan import Plan
    from liex_lab.recordings.recording import Recording
    from liex_lab.recordings.timestamps import Gap
    from liex_lab.scene.floor import Floor
    from liex_lab.scene.scene import Scene
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

    @staticmethod
    def of(
        recording: Recording, floor: Floor, skeleton: Skeleton, plan: Plan, **more: Any
    ) -> Provenance:
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
        subject = {
            "subject_id": stated.subject_id or entries.get("subject_id"),
            "group": stated.group,
            "cage": stated.cage,
            "sex": stated.sex,
            "batch": stated.batch,
            "species": stated.species,
            "age": stated.age,
        }
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
            "plan": plan_table(self.plan_toml),
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


def plan_table(plan_toml: str) -> dict[str, Any]:
    """The plan as a nested table for session.json.

    Args:
        plan_toml: the plan as TOML text.

    Raises:
        SessionError: the text is not TOML.
    """
    try:
        return tomllib.loads(plan_toml)
    except tomllib.TOMLDecodeError as error:
        raise SessionError(
            f"the plan to be stored is not TOML ({error}); pass the plan's own TOML text"
        ) from None


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
