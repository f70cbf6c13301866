"""From a plan to objects: recording, background subtraction, estimator, tracker, rules.

Only this module turns names and numbers of a plan into objects of the library (a factory for each).
Errors in the plan are raised before any work is done.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions import storage, timeline
from liex_lab.behaviour import activity, bouts
from liex_lab.body.skeleton import FOREGROUNDS, VIEWS, Skeleton
from liex_lab.catalog import find_model, sha256
from liex_lab.errors import PlanError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.model import Model
from liex_lab.estimation.session_shape import labels_of
from liex_lab.optics.camera import Camera, Distortion, Lens, Water, preset
from liex_lab.plan import Plan, known_plans, sections
from liex_lab.recordings import depth_kernels, frame, open_recording, rectify
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene import (
    background,
    background_segmenter,
    hand_segmenter,
    height_maps,
    learning,
    support_plane,
)
from liex_lab.scene.floor import Floor
from liex_lab.scene.scene import UNKNOWN, Arena, find_arena, plane_of
from liex_lab.scene.zones import (
    Corners,
    DrawnZone,
    Zone,
    joint_of,
    read_zones,
    region_corners_px,
)
from liex_lab.sessions import Provenance, cutouts
from liex_lab.tracking.joint import JointTracker
from liex_lab.tracking.own_shape import StatedShape
from liex_lab.tracking.tracker import FrameTracker


def animal_of(plan: Plan) -> sections.AnimalSettings:
    """The plan's animal, completed from the skeleton if that is the user's own.

    Its name is then the skeleton's, and its spine 0.6 to 1.8 times the skeleton's length.

    Raises:
        LiexError: the skeleton's file cannot be read.
    """
    animal = plan.animal
    if not animal.skeleton.endswith(".toml"):
        return animal
    skeleton = Skeleton.load(animal.skeleton)
    # least and largest length of a user's own animal, over the home length
    low, high = (round(factor * skeleton.length, 3) for factor in (0.6, 1.8))
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
    # cached by the recording; takes the longest, so it shows the progress
    recording.digest(progress)
    arena, zones = build_arena(tracker.scene, plan)
    described = None  # a hand has no floor
    if isinstance(tracker.scene, background_segmenter.BackgroundSubtraction):
        described = replace(tracker.scene.described(), outline=arena)
    return Provenance.of(
        recording,
        tracker.scene.floor,
        tracker.estimator.skeleton,
        plan,
        model={"name": plan.estimation.model, "sha256": sha256(find_model(plan.estimation.model))},
        animal_size=animal_facts(plan, tracker),
        arena=arena,
        zones=zones,
        scene=described,
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
    recording: Recording, plan: Plan, segmenter: height_maps.Segmenter
) -> NDArray[np.uint16] | None:
    """The still scene (H, W) mm behind the replay's cut-outs; None if the replay has none.

    Args:
        recording: an open recording.
        plan: its section `replay`.
        segmenter: the learned segmentation, which separates an animal at rest from the scene.
    """
    if plan.replay.depth not in (cutouts.ANIMAL, cutouts.ARENA):
        return None
    return cutouts.still_scene(
        recording,
        segmenter if isinstance(segmenter, background_segmenter.BackgroundSubtraction) else None,
    )


def build_arena(scene: height_maps.Segmenter, plan: Plan) -> tuple[Arena, tuple[Zone, ...]]:
    """The outline of the arena's floor, and the plan's zones in it, arena frame, mm.

    Args:
        scene: the learned segmentation; a hand has no arena, so its outline is unknown.
        plan: names the file of zones.
    """
    arena = UNKNOWN
    if isinstance(scene, background_segmenter.BackgroundSubtraction):
        arena = find_arena(scene.background, scene.floor.for_camera(scene.grid), scene.grid)
    placed = (drawn.placed(scene.camera, scene.floor, arena) for drawn in build_zones(plan))
    return arena, tuple(zone for zones in placed for zone in zones)


def build_zones(plan: Plan) -> tuple[DrawnZone, ...]:
    """The zones of the plan as drawn; () if it names none.

    Raises:
        PlanError: the file of zones cannot be used, or names a part that the animal lacks.
    """
    zones = read_zones(plan.arena.zones) if plan.arena.zones else ()
    for part in {zone.body_part for zone in zones} - {None}:
        joint_of(str(part), Skeleton.load(animal_of(plan).skeleton).names)
    return zones


def build_surroundings(provenance: Provenance) -> activity.Surroundings:
    """Arena, zones and water surface for the measures of behaviour."""
    surface = activity.surface_height_mm(provenance.floor_distance_mm, provenance.optics)
    return activity.Surroundings(
        provenance.arena, [zone.name for zone in provenance.zones], surface
    )


def session_bytes(recording: Recording, plan: Plan, length_mm: float, distance_mm: float) -> int:
    """Size of a recording's session on disk, bytes, within a factor of two.

    Args:
        recording: an open recording.
        plan: the animal's skeleton, and how much of the depth is kept.
        length_mm: of the animal.
        distance_mm: of the animal from the camera.
    """
    rows = sorted({0, len(recording) // 2})
    images = [depth_kernels.to_millimetres(recording.frame(row).depth) for row in rows]
    n_joints = Skeleton.load(plan.animal.skeleton).n_joints
    length_px = recording.camera.fx * length_mm / distance_mm
    return cutouts.needed_bytes(images, len(recording), n_joints, length_px, plan.replay.depth)


# Regions that a plan states, in the images of a recording, and proposed arenas.


def cut_out(recording: Recording, plan: Plan) -> Recording:
    """The recording with all but `arena.region` unread; unchanged if the plan states none.

    Raises:
        PlanError: the region lies outside the image.
        EstimationError: it is stated in millimetres, and no floor is found.
    """
    if plan.arena.region is None or recording.region_px:
        return recording
    return recording.masked(stated_corners(recording, plan, plan.arena.region))


def stated_corners(recording: Recording, plan: Plan, region: sections.Region) -> Corners:
    """The corners (u, v) px of a region in the images of a recording.

    Args:
        recording: an ideal pinhole's recording, of the whole image.
        plan: states the floor, or the animals that stand on it.
        region: the region.
    """
    floor = None if region.unit == "px" else _floor_of_image(recording, plan)
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
    return frame.region_mask(corners, recording.width, recording.height) if corners else None


def _floor_of_image(recording: Recording, plan: Plan) -> Floor:
    """The floor that the plan states, or the one on which animals stand in the whole image."""
    stated = stated_floor(recording.camera, plan)
    if stated is not None:
        return stated
    found = support_plane.find_support_plane(_sampled(recording, plan)[0]).floor
    return found.for_camera(recording.camera)


def _sampled(recording: Recording, plan: Plan) -> tuple[support_plane.SampledScene, int]:
    """Frames spread over a recording with their background, and the stride of their pixels."""
    stride = background.stride_for(recording, animal_of(plan).spine_min_mm)
    sample = background.sample_frames(recording, 96, stride)
    return background.sampled_scene(sample, recording.camera.every(stride), target_of(plan)), stride


def target_of(plan: Plan) -> support_plane.TargetAnimal:
    """The animal of a plan as it is searched for in depth images."""
    animal = animal_of(plan)
    return support_plane.TargetAnimal(
        (animal.spine_min_mm, animal.spine_max_mm),
        plan.foreground.min_height_mm,
        Skeleton.load(animal.skeleton).view,
    )


def arenas_of(recording: Recording, plan: Plan) -> list[sections.SeveralArenas]:
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
            "found in this image; leave the line out, or list them as [[arenas]] with name and "
            "region"
        )
    return found


def propose_arenas(recording: Recording, plan: Plan) -> list[sections.SeveralArenas]:
    """The arenas in which animals move, from left to right and top to bottom of the whole image.

    Returns:
        Two to eight of them, with disjoint polygons; [] if only one is found.
    """
    if Skeleton.load(plan.animal.skeleton).view.frame != VIEWS[0] or recording.region_px:
        return []
    scene, stride = _sampled(recording, plan)
    return [
        sections.SeveralArenas.model_validate(
            {
                "name": f"arena{k}",
                "region": [[float(stride * u), float(stride * v)] for u, v in corners],
            }
        )
        for k, corners in enumerate(support_plane.arenas_apart(scene), 1)
    ]


def build_recording(
    recording: str | Path | Recording, plan: Plan, progress: Progress = silent
) -> Recording:
    """The recording as an ideal camera in air would have made it.

    Lens distortion, refraction by water and a mirror are undone as each frame is read, and pixels
    outside the plan's region become unread.

    Args:
        recording: a path or address, or an open recording.
        plan: states camera, water surface, mirror, frame rate and topic.
        progress: called while an archive is unpacked or an index made.

    Raises:
        RecordingError: the recording cannot be opened.
        PlanError: the plan's region lies outside the image.
    """
    ideal = rectify.rectified(open_planned(recording, plan, progress), build_water(plan))
    return cut_out(rectify.mirrored(ideal) if plan.recording.mirrored else ideal, plan)


def open_planned(
    recording: str | Path | Recording,
    plan: Plan,
    progress: Progress = silent,
    pattern: str | None = None,
) -> Recording:
    """Open a recording with the plan's settings, its images unchanged; the plan's camera overrides.

    A plan that states all four intrinsics also opens a recording that has none.

    Args:
        recording: a path or address, or an open recording, whose camera is replaced.
        plan: states the camera, and frame rate and topic of recordings that need them.
        progress: called while an archive is unpacked or an index made.
        pattern: which images of a folder to use; None uses those that its camera.toml states.

    Raises:
        RecordingError: the recording cannot be opened, or is cut short and the plan does not accept
            that.
    """
    settings = plan.recording
    if isinstance(recording, str | Path):
        recording = open_recording(
            recording,
            camera=_stated_lens(plan),
            fps=settings.fps,
            topic=settings.topic,
            pattern=pattern,
            strict=not settings.accept_truncated,
            progress=progress,
        )
    recording.camera = _overruled(recording.camera, plan)
    return recording


def build_water(plan: Plan) -> Water | None:
    """The plan's water surface; None if the plan states no height of one."""
    stated = plan.water.model_dump()
    return Water(**stated) if stated["height_mm"] is not None else None


