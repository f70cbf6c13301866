"""From a plan to objects: the one place where names and numbers of a plan become a recording, a
tracker, rules.
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

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from liex_lab.actions.timeline import TimelineModel
    from liex_lab.arena.outline import Arena
    from liex_lab.arena.zones import DrawnZone, Zone
    from liex_lab.behaviour.bouts import MouseRules
    from liex_lab.behaviour.places import Surroundings
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.foreground.height_maps import Foreground
    from liex_lab.optics.camera import Camera, Distortion, Lens
    from liex_lab.optics.refraction import Water
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions import Provenance
    from liex_lab.tracking.tracker import FrameTracker


_SPANS = (
    0.6,
    1.8,
)  # of the home length: how small and how large an animal of the user's own may be


def build_recording(
    recording: str | Path | Recording, plan: Plan, progress: Progress = silent
) -> Recording:
    """The recording at a path, or one that is open already, as an ideal camera in air would have
    made it.

    Lens distortion, the water's refraction and a mirror are undone whenever a frame is read.
    """
    from liex_lab.recordings.rectify import mirrored, rectified

    seen = rectified(open_planned(recording, plan, progress), build_water(plan))
    return mirrored(seen) if plan.recording.mirrored else seen


def open_planned(
    recording: str | Path | Recording, plan: Plan, progress: Progress = silent
) -> Recording:
    """The recording at a path, opened as the plan says, or one that is open already; the plan's
    camera overrules.

    A plan that states all four intrinsics opens a recording that has none, too.
    """
    from liex_lab.recordings import open_recording

    settings = plan.recording
    if isinstance(recording, str | Path):
        recording = open_recording(
            recording,
            camera=_stated_lens(plan),
            fps=settings.fps,
            topic=settings.topic,
            strict=not settings.accept_truncated,
            progress=progress,
        )
    recording.camera = _overruled(recording.camera, plan)
    return recording


def build_water(plan: Plan) -> Water | None:
    """The water surface of the plan, if there is one."""
    from liex_lab.optics.refraction import Water

    stated = plan.water.model_dump()
    return Water(**stated) if stated["height_mm"] is not None else None


def _stated_lens(plan: Plan) -> Lens | None:
    """The plan's camera where it states all of it."""
    from liex_lab.optics.camera import Lens

    stated = {name: getattr(plan.camera, name) for name in ("fx", "fy", "cx", "cy")}
    return None if None in stated.values() else Lens(**stated, distortion=_stated_distortion(plan))


def _stated_distortion(plan: Plan) -> Distortion | None:
    from liex_lab.optics.camera import Distortion

    return Distortion.of(plan.camera.distortion_model or "plumb_bob", plan.camera.distortion or [])


def _overruled(camera: Camera, plan: Plan) -> Camera:
    """The camera with what the plan states put in."""
    stated: dict[str, Any] = plan.camera.model_dump(
        exclude_none=True, exclude={"distortion", "distortion_model"}
    )
    if plan.camera.distortion is not None:
        stated["distortion"] = _stated_distortion(plan)
    return replace(camera, **{"source": "plan", **stated}) if stated else camera


def plan_of(animal: str) -> Plan:
    """The bundled plan of an animal, or one for the animal of a skeleton's TOML."""
    from liex_lab.body.skeleton import Skeleton

    if animal in known_plans():
        return Plan.load(animal)
    skeleton = Skeleton.load(animal)
    low, high = (round(factor * skeleton.length, 3) for factor in _SPANS)
    return Plan.from_table(
        {
            "animal": {
                "name": skeleton.name,
                "skeleton": animal,
                "spine_min_mm": low,
                "spine_max_mm": high,
            },
            "foreground": {"min_height_mm": skeleton.view.min_height_mm},
            "estimation": {"model": f"{Path(animal).stem}.npz"},
        }
    )


def build_estimator(plan: Plan) -> PoseEstimator:
    """The estimator of the plan's animal; the last one is kept, for a study's next session mostly
    wants the same.
    """
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.catalog import find_model, sha256

    path = find_model(plan.estimation.model)
    estimator = kept_estimator(path, sha256(path), plan.estimation.n_candidates or 0)
    wanted = plan.animal.skeleton
    if wanted.endswith(".toml"):  # a file of the user's own: what matters is the animal in it
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
    """The estimator of a model file. digest: another content is another model."""
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.estimation.model import Model

    return PoseEstimator(Model.load(path), n_candidates)


