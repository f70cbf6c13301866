"""From a plan to objects: the one place where names and numbers of a plan become a recording, a tracker, rules."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import PlanError
from liex_lab.plan import Plan
from liex_lab.progress import Progress, silent

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from liex_lab.behaviour.bouts import MouseRules
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.recordings.crops import Foreground
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions import Provenance
    from liex_lab.tracking.tracker import FrameTracker


def build_recording(recording: str | Path | Recording, plan: Plan, progress: Progress = silent) -> Recording:
    """The recording at a path, opened as the plan says, or one that is open already; the plan's camera overrules.

    A plan that states all four intrinsics opens a recording that has none, too.
    """
    from liex_lab.camera import Lens
    from liex_lab.recordings import open_recording

    settings = plan.recording
    stated: dict[str, Any] = plan.camera.model_dump(exclude_none=True)
    if isinstance(recording, str | Path):
        lens = {name: stated[name] for name in ("fx", "fy", "cx", "cy") if name in stated}
        recording = open_recording(
            recording, camera=Lens(**lens) if len(lens) == 4 else None, fps=settings.fps, topic=settings.topic,
            strict=not settings.accept_truncated, progress=progress,
        )  # fmt: skip
    if stated:
        recording.camera = replace(recording.camera, **{"source": "plan", **stated})
    return recording


def build_estimator(plan: Plan) -> PoseEstimator:
    """The estimator of the plan's animal."""
    from liex_lab.catalog import find_model
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.estimation.model import Model

    model = Model.load(find_model(plan.estimation.model))
    if model.skeleton.name != plan.animal.skeleton:
        raise PlanError(
            f"the model '{plan.estimation.model}' was made for the skeleton {model.skeleton.name}, but the plan says "
            f"{plan.animal.skeleton}; set estimation.model to a model of the {plan.animal.skeleton}"
        )
    return PoseEstimator(model, plan.estimation.n_candidates or 0)


def build_tracker(recording: Recording, plan: Plan) -> FrameTracker:
    """The tracker of a recording: its scene learned, the animal's size and girth found."""
    from liex_lab.tracking.tracker import FrameTracker

    estimator = build_estimator(plan)
    scene, sample = build_scene(recording, plan, estimator.skeleton, plan.foreground.n_background_frames)
    return FrameTracker.prepare(estimator, scene, sample, plan.animal.spine_mm, plan.estimation.doubtful_above_mm)


def build_scene(
    recording: Recording, plan: Plan, skeleton: Skeleton, n_frames: int
) -> tuple[Foreground, NDArray[np.float32]]:
    """What tells the animal from the rest of the pictures, and the sample (n, H, W) mm that it was learned from."""
    from liex_lab.body.skeleton import FOREGROUNDS
    from liex_lab.recordings.foreground import Scene
    from liex_lab.recordings.nearest import NearestScene

    animal, foreground = plan.animal, plan.foreground
    if skeleton.view.foreground == FOREGROUNDS[1]:
        return NearestScene.learn(recording, skeleton.view, n_frames, (foreground.near_mm, foreground.far_mm))
    return Scene.learn(recording, (animal.spine_min_mm, animal.spine_max_mm), n_frames, foreground.min_height_mm)


def build_provenance(
    recording: Recording, plan: Plan, tracker: FrameTracker, progress: Progress = silent
) -> Provenance:
    """What the session says about its origin."""
    from liex_lab.catalog import find_model, sha256
    from liex_lab.sessions import Provenance

    recording.digest(progress)  # kept by the recording; the longest wait here, so it is the one that is shown
    origin = {"plan": "stated in the plan", "recording": "estimated over the recording"}[tracker.size_origin]
    return Provenance.of(
        recording,
        tracker.scene.floor,
        tracker.estimator.skeleton,
        plan,
        model={"name": plan.estimation.model, "sha256": sha256(find_model(plan.estimation.model))},
        animal_size={"spine_mm": round(tracker.spine_mm, 3), "origin": origin, "girth": round(tracker.body.girth, 3)},
    )


def build_rules(plan: Plan) -> MouseRules:
    """The thresholds of the behaviours."""
    from liex_lab.behaviour.bouts import MouseRules

    return MouseRules(**plan.behaviour.model_dump())