def _stated_lens(plan: Plan) -> Lens | None:
    """The plan's camera if fully stated, a placeholder for its preset, or None."""
    stated = {name: getattr(plan.camera, name) for name in ("fx", "fy", "cx", "cy")}
    if None in stated.values() and plan.camera.preset is not None:
        return Lens(1.0, 1.0, 0.0, 0.0)  # its numbers follow once the image size is known
    return None if None in stated.values() else Lens(**stated, distortion=_stated_distortion(plan))


def _stated_distortion(plan: Plan) -> Distortion | None:

    return Distortion.of(plan.camera.distortion_model or "plumb_bob", plan.camera.distortion or [])


def _overruled(camera: Camera, plan: Plan) -> Camera:
    """The camera with the plan's values."""
    if plan.camera.preset is not None:
        camera = preset(plan.camera.preset, camera.width, camera.height)
    stated: dict[str, Any] = plan.camera.model_dump(
        exclude_none=True, exclude={"preset", "distortion", "distortion_model"}
    )
    if plan.camera.distortion is not None:
        stated["distortion"] = _stated_distortion(plan)
    return replace(camera, **{"source": "plan", **stated}) if stated else camera


def plan_of(animal: str) -> Plan:
    """The bundled plan of that name, or a plan for the animal of a skeleton's TOML.

    The latter expects a model `NAME.npz` with the name of the skeleton's file.
    """
    if animal in known_plans():
        return Plan.load(animal)
    plan = Plan.from_table(
        {
            "animal": {"skeleton": animal},
            "foreground": {"min_height_mm": Skeleton.load(animal).view.min_height_mm},
            "estimation": {"model": f"{Path(animal).stem}.npz"},
        }
    )
    return plan.model_copy(update={"animal": animal_of(plan)})


