"""Parametric body shapes of a tubular animal, and random families to draw animals from.

The trunk is a generalised cylinder: superellipses |x / a|^p + |y / b|^p = 1 across the mid-axis
(Barr 1981), with half widths a and half heights b at stations along the spine; ears and feet are
ellipsoids, the tail is a thin tube. A family draws smooth random factors for the profiles, so that
a model trained on rendered animals covers the variation of real ones (domain randomisation).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body._skinning_kernels import TAIL_RINGS
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError

Array = NDArray[np.float64]

FAMILIES = ("train", "augmented", "wide", "other")
_WILD_SHARE = 0.6
_HULL_SHARE = 0.5  # of the wild ones


@dataclass(frozen=True)
class BodyShape:
    """The body around a tubular animal's mid-axis, one shape or a batch (...).

    Lengths in mm at scale 1.

    Attributes:
        half_width: (..., R) mm at the tube's stations.
        half_height: (..., R) mm at the tube's stations.
        power: (...) of the superellipse across (2 is an ellipse).
        blobs: (..., B, 6) ellipsoids: station, left and up of the centre, radii forward, left, up.
        tail: (..., 3) length, radius at the rump, radius at the tip.
        fur: (...) from 0 (sleek) to 1 (long and soft): how much a sensor loses at the outline.
    """

    half_width: Array
    half_height: Array
    power: Array
    blobs: Array
    tail: Array
    fur: Array

    @staticmethod
    def default(skeleton: Skeleton) -> BodyShape:
        """The animal described by the skeleton's [surface] table, with stations along one chain of
        joints.

        Raises:
            LiexError: the joints are not one chain, or the table is incomplete.
        """
        table = skeleton.surface
        if not skeleton.is_chain:
            raise LiexError(
                f"the [surface] of '{skeleton.name}' has stations, but its joints are not one "
                "chain, each the parent of the next; give radii_mm instead"
            )
        try:
            width = np.array(table["half_width_mm"], float)
            height = np.array(table["half_height_mm"], float)
            blobs = [
                [pair["station"], side * pair["left_mm"], pair["up_mm"], *pair["radii_mm"]]
                for pair in table.get("pairs", [])
                for side in (1.0, -1.0)
            ]
            tail = np.array(table.get("tail_mm", [0.0, 0.0, 0.0]), float)
        except (KeyError, TypeError, ValueError) as error:
            raise LiexError(
                f"the [surface] of the skeleton '{skeleton.name}' is incomplete: {error}"
            ) from None
        if not len(width) == len(height) == len(table["stations"]) >= 4:
            raise LiexError(
                f"the [surface] of '{skeleton.name}' needs equally many stations, half_width_mm "
                "and half_height_mm, at least 4"
            )
        return BodyShape(
            width, height, np.array(2.0), np.array(blobs, float).reshape(-1, 6), tail, np.array(0.5)
        )

    def bare(self) -> BodyShape:
        """The same trunk without ears, feet and tail, for models of unknown limbs."""
        return replace(self, blobs=_with_radii(self.blobs, 0.0), tail=np.zeros_like(self.tail))

    def __len__(self) -> int:
        """Number of shapes in a batch."""
        return len(self.fur)

    def __getitem__(self, index: int | slice | NDArray[np.int64]) -> BodyShape:
        """One shape, or some, of a batch, by number, slice or row numbers."""
        return BodyShape(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def broadcast(self, n: int) -> BodyShape:
        """A batch (n,) of this one shape, or this batch."""
        if self.fur.ndim == 1 and len(self.fur) == n:
            return self
        return BodyShape(*(np.broadcast_to(a, (n, *a.shape)).copy() for a in vars(self).values()))


def draw_shapes(rng: np.random.Generator, skeleton: Skeleton, family: str, n: int) -> BodyShape:
    """Draw n animals of a family.

    Args:
        rng: random generator.
        skeleton: one chain of joints, with stations in its [surface].
        family: 'train' varies the default animal as mice vary; most of 'augmented' and all of
            'wide' vary more than mice do, so that no forest relies on one exact profile; 'other'
            has bodies of another build, which no forest is trained on.
        n: animals.

    Returns:
        A batch (n,) of shapes.

    Raises:
        LiexError: there is no such family.
    """
    if family not in FAMILIES:
        raise LiexError(f"there is no shape family '{family}'; choose one of {', '.join(FAMILIES)}")
    default = BodyShape.default(skeleton)
    stations = np.array(skeleton.surface["stations"], float)
    wild = (rng.random(n) < _WILD_SHARE) & (family == "augmented") | (family == "wide")
    if family == "other":
        width, height = _foreign(rng, default, stations, n)
    else:
        width, height = _varied(rng, default, stations, wild[:, None])
    if family in ("augmented", "wide"):
        free = wild & (rng.random(n) < _HULL_SHARE)
        hull_width, hull_height = _hulls(rng, default, stations, n)
        width = np.where(free[:, None], hull_width, width)
        height = np.where(free[:, None], hull_height, height)
    names = [pair["name"] for pair in skeleton.surface.get("pairs", []) for _ in range(2)]
    blobs = np.broadcast_to(default.blobs, (n, *default.blobs.shape)).copy()
    for b in range(len(names)):
        # limbs stay on the body, however wide it is
        station = default.blobs[b, 0]
        k = int(np.argmin(np.abs(stations - station)))
        blobs[:, b, 1] *= width[:, k] / default.half_width[k]
        blobs[:, b, 2] *= height[:, k] / default.half_height[k]
    for name in sorted(set(names)):
        rows = [b for b, other in enumerate(names) if other == name]
        _vary_pair(rng, blobs, rows, name, family, np.where(wild, 1.8, 1.2))
    length = skeleton.length * rng.uniform(0.55, 0.95, n) * (rng.random(n) < 0.75)
    tail = np.stack([length, rng.uniform(1.4, 2.6, n), rng.uniform(0.5, 1.1, n)], axis=-1)
    return BodyShape(width, height, rng.uniform(1.9, 2.7, n), blobs, tail, rng.random(n))


def draw_tail_bends(rng: np.random.Generator, n: int) -> Array:
    """Bends of n tails: slow waves and small individual turns.

    Args:
        rng: random generator.
        n: tails.

    Returns:
        (n, TAIL_RINGS) rad, the turn at each ring.
    """
    ring = np.arange(TAIL_RINGS) / TAIL_RINGS
    first, second = rng.normal(0.0, 0.12, (2, n, 1))
    phase = rng.uniform(0.0, 2.0 * np.pi, (n, 1))
    bends = (
        first + second * np.sin(2.0 * np.pi * ring + phase) + rng.normal(0.0, 0.04, (n, TAIL_RINGS))
    )
    bends[:, 0] += rng.normal(0.0, 0.35, n)
    return bends


def _bump(stations: Array, centre: Array, spread: float) -> Array:
    """A bell (n, R) of height 1 around `centre` (n, 1) along the stations (R,)."""
    return np.exp(-(((stations - centre) / spread) ** 2))


def _varied(
    rng: np.random.Generator, default: BodyShape, stations: Array, wild: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Half widths and heights (n, R): the default profile, made fatter, blunter, ... by smooth
    factors.

    wild (n, 1): animals outside the range of mice, with ranges twice as wide and additional waves.
    """
    n = len(wild)

    def draw(low: float, high: float) -> Array:
        half = 0.5 * (high - low) * np.where(wild, 2.0, 1.0)
        return 0.5 * (low + high) + half * rng.uniform(-1.0, 1.0, (n, 1))

    read = _reread(stations, np.exp(draw(-0.35, 0.35)), np.exp(draw(-0.45, 0.35)))
    width = np.interp(read, stations, default.half_width)
    height = np.interp(read, stations, default.half_height)
    girth = np.exp(draw(np.log(0.8), np.log(1.25)))
    # below 1 the body is more of a cylinder with a broad head, above 1 more of a drop
    drop = np.where(wild, np.exp(draw(-0.32, 0.15)), 1.0)
    width = default.half_width.max() * (width / default.half_width.max()) ** drop
    height = default.half_height.max() * (height / default.half_height.max()) ** drop
    belly = draw(-0.08, 0.28) * _bump(stations, draw(0.10, 0.50), 0.18)
    neck = 1.0 - draw(-0.03, 0.20) * _bump(stations, np.full((n, 1), 0.70), 0.07)
    head = 1.0 + draw(-0.15, 0.20) / (1.0 + np.exp(-(stations - 0.74) / 0.03))
    hunch = 1.0 + draw(-0.10, 0.20) * _bump(stations, draw(0.15, 0.45), 0.20)
    width = width * np.where(wild, _waves(rng, stations, n, 0.10), 1.0)
    height = height * np.where(wild, _waves(rng, stations, n, 0.07), 1.0)
    width = width * girth * draw(0.90, 1.10) * (1.0 + belly) * neck * head
    height = height * girth * draw(0.88, 1.12) * (1.0 + 0.5 * belly) * np.sqrt(neck) * head * hunch
    return width, height


