"""BORIS's own functions open a project and say what they found, as JSON: a program of its own.

`import boris` starts with its window and its player, which want a sound server and libmpv; what
reads projects wants neither, so the package is entered beside its front door and the player is an
empty module. `python boris_reader.py PROJECT` prints
`{"changed", "message", "faults", "media", "observations"}`.
"""

import importlib
import importlib.util
import json
import sys
from types import ModuleType
from typing import Any


def functions() -> Any:
    """The module of BORIS that opens and checks projects."""
    found = importlib.util.find_spec("boris")
    assert found is not None
    package = ModuleType("boris")
    package.__path__ = list(found.submodule_search_locations or [])
    player = ModuleType("boris.mpv2")
    player.__dict__["sofile"] = "none"
    sys.modules |= {"boris": package, "boris.mpv2": player}
    package.__dict__["mpv2"] = player
    return importlib.import_module("boris.project_functions")


def told(path: str) -> dict[str, Any]:
    """What BORIS makes of a project.

    changed and message are those of its reader; faults is what its check of integrity finds; media
    has the media files of every observation as BORIS finds them, and observations their events with
    START and STOP.
    """
    boris = functions()
    _, changed, project, message = boris.open_project_json(path)
    if "error" in project:
        return {"error": project["error"]}
    observations = project["observations"]
    faults = boris.check_project_integrity(project, project["time_format"], path)
    return {
        "changed": changed,
        "message": message,
        "faults": faults.replace("<br>", ""),
        "media": {
            name: [boris.full_path(file, path) for file in one["file"]["1"]]
            for name, one in observations.items()
        },
        "observations": {
            name: boris.events_start_stop(project["behaviors_conf"], one["events"], one["type"])
            for name, one in observations.items()
        },
    }


if __name__ == "__main__":
    print(json.dumps(told(sys.argv[1]), default=str))