def build_estimator(plan: Plan) -> PoseEstimator:
    """The pose estimator of the plan's model and animal.

    The last one stays in memory, since the next session of a study usually needs the same one.

    Raises:
        ModelError: there is no such model, or its file is damaged.
        PlanError: the model was made for another skeleton than the plan's.
    """
    path = find_model(plan.estimation.model)
    estimator = kept_estimator(path, sha256(path), plan.estimation.n_candidates or 0)
    wanted = plan.animal.skeleton
    if wanted.endswith(".toml"):  # the user's own file: the name of its animal counts
        wanted = Skeleton.load(wanted).name
    if estimator.skeleton.name != wanted:
        raise PlanError(
            f"the model '{plan.estimation.model}' was made for the skeleton "
            f"{estimator.skeleton.name}, but the plan names {plan.animal.skeleton}; set "
            f"estimation.model to a model of the {wanted}"
        )
    return estimator


@lru_cache(maxsize=1)
def kept_estimator(path: Path, digest: str, n_candidates: int) -> PoseEstimator:
    """The pose estimator of a model file; the last one stays in memory.

    Args:
        path: the model file.
        digest: SHA-256 of its content, so that a changed file is loaded again.
        n_candidates: initial poses per frame; 0 uses the method's default.
    """
    return PoseEstimator(Model.load(path), n_candidates)


