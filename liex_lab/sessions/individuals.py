"""Sessions of the animals of one arena: which of them belong together, and the names of all.

A run with several animals writes a session of each. Their `interactions` in session.json name all
animals of the arena, in the same order in every session.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.vocabulary import individual_colours
from liex_lab.behaviour.interactions import Interactions
from liex_lab.errors import SessionError, refuse
from liex_lab.sessions.provenance import Provenance
from liex_lab.sessions.session import Session


def individuals_of(session: Session) -> list[str]:
    """The names of all animals of the session's arena, its own among them."""
    return list((session.metadata.get("interactions") or {}).get("individuals", ())) or [
        str(session.metadata["individual"])
    ]


def arena_name(session: Session) -> str:
    """The session's name without its animal: NAME of NAME-animal1."""
    return session.name.removesuffix(f"-{session.metadata['individual']}")


def _arena(session: Session) -> Hashable:
    """What sessions of the animals of one arena have in common; the session itself if alone."""
    names = individuals_of(session)
    region: Any = session.metadata.get("plan", {}).get("arena", {}).get("region")
    recorded = (session.metadata["input"]["sha256"], str(region), *names)
    return recorded if len(names) > 1 else session.path


def by_arena(sessions: Sequence[Session]) -> list[list[Session]]:
    """The sessions of each arena, in the order of the first of each."""
    found: dict[Hashable, list[Session]] = {}
    for session in sessions:
        found.setdefault(_arena(session), []).append(session)
    return [individuals(some) for some in found.values()]


def individuals(sessions: Sequence[Session]) -> list[Session]:
    """Sessions of animals of one arena in the order of the animals; a single one is returned as is.

    Args:
        sessions: one session or more.

    Raises:
        SessionError: they are not of one arena, of one animal twice, or of other frames.
    """
    first = sessions[0]
    names = individuals_of(first)
    own = [str(session.metadata["individual"]) for session in sessions]
    frames = [session.table("frames", ["frame_index"])["frame_index"] for session in sessions]
    other = [one.name for one in sessions if _arena(one) != _arena(first)]
    apart = [
        one.name
        for one, index in zip(sessions, frames, strict=True)
        if not np.array_equal(index, frames[0])
    ]
    refuse(
        SessionError,
        (
            bool(other),
            f"the sessions of the animals of one arena are written together, and {first.name} and "
            f"{', '.join(other)} are not of one recording; name those of one run",
        ),
        (
            len(set(own)) < len(own),
            f"each animal has one session, and there are several of {', '.join(sorted(set(own)))}; "
            "name one of each",
        ),
        (
            bool(apart),
            f"animals of one arena have the same frames, and those of {', '.join(apart)} are not "
            f"those of {first.name}; measure the recording again with `liex run`",
        ),
    )
    return [session for _, session in sorted(zip(map(names.index, own), sessions, strict=True))]


@dataclass(frozen=True)
class OtherAnimal:
    """Another animal of the arena, as a session's replay shows it in n frames.

    Attributes:
        name: of the animal.
        colour: 0xRRGGBB.
        joints_mm: (n, J, 3) arena frame; NaN without a pose.
        origin: the session's camera.
    """

    name: str
    colour: int
    joints_mm: NDArray[np.float64]
    origin: Provenance

    def uv_px(self, rows: slice) -> NDArray[np.float64]:
        """The joints (m, J, 2) of some frames, px of the depth image."""
        return self.origin.camera.project(
            self.origin.T_arena_camera.inverse() @ self.joints_mm[rows]
        )


def in_replay(
    origin: Provenance, together: Interactions | None
) -> tuple[int | None, list[OtherAnimal]]:
    """The colour 0xRRGGBB of a session's animal beside others, and these; None and [] if alone."""
    if together is None:
        return None, []
    colours = individual_colours([one.name for one in together.animals])
    numbers = {name: int(colour[1:], 16) for name, colour in colours.items()}
    others = [
        OtherAnimal(one.name, numbers[one.name], one.joints_mm, origin)
        for one in together.animals
        if one.name != origin.individual
    ]
    return numbers[origin.individual], others