def _hulls(
    rng: np.random.Generator, default: BodyShape, stations: Array, n: int
) -> tuple[Array, Array]:
    """Half widths and heights (n, R) of bodies independent of the default profile.

    Any smooth closed outline whose rear is broader than its snout, with a waist, a neck, both or
    neither: monotone cubic interpolation (PCHIP) of its square through random knots.
    """
    from scipy.interpolate import PchipInterpolator

    u = (stations - stations[0]) / (stations[-1] - stations[0])
    knots = np.array([0.0, 0.06, 0.18, 0.32, 0.46, 0.60, 0.72, 0.82, 0.92, 1.0])
    low = np.array([0.0, 0.30, 0.65, 0.80, 0.75, 0.60, 0.45, 0.35, 0.18, 0.0])
    high = np.array([0.0, 0.75, 1.00, 1.05, 1.05, 1.05, 1.00, 0.85, 0.55, 0.0])
    # one draw for the whole body and one for each position: fat noses and necks are correlated
    whole = rng.random((n, 1))
    share = np.clip(0.6 * whole + 0.4 * rng.random((n, len(knots))), 0.0, 1.0)
    # squares are interpolated, so that both ends are round as those of an ellipse
    outline = (
        np.maximum(PchipInterpolator(knots, (low + share * (high - low)) ** 2, axis=1)(u), 0.0)
        ** 0.5
    )
    outline /= outline.max(axis=1, keepdims=True)
    width = (
        default.half_width.max() * np.exp(rng.uniform(np.log(0.65), np.log(1.4), (n, 1))) * outline
    )
    ratio = default.half_height.max() / default.half_width.max() * rng.uniform(0.75, 1.2, (n, 1))
    return width, width * ratio * _waves(rng, stations, n, 0.05)


