"""Posture and movement of a real mouse compared with the virtual one: `liex evaluate motion`.

The real mouse is given by 3D points (an .npz); those of the virtual one are the same points on its
back, in recordings in which it walks about, and in the training postures of the models.

The points go from the base of the tail to the nose (`POINTS`), the three between them along the
back. With a, b, c the directions from the first to the middle of the second and third, from there
to the fourth, and from the first to the fourth, and h from the fourth to the fifth,

    trunk_bend  angle from a to b on the floor        trunk_arch  elevation of a minus that of b
    pitch       elevation of c                        head_turn   angle from c to h on the floor
    head_pitch  elevation of h minus that of c        stretch     tail to nose over its median

`MOTION_PROTOCOL` defines every number.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError, refuse
from liex_lab.exchange.points import PointNames, read_points
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation.recording import FRAME_NS
from liex_lab.simulation.simulator import world_of
from liex_lab.simulation.species import MouseSpecies

POINTS = ("tail base", "hind back", "fore back", "neck", "nose")
POSTURE = ("trunk_bend", "trunk_arch", "pitch", "head_turn", "head_pitch", "stretch")
MOTION_PROTOCOL = (
    "Five points from the tail's base to the nose, of a real animal and of a virtual one at the "
    "same shares of its length (the inner three `above` the mid-axis, a share of the body's half "
    "height by which the median of trunk_arch is the real animal's). trunk_bend and head_turn: "
    "angles on the floor without their sign, degrees, and about_lean what is beside their median, "
    "lean_degrees, which is nought of an animal that is recorded for long enough and whose points "
    "lie in its middle; trunk_arch, pitch, head_pitch: elevations, degrees; stretch: tail to nose "
    "over its median. Of these outside: share of the real frames beyond what lies between the "
    "0.5 % and 99.5 % quantiles of the virtual ones. Rates of change, where the frame rate is "
    "stated: speed in lengths/s of the point between tail and neck, turning of the trunk and "
    "changes of trunk_bend, head_turn and head_pitch in degrees/s without their sign, all over "
    "steps of about 1/30 s. nearest_degrees: for a real frame, the root mean square difference of "
    "the five angles to the most similar virtual posture, mirror images being one."
)
_UNSIGNED = ("trunk_bend", "head_turn")
_AT_ONCE = 256


@dataclass(frozen=True)
class PointMotion:
    """Postures of one animal, and their rates of change.

    Attributes:
        points_mm: (n, 5, 3) see `POINTS`, z up.
        clips: (n,) number of the uninterrupted recording of each frame; None if the postures are
            unrelated.
        rate_hz: frames per second; None if unknown.
    """

    points_mm: Array
    clips: NDArray[np.int64] | None = None
    rate_hz: float | None = None

    @property
    def length_mm(self) -> float:
        """Median length along the points."""
        return float(
            np.median(np.linalg.norm(np.diff(self.points_mm, axis=1), axis=-1).sum(axis=1))
        )

    def posture(self) -> dict[str, Array]:
        """Each of `POSTURE` in every frame (n,), degrees and with its sign; stretch a ratio."""
        rump, hind, fore, neck, nose = np.moveaxis(self.points_mm, 1, 0)
        middle = 0.5 * (hind + fore)
        rear, front, trunk, head = middle - rump, neck - middle, neck - rump, nose - neck
        reach = np.linalg.norm(nose - rump, axis=-1)
        return {
            "trunk_bend": _turn(rear, front),
            "trunk_arch": _elevation(rear) - _elevation(front),
            "pitch": _elevation(trunk),
            "head_turn": _turn(trunk, head),
            "head_pitch": _elevation(head) - _elevation(trunk),
            "stretch": reach / np.median(reach),
        }

    def change(self) -> dict[str, Array]:
        """Rates of change (m,) of position, direction and angles; {} without a frame rate."""
        if self.rate_hz is None or self.clips is None:
            return {}
        lag = max(1, round(self.rate_hz * (1.0 / 30.0)))
        together = self.clips[lag:] == self.clips[:-lag]
        per_s = self.rate_hz / lag
        rump, neck = self.points_mm[:, 0], self.points_mm[:, 3]
        trunk, middle = neck - rump, 0.5 * (neck + rump)
        step = np.linalg.norm((middle[lag:] - middle[:-lag])[:, :2], axis=-1)
        found = {
            "speed": step / self.length_mm * per_s,
            "turning": np.abs(_turn(trunk[:-lag], trunk[lag:])) * per_s,
        }
        posture = self.posture()
        for name in ("trunk_bend", "head_turn", "head_pitch"):
            found[f"{name}_rate"] = (
                np.abs((posture[name][lag:] - posture[name][:-lag] + 180.0) % 360.0 - 180.0) * per_s
            )
        return {name: values[together] for name, values in found.items()}


def _turn(first: Array, second: Array) -> Array:
    """Angles (n,) degrees on the floor from the first directions (n, 3) to the second."""
    off = np.arctan2(second[:, 1], second[:, 0]) - np.arctan2(first[:, 1], first[:, 0])
    return np.asarray(np.degrees((off + np.pi) % (2.0 * np.pi) - np.pi))


def _elevation(direction: Array) -> Array:
    """Elevations (n,) of directions (n, 3), degrees."""
    return np.asarray(
        np.degrees(np.arctan2(direction[:, 2], np.hypot(direction[:, 0], direction[:, 1])))
    )


def motion_figures(real: PointMotion, virtual: dict[str, PointMotion]) -> dict[str, Any]:
    """Quantiles of postures and rates of change of a real animal and of virtual ones.

    Returns:
        `quantiles`: by measure, then by animal, the 5 %, 50 % and 95 % quantiles; `outside`: by
            virtual animal, then by measure, the share of real frames outside its range;
            `nearest_degrees`: by virtual animal, the median and the 95 % quantile; `lean_degrees`:
            the real animal's median bend and turn with their signs, 0 without a lean to one side.
            See `MOTION_PROTOCOL`.
    """
    own, posture = _shown(real), real.posture()
    others = {name: _shown(one) for name, one in virtual.items()}
    quantiles = {
        measure: {
            name: np.quantile(shown[measure], (0.05, 0.5, 0.95)).tolist()
            for name, shown in {"real": own, **others}.items()
            if measure in shown
        }
        for measure in own
    }
    outside = {
        name: {
            m: float(((own[m] < low) | (own[m] > high)).mean())
            for m in POSTURE
            for low, high in (np.quantile(shown[m], (0.005, 0.995)),)
        }
        for name, shown in others.items()
    }
    return {
        "n_frames": {"real": len(real.points_mm)}
        | {name: len(one.points_mm) for name, one in virtual.items()},
        "quantiles": quantiles,
        "outside": outside,
        "nearest_degrees": {
            name: np.quantile(nearest(real, one), (0.5, 0.95)).tolist()
            for name, one in virtual.items()
        },
        "lean_degrees": {name: float(np.median(posture[name])) for name in _UNSIGNED},
        "protocol": MOTION_PROTOCOL,
    }


def _shown(motion: PointMotion) -> dict[str, Array]:
    """Postures, angles on the floor also unsigned and about their median, and rates of change."""
    shown: dict[str, Array] = {}
    for name, values in motion.posture().items():
        shown[name] = np.abs(values) if name in _UNSIGNED else values
        if name in _UNSIGNED:
            shown[f"{name}_about_lean"] = np.abs(values - np.median(values))
    return shown | motion.change()


def nearest(real: PointMotion, virtual: PointMotion) -> Array:
    """Difference (n,) degrees of each real posture to the most similar virtual or mirrored one."""
    own, drawn = (  # the five angles (n, 5) of each posture
        np.stack([*one.posture().values()][:-1], axis=-1) for one in (real, virtual)
    )
    drawn = np.concatenate(
        [drawn, drawn * np.array([-1.0 if name in _UNSIGNED else 1.0 for name in POSTURE[:-1]])]
    )
    return np.concatenate(
        [
            np.sqrt(((own[at : at + _AT_ONCE, None] - drawn) ** 2).mean(axis=-1).min(axis=1))
            for at in range(0, len(own), _AT_ONCE)
        ]
    )


_SEEDS = range(300, 312)  # of recordings of a virtual mouse
_PER_RECORDING = 300
_N_POSTURES = 12_000
_FEWEST = 50  # frames


Bodies = tuple[Pose, Array, BodyShape]  # poses (n), girth (n,), shapes (n)


def evaluate_motion(
    reference: str | Path,
    *,
    names: Sequence[str] = ("TTI", "Trunk", "Spine", "Neck", "Nose"),
    up: str = "z",
    rate_hz: float | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Quantiles of the postures and motion of a real mouse and of the virtual mouse.

    Args:
        reference: .npz with `points_mm` (n, P, 3), `names` (P,), and, if there are breaks,
            `clip_frames`, the number of frames between breaks.
        names: those of the five points, from the tail's base to the nose.
        up: the axis of the file that points up: x, y, z, -x, -y or -z.
        rate_hz: frame rate of the file; None leaves the speeds out.
        progress: called recording by recording.

    Returns:
        See `motion_figures`; the virtual ones are `walk` and `training`.

    Raises:
        LiexError: the file cannot be read, lacks a point, or is upside down.
    """
    real = read_motion(Path(reference), names, up, rate_hz)
    skeleton = Skeleton.load("mouse")
    along = _shares(real.points_mm)
    bodies = _postures(skeleton)
    above = _height_of(real, skeleton, bodies, along)
    virtual = {
        "walk": _walk(skeleton, along, above, progress),
        "training": PointMotion(on_back(skeleton, bodies, along, above)),
    }
    return {"above": above, **motion_figures(real, virtual)}


