"""Noise models of depth sensors: structured light, stereo, time of flight, plenoptic (light field).

PrimeSense: disparity f b / z, quantised to eighths of a pixel, with projector shadow; stereo is the
same with another baseline and step, the second camera in the place of the projector, so that the
error of depth is z^2 / (f b) times that of disparity. Kinect v2 and Azure: axial noise that grows
as z^2 with radial and slope terms, and flying pixels at edges. Light field: smooth range noise
growing as z^2, texture-less gaps and mismatches. Before any of them, `soften` blurs the outline of
fur and `smear` the edges of what moves; `sense` selects the model.

All random numbers come from a xorshift64 generator (Marsaglia 2003) whose state (1,) uint64 belongs
to one image, so an image depends on its seed alone, never on threads or order.

Arguments that all kernels share: depth (H, W) float32 mm, 0 = nothing in range; what (H, W) uint8:
NOTHING, STILL (background), ANIMAL, OBJECT; `p`: one row (N_PARAMETERS,) of sensor parameters,
indexed as below.
"""

from statistics import NormalDist

import numpy as np

from liex_lab.runtime.kernels import inner_kernel, kernel

NOTHING, STILL, ANIMAL, OBJECT = range(4)  # kinds of pixels
PRIMESENSE_KIND, KINECT_V2_KIND, LIGHT_FIELD_KIND, STEREO_KIND = range(4)
BASELINE_MM = 75.0  # between the projector and the camera of a PrimeSense
SUBPIXEL = 8.0  # its disparity is quantised to eighths of a pixel
_LOST = 0.5  # share of the pixels that an edge sweeps during an exposure that are unread

# columns of a row of sensor parameters
(
    KIND,
    NOISE,
    EROSION,
    FUR,
    BIAS,
    HOLES,
    DARK,
    SIDE,
    SMOOTH,
    WHITE,
    LUMPS,
    EDGE_DROP,
    GRID,
    JITTER,
    FLYING,
    UNIT,  # step of the depth image, mm
    BACKGROUND,  # error of a learned background
    OUTLIERS,  # rarity of outliers
    BASELINE,  # of two views, mm
    STEPS,  # of disparity in a pixel
    WEAK,  # additional noise where the animal returns little light, over the usual
    MOTION_U,  # what the animal moves during an exposure, px
    MOTION_V,
) = range(23)
N_PARAMETERS = 23
# distance from a light field's main lens to which its parameters refer; range noise grows with z^2
TYPICAL_MM = 250.0


_NEIGHBOURS = ((-1, 0), (1, 0), (0, -1), (0, 1))


# spacing of the smooth fields of a light field camera over its grid: fine and coarse range noise,
# missing texture, mismatches, and two of jitter
_FIELDS = (1.0, 4.0, 2.0, 1.0, 1.5, 1.5)

_TABLE_BITS = 13


# quantiles of the standard normal distribution at 2^13 evenly spaced probabilities
NORMAL = np.array(
    [NormalDist().inv_cdf(p) for p in (np.arange(1 << _TABLE_BITS) + 0.5) / (1 << _TABLE_BITS)],
    np.float32,
)


@inner_kernel()
def advance(state):
    """The next 64 random bits (xorshift64, after Marsaglia); state (1,) must not be 0."""
    x = state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return x


@kernel()
def uniform(state):
    """A number in [0, 1) with 24 random bits, advancing state (1,)."""
    return np.float64(advance(state) >> np.uint64(40)) * (1.0 / 16777216.0)


@kernel()
def normal(state, table):
    """A standard normal number by inversion, to the resolution of the quantile table (2^13,)."""
    return table[np.int64(advance(state) >> np.uint64(64 - _TABLE_BITS))]


@inner_kernel()
def smooth_field(state, table, spacing, out):
    """Value noise: normal numbers at nodes `spacing` pixels apart, interpolated bilinearly.

    Args:
        state: (1,) uint64 of the generator, advanced.
        table: (2^13,) float32 normal quantiles.
        spacing: of the nodes, px; the lattice's offset is random.
        out: (H, W) float32, output; unit standard deviation at the nodes.
    """
    height, width = out.shape
    n_columns = int(width / spacing) + 3
    above = np.empty(n_columns, np.float32)
    below = np.empty(n_columns, np.float32)
    start_u = uniform(state)
    start_v = uniform(state)
    column_of = np.empty(width, np.int32)
    share_of = np.empty(width, np.float32)
    for u in range(width):
        at = u / spacing + start_u
        column_of[u] = int(at)
        share_of[u] = at - int(at)
    for k in range(n_columns):
        above[k] = normal(state, table)
        below[k] = normal(state, table)
    node = 0
    for v in range(height):
        at = v / spacing + start_v
        while int(at) > node:
            node += 1
            for k in range(n_columns):
                above[k] = below[k]
                below[k] = normal(state, table)
        t = np.float32(at - node)
        for u in range(width):
            k = column_of[u]
            s = share_of[u]
            a = above[k] + s * (above[k + 1] - above[k])
            b = below[k] + s * (below[k + 1] - below[k])
            out[v, u] = a + t * (b - a)


