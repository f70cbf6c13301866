"""Pinhole camera with lens distortion: Brown-Conrady (rational) and Kannala-Brandt fisheye.

u = fx x' + cx, v = fy y' + cy, where (x', y') is the distorted ray (x, y) = (X / Z, Y / Z), r^2 =
x^2 + y^2, in OpenCV's convention:

- Brown-Conrady (Brown 1966): the radius times (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4
  + k6 r^6); to x' comes 2 p1 x y + p2 (r^2 + 2 x^2), to y' p1 (r^2 + 2 y^2) + 2 p2 x y;
- Kannala-Brandt (2006): the radius becomes t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8), t = atan r.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from liex_lab.arrays import Array, ArrayLike
from liex_lab.errors import LiexError

BROWN_CONRADY = "brown_conrady"
KANNALA_BRANDT = "kannala_brandt"
_N_COEFFICIENTS = {BROWN_CONRADY: 8, KANNALA_BRANDT: 4}
_MODELS = {  # names of OpenCV, ROS and Foxglove; an empty name is ROS's default model
    **dict.fromkeys(
        ("", "plumb_bob", "brown_conrady", "rational_polynomial", "opencv", "radtan"), BROWN_CONRADY
    ),
    **dict.fromkeys(("kannala_brandt", "equidistant", "fisheye", "opencv_fisheye"), KANNALA_BRANDT),
}
_WIDEST = 8.0  # tangent of the largest angle from the optical axis that is considered, 83 degrees


@dataclass(frozen=True)
class Distortion:
    """Distortion of rays by a lens.

    The ray (x, y, 1) of an ideal pinhole becomes the real ray (x', y', 1). `of` builds it from the
    values stated in a file.

    Attributes:
        model: 'brown_conrady' or 'kannala_brandt'.
        coefficients: in OpenCV's order: 'brown_conrady' has k1 k2 p1 p2 k3 k4 k5 k6 (ROS: plumb_bob
            with five of them, rational_polynomial with all), 'kannala_brandt' the k1 k2 k3 k4 of a
            fisheye lens (ROS: equidistant).

    Raises:
        LiexError: an unknown model, coefficients that are not finite, or a wrong number of them.
    """

    model: str
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        n = _N_COEFFICIENTS.get(self.model)
        if n is None or len(self.coefficients) != n or not np.isfinite(self.coefficients).all():
            raise LiexError(
                "a lens distortion is brown_conrady with 8 finite coefficients or kannala_brandt "
                f"with 4, got {self.model} with {list(self.coefficients)}; correct distortion in "
                "camera.toml or in the plan"
            )

    @staticmethod
    def of(model: str, coefficients: Sequence[float]) -> Distortion | None:
        """The distortion stated in a file; None if all coefficients are zero.

        Args:
            model: name of OpenCV, ROS or Foxglove, in any case; an empty name is plumb_bob.
            coefficients: in OpenCV's order; missing trailing ones are zero. OpenCV's thin prism
                (beyond the eighth) is refused unless zero.

        Raises:
            LiexError: an unknown model, or too many coefficients.
        """
        values = [float(value) for value in coefficients]
        name = model.strip().lower().replace("-", "_").replace(" ", "_")
        if not any(values):
            return None
        if name not in _MODELS:
            raise LiexError(
                f"the lens distortion model '{model}' is not supported; state it as plumb_bob, "
                "rational_polynomial or equidistant, or set all its coefficients to 0 if it is "
                "negligible"
            )
        n = _N_COEFFICIENTS[_MODELS[name]]
        if any(values[n:]):
            raise LiexError(
                f"the lens distortion model '{model}' has up to {n} coefficients here, got "
                f"{len(values)}: {values}; calibrate the lens with fewer, or omit the others"
            )
        return Distortion(_MODELS[name], tuple((values + [0.0] * n)[:n]))

    @cached_property
    def limit(self) -> float:
        """The radius of (x, y) up to which the distorted radius increases monotonically.

        The model is invalid beyond it.
        """
        r = np.linspace(0.0, _WIDEST, 4001)
        turned = np.flatnonzero(~(np.diff(self._radius(r)) > 0))
        return float(r[turned[0]]) if len(turned) else _WIDEST

    def _radius(self, r: Array) -> Array:
        """The distorted radius of rays at radius r (...), without the tangential part."""
        k = self.coefficients
        if self.model == KANNALA_BRANDT:
            angle = np.arctan(r)
            s = angle * angle
            return np.asarray(angle * (1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))))
        s = r * r
        below = 1.0 + s * (k[5] + s * (k[6] + s * k[7]))
        return np.asarray(
            r * (1.0 + s * (k[0] + s * (k[1] + s * k[4]))) / np.where(below > 0, below, np.nan)
        )

    def distort(self, xy: ArrayLike) -> Array:
        """Distort ideal rays; NaN beyond `limit`.

        Args:
            xy: (..., 2) rays at z = 1.

        Returns:
            (..., 2) distorted, at z = 1.
        """
        x, y = np.moveaxis(np.asarray(xy, float), -1, 0)
        s = x * x + y * y
        r = np.sqrt(s)
        ratio = np.where(r > 1e-12, self._radius(r) / np.maximum(r, 1e-12), 1.0)
        ratio = np.where(r <= self.limit, ratio, np.nan)
        if self.model == KANNALA_BRANDT:
            return np.stack([x * ratio, y * ratio], axis=-1)
        p1, p2 = self.coefficients[2:4]
        across = 2.0 * x * y
        return np.stack(
            [
                x * ratio + p1 * across + p2 * (s + 2.0 * x * x),
                y * ratio + p1 * (s + 2.0 * y * y) + p2 * across,
            ],
            axis=-1,
        )

    def undistort(self, xy: ArrayLike) -> Array:
        """The ideal rays of distorted ones; NaN without one within `limit`.

        The radius by bisection of the radial part, which increases, then Newton's steps for the
        small tangential one.

        Args:
            xy: (..., 2) distorted rays, at z = 1.

        Returns:
            (..., 2) ideal rays at z = 1.
        """
        bent_xy = np.asarray(xy, float)
        target = np.linalg.norm(bent_xy, axis=-1)
        low = np.zeros_like(target)
        high = np.full_like(target, self.limit)
        for _ in range(50):
            middle = 0.5 * (low + high)
            below = self._radius(middle) < target
            low = np.where(below, middle, low)
            high = np.where(below, high, middle)
        ideal = (
            bent_xy * (np.where(target > 1e-12, low / np.maximum(target, 1e-12), 1.0))[..., None]
        )
        ideal = np.where(self._radius(low)[..., None] < target[..., None] - 1e-3, np.nan, ideal)
        right = np.array([1e-6, 0.0])
        down = np.array([0.0, 1e-6])
        for _ in range(8):
            bent = self.distort(ideal)
            residual = bent - bent_xy
            along_x = (self.distort(ideal + right) - bent) / 1e-6
            along_y = (self.distort(ideal + down) - bent) / 1e-6
            determinant = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
            move_x = (
                residual[..., 0] * along_y[..., 1] - residual[..., 1] * along_y[..., 0]
            ) / determinant
            move_y = (
                along_x[..., 0] * residual[..., 1] - along_x[..., 1] * residual[..., 0]
            ) / determinant
            ideal = ideal - np.stack([move_x, move_y], axis=-1)
        wrong = ~(np.linalg.norm(self.distort(ideal) - bent_xy, axis=-1, keepdims=True) < 1e-9)
        return np.where(wrong, np.nan, ideal)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for session.json, the arguments of `Distortion.of`."""
        return {"model": self.model, "coefficients": list(self.coefficients)}

    def __str__(self) -> str:
        """The model and its coefficients to four digits."""
        return f"{self.model} {', '.join(f'{value:.4g}' for value in self.coefficients)}"


