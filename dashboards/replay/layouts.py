"""Layouts of a replay: the Rerun blueprint, and the Foxglove layout of session.mcap."""

import json
from collections.abc import Callable
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from liex_lab.behaviour.body import drawn_measures
from liex_lab.runtime.durable import replacing, write_whole
from liex_lab.runtime.text_files import value_at
from liex_lab.scene.height_maps import N_OBJECTS
from liex_lab.sessions import Session, cutouts, rrd_scene, viewer
from liex_lab.sessions.rrd import ANIMALS, OVERLAY, SKELETON, TOGETHER, corrected_entity


def write_blueprint(session: Session) -> Path:
    """Write the blueprint, replay.rbl, to a session's folder; returns its path.

    It applies to any replay of liex_lab when dragged into a viewer.
    """
    path = session.path / "replay.rbl"
    with replacing(path) as beside:
        replay_blueprint(session.metadata).save("liex_lab", str(beside))
    return path


def live_blueprint(body_m: float) -> Any:
    """The layout of a stream of skeletons: scene, depth image, and the predicted error below.

    `body_m` is the length of the animal's body, m.
    """
    image = rrb.Spatial2DView(
        origin="arena/camera/image",
        contents=["$origin/**", f"+ /{SKELETON}/**", f"+ /{ANIMALS}/**"],
        name="depth with the skeletons",
    )
    error = rrb.TimeSeriesView(origin=viewer.ERROR, name="predicted error (mm)")
    return _blueprint(
        rrb.Vertical(rrb.Horizontal(_scene(body_m, SKELETON), image), error, row_shares=[4, 1])
    )


def replay_blueprint(session: dict[str, Any]) -> Any:
    """A Rerun blueprint; passed to `SessionWriter` as `blueprint`.

    With corrections, the corrected entities are shown; the original ones are hidden in the views
    but remain in the replay.

    Args:
        session: the content of session.json.
    """
    animal = session["animal"]
    corrected = bool(session.get("corrections"))
    at = corrected_entity if corrected else str
    # without an exchange the other animals of the arena are as they were measured
    moved = bool((session.get("corrections") or {}).get("swap"))
    measured = ["skeleton", "body", "uncertainty", "root"] if corrected else []
    measured += ["animals"] * moved
    body_m = float(animal.get("spine_mm") or animal["home_length_mm"]) / 1000.0
    hidden = [OVERLAY, corrected_entity(OVERLAY), *(f"arena/{name}" for name in measured)]
    scene = _scene(body_m, at(SKELETON), ["$origin/**", *(f"- /{name}/**" for name in hidden)])
    plan = session.get("plan", {})
    kept = plan.get("replay", {}).get("depth")
    count = value_at(plan, ("animal", "count")) or 1
    n_boxes = N_OBJECTS if count == "auto" else max(cutouts.N_BOXES, count)
    # the coordinate frames of the cut-outs in the image, by their entities; rerun's types of
    # overrides leave them out
    frames: dict[Any, Any] = {
        rrd_scene.cutout_entity(k, which): rr.CoordinateFrame(rrd_scene.cutout_frame(k))
        for k in range(n_boxes)
        for which in range(cutouts.N_WINDOWS)
    }
    image: Any = rrb.Spatial2DView(
        origin="arena/camera/image",
        contents=[
            "$origin/**",
            f"+ /{rrd_scene.CUTOUTS}/**",
            *(f"- /{OVERLAY}/{name}" for name in ("joints", "bones") if corrected),
            *[f"- /{OVERLAY}/animals/**"] * moved,
        ],
        overrides={} if kept in (cutouts.ALL, cutouts.NONE) else frames,
        name="depth with the corrected skeleton" if corrected else "depth with the fitted skeleton",
    )
    if kept == cutouts.ANIMAL:  # above it, a view whose camera follows the animal
        zoomed = rrb.Spatial2DView(
            origin=f"{rrd_scene.CUTOUTS}/1",
            contents=["$origin/**", f"+ /{at(SKELETON)}/**"],
            name="the animal, zoomed",
        )
        image = rrb.Vertical(zoomed, image)
    return _blueprint(
        rrb.Vertical(
            rrb.Horizontal(scene, image),
            *_over_time(at, animal, [] if moved else [f"+ /{TOGETHER}/**"]),
            row_shares=[5, 1.6 * n_boxes / 2, 2],
        )
    )


