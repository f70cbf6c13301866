"""Random bodies: tubular mice, any animal around its skeleton, and hands with their arms.

A family draws smooth random factors for the profile of the default body, so that a model trained on
rendered animals covers the variation of real ones (domain randomisation). Hands get log-normal
factors (clipped at two standard deviations) of bone lengths finger by finger, of the palm's breadth
and of the capsules' radii; a forearm, a sleeve and an upper arm are more capsules behind the wrist.
"""

from dataclasses import dataclass, replace

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body._skinning_kernels import TAIL_RINGS
from liex_lab.body.pose import Pose, aim
from liex_lab.body.shape import Body, BodyShape, Capsules, MeshBody, Surface
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.geometry import so3
from liex_lab.runtime.memory import Rows

FAMILIES = ("train", "augmented", "wide", "other")
_WILD_SHARE = 0.6


def _check_family(family: str) -> None:
    if family not in FAMILIES:
        raise LiexError(f"there is no shape family '{family}'; choose one of {', '.join(FAMILIES)}")


def _waves(rng: np.random.Generator, along: Array, n: int, deviation: float) -> Array:
    """Sums (n, R) of four slow waves along the body, each with random phase and amplitude."""
    total = np.zeros((n, len(along)))
    for cycles in (0.5, 1.0, 1.5, 2.0):
        phase = rng.uniform(0.0, 2.0 * np.pi, (n, 1))
        total += rng.normal(0.0, deviation, (n, 1)) * np.sin(2.0 * np.pi * cycles * along + phase)
    return total


# Tubular bodies of mice.


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
    _check_family(family)
    default = BodyShape.default(skeleton)
    stations = np.array(skeleton.surface["stations"], float)
    wild = (rng.random(n) < _WILD_SHARE) & (family == "augmented") | (family == "wide")
    if family == "other":
        width, height = _foreign(rng, default, stations, n)
    else:
        width, height = _varied(rng, default, stations, wild[:, None])
    if family in ("augmented", "wide"):
        free = wild & (rng.random(n) < 0.5)
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
    width = width * np.where(wild, np.exp(_waves(rng, stations, n, 0.10 / np.sqrt(2.0))), 1.0)
    height = height * np.where(wild, np.exp(_waves(rng, stations, n, 0.07 / np.sqrt(2.0))), 1.0)
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
    return width, width * ratio * np.exp(_waves(rng, stations, n, 0.05 / np.sqrt(2.0)))


def _reread(stations: Array, snout: Array, rump: Array) -> Array:
    """Positions (n, R) on the default profile to sample for each station: powers above 1 make a fat
    snout or a thin rump.
    """
    low = stations[0]
    high = 0.10
    rear = low + (high - low) * np.clip((stations - low) / (high - low), 0.0, 1.0) ** rump
    front = 0.70 + 0.30 * np.clip((stations - 0.70) / 0.30, 0.0, 1.0) ** snout
    return np.where(stations < high, rear, np.where(stations > 0.70, front, stations))


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


# Random variation of any animal's body: girth and proportions around its skeleton.


def vary_body(rng: np.random.Generator, skeleton: Skeleton, family: str, n: int) -> Body:
    """Draw n animals of a family around the body described by a skeleton's TOML.

    Args:
        rng: random generator.
        skeleton: with its [surface] table.
        family: 'train' varies it as individuals vary; most of 'augmented' varies more than
            individuals do, so that no forest relies on one exact profile; 'wide' varies all three
            times as much as 'train'; 'other' has builds outside of the first two: far slimmer or
            stouter, with the mass far forward or far back.
        n: animals.

    Returns:
        A batch (n,) of the skeleton's kind of body.

    Raises:
        LiexError: there is no such family, or the skeleton describes no surface.
    """
    _check_family(family)
    surface = Surface.of(skeleton)
    fur = rng.uniform(0.0, 0.4, n)
    default = surface.body
    if not isinstance(default, BodyShape):
        wide, high = _factors(rng, skeleton.reach / skeleton.length, family, n)
        girth = np.sqrt(wide * high)
        if isinstance(default, MeshBody):
            return replace(default, width=girth, fur=fur)
        assert isinstance(default, Capsules)
        around = default.radii * girth[:, default.joints]
        return replace(default.broadcast(n), radii=around, fur=fur)
    wide, high = _factors(rng, np.clip(surface.stations, 0.0, 1.0), family, n)
    shape = default.broadcast(n)
    blobs = shape.blobs.copy()
    for first in range(0, blobs.shape[1], 2):  # limbs come in pairs, one on each side
        nearest = int(np.argmin(np.abs(surface.stations - blobs[0, first, 0])))
        size = rng.uniform(0.6, 1.3, n) * (rng.random(n) < 0.7)
        for b in (first, first + 1):
            blobs[:, b, 1] *= wide[:, nearest]
            blobs[:, b, 2] *= high[:, nearest]
            blobs[:, b, 3:] *= size[:, None]
    power = rng.uniform(1.8, 2.4, n)
    return BodyShape(
        shape.half_width * wide, shape.half_height * high, power, blobs, shape.tail, fur
    )


