"""Motion and association parameters of each animal, stored in `tunings.toml`.

The parameters describe how an animal moves (integrated Ornstein-Uhlenbeck processes), how single
frames err, and the costs of a chain of hypotheses. The file next to this module contains them for
the bundled animals; `liex train tracking` fits them on rendered sequences whose seeds are not those
of any test.
"""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from liex_lab.tracking.association import AssociationCosts
from liex_lab.tracking.smoother import Motion, OrnsteinUhlenbeck

TUNINGS = Path(__file__).with_name("tunings.toml")
# fields of `Motion` with another name in the file, kept for compatibility
_STORED_AS = {
    "position_error": "place_error",
    "position_variance": "place_drive",
    "position_decay_s": "place_fade",
    "degrees_of_freedom": "freedom",
    "gate": "reject",
    "correlated_share": "lasting",
    "calibration": "honest",
    "root_calibration": "honest_root",
    "bend_calibration": "honest_bend",
    "joint_calibration": "honest_joints",
}
_USUAL = "mouse"  # used for animals without parameters of their own


@dataclass(frozen=True)
class TrackingParameters:
    """The parameters of one animal.

    Attributes:
        chain: costs of the association by Viterbi.
        motion: motion and error parameters of the smoother.
    """

    chain: AssociationCosts
    motion: Motion

    @staticmethod
    @cache
    def of(name: str) -> TrackingParameters:
        """The parameters of an animal, or the mouse's if it has none of its own.

        Args:
            name: name of the skeleton, such as 'fish'.

        Returns:
            The parameters, cached by name.
        """
        known = tomllib.loads(TUNINGS.read_text(encoding="utf-8"))
        if name in known:
            return TrackingParameters.from_table(known[name])
        usual = TrackingParameters.from_table(known[_USUAL])
        # the joints differ
        return replace(usual, motion=replace(usual.motion, joint_calibration=()))

    @staticmethod
    def from_table(table: dict[str, Any]) -> TrackingParameters:
        """The parameters from their TOML table.

        Args:
            table: the tables `chain` and `motion` as read by `tomllib`; the three numbers of a
                coordinate are error, drive (process variance) and fade (decay time).
        """
        field_of = {stored: name for name, stored in _STORED_AS.items()}
        motion = {field_of.get(key, key): value for key, value in table["motion"].items()}
        for group in ("turn", "bend"):
            motion[group] = tuple(OrnsteinUhlenbeck(*row) for row in motion[group])
        motion["size"] = OrnsteinUhlenbeck(*motion["size"])
        for name in (
            "position_error",
            "position_variance",
            "stretch",
            "root_calibration",
            "bend_calibration",
        ):
            motion[name] = tuple(motion[name])
        motion["joint_calibration"] = tuple(motion.get("joint_calibration", ()))
        motion["calibration"] = tuple((stated, factor) for stated, factor in motion["calibration"])
        return TrackingParameters(AssociationCosts(**table["chain"]), Motion(**motion))

    def to_toml(self, name: str) -> str:
        """The parameters as TOML tables, numbers to four significant digits.

        Args:
            name: the animal, as the tables' prefix.

        Returns:
            The text of `[name.chain]` and `[name.motion]`.
        """
        lines = [
            f"[{name}.chain]",
            *(f"{key} = {_text(value)}" for key, value in asdict(self.chain).items()),
        ]
        lines += ["", f"[{name}.motion]"]
        for key, value in asdict(self.motion).items():
            rows = [list(row.values()) for row in value] if key in ("turn", "bend") else value
            rows = list(value.values()) if key == "size" else rows
            lines.append(f"{_STORED_AS.get(key, key)} = {_text(rows)}")
        return "\n".join(lines) + "\n"


def tunings_with(name: str, tuning: TrackingParameters) -> str:
    """The text of `tunings.toml` with an animal's tables added or replaced.

    Args:
        name: name of the animal's skeleton.
        tuning: its parameters.

    Returns:
        The whole file, including its leading comment.
    """
    text = TUNINGS.read_text(encoding="utf-8")
    head = text[: text.index("\n[")]
    known = {
        animal: TrackingParameters.from_table(table)
        for animal, table in tomllib.loads(text).items()
    } | {name: tuning}
    return "\n".join(
        [head.rstrip("\n") + "\n", *(each.to_toml(animal) for animal, each in known.items())]
    )


def _text(value: Any) -> str:
    """A number, or lists of them, in TOML."""
    return (
        f"[{', '.join(map(_text, value))}]"
        if isinstance(value, list | tuple)
        else repr(float(f"{value:.4g}"))
    )
