"""How a real mouse holds itself and moves, beside the virtual one: `liex evaluate motion`.

The real mouse comes as points in space (an .npz); the virtual one is asked where the same places of
its back are: in recordings in which it goes about, and in the postures that models are trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError
from liex_lab.evaluation.motion import POINTS, Motion, motion_figures
from liex_lab.runtime.memory import check_npz
from liex_lab.runtime.progress import Progress, silent

if TYPE_CHECKING:
    from liex_lab.body.pose import Pose
    from liex_lab.body.shape import BodyShape
    from liex_lab.body.skeleton import Skeleton

Array = NDArray[np.float64]

NAMES = ("TTI", "Trunk", "Spine", "Neck", "Nose")
UPS = {
    sign + axis: (k, -1.0 if sign else 1.0) for k, axis in enumerate("xyz") for sign in ("", "-")
}
_SEEDS = range(300, 312)  # of recordings of a virtual mouse
_PER_RECORDING = 300
_N_POSTURES = 12_000
_POSTURE_SEED = 300
_MOST_BYTES = 2_000_000_000
_FEWEST = 50  # frames


@dataclass(frozen=True)
class Bodies:
    """Virtual mice in their postures.

    Attributes:
        pose: (n) poses.
        girth: (n,) factor of all lengths across the bodies.
        shape: (n) the bodies.
    """

    pose: Pose
    girth: Array
    shape: BodyShape

    def __getitem__(self, rows: slice) -> Bodies:
        """Some of them."""
        return Bodies(self.pose[rows], self.girth[rows], self.shape[rows])


def evaluate_motion(
    reference: str | Path,
    *,
    names: Sequence[str] = NAMES,
    up: str = "z",
    rate_hz: float | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Quantiles of a real mouse's postures and motion beside those of the virtual mouse.

    Args:
        reference: .npz with `points_mm` (n, P, 3), `names` (P,), and, where there are breaks,
            `clip_frames`, after how many frames there is one each time.
        names: those of the five points, from the tail's base to the nose.
        up: the axis of the file that points up, a key of `UPS`.
        rate_hz: frames a second of the file; None leaves the speeds out.
        progress: told recording by recording.

    Returns:
        See `liex_lab.evaluation.motion.motion_figures`; the virtual ones are `walk` and `training`.

    Raises:
        LiexError: the file cannot be read, lacks a point, or is upside down.
    """
    from liex_lab.body.skeleton import Skeleton

    real = read_motion(Path(reference), names, up, rate_hz)
    skeleton = Skeleton.load("mouse")
    along = _shares(real.points_mm)
    bodies = _postures(skeleton)
    above = _height_of(real, skeleton, bodies, along)
    virtual = {
        "walk": _walk(skeleton, along, above, progress),
        "training": Motion(on_back(skeleton, bodies, along, above)),
    }
    return {"above": above, **motion_figures(real, virtual)}


