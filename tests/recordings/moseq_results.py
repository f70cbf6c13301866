"""Writer of the layout of moseq2-extract's results_00.h5, by its published definitions, and the
scalars, one frame at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

LOW, HIGH, SIDE = 10, 100, 80
FOCAL = (512 / (2 * np.deg2rad(35.3)), 424 / (2 * np.deg2rad(30.0)))  # the angle for its tangent
_TAIL = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))


def heights(
    depth: NDArray[Any], background: NDArray[Any], roi: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Heights (h, w) mm in the crop around the region, 0 outside of LOW to HIGH."""
    height = (background - depth.astype(float)).astype(np.int64).astype(np.uint8)
    height[(height < LOW) | (height > HIGH)] = 0
    rows, columns = np.nonzero(roi)
    return (height * roi)[rows.min() : rows.max(), columns.min() : columns.max()]


def filtered(height: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.morphologyEx(cv2.medianBlur(height, 3), cv2.MORPH_OPEN, _TAIL), np.uint8)


def features(height: NDArray[np.uint8]) -> tuple[float, float, float, float, float]:
    """Centroid x, y px, orientation rad, length and width px of the largest outline."""
    outlines, _ = cv2.findContours(
        (height > LOW).astype(np.uint8), cv2.RETR_TREE, cv2.CHAIN_APPROX_SIMPLE
    )
    m = cv2.moments(max(outlines, key=cv2.contourArea))
    spread = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / m["m00"]
    short, long = np.sqrt(np.maximum(np.linalg.eigvalsh(spread), 0))
    angle = -0.5 * np.arctan2(2 * m["mu11"], m["mu20"] - m["mu02"])
    # MoSeq leaves the factor 2 of both eigenvalues in
    return m["m10"] / m["m00"], m["m01"] / m["m00"], angle, 4 * long, 4 * short


def cut_out(height: NDArray[np.uint8], x: float, y: float, angle: float) -> NDArray[np.uint8]:
    half = SIDE // 2
    left, top = int(np.trunc(x - half)), int(np.trunc(y - half))
    padded = np.pad(height, SIDE)
    window = padded[top + SIDE : top + 2 * SIDE, left + SIDE : left + 2 * SIDE]
    turn = cv2.getRotationMatrix2D((half, half), -np.rad2deg(angle), 1)
    return np.asarray(cv2.warpAffine(window, turn, (SIDE, SIDE)), np.uint8)


def write_results(
    path: Path,
    depth: Sequence[NDArray[Any]],
    background: NDArray[Any],
    roi: NDArray[np.bool_],
    times_ms: NDArray[np.float64],
    flips: NDArray[np.bool_] | None = None,
    places: NDArray[np.float64] | None = None,
    acquisition: dict[str, Any] | None = None,
    floor: float | None = None,
    stored: dict[str, NDArray[Any]] | None = None,
) -> dict[str, NDArray[Any]]:
    """Write the file; returns the scalars of these frames.

    places: (n, 3) centroid x, y in the crop and angle; stored: scalars that the file holds instead.
    """
    n = len(depth)
    floor = floor or float(np.median(background[roi]))
    high = [heights(one, background, roi) for one in depth]
    found = np.array([features(filtered(one)) for one in high])
    if places is None:
        places = found[:, :3].copy()
        places[:, 2] = np.unwrap(2 * places[:, 2]) / 2
    cuts = np.stack([cut_out(one, *at) for one, at in zip(high, places, strict=True)])
    clean = np.stack([cut_out(filtered(one), *at) for one, at in zip(high, places, strict=True)])
    turned = np.zeros(n, np.bool_) if flips is None else flips
    cuts[turned] = np.rot90(cuts[turned], 2, axes=(1, 2))
    x, y = places[:, 0], places[:, 1]
    is_mouse = (clean > LOW) & (clean < HIGH)
    area = is_mouse.sum(axis=(1, 2))
    mean = np.array([one[own].mean() for one, own in zip(clean, is_mouse, strict=True)])
    xyz = {
        "px": np.stack([x, y, mean], axis=1),
        "mm": np.stack([(x - 256) * floor / FOCAL[0], (y - 212) * floor / FOCAL[1], mean], axis=1),
    }
    steps = {unit: np.diff(one, axis=0, prepend=one[:1]) for unit, one in xyz.items()}
    scale = floor / np.array(FOCAL)
    scalars = {
        **{f"centroid_{axis}_{u}": xyz[u][:, k] for u in xyz for k, axis in enumerate("xy")},
        **{f"velocity_2d_{u}": np.linalg.norm(steps[u][:, :2], axis=1) for u in xyz},
        **{f"velocity_3d_{u}": np.linalg.norm(steps[u], axis=1) for u in xyz},
        "length_px": found[:, 3],
        "width_px": found[:, 4],
        "area_px": area,
        "length_mm": found[:, 3] * scale[0],
        "width_mm": found[:, 4] * scale[1],
        "area_mm": area * scale.mean(),
        "height_ave_mm": mean,
        "angle": places[:, 2] + np.pi * turned,
        "velocity_theta": np.arctan2(steps["mm"][:, 1], steps["mm"][:, 0]),
    }
    with h5py.File(path, "w") as file:
        for name, values in (scalars | (stored or {})).items():
            file.create_dataset(f"scalars/{name}", data=values.astype("f4"), compression="gzip")
        file.create_dataset("timestamps", data=times_ms, compression="gzip")
        file.create_dataset("frames", data=cuts, compression="gzip")
        file.create_dataset("frames_mask", data=cuts > 0, compression="gzip")
        own = file.create_group("metadata/extraction")
        own["true_depth"] = floor
        own["roi"] = roi
        own["background"] = background
        own["first_frame"] = np.asarray(depth[0], np.uint16)
        own["extract_version"] = np.bytes_("1.2.0")
        if flips is not None:
            own["flips"] = flips
        own["parameters/min_height"] = LOW
        own["parameters/max_height"] = HIGH
        for key, value in (acquisition or {}).items():
            file[f"metadata/acquisition/{key}"] = value
    return scalars
