"""Regions that a plan states, in the images of a recording, and proposed arenas.

An arena is cut out by making all pixels outside its region unread. Image size and camera stay the
same, so measurements keep their coordinates, and the session of one arena of several equals that of
a recording that contains nothing else. Regions in millimetres need the floor, which is estimated
from the whole image, or stated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from liex_lab.body.skeleton import VIEWS, Skeleton
from liex_lab.errors import PlanError
from liex_lab.optics.camera import Camera
from liex_lab.plan import Plan
from liex_lab.plan.sections import Region, SeveralArenas
from liex_lab.recordings.frame import region_mask
from liex_lab.recordings.recording import Recording
from liex_lab.scene.floor import Floor
from liex_lab.scene.scene import plane_of
from liex_lab.scene.support_plane import (
    SampledScene,
    TargetAnimal,
    arenas_apart,
    find_support_plane,
)
from liex_lab.scene.zones import Corners, region_corners_px

from .origin import animal_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


_N_SAMPLED = 96


def cut_out(recording: Recording, plan: Plan) -> Recording:
    """The recording with all but `arena.region` unread; unchanged if the plan states none.

    Raises:
        PlanError: the region lies outside the image.
        EstimationError: it is stated in millimetres, and no floor is found.
    """
    if plan.arena.region is None or recording.region_px:
        return recording
    return recording.masked(stated_corners(recording, plan, plan.arena.region))


def stated_corners(recording: Recording, plan: Plan, region: Region) -> Corners:
    """The corners (u, v) px of a region in the images of a recording.

    Args:
        recording: an ideal pinhole's recording, of the whole image.
        plan: states the floor, or the animals that stand on it.
        region: the region.
    """
    floor = None if region.unit == "px" else _floor_of_picture(recording, plan)
    return region_corners_px(region, recording.camera, floor)


def pinned(plan: Plan, recording: Recording) -> Plan:
    """The plan with the region of a recording, which was cut out, in pixels."""
    if not recording.region_px:
        return plan
    corners = [list(corner) for corner in recording.region_px]
    return plan.with_settings([f"arena.region={corners}"])


def stated_floor(camera: Camera, plan: Plan) -> Floor | None:
    """The floor that the plan states (`arena.floor`); None if it is to be found.

    Raises:
        PlanError: the floor does not face the camera.
    """
    floor = plan.arena.floor
    return None if isinstance(floor, str) else plane_of(floor.point, floor.normal, camera)


def region_of(recording: Recording, plan: Plan) -> NDArray[np.bool_] | None:
    """The pixels (H, W) bool of the plan's `arena.region`; None for all.

    Raises:
        PlanError: the region lies outside the image.
    """
    corners = recording.region_px
    if not corners and plan.arena.region is not None:
        corners = stated_corners(recording, plan, plan.arena.region)
    return region_mask(corners, recording.width, recording.height) if corners else None


def _floor_of_picture(recording: Recording, plan: Plan) -> Floor:
    """The floor that the plan states, or the one on which animals stand in the whole image."""
    stated = stated_floor(recording.camera, plan)
    if stated is not None:
        return stated
    found = find_support_plane(_sampled(recording, plan)[0]).floor
    return found.for_camera(recording.camera)


def _sampled(recording: Recording, plan: Plan) -> tuple[SampledScene, int]:
    """Frames spread over a recording with their background, and the stride of their pixels."""
    from liex_lab.scene.background import sample_frames, sampled_scene, stride_for

    stride = stride_for(recording, animal_of(plan).spine_min_mm)
    sample = sample_frames(recording, _N_SAMPLED, stride)
    return sampled_scene(sample, recording.camera.every(stride), target_of(plan)), stride


def target_of(plan: Plan) -> TargetAnimal:
    """The animal of a plan as it is searched for in depth images."""
    animal = animal_of(plan)
    return TargetAnimal(
        (animal.spine_min_mm, animal.spine_max_mm),
        plan.foreground.min_height_mm,
        Skeleton.load(animal.skeleton).view,
    )


def arenas_of(recording: Recording, plan: Plan) -> list[SeveralArenas]:
    """The arenas of a recording of the whole image, as listed in the plan or as proposed.

    Raises:
        PlanError: the setting is 'auto', and fewer than two are found.
    """
    if plan.arenas != "auto":
        return list(plan.arenas or ())
    found = propose_arenas(recording, plan)
    if len(found) < 2:
        raise PlanError(
            "arenas = 'auto' proposes several arenas in which animals move, and fewer than two are "
            "seen in this picture; leave the line out, or list them as [[arenas]] with name and "
            "region"
        )
    return found


def propose_arenas(recording: Recording, plan: Plan) -> list[SeveralArenas]:
    """The arenas in which animals move, from left to right and top to bottom of the whole image.

    Returns:
        Two to eight of them, with disjoint polygons; [] if only one is found.
    """
    view = Skeleton.load(plan.animal.skeleton).view
    if view.frame != VIEWS[0] or recording.region_px:
        return []
    scene, stride = _sampled(recording, plan)
    return [
        SeveralArenas.model_validate(
            {
                "name": f"arena{k}",
                "region": [[float(stride * u), float(stride * v)] for u, v in corners],
            }
        )
        for k, corners in enumerate(arenas_apart(scene), 1)
    ]