def build_tracker(
    recording: Recording, plan: Plan, estimator_of: Callable[[], PoseEstimator] | None = None
) -> FrameTracker:
    """The tracker of a recording: learns the background and estimates the animal's size and girth.

    Args:
        recording: an open recording.
        plan: animal, foreground, estimation and tracking.
        estimator_of: waits for an estimator of the plan that is already being made; None makes it
            here.

    Raises:
        EstimationError: no floor or no animal is found in the sampled frames.
        PlanError: the file of zones or the model does not fit.
    """
    build_zones(plan)  # errors in their file are raised before any work is done
    n_frames = plan.foreground.n_background_frames
    stated = Skeleton.load(plan.animal.skeleton)
    try:  # while the model is read; an unusable model's error comes first
        scene, sample = build_scene(recording, plan, stated, n_frames)
    finally:
        estimator = estimator_of() if estimator_of else build_estimator(plan)
    if estimator.skeleton.view != stated.view:  # the model has an older version of the skeleton
        scene, sample = build_scene(recording, plan, estimator.skeleton, n_frames)
    shared = plan.animal.shared
    return FrameTracker.prepare(
        estimator,
        scene,
        sample,
        plan.animal.spine_mm or (shared.spine_mm if shared else None),
        plan.estimation.doubtful_above_mm,
        plan.tracking.bridge_s,
        adapt=plan.estimation.adapt == "auto",
        stated=build_stated_shape(plan, estimator.skeleton),
    )


def build_joint_tracker(
    recording: Recording, plan: Plan, alone: FrameTracker, n_animals: int
) -> JointTracker:
    """The tracker of several animals in one arena.

    Args:
        recording: an open recording.
        plan: states the number of sampled frames.
        alone: the tracker of one of the animals.
        n_animals: how many are measured.

    Raises:
        EstimationError: fewer animals stand apart in all sampled frames.
    """
    stride = (
        alone.scene.stride
        if isinstance(alone.scene, background_segmenter.BackgroundSubtraction)
        else 1
    )
    sample = background.sample_frames(recording, plan.foreground.n_background_frames, stride)
    return JointTracker.prepare(alone, sample, n_animals)