@dataclass(frozen=True)
class Lens:
    """The intrinsics of a camera without its image size.

    Attributes:
        fx: focal length along rows, px.
        fy: focal length along columns, px.
        cx: principal point, px; 0 is the centre of the first pixel.
        cy: principal point, px.
        distortion: of the lens; None without distortion.

    Raises:
        LiexError: a focal length that is not positive, or a number that is not finite.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if not (
            self.fx > 0 and self.fy > 0 and np.isfinite([self.fx, self.fy, self.cx, self.cy]).all()
        ):
            raise LiexError(
                f"focal lengths are positive pixels, got fx={self.fx}, fy={self.fy}, cx={self.cx}, "
                f"cy={self.cy}; correct them in camera.toml or with --set camera.fx=... --set "
                "camera.fy=..."
            )


@dataclass(frozen=True)
class Camera(Lens):
    """A depth camera: pinhole intrinsics, lens distortion, and image size.

    Pixels; (0, 0) is the centre of the top-left pixel. Camera frame: x right, y down, z away from
    the lens, mm. Only an unprocessed recording may have a distortion; all analysis requires an
    ideal pinhole, provided by `recordings.rectify`.

    Attributes:
        width: px.
        height: px.
        source: origin of the intrinsics.

    Raises:
        LiexError: an image without pixels, or intrinsics that `Lens` refuses.
    """

    width: int
    height: int
    source: str = "stated"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.width > 0 and self.height > 0):
            raise LiexError(
                f"an image has at least one pixel, got {self.width} x {self.height}; correct "
                "width and height in camera.toml"
            )

    def project(self, p_camera: ArrayLike) -> Array:
        """Pixels of points; NaN behind the lens.

        Args:
            p_camera: (..., 3) mm, camera frame.

        Returns:
            (..., 2) u, v px.
        """
        x, y, z = np.moveaxis(np.asarray(p_camera, float), -1, 0)
        z = np.where(z > 0, z, np.nan)
        if self.distortion is None:
            return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)
        return self.distortion.distort(np.stack([x / z, y / z], axis=-1)) * [self.fx, self.fy] + [
            self.cx,
            self.cy,
        ]

    def unproject(self, uv: ArrayLike, depth: ArrayLike) -> Array:
        """Points of pixels at given depths.

        Args:
            uv: (..., 2) px.
            depth: (...) mm, along the optical axis.

        Returns:
            (..., 3) mm, camera frame.
        """
        u, v = np.moveaxis(np.asarray(uv, float), -1, 0)
        z = np.asarray(depth, float)
        x = (u - self.cx) / self.fx
        y = (v - self.cy) / self.fy
        if self.distortion is not None:
            x, y = np.moveaxis(self.distortion.undistort(np.stack([x, y], axis=-1)), -1, 0)
        return np.stack([x * z, y * z, z * np.ones_like(u)], axis=-1)

    def every(self, stride: int) -> Camera:
        """The camera of every `stride`-th row and column of the image."""
        if stride == 1:
            return self
        fx, fy, cx, cy = (value / stride for value in (self.fx, self.fy, self.cx, self.cy))
        width = -(-self.width // stride)
        height = -(-self.height // stride)
        return Camera(fx, fy, cx, cy, width, height, self.source, distortion=self.distortion)

    @property
    def intrinsics(self) -> Array:
        """Focal lengths and principal point (4,): fx, fy, cx, cy, px."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def matrix(self) -> Array:
        """The intrinsic matrix K (3, 3), px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for session.json and camera.toml."""
        numbers = {
            name: getattr(self, name)
            for name in ("fx", "fy", "cx", "cy", "width", "height", "source")
        }
        return (
            numbers
            if self.distortion is None
            else {**numbers, "distortion": self.distortion.to_dict()}
        )

    @staticmethod
    def from_dict(numbers: dict[str, Any]) -> Camera:
        """The camera that `to_dict` wrote; other keys are ignored."""
        values = {
            name: numbers[name] for name in ("fx", "fy", "cx", "cy", "width", "height", "source")
        }
        bent = numbers.get("distortion")
        return Camera(**values, distortion=Distortion.of(**bent) if bent else None)


