"""One body for the sessions of one animal: a random-effects mean of the individual estimates."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from liex_lab.plan import sections

MOST_APART = 0.08  # of the median length: a larger difference means growth, or another animal
_DECIMALS = 4  # of a shape, relative to the length or to the average animal


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False)


class Shape(_Part):
    """The shape that a session found, see `sections.SharedShape`."""

    kept: bool = False
    n_frames: int = Field(0, ge=0, description="frames that show the animal well")
    residual_mm: float | None = None
    width: list[sections.Factor] = []
    height: list[sections.Factor] = []
    joints_moved: list[sections.Point] = []


class Animal(_Part):
    """The animal that a session found; girth is that of the average body."""

    spine_mm: sections.Positive
    girth: sections.Factor
    shape: Shape = Shape()


class Inspection(_Part):
    """The entries of look.json that are read if an animal was found."""

    animal: Animal
    log_sd: float = Field(ge=0.0, description="of the length in single frames")
    n_frames: int = Field(ge=1, description="frames with a pose")
    stated: bool = Field(description="whether the plan states the length")


def spread_of(found: Sequence[Inspection]) -> float:
    """The spread of the lengths: largest minus smallest, over the median.

    Args:
        found: of sessions of one animal, at least one.
    """
    lengths = [one.animal.spine_mm for one in found]
    return (max(lengths) - min(lengths)) / float(np.median(lengths))


def agree(subject: str, found: Sequence[Inspection]) -> sections.SharedBody:
    """The shared values of sessions, independent of their order.

    A shape is shared if more frames support one than contradict one.

    Args:
        subject: the animal.
        found: of its sessions, whose lengths are at most `MOST_APART` apart.
    """
    found = sorted(found, key=repr)  # sums of floats depend on their order
    kept, others = ([o for o in found if o.animal.shape.kept == wanted] for wanted in (True, False))
    shapes = [one.animal.shape for one in kept]
    weights = [one.n_frames for one in shapes]
    # a shape was tried, and rejected on held-out frames
    refused = [one.animal.shape for one in others if one.animal.shape.residual_mm is not None]
    is_shared = sum(weights) > sum(one.n_frames for one in refused)

    def mean(values: Any, weights: Sequence[float]) -> Any:
        return np.average(values, axis=0, weights=weights).round(_DECIMALS).tolist()

    measured = [one for one in found if not one.stated]
    return sections.SharedBody(
        subject=subject,
        n_sessions=len(found),
        spine_mm=round(_length(measured), 3) if measured else None,
        girth=mean([one.animal.girth for one in others], [one.n_frames for one in others])
        if others and not is_shared
        else None,
        shape=sections.SharedShape(
            width=mean([one.width for one in shapes], weights),
            height=mean([one.height for one in shapes], weights),
            joints_moved=mean([one.joints_moved for one in shapes], weights),
        )
        if is_shared
        else None,
    )


def _length(measured: Sequence[Inspection]) -> float:
    """The random-effects mean of the lengths; their logarithms have a variance from the scatter of
    each session's own frames, and one between sessions, by the method of moments.
    """
    y = np.log([one.animal.spine_mm for one in measured])
    own = np.array([max(one.log_sd**2 / one.n_frames, 0.001**2) for one in measured])
    v, between = 1.0 / own, 0.0
    if len(y) > 1:
        q = (v * (y - np.average(y, weights=v)) ** 2).sum()
        between = max(0.0, (q - (len(y) - 1)) / (v.sum() - (v**2).sum() / v.sum()))
    return float(np.exp(np.average(y, weights=1.0 / (own + between))))
