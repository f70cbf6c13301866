"""A mouse whose every number is known: it walks on a circle at a constant speed and may
rear once.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import DepthFrame
from liex_lab.sessions import Provenance, Session, SessionWriter
from liex_lab.tracking.track import Track

FLOOR_MM = 700.0
SPINE_MM = 90.0
SMALL = Camera(95.8, 95.8, 53.0, 39.5, 107, 80, source="typical PrimeSense, a sixth of its size")
SD_ROOT = np.array(
    [0.02, 0.02, 0.05, 1.5, 1.5, 2.0]
)  # rad and mm; of two of them a fifth is common


@dataclass(frozen=True)
class WalkingMouse:
    """times_s of the frames; the body's centre goes round a circle (counter-clockwise) at
    speed_mm_s.

    rear_s: from when to when the nose is held up; lost: rows without a pose.
    """

    times_s: np.ndarray
    speed_mm_s: float = 200.0
    radius_mm: float = 150.0
    rear_s: tuple[float, float] | None = None
    lost: tuple[int, ...] = ()
    sd_mm: float = 1.0
    camera: Camera = SMALL
    skeleton: Skeleton = field(default_factory=lambda: Skeleton.load("mouse"))

    @property
    def times_ns(self) -> np.ndarray:
        return 1_700_000_000_000_000_000 + np.rint(self.times_s * 1e9).astype(np.int64)

    @property
    def T_arena_camera(self) -> SE3:
        return SE3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, FLOOR_MM]))

    def track(self) -> Track:
        """The true track, with an sd that nobody measured."""
        n, skeleton = len(self.times_s), self.skeleton
        scale = np.full(n, SPINE_MM / skeleton.length)
        turned = self.speed_mm_s * self.times_s / self.radius_mm
        heading = turned + np.pi / 2
        pitch = np.zeros(n)
        if self.rear_s:
            start, stop = self.rear_s
            ramp = 0.15
            pitch = np.radians(55.0) * np.clip(
                np.minimum(self.times_s - start, stop - self.times_s) / ramp, 0, 1
            )
        rotation = so3.exp(np.stack([0 * heading, 0 * heading, heading], -1)) @ so3.exp(
            np.stack([0 * pitch, -pitch, 0 * pitch], -1)
        )
        angles = np.zeros((n, skeleton.n_joints, 3))
        pose = Pose(SE3(rotation, np.zeros((n, 3))), angles, scale)
        # the centre of rump to neck goes exactly round the circle, whatever the posture
        centre = pose.joints(skeleton)[:, :-1].mean(axis=1)
        wanted = np.stack(
            [self.radius_mm * np.cos(turned), self.radius_mm * np.sin(turned), np.full(n, 18.0)], -1
        )
        wanted[:, 2] += centre[:, 2]
        pose = replace(pose, root=SE3(rotation, wanted - centre))
        joints = pose.joints(skeleton)
        uv = self.camera.project(self.T_arena_camera.inverse() @ joints)
        track = Track(
            skeleton=skeleton,
            times_ns=self.times_ns,
            joints_mm=joints,
            uv_px=uv,
            sd_mm=np.full(joints.shape[:2], self.sd_mm),
            sd_xy_mm=np.full(joints.shape[:2], 1.1 * self.sd_mm),
            sd_z_mm=np.full(joints.shape[:2], 1.25 * self.sd_mm),
            root_rotation=rotation,
            root_mm=pose.root.translation,
            cov_root=np.tile(np.outer(SD_ROOT, SD_ROOT) * (0.8 * np.eye(6) + 0.2), (n, 1, 1)),
            angles_rad=angles,
            sd_angles_rad=np.full(angles.shape, 0.05),
            scale=scale,
            predicted_error_mm=2.0 + 0.5 * np.sin(self.times_s),
            residual_mm=np.full(n, 1.5),
            n_foreground_px=np.full(n, 900, np.int64),
            centroid_mm=joints.mean(axis=1),
            centroid_px=uv.mean(axis=1),
            p_flip=np.zeros(n),
            bridged=np.zeros(n, bool),
            flag=np.full(n, "", "<U12"),
            n_animals=np.ones(n, np.int64),
        )
        return forget(track, self.lost)

    def frame(self, row: int) -> DepthFrame:
        """A depth frame: the floor, and an ellipsoid where the animal is; it is kept."""
        kept = self.__dict__.setdefault("_kept_frames", {})
        if row not in kept:
            kept[row] = self._render(row)
        return kept[row]

    def _render(self, row: int) -> DepthFrame:
        joints = self._joints[row]
        camera = self.camera
        v, u = np.mgrid[: camera.height, : camera.width]
        x, y = (u - camera.cx) / camera.fx * FLOOR_MM, -(v - camera.cy) / camera.fy * FLOOR_MM
        along = joints[-1] - joints[0]
        middle, length = joints.mean(axis=0), max(float(np.hypot(*along[:2])), 30.0)
        c, s = along[:2] / np.hypot(*along[:2])
        p, q = (x - middle[0]) * c + (y - middle[1]) * s, -(x - middle[0]) * s + (y - middle[1]) * c
        inside = 1.0 - (p / (0.65 * length)) ** 2 - (q / 17.0) ** 2
        height = np.where(
            inside > 0, np.maximum(middle[2], 5.0) + 16.0 * np.sqrt(np.maximum(inside, 0)), 0.0
        )
        rng = np.random.default_rng(row)
        depth = FLOOR_MM - height + rng.normal(0.0, 1.0, height.shape)
        depth[rng.random(height.shape) < 0.01] = 0.0
        return DepthFrame(row, int(self.times_ns[row]), np.rint(depth).astype(np.float32))

    def chunks(self, size: int) -> Iterator[tuple[list[DepthFrame], Track]]:
        """Frames and their part of the track, `size` at a time."""
        track = self.track()
        for start in range(0, len(self.times_s), size):
            stop = min(start + size, len(self.times_s))
            yield [self.frame(row) for row in range(start, stop)], track[start:stop]

    def provenance(self, **more: Any) -> Provenance:
        """What a session has to be told."""
        known: dict[str, Any] = {
            "name": "circle",
            "skeleton": self.skeleton,
            "camera": self.camera,
            "T_arena_camera": self.T_arena_camera,
            "floor_distance_mm": FLOOR_MM,
            "input_sha256": hashlib.sha256(str(more.get("name")).encode()).hexdigest(),
            "plan_toml": 'animal = "mouse"\nseed = 7\n',
            "format": "synthetic",
            "n_frames": len(self.times_s),
            "individual": "mouse_1",
            "animal_size": {"spine_mm": SPINE_MM, "origin": "known from the simulation"},
        }
        return Provenance(**{**known, **more})

    @property
    def _joints(self) -> np.ndarray:
        key = "_cached_joints"
        if key not in self.__dict__:
            object.__setattr__(self, key, replace(self, lost=()).track().joints_mm)
        return self.__dict__[key]


def steady(seconds: float, fps: float = 30.0) -> np.ndarray:
    """Times of a camera that misses nothing."""
    return np.arange(round(seconds * fps)) / fps


def forget(track: Track, rows: tuple[int, ...], flag: str = "not_found") -> Track:
    """The same track with some frames in which the animal was not found."""
    if not rows:
        return track
    empty = vars(Track.empty(track.skeleton, track.times_ns, flag))
    columns = {name: value.copy() for name, value in vars(track).items() if name != "skeleton"}
    for name, column in columns.items():
        column[list(rows)] = empty[name][list(rows)]
    return Track(track.skeleton, **columns)


def write(folder: Path, mouse: WalkingMouse, chunk: int = 20, **more: Any) -> Session:
    """A whole session of this mouse, behaviour included; `more` goes to `provenance`, but for
    Session.create's own.
    """
    from liex_lab import behaviour

    own = {name: more.pop(name) for name in ("overwrite", "blueprint", "report") if name in more}
    with SessionWriter(folder, mouse.provenance(**more), **own) as writer:
        for frames, _ in mouse.chunks(chunk):
            writer.add(frames)
        writer.track = mouse.track()
        origin = writer.origin
        around = behaviour.Surroundings(origin.arena, [zone.name for zone in origin.zones])
        measured = behaviour.measure_rows(writer.rows, None, around)
        return writer.close(**measured.for_session())
