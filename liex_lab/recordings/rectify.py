"""Rectification of depth images: correction of lens distortion and of refraction at a water
surface.

All later steps assume an ideal pinhole camera in air; a recording without distortion and water is
returned unchanged. Distortion (Brown-Conrady or Kannala-Brandt): inverse warping by a
nearest-neighbour lookup table into an undistorted image with the same focal lengths, enlarged to
contain what the distorted one contained. Water (Snell's law, `Water.law`): every reading becomes a
point, is moved to its true position and splatted forward with a z-buffer into an ideal camera above
the real one (`Water.without`); small holes are then closed.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera, Water
from liex_lab.recordings import depth_kernels as kernels
from liex_lab.recordings.frame import Depth
from liex_lab.recordings.recording import Recording

_MAX_GROWTH = 0.15  # of an image's width or height, at each side


def rectified(recording: Recording, water: Water | None = None) -> Recording:
    """The recording with lens distortion and refraction corrected on reading.

    If more than 5 % of the pixels are lost at the image's edge, `problems` of the result report it.

    Args:
        recording: depth as delivered by the camera.
        water: the water surface; None for air. Ignored if it was corrected before.

    Returns:
        The rectified recording, whose `optics` list the corrections; the recording itself if there
        is neither distortion nor water.
    """
    camera = recording.camera
    water = None if recording.optics.get("water") else water  # it was corrected before
    if camera.distortion is None and water is None:
        return recording
    optics = {
        **recording.optics,
        "distortion": None if camera.distortion is None else camera.distortion.to_dict(),
        "water": None if water is None else water.to_dict(),
    }
    view = recording.viewed_by(ideal_camera(camera, water), rectifier(camera, water), optics)
    lost = share_lost(camera)
    # share of an image's pixels lost at its edge
    if lost > 0.05:
        view.problems.append(
            f"{lost:.0%} of the pixels leave the image when the lens distortion is undone; keep "
            "the animal away from the image's edge, or check the distortion's coefficients"
        )
    return view


def mirrored(recording: Recording, *, lent: bool = False) -> Recording:
    """The recording with left and right exchanged in every image.

    Drivers of some cameras deliver mirrored images. A mirrored image of a left hand cannot be
    distinguished from one of a right hand, so this also serves to measure left hands.

    Args:
        recording: rectified depth: a distortion would not be mirrored.
        lent: keep the recording open when the result is closed.

    Returns:
        The mirrored recording, with its principal point mirrored too.
    """
    camera = recording.camera
    turned = replace(camera, cx=camera.width - 1.0 - camera.cx)
    optics = {**recording.optics, "mirrored": True}
    return recording.viewed_by(
        turned, lambda depth: np.ascontiguousarray(depth[:, ::-1]), optics, lent=lent
    )


def ideal_camera(camera: Camera, water: Water | None = None) -> Camera:
    """The ideal pinhole camera, in air, of the rectified images.

    Args:
        camera: the real camera, perhaps with distortion.
        water: the water surface in front of it; None for air.
    """
    straight = straight_camera(camera)
    return straight if water is None else water.without(straight)


def straight_camera(camera: Camera) -> Camera:
    """The same camera without distortion, with an image large enough for the distorted one.

    The image grows on each side by the displacement of the distorted edge, up to 15 % of its width
    or height (`_MAX_GROWTH`), because the far corners of a fisheye lens would be at infinity. Its
    sizes are multiples of four; the focal lengths stay the same.
    """
    straight = replace(camera, distortion=None)
    if camera.distortion is None:
        return straight
    size = (camera.width, camera.height)
    grown: list[tuple[int, int]] = []
    for axis in (0, 1):
        along = np.linspace(0.0, size[1 - axis] - 1.0, 65)
        before, after = (
            np.stack([np.full(65, end), along][:: 1 - 2 * axis], axis=-1)
            for end in (0.0, size[axis] - 1.0)
        )
        low, high = (
            straight.project(camera.unproject(edge, 1.0))[:, axis] for edge in (before, after)
        )
        most = _MAX_GROWTH * size[axis]
        bounds = [
            np.where(np.isfinite(off), off, most).max() for off in (-low, high - size[axis] + 1.0)
        ]
        start, stop = (int(np.ceil(min(max(value, 0.0), most))) for value in bounds)
        grown.append((start, stop + -(size[axis] + start + stop) % 4))
    (left, right), (top, bottom) = grown
    return replace(
        straight,
        cx=camera.cx + left,
        cy=camera.cy + top,
        width=camera.width + left + right,
        height=camera.height + top + bottom,
    )


def rectifier(camera: Camera, water: Water | None = None) -> Callable[[Depth], Depth]:
    """The function that converts depth of a camera to depth of its `ideal_camera`.

    Args:
        camera: the real camera, perhaps with distortion.
        water: the water surface in front of it; None for air.

    Returns:
        A function from depth (H, W) float32 mm to depth (H', W') float32 mm, 0 where unread.
    """
    source = None if camera.distortion is None else lookup_table(camera)
    laws = None if water is None else pixel_laws(straight_camera(camera), water)

    def undo(depth: Depth) -> Depth:
        """Rectify depth (H, W) float32 mm, 0 where unread; returns (H', W') float32 mm."""
        if source is not None:
            straight = np.empty(source.shape, np.float32)
            kernels.gather(depth, source, straight)
            depth = straight
        if laws is not None:
            lifted = np.empty_like(depth)
            closed = np.empty_like(depth)
            kernels.lift(depth, laws, lifted)
            kernels.close(lifted, closed)
            depth = closed
        return depth

    return undo


def lookup_table(camera: Camera) -> NDArray[np.int32]:
    """For every pixel of the undistorted image, the nearest pixel of the distorted one.

    Nearest-neighbour inverse warping: forward warping would leave holes where the undistorted image
    is larger. Depth along the optical axis is the same in both. It is never interpolated, which
    would create points between the animal and the floor.

    Args:
        camera: the camera with distortion.

    Returns:
        (H', W') int32, row * width + column in the distorted image; -1 if absent.
    """
    straight = straight_camera(camera)
    pixels = np.floor(camera.project(straight.unproject(_pixels(straight), 1.0)) + 0.5)
    inside = _inside(pixels, camera)
    pixels = np.where(inside[..., None], pixels, 0).astype(np.int32)
    return np.where(inside, pixels[..., 1] * camera.width + pixels[..., 0], -1).astype(np.int32)


def pixel_laws(camera: Camera, water: Water) -> NDArray[np.float32]:
    """Refraction law of every pixel's ray, in homogeneous pixels, as required by `kernels.lift`.

    13 numbers per pixel: the first four of `Water.law`, its two vectors of three in homogeneous
    pixels (u z, v z, z) of the ideal camera, and the shift of three to that camera, which is higher
    than the real one by `lift_mm`.

    Args:
        camera: a camera without distortion.
        water: the water surface in front of it.

    Returns:
        (H, 13, W) float32.
    """
    ideal = water.without(camera)
    up = water.lift_mm
    to_pixels = ideal.matrix
    laws = np.empty((camera.height, 13, camera.width), np.float32)
    uv = _pixels(camera)
    for row in range(0, camera.height, 8):  # some rows at a time stay in the processor's cache
        law = water.law(camera.unproject(uv[row : row + 8], 1.0)[..., :2])
        part = [law[..., :4], law[..., 4:7] @ to_pixels.T, law[..., 7:10] @ to_pixels.T]
        part.append(np.broadcast_to(to_pixels @ up, part[1].shape))
        laws[row : row + 8] = np.moveaxis(np.concatenate(part, axis=-1), -1, 1)
    return laws


def share_lost(camera: Camera) -> float:
    """Share of the distorted image's pixels that are outside the undistorted image.

    Args:
        camera: the real camera, perhaps with distortion.

    Returns:
        A share from 0 to 1, measured on every eighth row and column; 0 without distortion.
    """
    if camera.distortion is None:
        return 0.0
    straight = straight_camera(camera)
    uv = straight.project(camera.unproject(_pixels(camera)[::8, ::8], 1.0))
    return float(1.0 - _inside(uv, straight).mean())


def _inside(uv: NDArray[np.float64], camera: Camera) -> NDArray[np.bool_]:
    """Whether (...) pixels (..., 2) are in the image; False for NaN."""
    right = uv[..., 0] + 0.5
    down = uv[..., 1] + 0.5
    return np.asarray((right >= 0) & (right < camera.width) & (down >= 0) & (down < camera.height))


def _pixels(camera: Camera) -> NDArray[np.float64]:
    """(u, v) of every pixel (H, W, 2)."""
    return np.stack(
        np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height))), axis=-1
    )