KINECT_V2 = Camera(365.0, 365.0, 255.5, 211.5, 512, 424, source="typical Kinect v2")
PRIMESENSE = Camera(575.8, 575.8, 319.5, 239.5, 640, 480, source="typical PrimeSense")
RAYTRIX_R5 = Camera(2363.0, 2363.0, 511.5, 511.5, 1024, 1024, source="typical Raytrix R5")
PRIMESENSE_QVGA = Camera(
    287.9, 287.9, 159.5, 119.5, 320, 240, source="typical PrimeSense at 320 x 240"
)
AZURE_KINECT = Camera(504.0, 504.0, 319.5, 287.5, 640, 576, source="typical Azure Kinect, narrow")
REALSENSE_D435 = Camera(425.0, 425.0, 423.5, 239.5, 848, 480, source="typical RealSense D435")
RAYTRIX_R5_WIDE = Camera(1800.0, 1800.0, 511.5, 511.5, 1024, 1024, source="R5, shorter lens")
RAYTRIX_R5_LONG = Camera(2900.0, 2900.0, 639.5, 639.5, 1280, 1280, source="R5, longer lens")


# Depth cameras by name: nominal figures of every depth mode, with their source, from cameras.csv.


_LENSES = {
    "": None,
    "azure": Distortion(
        BROWN_CONRADY, (4.72474, 3.20922, 5.9e-6, 0.000124, 0.170596, 5.05586, 4.77578, 0.886494)
    ),
    "femto": Distortion(
        BROWN_CONRADY, (8.68957, 4.46817, 0.0, 0.0, 0.172922, 9.01699, 7.37854, 1.05598)
    ),
}