def _factors(rng: np.random.Generator, along: Array, family: str, n: int) -> tuple[Array, Array]:
    """Factors (n, R) of width and height at positions `along` (R,) the body, from 0 to 1."""
    wild = ((rng.random(n) < _WILD_SHARE) & (family == "augmented"))[:, None]
    sign = rng.choice([-1.0, 1.0], (4, n, 1))
    size, slope, flat, belly = rng.uniform(0.0, 1.0, (4, n, 1))
    at = rng.uniform(0.2, 0.5, (n, 1))
    if family == "other":
        log_girth = sign[0] * (0.24 + 0.12 * size)
        tilt = sign[1] * (0.40 + 0.25 * slope)
        squeeze = sign[2] * (0.10 + 0.12 * flat)
        bulge = 0.25 * belly
        rough = np.full((n, 1), 0.05)
    else:
        more = np.where(wild, 2.0, 3.0 if family == "wide" else 1.0)
        log_girth = more * sign[0] * 0.12 * size
        tilt = more * sign[1] * 0.15 * slope
        squeeze = more * sign[2] * 0.08 * flat
        bulge = more * (0.2 * belly - 0.05)
        rough = np.where(wild, 0.08, 0.08 if family == "wide" else 0.03)
    straight = log_girth + tilt * (along - 0.4)
    log_width = straight + np.log1p(bulge * np.exp(-(((along - at) / 0.18) ** 2)))
    log_height = straight + 0.5 * (log_width - log_girth - tilt * (along - 0.4))
    waves = [_waves(rng, along, n, np.sqrt(0.5)) * rough for _ in range(2)]
    return np.exp(log_width + squeeze + waves[0]), np.exp(log_height - squeeze + waves[1])


# Hands and arms.


_FINGERS = ("thumb", "index", "middle", "ring", "little")
ARM_MM = 260.0  # from the wrist to the elbow, at scale 1
N_ARM_CAPSULES = 4


@dataclass(frozen=True)
class HandShape(Rows):
    """The hands of n people. Lengths in mm at scale 1.

    Attributes:
        offsets: (n, J, 3) mm, the joints as in `Skeleton.offsets`.
        flesh: capsules, a batch (n).
        arm: (n, 4) radii mm at wrist and elbow, ratio of width to thickness, and the start of a
            sleeve along the forearm as a share (1: no sleeve).
    """

    offsets: Array
    flesh: Capsules
    arm: Array

    def joints(self, skeleton: Skeleton, pose: Pose) -> tuple[Array, Array]:
        """Joints of each person's own hand in a pose: forward kinematics with individual bone
        lengths.

        Args:
            skeleton: of the hand.
            pose: (n) poses.

        Returns:
            Rotations (n, J, 3, 3) and positions (n, J, 3) mm, in the poses' frame.
        """
        rotations = pose.frames(skeleton).rotation
        positions = np.empty(self.offsets.shape)
        positions[:, 0] = pose.root.translation
        for j in range(1, skeleton.n_joints):
            p = skeleton.parents[j]
            step = np.einsum("nij,nj->ni", rotations[:, p], self.offsets[:, j])
            positions[:, j] = positions[:, p] + pose.scale[:, None] * step
        return rotations, positions


def draw_hands(rng: np.random.Generator, skeleton: Skeleton, family: str, n: int) -> HandShape:
    """Draw the hands of n people of a family.

    Args:
        rng: random generator.
        skeleton: of the hand, with names that begin with a finger's and an underscore.
        family: 'train' varies the preset as people vary, 'augmented' somewhat more; 'other' has
            hands that no model is trained on: short and plump ones, and long and slender ones.
        n: people.

    Returns:
        A batch (n) of hands.

    Raises:
        LiexError: there is no such family.
    """
    _check_family(family)
    wide = {"train": 1.0, "augmented": 1.5, "wide": 2.0, "other": 1.0}[family]

    def draw(sd: float, *shape: int) -> Array:
        """Log-normal factors (n, *shape), clipped at two standard deviations.

        Args:
            sd: of their logarithm, before the family's own factor.
            *shape: axes behind n.
        """
        return np.exp(wide * sd * np.clip(rng.standard_normal((n, *shape)), -2.0, 2.0))

    lengths = draw(0.03, 5)
    girth = draw(0.09)
    breadth = draw(0.05)
    if family == "other":
        plump = rng.random(n) < 0.5
        lengths *= np.where(plump, rng.uniform(0.82, 0.9, n), rng.uniform(1.1, 1.18, n))[:, None]
        girth *= np.where(plump, rng.uniform(1.25, 1.4, n), rng.uniform(0.72, 0.8, n))
        breadth *= np.where(plump, rng.uniform(1.08, 1.16, n), rng.uniform(0.84, 0.92, n))
    offsets = np.broadcast_to(skeleton.offsets, (n, skeleton.n_joints, 3)).copy()
    for j, name in enumerate(skeleton.names[1:], start=1):
        finger = name.split("_")[0]
        if skeleton.parents[j] == 0:
            offsets[:, j] *= np.stack([draw(0.03), breadth, np.ones(n)], axis=1)
        else:
            offsets[:, j] *= (lengths[:, _FINGERS.index(finger)] * draw(0.02))[:, None]
    flesh = Capsules.of(skeleton)
    n_capsules = len(flesh.joints)
    radii = flesh.radii * girth[:, None, None] * draw(0.05, n_capsules, 1)
    bones = flesh.joints[: skeleton.n_joints - 1]
    of_finger = np.concatenate([bones[:, 0] > 0, np.zeros(n_capsules - len(bones), bool)])
    radii *= np.where(of_finger[None, :], draw(0.06)[:, None], 1.0)[..., None]
    wrist = rng.uniform(22.0, 29.0, n) * np.sqrt(girth)
    sleeve = np.where(rng.random(n) < 0.5, rng.uniform(0.0, 0.7, n), 1.0)
    arm = np.stack(
        [wrist, wrist * rng.uniform(1.15, 1.55, n), rng.uniform(1.1, 1.45, n), sleeve], axis=1
    )
    ends = np.broadcast_to(flesh.offsets, (n, *flesh.offsets.shape)).copy()
    return HandShape(offsets, Capsules(flesh.joints, ends, radii, np.zeros(n)), arm)


