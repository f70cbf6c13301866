"""Public Python interface: the CLI commands as Python functions.

`run_session` is `liex run`, `run_demo` is `liex demo`, and so on. Jobs are imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from liex_lab.pipelines.arenas import run_arenas
    from liex_lab.pipelines.bench import serve_dashboard
    from liex_lab.pipelines.compare import compare_groups
    from liex_lab.pipelines.correct import correct_session, describe_session
    from liex_lab.pipelines.drawing import draw_figures, export_video
    from liex_lab.pipelines.evaluation.actions import evaluate_actions
    from liex_lab.pipelines.evaluation.paper.run import run_tables
    from liex_lab.pipelines.evaluation.scale import run_scale
    from liex_lab.pipelines.evaluation.scenes import evaluate_scenes
    from liex_lab.pipelines.evaluation.several import evaluate_several
    from liex_lab.pipelines.evaluation.tracking import evaluate_tracking
    from liex_lab.pipelines.live import follow_live
    from liex_lab.pipelines.points import import_animals, import_points
    from liex_lab.pipelines.session import run_demo, run_session
    from liex_lab.pipelines.study.run import run_study
    from liex_lab.pipelines.sync import sync_session
    from liex_lab.pipelines.triggers import Triggers
    from liex_lab.pipelines.verify import verify_session

_JOBS = {  # function: the module of `pipelines` that defines it
    "run_session": "session",
    "run_arenas": "arenas",
    "compare_groups": "compare",
    "correct_session": "correct",
    "describe_session": "correct",
    "draw_figures": "drawing",
    "export_video": "drawing",
    "follow_live": "live",
    "Triggers": "triggers",
    "import_animals": "points",
    "import_points": "points",
    "run_demo": "session",
    "run_study": "study.run",
    "serve_dashboard": "bench",
    "sync_session": "sync",
    "verify_session": "verify",
    "run_scale": "evaluation.scale",
    "evaluate_tracking": "evaluation.tracking",
    "evaluate_scenes": "evaluation.scenes",
    "evaluate_several": "evaluation.several",
    "evaluate_actions": "evaluation.actions",
    "evaluate_tracks": "evaluation.actions",
    "run_tables": "evaluation.paper.run",
    # used by the command line only
    "evaluate_pose": "evaluation.pose",
    "evaluate_builds": "evaluation.pose",
    "evaluate_foreign": "evaluation.foreign",
    "evaluate_sizes": "evaluation.pose",
    "evaluate_reference": "evaluation.pose",
    "evaluate_speed": "evaluation.speed",
    "evaluate_recordings": "evaluation.speed",
    "evaluate_live": "evaluation.live",
    "evaluate_statistics": "evaluation.statistics",
    "evaluate_sync": "evaluation.sync",
    "evaluate_cameras": "evaluation.cameras",
    "evaluate_nyu": "evaluation.nyu",
    "hands_in_short": "evaluation.nyu",
    "search_noise": "evaluation.tracking",
    "train_actions": "training.action_model",
    "train_model": "training.pose_model",
    "train_shape": "training.shape_model",
    "train_tracking": "training.motion_model",
    "convert": "convert",
    "pack": "convert",
    "record": "record",
    "examine": "doctor",
    "print_report": "doctor",
    "whole_images": "drawing",
    "begin_study": "study.init",
    "read_any_labels": "training.action_model",
    "suggest": "training.action_model",
}

__all__ = [  # noqa: RUF022 - in the order of the manual
    "run_session",
    "run_arenas",
    "correct_session",
    "describe_session",
    "sync_session",
    "follow_live",
    "Triggers",
    "import_points",
    "import_animals",
    "run_demo",
    "draw_figures",
    "compare_groups",
    "export_video",
    "run_study",
    "serve_dashboard",
    "verify_session",
    "run_scale",
    "evaluate_tracking",
    "evaluate_scenes",
    "evaluate_several",
    "evaluate_actions",
    "run_tables",
]


def __getattr__(name: str) -> Any:
    if name not in _JOBS:
        raise AttributeError(f"module 'liex_lab.api' has no attribute '{name}'")
    return getattr(import_module(f"liex_lab.pipelines.{_JOBS[name]}"), name)