class DepthMode(NamedTuple):
    """A depth mode of a camera by name, as its maker states it.

    Attributes:
        name: of the camera, a key of `PRESETS`.
        mode: of its depth stream.
        camera: nominal intrinsics; a specimen differs by one or two per cent.
        range_mm: nearest and farthest distance, mm; None if not stated.
        rates_hz: its frame rates, frames/s.
        unit_mm: mm of a step of its depth, as delivered.
    """

    name: str
    mode: str
    camera: Camera
    range_mm: tuple[float, float] | None
    rates_hz: tuple[int, ...]
    unit_mm: float


def _depth_modes() -> tuple[DepthMode, ...]:
    text = Path(__file__).with_name("cameras.csv").read_text(encoding="utf-8")
    modes = []
    for row in csv.DictReader(text.splitlines()):
        fx, fy, cx, cy = (float(row[key]) for key in ("fx", "fy", "cx", "cy"))
        size = int(row["width"]), int(row["height"])
        camera = Camera(fx, fy, cx, cy, *size, row["source"], distortion=_LENSES[row["lens"]])
        reach = (float(row["near_mm"]), float(row["far_mm"])) if row["far_mm"] else None
        rates = tuple(map(int, row["rates_hz"].split()))
        modes.append(
            DepthMode(row["name"], row["mode"], camera, reach, rates, float(row["unit_mm"]))
        )
    return tuple(modes)


DEPTH_MODES = _depth_modes()
# for each name, one camera per image size
PRESETS = {
    name: tuple(one.camera for one in DEPTH_MODES if one.name == name)
    for name in dict.fromkeys(one.name for one in DEPTH_MODES)
}


def preset(name: str, width: int, height: int) -> Camera:
    """The preset camera for images of a size.

    Args:
        name: a key of `PRESETS`.
        width: columns of the images, px.
        height: rows of the images, px.

    Raises:
        LiexError: there is no such name, or that camera has no images of this size.
    """
    if name not in PRESETS:
        raise LiexError(
            f"camera.preset is one of {', '.join(PRESETS)}, got '{name}'; choose one of them, or "
            "state fx, fy, cx and cy"
        )
    cameras = PRESETS[name]
    for camera in cameras:
        if (camera.width, camera.height) == (width, height):
            return replace(camera, source=f"preset {name}")
    sizes = " or ".join(f"{camera.width} x {camera.height}" for camera in cameras)
    raise LiexError(
        f"the camera '{name}' has images of {sizes} px, but these have {width} x {height}; "
        "choose the recording's camera, or state fx, fy, cx and cy"
    )