def _blueprint(views: Any) -> Any:
    return rrb.Blueprint(
        views,
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _scene(body_m: float, skeleton: str, contents: Any = "$origin/**") -> Any:
    """The 3D view that follows an animal of length `body_m` by its skeleton's entity."""
    return rrb.Spatial3DView(
        origin="arena",
        contents=contents,
        name="3D: the animal, followed (metres)",
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=body_m * np.array([0.8, -2.6, 2.2]),
            look_target=[0.0, 0.0, 0.0],
            eye_up=[0.0, 0.0, 1.0],
            tracking_entity=f"/{skeleton}/joints",
        ),
        line_grid=rrb.LineGrid3D(visible=False),
    )


def _over_time(
    at: Callable[[str], str], animal: dict[str, Any], more: list[str]
) -> tuple[Any, Any]:
    """The lanes of actions, and the curves below them with the list of messages.

    Args:
        at: the entity to show for a measured one.
        animal: the section of that name of session.json; its joints determine the curves.
        more: further contents of the lanes.
    """
    lanes = rrb.StateTimelineView(
        origin=at("ethogram"),
        contents=["$origin/**", *more],
        name="actions (predicted) and frames to distrust (tracking)",
    )
    shown = drawn_measures(animal)
    curves = rrb.Horizontal(
        *(
            rrb.TimeSeriesView(
                origin=at(one.entity),
                contents=["$origin/**", f"+ /{at(one.entity_before)}"],
                name=f"{one.title.lower()} {one.what}".split(";")[0].split(",")[0],
            )
            for one in shown
        ),
        rrb.TimeSeriesView(origin=at("error/predicted"), name="predicted error"),
        rrb.TextLogView(
            origin="log",
            name="what to review: click to jump there",
            columns=rrb.TextLogColumns(timeline_columns=["time"], text_log_columns=["body"]),
        ),
        column_shares=[*(2.0 for _ in shown), 2.0, 2.4],
    )
    return lanes, curves


# Foxglove layout (JSON) of a session's MCAP file, for import in Foxglove


LAYOUT_FILE = "foxglove.json"


def write_layout(session: Session) -> Path:
    """Write foxglove.json to a session's folder; returns its path."""
    path = session.path / LAYOUT_FILE
    write_whole(path, json.dumps(foxglove_layout(session.metadata), indent=1) + "\n")
    return path


def foxglove_layout(about: dict[str, Any]) -> dict[str, Any]:
    """The layout: scene and depth above, actions, heights and messages below.

    Args:
        about: the content of session.json.
    """
    # scene and depth above, the rest below
    layout: dict[str, Any] = json.loads(
        (Path(__file__).parent / LAYOUT_FILE).read_text(encoding="utf-8")
    )
    panels = layout["configById"]
    far_mm = float(about["camera"]["floor_distance_mm"])
    panels["Image!depth"]["imageMode"] |= {
        "minValue": round(0.85 * far_mm),
        "maxValue": round(1.02 * far_mm),
    }
    joints = list(about["animal"]["joints"])
    ends = sorted({0, len(joints) - 1} if about["animal"]["name"] != "hand" else {0})
    panels["Plot!heights"]["paths"] = [
        {
            "value": f"/skeleton/joints.poses[{j}].position.z",
            "label": joints[j],
            "enabled": True,
            "timestampMethod": "receiveTime",
            "color": colour,
        }
        for j, colour in zip(ends, ("#4477aa", "#ee6677"), strict=False)
    ]
    names = (about.get("interactions") or {}).get("individuals", ())
    panels["StateTransitions!actions"]["paths"] += [
        {
            "value": f'/interactions{{agent=="{agent}"}}{{target=="{target}"}}.interactions',
            "label": f"{agent} to {target}",
            "timestampMethod": "receiveTime",
        }
        for agent, target in permutations(names, 2)
    ]
    return layout
