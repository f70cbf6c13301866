"""From a plan to objects: recording, background subtraction, estimator, tracker, rules.

Only this module turns names and numbers of a plan into objects of the library (a factory for each).
Errors in the plan are raised before any work is done.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import PlanError
from liex_lab.plan import Plan, known_plans
from liex_lab.runtime.progress import Progress, silent

from .origin import animal_of, build_zones
from .regions import cut_out, region_of, stated_floor

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from liex_lab.actions.timeline import TimelineModel
    from liex_lab.behaviour.bouts import MouseRules
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.optics.camera import Camera, Distortion, Lens
    from liex_lab.optics.refraction import Water
    from liex_lab.plan.sections import SharedShape
    from liex_lab.recordings.recording import Recording
    from liex_lab.scene.height_maps import Segmenter
    from liex_lab.tracking.own_shape import StatedShape
    from liex_lab.tracking.tracker import FrameTracker


_RULED = "mouse"  # the animal that the rules were made for


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
    from liex_lab.recordings.rectify import mirrored, rectified

    seen = rectified(open_planned(recording, plan, progress), build_water(plan))
    return cut_out(mirrored(seen) if plan.recording.mirrored else seen, plan)


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
    from liex_lab.recordings import open_recording

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
    from liex_lab.optics.refraction import Water

    stated = plan.water.model_dump()
    return Water(**stated) if stated["height_mm"] is not None else None


def _stated_lens(plan: Plan) -> Lens | None:
    """The plan's camera if fully stated, a placeholder for its preset, or None."""
    from liex_lab.optics.camera import Lens

    stated = {name: getattr(plan.camera, name) for name in ("fx", "fy", "cx", "cy")}
    if None in stated.values() and plan.camera.preset is not None:
        return Lens(1.0, 1.0, 0.0, 0.0)  # its numbers follow once the image size is known
    return None if None in stated.values() else Lens(**stated, distortion=_stated_distortion(plan))


def _stated_distortion(plan: Plan) -> Distortion | None:
    from liex_lab.optics.camera import Distortion

    return Distortion.of(plan.camera.distortion_model or "plumb_bob", plan.camera.distortion or [])


def _overruled(camera: Camera, plan: Plan) -> Camera:
    """The camera with the plan's values."""
    if plan.camera.preset is not None:
        from liex_lab.optics.camera import preset

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
    from liex_lab.body.skeleton import Skeleton

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
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.catalog import find_model, sha256

    path = find_model(plan.estimation.model)
    estimator = kept_estimator(path, sha256(path), plan.estimation.n_candidates or 0)
    wanted = plan.animal.skeleton
    if wanted.endswith(".toml"):  # the user's own file: the name of its animal counts
        wanted = Skeleton.load(wanted).name
    if estimator.skeleton.name != wanted:
        raise PlanError(
            f"the model '{plan.estimation.model}' was made for the skeleton "
            f"{estimator.skeleton.name}, but the plan says {plan.animal.skeleton}; set "
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
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.estimation.model import Model

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
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.tracking.tracker import FrameTracker

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


def build_stated_shape(plan: Plan, skeleton: Skeleton) -> StatedShape | None:
    """The shape that the plan states for its animal (`animal.shared`); None if it states none.

    Raises:
        PlanError: the shape is of another skeleton.
    """
    from liex_lab.tracking.own_shape import StatedShape

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
    return StatedShape(shape_labels(shape), shared.girth, shared.by)


def shape_labels(shape: SharedShape) -> NDArray[np.float64]:
    """A plan's shape as (K,) labels, see `session_shape.labels_of`."""
    import numpy as np

    from liex_lab.estimation.session_shape import labels_of

    columns = (np.array(column) for column in (shape.joints_moved, shape.width, shape.height))
    return labels_of(*columns)


def build_scene(
    recording: Recording, plan: Plan, skeleton: Skeleton, n_frames: int
) -> tuple[Segmenter, NDArray[np.float32]]:
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
    from liex_lab.body.skeleton import FOREGROUNDS
    from liex_lab.scene.hand_segmenter import HandSegmenter
    from liex_lab.scene.learning import learn_scene

    animal = animal_of(plan)
    foreground = plan.foreground
    region = region_of(recording, plan)
    floor = stated_floor(recording.camera, plan)
    if skeleton.view.foreground == FOREGROUNDS[1]:
        if region is not None or floor is not None:
            raise PlanError(
                "arena.region and arena.floor are for animals before a still background, and the "
                f"{skeleton.name} is told by its distance; set foreground.near_mm and far_mm"
            )
        return HandSegmenter.learn(
            recording, skeleton.view, n_frames, (foreground.near_mm, foreground.far_mm)
        )
    sizes = (animal.spine_min_mm, animal.spine_max_mm)
    return learn_scene(
        recording, sizes, n_frames, foreground.min_height_mm, skeleton.view, floor, region
    )


def build_rules(plan: Plan) -> MouseRules:
    """Thresholds of the rules that name behaviours, from the plan's section `behaviour`."""
    from liex_lab.behaviour.bouts import MouseRules

    return MouseRules(**plan.behaviour.model_dump())


def build_recogniser(plan: Plan, skeleton: Skeleton) -> TimelineModel | None:
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
    from liex_lab.actions.storage import bundled_action_models, load_action_model

    name = plan.actions.model
    if name == "rules" or (name is None and skeleton.name not in bundled_action_models()):
        return None
    model = load_action_model(name or skeleton.name)
    if model.skeleton != skeleton.name:
        raise PlanError(
            f"the action model '{name}' was made for the skeleton {model.skeleton}, but the plan "
            f"says {skeleton.name}; set actions.model to another one, or to 'rules'"
        )
    return model


def why_nameless(plan: Plan, skeleton: Skeleton) -> str:
    """Why no actions are named if there is no recogniser; '' if rules name them (`actions.model`).

    The rules are a mouse's: a hand does not rear, and a snake does not run.
    """
    if plan.actions.model is not None or skeleton.name == _RULED:
        return ""
    return (
        f"No actions are named: no vocabulary was made for a {skeleton.name}. `liex train actions` "
        "makes one from what you label; `--set actions.model=rules` names runs, walks and pauses "
        "as of a mouse, and the rears of an animal that stands."
    )