def build_tracker(
    recording: Recording, plan: Plan, estimator_of: Callable[[], PoseEstimator] | None = None
) -> FrameTracker:
    """The tracker of a recording: its scene learned, the animal's size and girth found.
    estimator_of: waits for the plan's, where that is being made already.
    """
    from liex_lab.tracking.tracker import FrameTracker

    build_zones(plan)  # a slip in their file is told before any work is done
    estimator = estimator_of() if estimator_of else build_estimator(plan)
    scene, sample = build_scene(
        recording, plan, estimator.skeleton, plan.foreground.n_background_frames
    )
    limit = plan.estimation.doubtful_above_mm
    bridge_s = plan.tracking.bridge_s
    return FrameTracker.prepare(estimator, scene, sample, plan.animal.spine_mm, limit, bridge_s)


def build_scene(
    recording: Recording, plan: Plan, skeleton: Skeleton, n_frames: int
) -> tuple[Foreground, NDArray[np.float32]]:
    """What tells the animal from the rest of the pictures, and the sample (n, H, W) mm that it was
    learned from.
    """
    from liex_lab.body.skeleton import FOREGROUNDS
    from liex_lab.foreground.background_segmenter import Scene
    from liex_lab.foreground.hand_segmenter import NearestScene

    animal = plan.animal
    foreground = plan.foreground
    if skeleton.view.foreground == FOREGROUNDS[1]:
        return NearestScene.learn(
            recording, skeleton.view, n_frames, (foreground.near_mm, foreground.far_mm)
        )
    sizes = (animal.spine_min_mm, animal.spine_max_mm)
    return Scene.learn(recording, sizes, n_frames, foreground.min_height_mm, skeleton.view)


def build_provenance(
    recording: Recording, plan: Plan, tracker: FrameTracker, progress: Progress = silent
) -> Provenance:
    """What the session says about its origin."""
    from liex_lab.catalog import find_model, sha256
    from liex_lab.sessions import Provenance

    recording.digest(
        progress
    )  # kept by the recording; the longest wait here, so it is the one that is shown
    arena, zones = build_arena(tracker.scene, plan)
    origin = {"plan": "stated in the plan", "recording": "estimated over the recording"}[
        tracker.size_origin
    ]
    return Provenance.of(
        recording,
        tracker.scene.floor,
        tracker.estimator.skeleton,
        plan,
        model={"name": plan.estimation.model, "sha256": sha256(find_model(plan.estimation.model))},
        animal_size={
            "spine_mm": round(tracker.spine_mm, 3),
            "origin": origin,
            "girth": round(tracker.body.girth, 3),
        },
        arena=arena,
        zones=zones,
    )


def build_arena(scene: Foreground, plan: Plan) -> tuple[Arena, tuple[Zone, ...]]:
    """The shape of the arena, where there is one, and the plan's zones in it."""
    from liex_lab.arena.floor import Floor
    from liex_lab.arena.outline import UNKNOWN, find_arena
    from liex_lab.foreground.background_segmenter import Scene

    arena = UNKNOWN
    if isinstance(scene, Scene):
        floor = Floor.from_plane(scene.floor.normal, scene.floor.distance_mm, scene.grid)
        arena = find_arena(scene.background, floor, scene.grid)
    return arena, tuple(zone.placed(scene.camera, scene.floor, arena) for zone in build_zones(plan))


def build_zones(plan: Plan) -> tuple[DrawnZone, ...]:
    """The zones of the plan, as they were drawn."""
    from liex_lab.arena.zones import read_zones

    return read_zones(plan.arena.zones) if plan.arena.zones else ()


def build_surroundings(provenance: Provenance) -> Surroundings:
    """What measures of behaviour have to know of arena, zones and water."""
    from liex_lab.behaviour.places import Surroundings, surface_height_mm

    surface = surface_height_mm(provenance.floor_distance_mm, provenance.optics)
    return Surroundings(provenance.arena, [zone.name for zone in provenance.zones], surface)


def build_rules(plan: Plan) -> MouseRules:
    """The thresholds of the behaviours."""
    from liex_lab.behaviour.bouts import MouseRules

    return MouseRules(**plan.behaviour.model_dump())


def build_recogniser(plan: Plan, skeleton: Skeleton) -> TimelineModel | None:
    """The recogniser of the plan: the named one, or the animal's bundled one; None where the rules
    name actions.
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