def build_stated_shape(plan: Plan, skeleton: Skeleton) -> StatedShape | None:
    """The shape that the plan states for its animal (`animal.shared`); None if it states none.

    Raises:
        PlanError: the shape is of another skeleton.
    """
    shared = plan.animal.shared
    if shared is None:
        return None
    shape = shared.shape
    if shape is None:
        return StatedShape(None, shared.girth, shared.by)
    if len(shape.joints_moved) != skeleton.n_joints:
        raise PlanError(
            f"animal.shared.shape.joints_moved lists {len(shape.joints_moved)} joints, and the "
            f"{skeleton.name} has {skeleton.n_joints}; take animal.shared of a session of this "
            "skeleton, or leave it out"
        )
    labels = labels_of(shape.joints_moved, shape.width, shape.height)
    return StatedShape(labels, shared.girth, shared.by)


def build_scene(
    recording: Recording, plan: Plan, skeleton: Skeleton, n_frames: int
) -> tuple[height_maps.Segmenter, NDArray[np.float32]]:
    """The learned segmentation and the sampled frames it was learned from.

    Background subtraction with a floor plane; segmentation by distance for a hand.

    Args:
        recording: an open recording.
        plan: expected spine lengths, and the foreground's thresholds, mm.
        skeleton: its view selects the segmentation.
        n_frames: number of sampled frames, spread over the recording.

    Returns:
        The segmenter, and the sample (n, H, W) float32 mm, 0 where unread.

    Raises:
        EstimationError: no floor or no animal is found in the sample.
        PlanError: the plan states a region or a floor for a hand.
    """
    animal = animal_of(plan)
    foreground = plan.foreground
    region = region_of(recording, plan)
    floor = stated_floor(recording.camera, plan)
    if skeleton.view.foreground == FOREGROUNDS[1]:
        if region is not None or floor is not None:
            raise PlanError(
                "arena.region and arena.floor are for animals before a still background, and the "
                f"{skeleton.name} is separated by its distance; set foreground.near_mm and far_mm"
            )
        return hand_segmenter.HandSegmenter.learn(
            recording, skeleton.view, n_frames, (foreground.near_mm, foreground.far_mm)
        )
    sizes = (animal.spine_min_mm, animal.spine_max_mm)
    return learning.learn_scene(
        recording,
        sizes,
        n_frames,
        foreground.min_height_mm,
        skeleton.view,
        floor,
        region,
        alone=animal.count in (1, "auto"),
    )


def build_rules(plan: Plan) -> bouts.MouseRules:
    """Thresholds of the rules that name behaviours, from the plan's section `behaviour`."""
    return bouts.MouseRules(**plan.behaviour.model_dump())


def build_recogniser(plan: Plan, skeleton: Skeleton) -> timeline.TimelineModel | None:
    """The plan's action recogniser, named or bundled; None if absent.

    Without a recogniser rules name the actions, or nothing does, see `why_nameless`.

    Args:
        plan: its setting `actions.model`: a name, a path, `rules`, or None for the animal's bundled
            one.
        skeleton: the animal's skeleton.

    Raises:
        ModelError: there is no such model.
        PlanError: the model was made for another skeleton.
    """
    name = plan.actions.model
    if name == "rules" or (name is None and skeleton.name not in storage.bundled_action_models()):
        return None
    model = storage.load_action_model(name or skeleton.name)
    if model.skeleton != skeleton.name:
        raise PlanError(
            f"the action model '{name}' was made for the skeleton {model.skeleton}, but the plan "
            f"names {skeleton.name}; set actions.model to another one, or to 'rules'"
        )
    return model


def why_nameless(plan: Plan, skeleton: Skeleton) -> str:
    """Why no actions are named if there is no recogniser; '' if rules name them (`actions.model`).

    The rules are a mouse's: a hand does not rear, and a snake does not run.
    """
    # the animal that the rules were made for
    if plan.actions.model is not None or skeleton.name == "mouse":
        return ""
    return (
        f"No actions are named: no vocabulary was made for a {skeleton.name}. `liex train actions` "
        "makes one from what you label; `--set actions.model=rules` names runs, walks and pauses "
        "as of a mouse, and the rears of an animal that stands."
    )