def in_short(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The figures as rows of a table, one measure a row.

    Args:
        result: what `evaluate_motion` gave.
    """
    rows = {}
    for measure, of in result["quantiles"].items():
        rows[measure] = {
            whose: " / ".join(f"{v:.3g}" for v in values) for whose, values in of.items()
        }
        for whose, outside in result["outside"].items():
            if measure in outside:
                rows[measure][f"outside_{whose}"] = f"{100 * outside[measure]:.1f} %"
    rows["nearest_degrees (50, 95 %)"] = {
        whose: " / ".join(f"{v:.3g}" for v in values)
        for whose, values in result["nearest_degrees"].items()
    }
    return rows


def read_motion(path: Path, names: Sequence[str], up: str, rate_hz: float | None) -> Motion:
    """The five points of a real animal from a file, z up.

    Args:
        path: of the .npz, see `evaluate_motion`.
        names: of the five points, from the tail's base to the nose.
        up: a key of `UPS`.
        rate_hz: frames a second; None where nobody knows.

    Raises:
        LiexError: the file cannot be read, lacks a point, or is upside down.
    """
    if up not in UPS:
        raise LiexError(f"up is one of {', '.join(UPS)}, got '{up}'")
    if len(names) != len(POINTS):
        raise LiexError(f"five points are needed ({', '.join(POINTS)}), got {len(names)} names")
    try:
        check_npz(path, _MOST_BYTES)
        with np.load(path) as held:
            points = held["points_mm"].astype(float)
            known = [str(name) for name in held["names"]]
            clip = int(held["clip_frames"]) if "clip_frames" in held else len(points)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise LiexError(
            f"{path} holds no motion: an .npz with points_mm (n, P, 3) and names (P,) is "
            f"expected ({error})"
        ) from None
    if points.ndim != 3 or points.shape[1:] != (len(known), 3) or clip < 1:
        raise LiexError(
            f"{path}: points_mm (n, {len(known)}, 3) is expected for {len(known)} names and "
            f"clip_frames of 1 or more, got {points.shape} and {clip}"
        )
    missing = [name for name in names if name not in known]
    if missing:
        raise LiexError(f"{path} has no point {', '.join(missing)}; it has {', '.join(known)}")
    chosen = _upright(points, [known.index(name) for name in names], up, path)
    clips = np.arange(len(points)) // clip
    whole = np.isfinite(chosen).all(axis=(1, 2))
    if whole.sum() < _FEWEST:
        raise LiexError(
            f"{path}: {whole.sum()} frames have all five points, and {_FEWEST} are needed"
        )
    # what is not there is a break
    clips = clips * len(points) + np.cumsum(~whole)
    return Motion(chosen[whole], clips[whole], rate_hz)


def _upright(points: Array, columns: list[int], up: str, path: Path) -> Array:
    """The chosen points (n, 5, 3) with z up; an error where their back is below everything else."""
    axis, sign = UPS[up]
    level = [k for k in range(3) if k != axis]
    turned = np.stack([points[..., level[0]], points[..., level[1]], sign * points[..., axis]], -1)
    back = np.nanmedian(turned[:, columns[1:4], 2])
    others = [k for k in range(points.shape[1]) if k not in columns]
    if others and back < np.nanmedian(turned[:, others, 2]):
        raise LiexError(
            f"{path}: with '{up}' up the back lies {np.nanmedian(turned[:, others, 2]) - back:.0f} "
            "mm below the other points; say which axis points up (--up)"
        )
    return turned[:, columns]


def _shares(points_mm: Array) -> Array:
    """Where (5,) along an animal the points are, 0 the tail's base and 1 the nose."""
    bones = np.median(np.linalg.norm(np.diff(points_mm, axis=1), axis=-1), axis=0)
    reach = np.concatenate([[0.0], np.cumsum(bones)])
    return np.asarray(reach / reach[-1])


def _walk(skeleton: Skeleton, along: Array, above: float, progress: Progress) -> Motion:
    """A virtual mouse that goes about, some recordings of it."""
    from liex_lab.body.shape import BodyShape
    from liex_lab.simulation.recording import FRAME_NS, SyntheticSession
    from liex_lab.simulation.simulator import world_of

    points = []
    for k, seed in enumerate(_SEEDS):
        progress(k, len(_SEEDS), "a virtual mouse goes about")
        recording = world_of(skeleton).motion(seed, _PER_RECORDING)
        assert isinstance(recording, SyntheticSession)
        held = recording.contents
        assert isinstance(held.shape, BodyShape)
        own = Bodies(held.pose, held.girth, held.shape.broadcast(_PER_RECORDING))
        points.append(on_back(skeleton, own, along, above))
    clips = np.repeat(np.arange(len(points)), _PER_RECORDING)
    return Motion(np.concatenate(points), clips, 1e9 / FRAME_NS)


def _postures(skeleton: Skeleton) -> Bodies:
    """Postures as models are trained on."""
    from liex_lab.simulation.species import MouseSpecies

    rng = np.random.default_rng(_POSTURE_SEED)
    species = MouseSpecies(skeleton)
    n = _N_POSTURES
    shape = species.shapes(rng, "train", n)
    camera_mm = np.full(n, np.mean(species.setting.camera_mm))
    drawn = species.postures(rng, rng.uniform(*species.sizes, n), shape, camera_mm)
    return Bodies(drawn.pose, drawn.girth, shape)


def _height_of(real: Motion, skeleton: Skeleton, bodies: Bodies, along: Array) -> float:
    """How high in a virtual body, as a share of its half height, the real animal's points lie.

    Nobody says how deep below the fur a point was put. By what the back's arch is in the median.
    """
    wanted = float(np.median(real.posture()["trunk_arch"]))
    some = bodies[: _N_POSTURES // 8]
    low, high = 0.0, 1.0
    for _ in range(12):
        above = 0.5 * (low + high)
        arch = Motion(on_back(skeleton, some, along, above)).posture()["trunk_arch"]
        low, high = (above, high) if np.median(arch) < wanted else (low, above)
    return round(0.5 * (low + high), 3)


def on_back(skeleton: Skeleton, bodies: Bodies, along: Array, above: float) -> Array:
    """Places of bodies where a real animal's points would be.

    Args:
        skeleton: of the animal, one chain with a tube as its surface.
        bodies: n of them.
        along: (P,) shares of the length, 0 and 1 for the ends, which lie on the mid-axis.
        above: how high over the mid-axis the others lie, over the body's half height there.

    Returns:
        (n, P, 3) mm, in the frame of the poses.
    """
    from liex_lab.body.surface import joint_reaches

    frames = bodies.pose.frames(skeleton)
    joints, upwards = frames.translation, frames.rotation[..., 2]
    reach = joint_reaches(skeleton)
    bone = np.clip(np.searchsorted(reach, along, side="right") - 1, 0, len(reach) - 2)
    share = ((along - reach[bone]) / (reach[bone + 1] - reach[bone]))[:, None]
    axis = joints[:, bone] + share * (joints[:, bone + 1] - joints[:, bone])
    stations = np.asarray(skeleton.surface["stations"], float)
    half = np.stack([np.interp(along, stations, one) for one in bodies.shape.half_height])
    rise = above * half * bodies.girth[:, None] * ((along > 0.0) & (along < 1.0))
    return np.asarray(axis + rise[..., None] * upwards[:, bone])
