"""Foxglove layout (JSON) of a session's MCAP file, to be imported there as a layout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from liex_lab.sessions import Session

FILE = "foxglove.json"
_DEPTH = "/camera/depth"
_CALIBRATION = "/camera/calibration"
_SKELETON = "/camera/skeleton"
_SCENE = "/skeleton/scene"
_ACTIONS = "/actions"
_NOTES = "/log"
_JOINTS = "/skeleton/joints"


def write_layout(session: Session) -> Path:
    """Write foxglove.json into a session's folder.

    Args:
        session: the opened session.

    Returns:
        Path of the file.
    """
    from liex_lab.runtime.durable import write_whole

    path = session.path / FILE
    write_whole(path, json.dumps(foxglove_layout(session.metadata), indent=1) + "\n")
    return path


def foxglove_layout(about: dict[str, Any]) -> dict[str, Any]:
    """The layout: scene and depth above, actions, heights and notes below.

    Args:
        about: the content of session.json.
    """
    far_mm = float(about["camera"]["floor_distance_mm"])
    joints = list(about["animal"]["joints"])
    ends = sorted({0, len(joints) - 1} if about["animal"]["name"] != "hand" else {0})
    colours = ("#4477aa", "#ee6677")
    panels: dict[str, Any] = {
        "3D!scene": {
            "followTf": "root",
            "followMode": "follow-position",
            "cameraState": {
                "distance": 0.5,
                "phi": 50,
                "thetaOffset": 45,
                "perspective": True,
                "fovy": 45,
                "target": [0, 0, 0],
                "targetOffset": [0, 0, 0],
                "targetOrientation": [0, 0, 0, 1],
                "near": 0.01,
                "far": 100,
            },
            "scene": {},
            "transforms": {},
            "layers": {
                "floor": {
                    "layerId": "foxglove.Grid",
                    "instanceId": "floor",
                    "label": "floor",
                    "visible": True,
                    "size": 1,
                    "divisions": 10,
                    "color": "#5a6472ff",
                    "frameId": "arena",
                    "position": [0, 0, 0],
                    "rotation": [0, 0, 0],
                }
            },
            "topics": {
                _SCENE: {"visible": True},
                _JOINTS: {"visible": True, "type": "axis", "axisScale": 0.01},
            },
        },
        "Image!depth": {
            "imageMode": {
                "imageTopic": _DEPTH,
                "calibrationTopic": _CALIBRATION,
                "annotations": {_SKELETON: {"visible": True}},
                "colorMode": "colormap",
                "colorMap": "turbo",
                "minValue": round(0.85 * far_mm),
                "maxValue": round(1.02 * far_mm),
            }
        },
        "StateTransitions!actions": {
            "isSynced": True,
            "paths": [
                {"value": f"{_ACTIONS}.action", "label": "action", "timestampMethod": "receiveTime"}
            ],
        },
        "Plot!heights": {
            "title": "height above the floor (m)",
            "isSynced": True,
            "showLegend": True,
            "showXAxisLabels": True,
            "paths": [
                {
                    "value": f"{_JOINTS}.poses[{j}].position.z",
                    "label": joints[j],
                    "enabled": True,
                    "timestampMethod": "receiveTime",
                    "color": colour,
                }
                for j, colour in zip(ends, colours, strict=False)
            ],
        },
        "Log!notes": {"topicToRender": _NOTES, "minLogLevel": 1},
    }
    above = {
        "direction": "row",
        "first": "3D!scene",
        "second": "Image!depth",
        "splitPercentage": 55,
    }
    below = {
        "direction": "row",
        "first": "Plot!heights",
        "second": "Log!notes",
        "splitPercentage": 70,
    }
    lower = {
        "direction": "column",
        "first": "StateTransitions!actions",
        "second": below,
        "splitPercentage": 40,
    }
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "column", "first": above, "second": lower, "splitPercentage": 65},
    }