def _reread(stations: Array, snout: Array, rump: Array) -> Array:
    """Positions (n, R) on the default profile to sample for each station: powers above 1 make a fat
    snout or a thin rump.
    """
    low = stations[0]
    high = 0.10
    rear = low + (high - low) * np.clip((stations - low) / (high - low), 0.0, 1.0) ** rump
    front = 0.70 + 0.30 * np.clip((stations - 0.70) / 0.30, 0.0, 1.0) ** snout
    return np.where(stations < high, rear, np.where(stations > 0.70, front, stations))


def _waves(rng: np.random.Generator, stations: Array, n: int, sd: float) -> Array:
    """Factors (n, R) around 1 that vary slowly by about `sd` along the body."""
    total = np.zeros((n, len(stations)))
    for cycles in (0.5, 1.0, 1.5, 2.0):
        phase = rng.uniform(0.0, 2.0 * np.pi, (n, 1))
        total += rng.normal(0.0, sd / np.sqrt(2.0), (n, 1)) * np.sin(
            2.0 * np.pi * cycles * stations + phase
        )
    return np.exp(total)


def _foreign(
    rng: np.random.Generator, default: BodyShape, stations: Array, n: int
) -> tuple[Array, Array]:
    """Half widths and heights (n, R) of builds that are not in 'train'.

    Every mouse is blunt behind and pointed in front; nothing else is shared with 'train'. Half of
    them are long and slim and widest at the shoulders: a blunt rump, a flank that widens forward in
    a straight line, then a cone to the nose. The other half are obese: an egg without a neck that
    ends in a short cone of a snout.
    """
    u = (stations - stations[0]) / (stations[-1] - stations[0])
    shoulder = rng.uniform(0.42, 0.55, (n, 1))
    rear = rng.uniform(0.72, 0.92, (n, 1))
    blunt = np.clip(u / 0.12, 0.0, 1.0) ** 0.5
    flank = rear + (1.0 - rear) * np.clip(u / shoulder, 0.0, 1.0)
    cone = np.clip((1.0 - u) / (1.0 - shoulder), 0.0, 1.0) ** rng.uniform(0.65, 0.9, (n, 1))
    slim = blunt * flank * cone
    power = rng.uniform(2.2, 3.0, (n, 1))
    warp = rng.uniform(0.75, 1.05, (n, 1))
    egg = np.maximum(1.0 - np.abs(2.0 * u**warp - 1.0) ** power, 0.0) ** (1.0 / power)
    egg = egg * np.clip((1.0 - u) / rng.uniform(0.28, 0.42, (n, 1)), 0.0, 1.0) ** 0.75
    obese = rng.random((n, 1)) < 0.5
    widest = default.half_width.max() * np.where(
        obese, rng.uniform(1.15, 1.38, (n, 1)), rng.uniform(0.66, 0.88, (n, 1))
    )
    flat = np.where(obese, rng.uniform(0.78, 0.95, (n, 1)), rng.uniform(0.90, 1.15, (n, 1)))
    width = widest * np.where(obese, egg, slim)
    return width, width * flat


def _vary_pair(
    rng: np.random.Generator,
    blobs: Array,
    rows: list[int],
    name: str,
    family: str,
    largest_ear: Array,
) -> None:
    """Ears and feet with varied size, position and presence, the same on both sides."""
    n = len(blobs)
    if name == "ear":
        size = rng.uniform(1.25, 1.7, n) if family == "other" else rng.uniform(0.6, largest_ear)
        present = rng.random(n) < (1.0 if family == "other" else 0.65)
        factors = np.stack(
            [rng.uniform(0.7, 1.6, n), rng.uniform(0.8, 1.1, n), rng.uniform(0.45, 1.1, n)], axis=-1
        )
    else:
        size = rng.uniform(0.7, 1.3, n)
        present = rng.random(n) < 0.6
        factors = rng.uniform(0.85, 1.15, (n, 3))
    spread = rng.uniform(0.85, 1.2, n)
    lift = rng.uniform(0.85, 1.1, n)
    for b in rows:
        blobs[:, b, 1] *= spread
        blobs[:, b, 2] *= lift
        blobs[:, b, 3:] *= (size * present)[:, None] * factors


def _with_radii(blobs: Array, factor: float) -> Array:
    """Blobs with their radii multiplied."""
    scaled = blobs.copy()
    scaled[..., 3:] *= factor
    return scaled
