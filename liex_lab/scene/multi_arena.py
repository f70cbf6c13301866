"""Multiple arenas in one image: separates the grounds on which different animals move.

Each ground (`floor.flat_grounds`) with moving objects of an animal's size is an arena, and so is a
walled one of similar size whose animal is asleep. An arena's region is within a largest spine
length of its ground's convex hull and nearer to it than to any other (a Voronoi cell), so that no
two regions meet.
"""

from __future__ import annotations

import numpy as np

from liex_lab.scene.floor import FlatGround, flat_grounds
from liex_lab.scene.support_plane import SampledScene, find_movers

_MOST = 8
_LEAST_MOVERS = 3  # moving objects on a ground
_ALIKE = 2.0  # largest ratio of areas for a ground without movement
_ENCLOSED = 0.6  # least walled share of its outline
_APART_PX = 2.0  # between two regions at least
_SMOOTH_PX = 1.5  # by which a polygon may leave its region


def arenas_apart(scene: SampledScene) -> list[list[tuple[int, int]]]:
    """The outlines of multiple arenas.

    Args:
        scene: sampled frames and their background.

    Returns:
        (u, v) corners of each, pixels of the scene's camera, row by row from the top left; [] for
        fewer than two or more than eight.
    """
    camera = scene.camera
    movers = find_movers(scene)
    supporting: list[FlatGround] = []
    others: list[FlatGround] = []
    for ground in flat_grounds(scene.background, camera, scene.least_ground_mm2):
        n = sum(mover.is_on(ground.floor, ground.patch) for mover in movers)
        (supporting if n >= _LEAST_MOVERS else others).append(ground)
    supporting = _one_each(supporting)
    if supporting:
        usual = float(np.median([ground.patch.sum() for ground in supporting]))
        asleep = [
            ground
            for ground in others
            if ground.enclosed >= _ENCLOSED and usual / _ALIKE < ground.patch.sum() < usual * _ALIKE
        ]
        supporting = _one_each([*supporting, *asleep])
    if not 2 <= len(supporting) <= _MOST:
        return []
    reach = [
        scene.spine_mm[1] * float(np.sqrt(camera.fx * camera.fy)) / ground.floor.distance_mm
        for ground in supporting
    ]
    return _outlines(supporting, reach)


def _one_each(grounds: list[FlatGround]) -> list[FlatGround]:
    """The grounds, without those that overlap the hull of an earlier one."""
    kept: list[FlatGround] = []
    for ground in grounds:
        rows, columns = np.nonzero(ground.patch)
        middle = (int(np.median(rows)), int(np.median(columns)))
        hull = ground.region(0.0)
        overlaps = any(
            one.region(0.0)[middle] or (hull & one.region(0.0)).sum() > 0.2 * hull.sum()
            for one in kept
        )
        if not overlaps:
            kept.append(ground)
    return kept


def _outlines(grounds: list[FlatGround], reach_px: list[float]) -> list[list[tuple[int, int]]]:
    """The polygons of the Voronoi cells around the grounds, within the reach of each, px."""
    import cv2

    away = np.stack(
        [
            cv2.distanceTransform(1 - ground.region(0.0).astype(np.uint8), cv2.DIST_L2, 5)
            for ground in grounds
        ]
    )
    found = []
    for k, reach in enumerate(reach_px):
        nearest_other = np.delete(away, k, axis=0).min(axis=0)
        margin = _APART_PX + 2.0 * _SMOOTH_PX
        cell = ((away[k] <= reach) & (away[k] + margin < nearest_other)).astype(np.uint8)
        outlines, _ = cv2.findContours(cell, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        largest = max(outlines, key=cv2.contourArea)
        corners = cv2.approxPolyDP(largest, _SMOOTH_PX, True)[:, 0]
        found.append([(int(u), int(v)) for u, v in corners])
    return _in_reading_order(found)


def _in_reading_order(outlines: list[list[tuple[int, int]]]) -> list[list[tuple[int, int]]]:
    """Row by row from the top, within a row from the left."""
    middles = [np.mean(corners, axis=0) for corners in outlines]
    heights = [np.ptp(np.array(corners)[:, 1]) for corners in outlines]
    row_px = 0.5 * float(np.median(heights)) if heights else 1.0
    order = sorted(range(len(outlines)), key=lambda k: float(middles[k][1]))
    rows: list[list[int]] = []
    for k in order:
        if rows and middles[k][1] - middles[rows[-1][0]][1] < row_px:
            rows[-1].append(k)
        else:
            rows.append([k])
    return [outlines[k] for row in rows for k in sorted(row, key=lambda k: float(middles[k][0]))]
