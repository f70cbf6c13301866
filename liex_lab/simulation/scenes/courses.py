"""Virtual mice on the courses of real ones: `liex evaluate several --courses FILE`.

The file is a pose file of JABS (HDF5 with `poseest`, version 3 or later): 12 points of each animal
of a video from above, in px, and its identity. In every frame a virtual mouse has the place, the
direction and the bends of a real one's back, and over the recording a length in proportion; heights
and pitch are those of a walk, so that it does not rear. Truth is exact, as of all that is rendered.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter1d, median_filter

from liex_lab.arrays import Array
from liex_lab.body.pose import Pose
from liex_lab.errors import LiexError, expecting, needing
from liex_lab.simulation.recording import Actor, RenderedRecording, Take
from liex_lab.simulation.rendering import Solid
from liex_lab.simulation.scene import SimulatedScene
from liex_lab.simulation.scenes.catalogue import RECIPES, Making
from liex_lab.simulation.scenes.places import Mesh
from liex_lab.simulation.scenes.stage import draw_animal, timing_of
from liex_lab.simulation.sensors import Sensor

_HZ = 30.0
_BACK = (9, 6, 3, 0)  # of the 12 points: tail base, middle of the back, base of the neck, nose
_SURE = 0.3  # least confidence of a point
_ROOM_MM = 20.0  # between the outermost point and a wall
# from the tail base to the nose, of a body as wide as a real mouse: longer ones overlap in contact
_SPINE = 0.85
_HIGH = 2.6  # the camera's height over half the arena's longer side


def read_courses(path: Path) -> Array:
    """The backs of real mice, (n, A, 4, 2) mm from the middle of their arena, y to the top.

    Points that are missing or not sure are interpolated; single wrong ones are removed by a median
    over five frames.

    Args:
        path: the pose file, at 30 frames/s.

    Raises:
        MissingPackageError: h5py is not installed.
        LiexError: the file is no such file, or has no identities.
    """
    with needing("exchange", f"reading {path}"):
        import h5py
    with (
        expecting(
            LiexError,
            f"{path} should be a pose file of JABS with identities (HDF5 with poseest/points, "
            "confidence, instance_embed_id and instance_id_center)",
            OSError,
            KeyError,
            IndexError,
        ),
        h5py.File(path) as file,
    ):
        poses = file["poseest"]
        points = poses["points"][:][:, :, _BACK, ::-1] * [1.0, -1.0]
        sure = poses["confidence"][:][:, :, _BACK] > _SURE
        identity = poses["instance_embed_id"][:]
        n_animals, scale = len(poses["instance_id_center"]), poses.attrs["cm_per_pixel"]
    backs = np.full((len(points), n_animals, *points.shape[2:]), np.nan)
    for k in range(n_animals):
        frame, row = np.nonzero(identity == k + 1)
        backs[frame, k] = np.where(sure[frame, row, :, None], points[frame, row], np.nan)
    table = pd.DataFrame(10.0 * scale * backs.reshape(len(backs), -1))
    whole = table.interpolate(limit_direction="both").to_numpy()
    smooth = gaussian_filter1d(median_filter(whole, (5, 1)), 1.2, axis=0).reshape(backs.shape)
    low, top = smooth.min(axis=(0, 1, 2)), smooth.max(axis=(0, 1, 2))
    return np.asarray(smooth - 0.5 * (low + top))


@dataclass(frozen=True)
class _Making(Making):
    """Builds one recording.

    Attributes:
        backs: (n, A, 4, 2) of the real mice, mm.
    """

    backs: Array

    def _cast(self, arenas: list[SimulatedScene]) -> tuple[list[Actor], list[Solid], list[Mesh]]:
        """A virtual mouse for each real one, and nothing else."""
        every = self.backs.swapaxes(0, 1)
        return [self._mouse(k, back, arenas[0]) for k, back in enumerate(every)], [], []

    def _mouse(self, which: int, back: Array, arena: SimulatedScene) -> Actor:
        """A mouse whose back is (n, 4, 2) mm."""
        n = len(back)
        along = np.linalg.norm(np.diff(back, axis=1), axis=2).cumsum(axis=1)
        spine = _SPINE * float(np.quantile(along[:, -1], 0.75))  # stretched
        middle, ahead = arena.centre + back.mean(axis=1), back[:, -1] - back[:, 0]
        speed = np.linalg.norm(np.gradient(middle, axis=0), axis=1) * _HZ / spine
        animal = draw_animal(
            self.seed,
            which,
            self.species,
            arena,
            replace(self.take, spine_mm=spine),
            timing_of("always", n),
            lambda rng, n_moments: (np.zeros(n, np.int64), speed),
            lambda *_: (middle, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))),
        )
        joints = animal.joints.copy()
        bones = np.diff(joints, axis=1)
        level = np.linalg.norm(bones[..., :2], axis=2)
        at = np.pad(level.cumsum(axis=1), ((0, 0), (1, 0)))
        share = np.pad(along, ((0, 0), (1, 0)))
        on_back = np.array(
            [
                [np.interp(to / to[-1], of / of[-1], axis) for axis in one.T]
                for to, of, one in zip(at, share, back, strict=True)
            ]
        ).swapaxes(1, 2)
        way = np.diff(on_back, axis=1)
        bones[..., :2] = level[..., None] * way / np.linalg.norm(way, axis=2, keepdims=True)
        joints[:, 1:] = joints[:, :1] + bones.cumsum(axis=1)
        joints[..., :2] += (middle - joints[..., :2].mean(axis=1))[:, None]
        return replace(
            animal, pose=Pose.from_joints(animal.surface.skeleton, joints, [0.0, 0.0, 1.0])
        )


def film_courses(backs: Array, seed: int, sensor: Sensor, family: str) -> RenderedRecording:
    """A recording of virtual mice on the courses of real ones, at 30 frames/s.

    Args:
        backs: (n, A, 4, 2) mm, see `read_courses`.
        seed: seed of bodies, floor, camera and noise.
        sensor: the camera's make.
        family: of body shapes, see `body.variation`.
    """
    half = np.abs(backs).max(axis=(0, 1, 2)) + _ROOM_MM
    recipe = replace(
        RECIPES["plain"], half_mm=tuple(half.tolist()), camera_mm=_HIGH * float(half.max())
    )
    take = Take(len(backs), sensor, family=family, name=f"courses-{seed}")
    return _Making(recipe, seed, take, backs).recording()