def forearms(
    rng: np.random.Generator,
    rotations: Array,
    positions: Array,
    scale: Array,
    bent: Array | None = None,
) -> tuple[Array, Array]:
    """Frames and elbows of the forearms that carry hands.

    The wrist bends within its usual range, and further if the arm would otherwise point towards the
    camera: a person stands behind the hand.

    Args:
        rng: random generator.
        rotations: (n, J, 3, 3) of the hands' joints, camera frame.
        positions: (n, J, 3) mm of the joints, camera frame.
        scale: (n,) of the hands.
        bent: (n, 3) rad, the wrists' bends; None to draw them.

    Returns:
        Frames (n, 3, 3), x from the elbow to the wrist, and elbows (n, 3) mm, camera frame.
    """
    n = len(scale)
    bend = np.zeros((n, 3))
    if bent is None:
        bent = np.radians(
            np.stack([np.zeros(n), rng.normal(0.0, 22.0, n), rng.normal(0.0, 12.0, n)], axis=1)
        )
    bend[:, 1] = np.clip(bent[:, 1], -1.0, 1.0)
    bend[:, 2] = np.clip(bent[:, 2], -0.4, 0.4)
    turned = rotations[:, 0] @ so3.exp(bend)
    forward = turned[:, :, 0].copy()
    forward[:, 2] = np.minimum(forward[:, 2], 0.0)  # not away from the camera
    frame = so3.exp(aim(turned[:, :, 0], forward)) @ turned
    return frame, positions[:, 1:3].mean(axis=1) - (scale * ARM_MM)[:, None] * frame[:, :, 0]


def arm_vertices(frame: Array, elbow: Array, shoulder: Array, scale: Array, arm: Array) -> Array:
    """Meshes of forearm, sleeve and upper arm: four capsules for each.

    Args:
        frame: (n, 3, 3) of the forearms, from `forearms`.
        elbow: (n, 3) mm, from `forearms`.
        shoulder: (n, 3) mm, in the same frame.
        scale: (n,) of the hands.
        arm: (n, 4) as in `HandShape`.

    Returns:
        (n, V, 3) mm.
    """
    n = len(scale)
    wrist = elbow + (scale * ARM_MM)[:, None] * frame[:, :, 0]
    joints = np.stack([wrist, elbow, shoulder], axis=1)
    # two adjacent tubes make an arm that is wider than thick
    side = 0.5 * arm[:, 0] * (arm[:, 2] - 1.0) * 2.0
    offsets = np.zeros((n, 4, 2, 3))
    radii = np.zeros((n, 4, 2))
    for c, sign in enumerate((1.0, -1.0)):
        offsets[:, c, :, 1] = sign * side[:, None]
        offsets[:, c, 0, 0] = 12.0
        radii[:, c] = arm[:, :2]
    sleeve = arm[:, 3]
    offsets[:, 2, 0, 0] = -np.minimum(sleeve, 0.98) * ARM_MM  # a tube needs some length
    wide = 1.25 * (arm[:, 0] + sleeve * (arm[:, 1] - arm[:, 0]) + side)
    radii[:, 2] = np.where(sleeve < 1.0, [wide, 1.3 * arm[:, 1]], 1.0).T
    radii[:, 3] = 1.3 * arm[:, 1:2]
    ends = np.array([[0, 1], [0, 1], [0, 1], [1, 2]])
    tubes = Capsules(ends, offsets, radii, np.zeros(n))
    return tubes.vertices(np.repeat(frame[:, None], 3, axis=1), joints, scale, scale)