def motion_in_short(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The result of `evaluate_motion` as rows of a table, one measure per row."""
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


def read_motion(path: Path, names: Sequence[str], up: str, rate_hz: float | None) -> PointMotion:
    """The five points of a real animal from a file, z up.

    Args:
        path: of the .npz, see `evaluate_motion`.
        names: of the five points, from the tail's base to the nose.
        up: the axis of the file that points up.
        rate_hz: frames per second; None if unknown.

    Raises:
        LiexError: the file cannot be read, lacks a point, or is upside down.
    """
    if len(names) != len(POINTS):
        raise LiexError(f"five points are needed ({', '.join(POINTS)}), got {len(names)} names")
    table = PointNames.load(
        None, up=up, fps=rate_hz or 1.0, joints=dict(zip(POINTS, names, strict=True))
    )
    points = read_points(path, table)
    columns = [points.names.index(one) for (one,) in table.of_joints(POINTS, points.names).values()]
    with np.load(path) as held:
        clip = int(held.get("clip_frames", len(points.points_mm)))
    chosen = points.points_mm[:, columns]
    below = np.delete(points.points_mm, columns, axis=1)[..., 2]
    off = np.nanmedian(below) - np.nanmedian(chosen[:, 1:4, 2]) if below.size else 0.0
    whole = np.isfinite(chosen).all(axis=(1, 2))
    refuse(
        LiexError,
        (clip < 1, f"{path}: clip_frames of 1 or more are expected, got {clip}"),
        (
            off > 0,
            f"{path}: with '{up}' up the back lies {off:.0f} mm below the other points; state "
            "which axis points up (--up)",
        ),
        (
            whole.sum() < _FEWEST,
            f"{path}: {whole.sum()} frames have all five points, and {_FEWEST} are needed",
        ),
    )
    # incomplete frames are breaks
    clips = (np.arange(len(chosen)) // clip) * len(chosen) + np.cumsum(~whole)
    return PointMotion(chosen[whole], clips[whole], rate_hz)


def _shares(points_mm: Array) -> Array:
    """Positions (5,) of the points along an animal, from 0 at the tail's base to 1 at the nose."""
    reach = np.concatenate(
        [[0.0], np.cumsum(np.median(np.linalg.norm(np.diff(points_mm, axis=1), axis=-1), axis=0))]
    )
    return np.asarray(reach / reach[-1])


def _walk(skeleton: Skeleton, along: Array, above: float, progress: Progress) -> PointMotion:
    """A virtual mouse that walks about, in several recordings."""
    points = []
    for k, seed in enumerate(_SEEDS):
        progress(k, len(_SEEDS), "a virtual mouse goes about")
        recording = world_of(skeleton).motion(seed, _PER_RECORDING)
        (mouse,) = recording.stage.actors
        assert isinstance(mouse.body, BodyShape)
        points.append(
            on_back(
                skeleton,
                (mouse.pose, mouse.girth, mouse.body[0].broadcast(_PER_RECORDING)),
                along,
                above,
            )
        )
    return PointMotion(
        np.concatenate(points), np.repeat(np.arange(len(points)), _PER_RECORDING), 1e9 / FRAME_NS
    )


def _postures(skeleton: Skeleton) -> Bodies:
    """Postures as in the models' training."""
    rng, n = np.random.default_rng(300), _N_POSTURES
    species = MouseSpecies(skeleton)
    shape = species.shapes(rng, "train", n)
    camera_mm = np.full(n, np.mean(species.setting.camera_mm))
    return *species.postures(rng, rng.uniform(*species.sizes, n), shape, camera_mm), shape


def _height_of(real: PointMotion, skeleton: Skeleton, bodies: Bodies, along: Array) -> float:
    """Height of the real animal's points in a virtual body, as a share of its half height.

    It is chosen to match the median arch of the back, since the depth of the points below the fur
    is unknown.
    """
    target = float(np.median(real.posture()["trunk_arch"]))
    some = slice(_N_POSTURES // 8)
    bodies = bodies[0][some], bodies[1][some], bodies[2][some]
    low, high = 0.0, 1.0
    for _ in range(12):
        above = 0.5 * (low + high)
        points = on_back(skeleton, bodies, along, above)
        arch = np.median(PointMotion(points).posture()["trunk_arch"])
        low, high = (above, high) if arch < target else (low, above)
    return round(0.5 * (low + high), 3)


def on_back(skeleton: Skeleton, bodies: Bodies, along: Array, above: float) -> Array:
    """Points of virtual bodies that correspond to a real animal's points.

    Args:
        skeleton: of the animal, one chain with a tube as its surface.
        bodies: n of them.
        along: (P,) shares of the length, 0 and 1 for the ends, which lie on the mid-axis.
        above: height of the others over the mid-axis, as a share of the body's half height there.

    Returns:
        (n, P, 3) mm, in the frame of the poses.
    """
    pose, girth, shape = bodies
    frames = pose.frames(skeleton)
    joints, upwards = frames.translation, frames.rotation[..., 2]
    reach = skeleton.reach / skeleton.length
    bone = np.clip(np.searchsorted(reach, along, side="right") - 1, 0, len(reach) - 2)
    share = ((along - reach[bone]) / (reach[bone + 1] - reach[bone]))[:, None]
    axis = joints[:, bone] + share * (joints[:, bone + 1] - joints[:, bone])
    stations = np.asarray(skeleton.surface["stations"], float)
    half = np.stack([np.interp(along, stations, one) for one in shape.half_height])
    rise = above * half * girth[:, None] * ((along > 0.0) & (along < 1.0))
    return np.asarray(axis + rise[..., None] * upwards[:, bone])
