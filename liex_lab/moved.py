"""Import hook (a meta path finder) for modules that have moved.

Old dotted paths still import, with one FutureWarning that says where the module lives now. `MOVED`
holds every public module of version 0.1 that has another place since. An old path is the very
module at the new one, not a copy of it.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.abc import Loader
else:  # importlib.abc brings tempfile and random along, for a class that is not asked what it is
    Loader = object

MOVED = {
    "liex_lab.sessions.lock": "liex_lab.runtime.lock",
    "liex_lab.actions.chain": "liex_lab.actions.semi_markov",
    "liex_lab.actions.labelled": "liex_lab.actions.labels",
    "liex_lab.actions.tables": "liex_lab.tables.rows",
    "liex_lab.actions.windows": "liex_lab.actions.channels",
    "liex_lab.body.balls": "liex_lab.body.spheres",
    "liex_lab.camera": "liex_lab.optics.camera",
    "liex_lab.cli_correct": "liex_lab.cli.correct",
    "liex_lab.cli_evaluate": "liex_lab.cli.evaluate",
    "liex_lab.cli_results": "liex_lab.cli.results",
    "liex_lab.cli_study": "liex_lab.cli.study",
    "liex_lab.cli_words": "liex_lab.cli.options",
    "liex_lab.estimation.correction": "liex_lab.estimation.forest_correction",
    "liex_lab.estimation.facing": "liex_lab.estimation.head_tail",
    "liex_lab.estimation.settle": "liex_lab.estimation.ridge_correction",
    "liex_lab.evaluation": "liex_lab.evaluation.pose",
    "liex_lab.evaluation_nyu": "liex_lab.evaluation.nyu",
    "liex_lab.evaluation_tracking": "liex_lab.evaluation.tracking",
    "liex_lab.memory": "liex_lab.runtime.memory",
    "liex_lab.network": "liex_lab.mlp",
    "liex_lab.plan_sections": "liex_lab.plan.sections",
    "liex_lab.progress": "liex_lab.runtime.progress",
    "liex_lab.recordings.acting": "liex_lab.simulation.agents.agent",
    "liex_lab.recordings.archive": "liex_lab.recordings.formats.moseq_files",
    "liex_lab.recordings.arena": "liex_lab.arena.floor",
    "liex_lab.recordings.arriving": "liex_lab.recordings.streaming",
    "liex_lab.recordings.background": "liex_lab.foreground.background",
    "liex_lab.recordings.crops": "liex_lab.foreground.height_maps",
    "liex_lab.recordings.encodings": "liex_lab.recordings.frame",
    "liex_lab.recordings.filming": "liex_lab.simulation.agents.render",
    "liex_lab.recordings.fish": "liex_lab.simulation.fish",
    "liex_lab.recordings.fish_acts": "liex_lab.simulation.agents.fish",
    "liex_lab.recordings.foreground": "liex_lab.foreground.background_segmenter",
    "liex_lab.recordings.generic": "liex_lab.simulation.generic",
    "liex_lab.recordings.gestures": "liex_lab.simulation.hand.gestures",
    "liex_lab.recordings.habits": "liex_lab.simulation.species",
    "liex_lab.recordings.hand_labels": "liex_lab.recordings.formats.images.nyu",
    "liex_lab.recordings.hand_postures": "liex_lab.simulation.hand.pose_prior",
    "liex_lab.recordings.hand_stage": "liex_lab.simulation.hand.scene",
    "liex_lab.recordings.hand_world": "liex_lab.simulation.hand.simulator",
    "liex_lab.recordings.hazards": "liex_lab.simulation.corruptions",
    "liex_lab.recordings.images": "liex_lab.recordings.formats.images.folder",
    "liex_lab.recordings.mcap": "liex_lab.recordings.formats.messages.mcap",
    "liex_lab.recordings.mcap_writer": "liex_lab.recordings.formats.messages.mcap_writer",
    "liex_lab.recordings.moseq": "liex_lab.recordings.formats.moseq",
    "liex_lab.recordings.mouse_acts": "liex_lab.simulation.agents.mouse",
    "liex_lab.recordings.nearest": "liex_lab.foreground.hand_segmenter",
    "liex_lab.recordings.nyu": "liex_lab.recordings.formats.images.nyu",
    "liex_lab.recordings.paths": "liex_lab.simulation.locomotion",
    "liex_lab.recordings.postures": "liex_lab.simulation.pose_prior",
    "liex_lab.recordings.raytrix": "liex_lab.recordings.formats.images.raytrix",
    "liex_lab.recordings.rosbag": "liex_lab.recordings.formats.messages.rosbag",
    "liex_lab.recordings.sensors": "liex_lab.simulation.sensors",
    "liex_lab.recordings.sequences": "liex_lab.simulation.tracking_sequences",
    "liex_lab.recordings.stage": "liex_lab.simulation.scene",
    "liex_lab.recordings.stamp_files": "liex_lab.recordings.timestamp_files",
    "liex_lab.recordings.steps": "liex_lab.recordings.frame",
    "liex_lab.recordings.swimming": "liex_lab.simulation.locomotion",
    "liex_lab.recordings.synthetic": "liex_lab.simulation.recording",
    "liex_lab.recordings.things": "liex_lab.simulation.objects",
    "liex_lab.recordings.times": "liex_lab.recordings.timestamps",
    "liex_lab.recordings.virtual": "liex_lab.simulation.address",
    "liex_lab.recordings.walking": "liex_lab.simulation.locomotion",
    "liex_lab.recordings.walls": "liex_lab.arena.outline",
    "liex_lab.recordings.windows": "liex_lab.simulation.training_patches",
    "liex_lab.recordings.worlds": "liex_lab.simulation.simulator",
    "liex_lab.recordings.writing": "liex_lab.recordings.writer",
    "liex_lab.recordings.zones": "liex_lab.arena.zones",
    "liex_lab.sessions.rows": "liex_lab.tables.rows",
    "liex_lab.sessions.stretches": "liex_lab.sessions.shards",
    "liex_lab.sessions.tables": "liex_lab.tables.schema",
    "liex_lab.study": "liex_lab.plan.study",
    "liex_lab.threads": "liex_lab.runtime.threads",
    "liex_lab.tracking.chain": "liex_lab.tracking.association",
    "liex_lab.tracking.curve": "liex_lab.tracking.offline",
    "liex_lab.tracking.hidden": "liex_lab.tracking.occlusion",
    "liex_lab.tracking.tuning": "liex_lab.tracking.motion_model",
    "liex_lab.tracking.windowed": "liex_lab.tracking.patch_observer",
    "liex_lab.water": "liex_lab.optics.refraction",
}


# they stand in the library where it is installed, and beside it in a clone
BESIDE = ("liex_lab.pipelines", "liex_lab.dashboards")
_LIBRARY = Path(__file__).resolve().parent


class _Forward(Loader):
    """Loads the module at the new path in place of the old one."""

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module at its new path; a warning says where that is.

        Args:
            spec: the forwarding spec, whose name is the old path.
        """
        new = MOVED[spec.name]
        # seen without asking for it, unlike a DeprecationWarning
        warnings.warn(
            f"{spec.name} has moved to {new}; import it from there", FutureWarning, stacklevel=2
        )
        module = import_module(new)
        self._own = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Run nothing again: the module has run at its new path, and keeps that path's spec.

        Args:
            module: what `create_module` returned.
        """
        module.__spec__ = self._own


class _MovedModules:
    """Finds `BESIDE` in a clone and the old paths of `MOVED`, after every other finder."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Spec of a package beside the library, or forwarding spec of an old path; else None.

        Args:
            name: the dotted path that is imported.
            path: not used.
            target: not used.
        """
        package = _LIBRARY.parent / name.removeprefix("liex_lab.") / "__init__.py"
        if name in BESIDE and package.is_file():
            return spec_from_file_location(name, package)
        return ModuleSpec(name, _Forward()) if name in MOVED else None


def keep_old_paths() -> None:
    """Let the old dotted paths be imported, from now on in this process."""
    if not any(isinstance(finder, _MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(_MovedModules())