@inner_kernel()
def soften(depth, what, p, state, table, field):
    """Effects of fur before any sensor: lumps, a bias of dark hair, a weaker outline.

    `p[EROSION]` pixels of the animal's outline take the depth of the surface behind, and a share
    0.5 `p[FUR]` of the next ones.

    Args:
        depth: (H, W) float32 mm, changed in place.
        what: (H, W) uint8 kinds, changed in place where the outline is lost.
        p: (N_PARAMETERS,) of the sensor.
        state: (1,) uint64 of the generator, advanced.
        table: (2^13,) float32 normal quantiles.
        field: (H, W) float32 scratch space.
    """
    height, width = depth.shape
    smooth_field(state, table, p[GRID] * 1.3, field)
    for v in range(height):
        for u in range(width):
            if what[v, u] == ANIMAL:
                depth[v, u] += p[LUMPS] * field[v, u] + p[BIAS]
    rounds = int(p[EROSION])
    for k in range(rounds + 1):
        share = 1.0 if k < rounds else 0.5 * p[FUR]
        lost = np.empty((height * width // 4, 2), np.int32)
        behind = np.empty(len(lost), np.float32)
        n_lost = 0
        for v in range(1, height - 1):
            for u in range(1, width - 1):
                if what[v, u] == ANIMAL and n_lost < len(lost):
                    far = _outside(depth, what, v, u)
                    if far > depth[v, u] + 2.0 and uniform(state) < share:
                        lost[n_lost, 0] = v
                        lost[n_lost, 1] = u
                        behind[n_lost] = far
                        n_lost += 1
        for i in range(n_lost):
            depth[lost[i, 0], lost[i, 1]] = behind[i]
            what[lost[i, 0], lost[i, 1]] = STILL


@inner_kernel()
def smear(depth, what, p, state):
    """Unread and mixed depth where the animal's edges pass during one exposure.

    A pixel that shows the animal for a part of the exposure and something else for the rest is
    unread (`_LOST`), or mixes both depths.

    Args:
        depth: (H, W) float32 mm, changed in place.
        what: (H, W) uint8 kinds.
        p: (N_PARAMETERS,) of the sensor.
        state: (1,) uint64 of the generator, advanced.
    """
    height, width = depth.shape
    n = int(np.ceil(max(abs(p[MOTION_U]), abs(p[MOTION_V])) / 2.0))
    if n == 0:
        return
    still = depth.copy()
    for v in range(height):
        for u in range(width):
            is_animal = what[v, u] == ANIMAL
            other = np.float32(0.0)
            for k in range(-n, n + 1):
                row = v + int(round(0.5 * k / n * p[MOTION_V]))
                column = u + int(round(0.5 * k / n * p[MOTION_U]))
                if (
                    0 <= row < height
                    and 0 <= column < width
                    and (what[row, column] == ANIMAL) != is_animal
                ):
                    other = max(other, still[row, column])
            if other > 0.0 and still[v, u] > 0.0:
                share = uniform(state)
                lost = uniform(state) < _LOST
                depth[v, u] = 0.0 if lost else still[v, u] + share * (other - still[v, u])


@kernel()
def _outside(depth, what, v, u):
    """The farthest of the four neighbours that are not the animal, 0 if all are."""
    far = np.float32(0.0)
    for dv, du in _NEIGHBOURS:
        if what[v + dv, u + du] != ANIMAL:
            far = max(far, depth[v + dv, u + du])
    return far


@kernel()
def _step(depth, v, u):
    """Largest signed depth difference to the existing neighbours (up to four), mm."""
    height, width = depth.shape
    here = depth[v, u]
    worst = np.float32(0.0)
    for dv, du in _NEIGHBOURS:
        row = v + dv
        column = u + du
        if 0 <= row < height and 0 <= column < width and depth[row, column] > 0:
            step = depth[row, column] - here
            if abs(step) > abs(worst):
                worst = step
    return worst


@inner_kernel()
def primesense(depth, what, p, focal, state, table, out):
    """Structured light and stereo: disparity f b / z with smooth noise, quantised to `p[STEPS]`.

    Disparity is estimated over a window (smooth errors, outlines displaced by about a pixel);
    points hidden from the projector, or from the second camera, next to raised objects are unread,
    and so are grazing surfaces.

    Args:
        depth: (H, W) float32 mm, 0 = nothing in range.
        what: (H, W) uint8 kinds.
        p: (N_PARAMETERS,) of the sensor.
        focal: px.
        state: (1,) uint64 of the generator, advanced.
        table: (2^13,) float32 normal quantiles.
        out: (H, W) uint16 in steps of `p[UNIT]` mm, output, 0 = unread.
    """
    height, width = depth.shape
    field = np.empty((height, width), np.float32)
    move_u = np.empty((height, width), np.float32)
    move_v = np.empty((height, width), np.float32)
    smooth_field(state, table, p[GRID], field)
    smooth_field(state, table, 2.5, move_u)
    smooth_field(state, table, 2.5, move_v)
    strength = p[NOISE]
    jitter = p[JITTER]
    fb = focal * p[BASELINE]
    steps = p[STEPS]
    shadow = np.empty(width, np.bool_)
    for v in range(height):
        _shadow(depth[v], fb, p[SIDE], shadow)
        for u in range(width):
            row = min(max(v + int(round(jitter * move_v[v, u])), 0), height - 1)
            column = min(max(u + int(round(jitter * move_u[v, u])), 0), width - 1)
            z = depth[row, column]
            if z <= 0.0 or shadow[column]:
                continue
            step = abs(_step(depth, row, column)) * focal / z
            animal = what[row, column] == ANIMAL
            drop = p[HOLES] + (p[DARK] if animal else 0.0)
            if step > 3.0:
                drop += p[EDGE_DROP] * min((step - 3.0) / 6.0, 1.0)
            if uniform(state) < drop * strength:
                continue
            noise = strength * (p[SMOOTH] * field[v, u] + p[WHITE] * normal(state, table))
            noise *= 1.0 + (p[WEAK] if animal else 0.0)
            disparity = np.round((fb / z + noise) * steps) / steps
            out[v, u] = int(fb / disparity / p[UNIT] + 0.5) if disparity > 0.5 else 0


@kernel()
def _shadow(row, fb, side, shadow):
    """Mark pixels of a row of depths (W,) that are hidden from the projector.

    The projector is to the right of the camera (side > 0) or to the left. In its view a point is
    shifted by its disparity; points that fall behind a nearer one are hidden by it.
    """
    width = len(row)
    front = 1e9
    for k in range(width):
        u = width - 1 - k if side > 0 else k
        shadow[u] = False
        if row[u] > 0:
            visible = (u if side > 0 else -u) - fb / row[u]
            # tolerance: slopes at a grazing angle are not a shadow's edge
            shadow[u] = visible > front + 0.7
            front = min(front, visible)


@inner_kernel()
def kinect_v2(depth, what, p, focal, centre_u, centre_v, state, table, out):
    """Time of flight: range noise by distance, angle and slope, and flying pixels at outlines.

    Noise grows with the squared distance, towards the corners and on slopes, part of it smooth; at
    an outline a pixel mixes the near and the far surface (flying pixels) or is unread.

    Args:
        depth: (H, W) float32 mm, 0 = nothing in range.
        what: (H, W) uint8 kinds.
        p: (N_PARAMETERS,) of the sensor.
        focal: px.
        centre_u: column of the optical axis, px of the window.
        centre_v: row of the optical axis, px of the window.
        state: (1,) uint64 of the generator, advanced.
        table: (2^13,) float32 normal quantiles.
        out: (H, W) uint16 mm, output, 0 = unread.
    """
    height, width = depth.shape
    field = np.empty((height, width), np.float32)
    smooth_field(state, table, p[GRID], field)
    strength = p[NOISE]
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if z <= 0.0:
                continue
            step = _step(depth, v, u)
            slope = min(abs(step) * focal / z, 3.0)
            far2 = (z * 1e-3) ** 2
            corner = 1.0 + ((u - centre_u) ** 2 + (v - centre_v) ** 2) / (focal * focal)
            animal = what[v, u] == ANIMAL
            drop = p[HOLES] + (p[DARK] * (1.0 + slope) if animal else 0.0)
            if abs(step) > 8.0:
                drop += p[EDGE_DROP]
                if uniform(state) < p[FLYING]:
                    z += step * uniform(state) * 0.9
            if uniform(state) < drop * strength:
                continue
            spread = (0.5 + 0.5 * far2) * corner * (1.0 + 0.5 * slope) * strength
            spread *= 1.0 + (p[WEAK] if animal else 0.0)
            z += spread * (p[SMOOTH] * field[v, u] + p[WHITE] * normal(state, table))
            out[v, u] = int(z + 0.5)


@inner_kernel()
def light_field(depth, what, p, state, table, out):
    """A plenoptic camera: depth from matched texture, with large and mostly smooth range noise.

    Outlines are some pixels off, often outwards; texture-less surfaces (DARK of the animal's, HOLES
    of the rest) are unread or (FLYING > 0.5) interpolated from their surroundings; patches are
    mismatched, less often for larger OUTLIERS. Range noise grows with (z / TYPICAL_MM)^2.

    Args:
        depth: (H, W) float32 mm, 0 = nothing in range.
        what: (H, W) uint8 kinds.
        p: (N_PARAMETERS,) of the sensor.
        state: (1,) uint64 of the generator, advanced.
        table: (2^13,) float32 normal quantiles.
        out: (H, W) uint16 in steps of `p[UNIT]` mm, output, 0 = unread.
    """
    height, width = depth.shape
    fields = np.empty((len(_FIELDS), height, width), np.float32)
    fine = fields[0]
    coarse = fields[1]
    blank = fields[2]
    wrong = fields[3]
    move_u = fields[4]
    move_v = fields[5]
    for k in range(len(fields)):
        smooth_field(state, table, _FIELDS[k] * p[GRID], fields[k])
    strength = p[NOISE]
    jitter = np.float32(p[JITTER])
    per_mm = 1.0 / TYPICAL_MM
    per_step = 1.0 / p[UNIT]
    for v in range(height):
        for u in range(width):
            row = min(max(int(v + jitter * move_v[v, u] + np.float32(0.5)), 0), height - 1)
            column = min(max(int(u + jitter * move_u[v, u] + np.float32(0.5)), 0), width - 1)
            z = depth[row, column]
            here = depth[v, u]
            if p[SIDE] > 0.0 and here > 0.0 and here < z:  # a near surface grows outwards only
                z = here
            if z <= 0.0:
                continue
            spread = strength * (z * per_mm) * (z * per_mm)
            animal = what[row, column] == ANIMAL
            if blank[v, u] + 0.3 * fine[v, u] < (p[DARK] if animal else p[HOLES]):
                if p[FLYING] < 0.5:
                    continue
                z += 1.5 * spread * p[SMOOTH] * coarse[v, u]
            if abs(wrong[v, u]) > p[OUTLIERS] - 0.25 * (strength - 1.0):
                z += 12.0 * wrong[v, u] * (0.3 + uniform(state))
            z += spread * (
                p[SMOOTH] * (0.7 * fine[v, u] + 0.7 * coarse[v, u])
                + p[WHITE] * normal(state, table)
            )
            out[v, u] = int(z * per_step + 0.5) if z > 0.0 else 0


@kernel()
def sense(depth, what, p, focal, centre_u, centre_v, state, table, field, out):
    """Apply `soften`, `smear` and the sensor's model to one image; depth and what are overwritten.

    Args:
        depth: (H, W) float32 mm, 0 = nothing in range; changed.
        what: (H, W) uint8 kinds; changed.
        p: (N_PARAMETERS,) of the sensor; `p[KIND]` selects the model.
        focal: px.
        centre_u: column of the optical axis, px of the window.
        centre_v: row of the optical axis, px of the window.
        state: (1,) uint64 of the generator, advanced.
        table: (2^13,) float32 normal quantiles.
        field: (H, W) float32 scratch space.
        out: (H, W) uint16 in steps of `p[UNIT]` mm, output, 0 = unread.
    """
    soften(depth, what, p, state, table, field)
    smear(depth, what, p, state)
    out[:] = 0
    if int(p[KIND]) == PRIMESENSE_KIND or int(p[KIND]) == STEREO_KIND:
        primesense(depth, what, p, focal, state, table, out)
    elif int(p[KIND]) == LIGHT_FIELD_KIND:
        light_field(depth, what, p, state, table, out)
    else:
        kinect_v2(depth, what, p, focal, centre_u, centre_v, state, table, out)
