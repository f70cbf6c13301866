"""Everything that is measured of one animal for the tables and figures of Lie-X (section 5)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Results:
    """All that is known of one animal.

    Attributes:
        animal: name of the skeleton.
        joints: names of its joints.
        splits: names of the test splits.
        rows: figures by variant, see `rows.measured_rows`.
        missing: by variant, why its row is not there; by figure and variant, why its curve is not.
        sealed: the split is the one that is measured once.
        test_postures: where the postures of the test splits come from; '' where seeds say so.
        sensitivity: curves by variant, see `sensitivity.sensitivity`.
        illustration: of the default, see `illustrations.illustrate`.
        examples: poses of all rows in fixed frames, see `examples.shown_poses`.
        failures: by variant, those of the frames in which it errs most.
    """

    animal: str
    joints: list[str]
    splits: list[str]
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    sealed: bool = False
    test_postures: str = ""
    sensitivity: dict[str, Any] = field(default_factory=dict)
    illustration: dict[str, Any] = field(default_factory=dict)
    examples: list[dict[str, Any]] = field(default_factory=list)
    failures: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