def of_size(width: int, height: int) -> list[str]:
    """Names of the cameras with images of this width and height, px."""
    return [
        name
        for name, cameras in PRESETS.items()
        if any((camera.width, camera.height) == (width, height) for camera in cameras)
    ]


def unusual_lens(camera: Camera) -> str:
    """A warning if the focal length differs from all preset cameras with this image size; ""
    otherwise.

    A wrong focal length scales all lengths across the image, and nothing else in a recording
    reveals it.

    Args:
        camera: as stated by the recording or the plan, for images without water.
    """
    size = (camera.width, camera.height)
    # sizes of few kinds of camera; for others, no lens is unusual
    usual_px = {
        name: one.fx
        for name, cameras in PRESETS.items()
        for one in cameras
        if (one.width, one.height) == size
        and size in ((640, 480), (512, 424), (320, 240), (640, 576), (320, 288), (512, 512))
    }
    # specimens, and images mapped to another lens, differ by less
    if not usual_px or any(abs(camera.fx / fx - 1.0) <= 0.1 for fx in usual_px.values()):
        return ""
    usual = ", ".join(f"{name} {fx:.0f}" for name, fx in usual_px.items())
    return (
        f"the focal length of {camera.fx:.0f} px differs from all preset cameras with images of "
        f"{camera.width} x {camera.height} px ({usual}); if it is wrong, every length is wrong: "
        "check it with an object of known length on the floor"
    )


def is_central(cx: float, cy: float, width: int, height: int, share: float = 0.4) -> bool:
    """Whether a principal point is in the middle of an image.

    Args:
        cx: its column, px.
        cy: its row, px.
        width: columns of the image, px.
        height: rows of the image, px.
        share: relative size of the middle part.
    """
    off = max(abs((cx + 0.5) / width - 0.5), abs((cy + 0.5) / height - 0.5))
    return off <= share / 2


def unusual_centre(camera: Camera) -> tuple[str, bool]:
    """A warning if the principal point is far from the middle of the image.

    Args:
        camera: as stated by the recording or the plan.

    Returns:
        A sentence, "" inside the middle 40 %; and True outside of the middle 80 %.
    """
    where = (camera.cx, camera.cy, camera.width, camera.height)
    if is_central(*where):
        return "", False
    return (
        f"the principal point ({camera.cx:.1f}, {camera.cy:.1f}) is far from the middle of the "
        f"image of {camera.width} x {camera.height} px, as if cx and cy belonged to another "
        "image size or to a larger image: lengths and the tilt are wrong if they do",
        not is_central(*where, 0.8),
    )


# Quality of a recording's depth sensor: noise, steps, unread edges, mixed pixels.


@dataclass(frozen=True)
class SensorCard:
    """The depth sensor of one recording.

    Attributes:
        noise: (depth mm, standard deviation mm) from near to far, () if nothing is still.
        step_mm: rounding step of depth at the usual distance; None if continuous.
        seam_px: width of the unread seam around the animal, pixels; None without an animal.
        mixed_share: share of readings at still edges between both sides ("flying pixels"), 0 to 1;
            None without such edges.
    """

    noise: tuple[tuple[float, float], ...] = ()
    step_mm: float | None = None
    seam_px: float | None = None
    mixed_share: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """For session.json; lengths in mm and pixels."""
        return asdict(self) | {"noise": [list(one) for one in self.noise]}

    @staticmethod
    def from_dict(numbers: dict[str, Any]) -> SensorCard:
        """The card that `to_dict` wrote, section `scene.sensor` of session.json."""
        noise = tuple((float(depth), float(sd)) for depth, sd in numbers["noise"])
        return SensorCard(noise, numbers["step_mm"], numbers["seam_px"], numbers["mixed_share"])

    def __str__(self) -> str:
        """One readable line."""
        noise = ", ".join(f"{sd:.1f} mm at {depth / 1000:.2f} m" for depth, sd in self.noise)
        # no sensor is so quiet
        if self.noise and max(sd for _, sd in self.noise) < 0.05:
            noise = "none, as of filtered or composed images"
        parts = [f"noise {noise or 'unknown'}"]
        if self.step_mm is not None:
            parts.append(f"steps of {self.step_mm:.2g} mm")
        if self.seam_px is not None:
            parts.append(f"{self.seam_px:.1f} px unread around the animal")
        if self.mixed_share is not None:
            parts.append(f"{self.mixed_share:.0%} of readings at edges are between both sides")
        return ", ".join(parts)


