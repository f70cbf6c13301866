"""Provenance of a session: recording, animal, arena and scene, zones, disk space."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from liex_lab.runtime.progress import Progress, silent

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from liex_lab.behaviour.activity import Surroundings
    from liex_lab.plan import Plan
    from liex_lab.plan.sections import AnimalSettings
    from liex_lab.recordings.recording import Recording
    from liex_lab.scene.height_maps import Segmenter
    from liex_lab.scene.scene import Arena, Scene
    from liex_lab.scene.zones import DrawnZone, Zone
    from liex_lab.sessions import Provenance
    from liex_lab.tracking.tracker import FrameTracker


# least and largest length of a user's own animal, over the home length
_SPANS = (0.6, 1.8)


def animal_of(plan: Plan) -> AnimalSettings:
    """The plan's animal, completed from the skeleton if that is the user's own.

    Its name is then the skeleton's, and its spine 0.6 to 1.8 times the skeleton's length.

    Raises:
        LiexError: the skeleton's file cannot be read.
    """
    from liex_lab.body.skeleton import Skeleton

    animal = plan.animal
    if not animal.skeleton.endswith(".toml"):
        return animal
    skeleton = Skeleton.load(animal.skeleton)
    low, high = (round(factor * skeleton.length, 3) for factor in _SPANS)
    own = {"name": skeleton.name, "spine_min_mm": low, "spine_max_mm": high}
    usual = type(animal).model_fields  # a plan that was written to a file states its defaults
    return animal.model_copy(
        update={k: v for k, v in own.items() if getattr(animal, k) == usual[k].default}
    )


def build_provenance(
    recording: Recording, plan: Plan, tracker: FrameTracker, progress: Progress = silent
) -> Provenance:
    """The session's provenance: recording, camera, plan, model, animal, arena, zones.

    Args:
        recording: an open recording; hashing its content takes the longest.
        plan: names the model and the zones.
        tracker: the prepared tracker: background, animal's size, girth.
        progress: called while the content is hashed.
    """
    from liex_lab.catalog import find_model, sha256
    from liex_lab.sessions import Provenance

    # cached by the recording; takes the longest, so it shows the progress
    recording.digest(progress)
    arena, zones = build_arena(tracker.scene, plan)
    return Provenance.of(
        recording,
        tracker.scene.floor,
        tracker.estimator.skeleton,
        plan,
        model={"name": plan.estimation.model, "sha256": sha256(find_model(plan.estimation.model))},
        animal_size=animal_facts(plan, tracker),
        arena=arena,
        zones=zones,
        scene=build_described_scene(tracker.scene, arena),
        background=build_background(recording, plan, tracker.scene),
    )


def animal_facts(plan: Plan, tracker: FrameTracker) -> dict[str, Any]:
    """The animal's size, girth and shape for session.json."""
    shared = plan.animal.shared
    origin = "estimated over the recording"
    if tracker.size_origin == "plan":
        is_shared = shared is not None and plan.animal.spine_mm is None
        origin = f"shared by {shared.by}" if shared and is_shared else "stated in the plan"
    return {
        "spine_mm": round(tracker.spine_mm, 3),
        "origin": origin,
        "girth": round(tracker.body.girth, 3),
        **({} if tracker.shape is None else {"shape": tracker.shape.to_dict()}),
    }


def build_background(
    recording: Recording, plan: Plan, segmenter: Segmenter
) -> NDArray[np.uint16] | None:
    """The still scene (H, W) mm behind the replay's cut-outs; None if the replay has none.

    Args:
        recording: an open recording.
        plan: its section `replay`.
        segmenter: the learned segmentation, which separates an animal at rest from the scene.
    """
    from liex_lab.scene.background_segmenter import BackgroundSubtraction
    from liex_lab.sessions.cutouts import ANIMAL, ARENA, still_scene

    if plan.replay.depth not in (ANIMAL, ARENA):
        return None
    return still_scene(
        recording, segmenter if isinstance(segmenter, BackgroundSubtraction) else None
    )


def build_described_scene(segmenter: Segmenter, arena: Arena) -> Scene | None:
    """The still scene for session.json; None for a hand, which has no floor."""
    from liex_lab.scene.background_segmenter import BackgroundSubtraction

    if not isinstance(segmenter, BackgroundSubtraction):
        return None
    return replace(segmenter.described(), outline=arena)


def build_arena(scene: Segmenter, plan: Plan) -> tuple[Arena, tuple[Zone, ...]]:
    """The outline of the arena's floor, and the plan's zones in it, arena frame, mm.

    Args:
        scene: the learned segmentation; a hand has no arena, so its outline is unknown.
        plan: names the file of zones.
    """
    from liex_lab.scene.background_segmenter import BackgroundSubtraction
    from liex_lab.scene.scene import UNKNOWN, find_arena

    arena = UNKNOWN
    if isinstance(scene, BackgroundSubtraction):
        arena = find_arena(scene.background, scene.floor.for_camera(scene.grid), scene.grid)
    return arena, tuple(zone.placed(scene.camera, scene.floor, arena) for zone in build_zones(plan))


def build_zones(plan: Plan) -> tuple[DrawnZone, ...]:
    """The zones of the plan as drawn; () if it names none.

    Raises:
        PlanError: the file of zones cannot be used.
    """
    from liex_lab.scene.zones import read_zones

    return read_zones(plan.arena.zones) if plan.arena.zones else ()


def build_surroundings(provenance: Provenance) -> Surroundings:
    """Arena, zones and water surface for the measures of behaviour."""
    from liex_lab.behaviour.activity import Surroundings, surface_height_mm

    surface = surface_height_mm(provenance.floor_distance_mm, provenance.optics)
    return Surroundings(provenance.arena, [zone.name for zone in provenance.zones], surface)


def session_bytes(recording: Recording, plan: Plan, length_mm: float, distance_mm: float) -> int:
    """Size of a recording's session on disk, bytes, within a factor of two.

    Args:
        recording: an open recording.
        plan: the animal's skeleton, and how much of the depth is kept.
        length_mm: of the animal.
        distance_mm: of the animal from the camera.
    """
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.recordings.depth_kernels import to_millimetres
    from liex_lab.sessions.cutouts import needed_bytes

    rows = sorted({0, len(recording) // 2})
    images = [to_millimetres(recording.frame(row).depth) for row in rows]
    n_joints = Skeleton.load(plan.animal.skeleton).n_joints
    length_px = recording.camera.fx * length_mm / distance_mm
    return needed_bytes(images, len(recording), n_joints, length_px, plan.replay.depth)
