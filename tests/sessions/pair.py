"""Two walking mice in one arena: a session of each, with the interactions of both."""

from pathlib import Path
from typing import Any

from liex_lab import behaviour
from liex_lab.behaviour.interactions import Individual, find_interactions
from liex_lab.plan.sections import InteractionThresholds
from liex_lab.sessions import Session, SessionWriter
from tests.sessions.walking_mouse import WalkingMouse, steady

NAMES = ("animal1", "animal2")


def write_pair(folder: Path, seconds: float = 3.0, group: str = "", **more: Any) -> list[Session]:
    """The second walks closer inside, faster, so that it passes the first; it is lost in frame 20.

    Those of a group have subjects named after the folder. `more` goes to the provenance.
    """
    times = steady(seconds)
    mice = (
        WalkingMouse(times, speed_mm_s=120.0),
        WalkingMouse(times, speed_mm_s=180.0, radius_mm=115.0, lost=(20,)),
    )
    tracks = [mouse.track() for mouse in mice]
    animals = [Individual.of_track(*one) for one in zip(NAMES, tracks, strict=True)]
    together = find_interactions(times, animals, InteractionThresholds())
    sessions = []
    for name, mouse, track in zip(NAMES, mice, tracks, strict=True):
        facts = {"name": f"pair-{name}", "individual": name, "input_sha256": "ab" * 32} | more
        if group:
            facts["subject"] = {"subject_id": f"{folder.name}_{name}", "group": group}
        path = folder / f"pair-{name}.liex"
        with SessionWriter(path, mouse.provenance(**facts)) as writer:
            for frames, _ in mice[0].chunks(30):
                writer.add(frames)
            writer.track = track
            measured = behaviour.measure_rows(writer.rows, None, behaviour.Surroundings())
            closing = measured.for_session()
            own = together.for_session(writer.rows, measured.tables)
            closing["results"] |= own["results"]
            closing["columns"] = [*closing["columns"], *own["columns"]]
            closing["record"] = {**closing.get("record", {}), **own["record"]}
            closing["together"] = own["together"]
            sessions.append(writer.close(**closing))
    return sessions