# Refraction at a flat water surface by Snell's law: the true position of a point observed from
# air.


RANGINGS = ("light_field", "structured_light", "time_of_flight", "paraxial")
_STEEPEST = 0.05  # cosine between a ray and the perpendicular; flatter rays do not reach the water


@dataclass(frozen=True)
class Water:
    """A flat water surface below the camera, which refracts by Snell's law.

    n sin r = sin i, with i and r the angles between ray and perpendicular in air and in water. A
    camera above the water observes every point in a wrong direction and reports a wrong depth. The
    direction is corrected by tracing the camera's ray down. The depth that the camera reports, the
    *apparent* depth, depends on its principle:

    - `light_field` (plenoptic cameras, many small views in all directions) and `structured_light`
    (also stereo; two views displaced along the image's rows) triangulate: the apparent point is
    where the back-traced rays of neighbouring views intersect. Straight down, that is at depth / n
    below the surface. Obliquely the rays of a point meet at two depths (refraction at a plane is
    astigmatic): views displaced within the plane of incidence see it at d cos^3(i) / (n cos^3(r)),
    views displaced across it at d tan(r) / tan(i), for a point d below the surface. A camera
    reports the depth whose disparity is the sum of both, each weighted with the part of the
    displacement along it; a light field uses the mean over all directions. - `time_of_flight`
    cameras report half the path of the light as if in air: the path in water counts n times, so
    that objects seem farther, not nearer. (n is that of the group velocity, and near infrared is
    soon absorbed.) - `paraxial`: depth / n below the surface at every angle, the textbook rule; for
    comparison.

    Attributes:
        height_mm: of the lens above the surface, along the perpendicular.
        refractive_index: of water over air, at least 1.
        tilt_x_rad: slope of the surface away from the camera towards the right of the image.
        tilt_y_rad: slope away from the camera towards the lower edge of the image.
        ranging: one of `RANGINGS`, see the module.

    Raises:
        LiexError: a height that is not positive, an index below 1, a tilt of 1.2 rad or more, or an
            unknown ranging.
    """

    height_mm: float
    refractive_index: float = 1.333
    tilt_x_rad: float = 0.0
    tilt_y_rad: float = 0.0
    ranging: str = "light_field"

    def __post_init__(self) -> None:
        numbers = (self.height_mm, self.refractive_index, self.tilt_x_rad, self.tilt_y_rad)
        possible = (
            self.height_mm > 0 and self.refractive_index >= 1 and np.abs(numbers[2:]).max() < 1.2
        )
        if not (possible and np.isfinite(numbers).all() and self.ranging in RANGINGS):
            raise LiexError(
                "a water surface has a positive height_mm below the lens, a "
                "refractive_index of at least 1, tilts below 1.2 rad and ranging "
                f"{', '.join(RANGINGS)}, got {asdict(self)}; correct [water] in the plan"
            )

    @property
    def normal(self) -> Array:
        """Unit normal (3,) of the surface, away from the camera, in the camera frame."""
        down = np.array([-np.tan(self.tilt_x_rad), -np.tan(self.tilt_y_rad), 1.0])
        return down / np.linalg.norm(down)

    @property
    def lift_mm(self) -> Array:
        """Translation (3,) mm from the camera's frame to that of `without`.

        To be added to points; the axes are parallel.
        """
        return (self.refractive_index - 1.0) * self.height_mm * self.normal

    def without(self, camera: Camera) -> Camera:
        """The ideal camera, higher up, that without the water has the same view as this one through
        it.

        Under water the rays that meet in the lens continue, near the perpendicular, as if they met
        n times as high above the surface. An ideal camera there (see `lift_mm`), with focal lengths
        n times as long, sees everything from the same side and in the same pixel; away from the
        perpendicular a point moves slightly towards the middle.

        Args:
            camera: the real one, without distortion.
        """
        n = self.refractive_index
        bent = self.law(np.zeros(2))[7:]
        return replace(
            camera,
            fx=n * camera.fx,
            fy=n * camera.fy,
            cx=camera.cx - n * camera.fx * float(bent[0] / bent[2]),
            cy=camera.cy - n * camera.fy * float(bent[1] / bent[2]),
        )

    def law(self, rays: ArrayLike) -> Array:
        """The effect of refraction on rays: ten numbers for each.

        (a, b, c, k, sx, sy, sz, bx, by, bz): a point reported at apparent depth z is d below the
        surface, where

            a d^2 + (b - c z) d = k z - 1,   if k z > 1,

        else above the water, at its apparent position; its position is (sx, sy, sz) + d (bx, by,
        bz), mm in the camera frame: the ray's own position on the surface, and its direction down.
        Rays flatter than 0.05 (cosine to the perpendicular) do not reach the water: k = 0.

        Args:
            rays: (..., 2), the x and y of (x, y, 1), camera frame.

        Returns:
            (..., 10).
        """
        xy = np.asarray(rays, float)
        ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        down = self.normal
        n = self.refractive_index
        h = self.height_mm
        cos_air = ray @ down
        reaches = cos_air > _STEEPEST
        cos_air = np.maximum(cos_air, _STEEPEST)
        cos_water = np.sqrt(1.0 - (1.0 - cos_air**2) / n**2)
        surface = ray * (h / cos_air)[..., None]
        bent = ray / n + (cos_water - cos_air / n)[..., None] * down
        law = np.concatenate(
            [self._depth_law(ray, cos_air, cos_water), surface, bent / cos_water[..., None]],
            axis=-1,
        )
        law[..., 3] = np.where(reaches, cos_air / (ray[..., 2] * h), 0.0)
        return law

    def _depth_law(self, ray: Array, cos_air: Array, cos_water: Array) -> Array:
        """a, b, c of `law` and an empty column for k (..., 4), from unit rays and cosines."""
        n = self.refractive_index
        h = self.height_mm
        zero = np.zeros_like(cos_air)
        if self.ranging == "paraxial":
            return np.stack([zero, zero + 1.0 / (n * h), zero, zero], axis=-1)
        if self.ranging == "time_of_flight":
            return np.stack([zero, n * cos_air / (h * cos_water), zero, zero], axis=-1)
        within = cos_air**3 / (
            n * cos_water**3
        )  # apparent over true depth, views displaced in the plane of incidence
        across = cos_air / (n * cos_water)  # tan r / tan i
        weight_within, weight_across = self._weights(ray, cos_air)
        return np.stack(
            [
                within * across / h**2,
                (within + across) / h,
                (weight_within * across + weight_across * within) / h**2,
                zero,
            ],
            axis=-1,
        )

    def _weights(self, ray: Array, cos_air: Array) -> tuple[Array, Array]:
        """The parts (...) of the views' displacement within and across the plane of incidence of
        unit rays (..., 3).

        They weight the disparities: cos i / z' summed over both foci, z' being the distance of each
        below the lens.
        """
        side = np.cross(self.normal, ray)
        straight_down = (
            np.linalg.norm(side, axis=-1, keepdims=True) < 1e-9
        )  # where both foci coincide
        side = np.where(straight_down, np.cross([0.0, 1.0, 0.0], ray), side)
        side = side / np.linalg.norm(side, axis=-1, keepdims=True)
        along = np.cross(side, ray)
        axes = (0, 1) if self.ranging == "light_field" else (0,)
        within = np.zeros_like(cos_air)
        across = np.zeros_like(cos_air)
        for k in (
            axes
        ):  # the disparity of a displacement along one image axis is measured along that axis
            slope = ray[..., k] / ray[..., 2]
            within += (along[..., k] - slope * along[..., 2]) * along[..., k]
            across += (side[..., k] - slope * side[..., 2]) * side[..., k]
        share = cos_air / ray[..., 2] / len(axes)
        return within * share, across * share

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for session.json."""
        return asdict(self)
