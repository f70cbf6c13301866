"""Rules that trigger on a frame: actions, zones and columns compared with numbers.

A rule is a condition, with `until` another one: from the frame in which it begins to hold until the
one in which the other holds (hysteresis: speed_mm_s > 200 until speed_mm_s < 150). The text is
parsed as a Python expression of names, numbers, comparisons, `and`, `or` and `not`; anything else
is refused, and nothing is executed. A condition on a column without a value in a frame neither
holds nor fails there.

The same rule is applied to the rows of an ongoing recording and to the finished session, and the
events of both are matched one to one. An event of the session is a span, from the onset to the end
of its condition, since an action is recognised live only after it has begun.
"""

import ast
import difflib
import operator
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from liex_lab.arrays import Array, Mask
from liex_lab.behaviour.activity import inside_zones
from liex_lab.behaviour.body import BodyAxis
from liex_lab.behaviour.kinematics import IMPOSSIBLE_MM_S
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import PlanError
from liex_lab.tables.rows import Rows
from liex_lab.tables.schema import FRAMES, rears_of, table_columns

TRUTH = "true or false"  # the unit of an action and of a zone
TOLERANCE_S = 0.5  # of a live event before the onset or after the end of that of the session
_LATER = ("tail_extreme_rad", "tail_beat_hz", "tail_beat_mm")  # known half a beat later
_UNUSABLE = (*_LATER, "time_s", "dt_s", "step_mm", "below_surface_mm")  # and unknown while live
_FORM = (
    "write an action, `in ZONE`, or columns compared with numbers: speed_mm_s > 200 and not in nest"
)
_OPERATORS: dict[type[ast.AST], Any] = {
    ast.USub: operator.neg,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.And: np.logical_and,
    ast.Or: np.logical_or,
    ast.Not: np.logical_not,
}


def usable_names(skeleton: Skeleton, words: Iterable[str], zones: Iterable[str]) -> dict[str, str]:
    """The names that a rule may use, with their units.

    Args:
        skeleton: the animal's; its joints have names such as nose_z_mm.
        words: the actions' names.
        zones: the zones' names, of which a rule names in_ZONE.
    """
    words = [word for word in words if word]
    kind = BodyAxis.of(skeleton.names, skeleton.parents.tolist()).kind
    columns = [*table_columns("kinematics", kind), *FRAMES]
    found = {one.name: one.unit for one in columns if one.dtype == "float64"}
    found |= {f"{joint}_{axis}_mm": "mm" for joint in skeleton.names for axis in "xyz"}
    found = {name: unit for name, unit in found.items() if name not in _UNUSABLE}
    rears = ["rear"] if rears_of(words) else []
    return found | dict.fromkeys([*words, *rears, *(f"in_{zone}" for zone in zones)], TRUTH)


@dataclass(frozen=True)
class Rule:
    """A rule that triggers.

    Attributes:
        text: as stated.
        names: the names in it, in order; the value of the first one is reported.
        on: its condition.
        off: the condition that ends it; None if it ends as soon as `on` does not hold.
    """

    text: str
    names: tuple[str, ...]
    on: ast.expr
    off: ast.expr | None = None

    @staticmethod
    def of_text(text: str, known: Mapping[str, str]) -> "Rule":
        """The rule that a text states.

        Args:
            text: CONDITION, or CONDITION until CONDITION.
            known: `usable_names` with their units.

        Raises:
            PlanError: the text is no condition, names what is not known, or compares what cannot be
                compared.
        """
        parts = re.split(r"\buntil\b", re.sub(r"\bin\s+(?=[A-Za-z])", "in_", text.strip()))
        try:
            if len(parts) > 2 or len(text) > 500:
                raise SyntaxError("too long" if len(parts) < 3 else "more than one until")
            on, *off = (ast.parse(part.strip(), mode="eval").body for part in parts)
        except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
            why = getattr(error, "msg", "") or "it cannot be read"
            raise PlanError(
                f"the trigger '{text}' is no condition ({why}); {_FORM}; numbers are in the "
                "column's own unit"
            ) from None
        for condition in (on, *off):
            if _unit(condition, known) != TRUTH:
                raise PlanError(f"the trigger '{text}' compares nothing; {_FORM}")
        nodes = [node for condition in (on, *off) for node in ast.walk(condition)]
        names = [node.id for node in nodes if isinstance(node, ast.Name)]
        if not names:
            raise PlanError(f"the trigger '{text}' names no column, action or zone; {_FORM}")
        return Rule(text, tuple(dict.fromkeys(names)), on, *off)

    def holds(self, values: Mapping[str, Array]) -> tuple[Mask, Mask]:
        """In which of n frames it begins or continues, and in which it ends.

        Args:
            values: (n,) each of its names, NaN if unknown; there neither is true.
        """
        on = np.asarray(_value(self.on, values)) != 0.0
        off = ~on if self.off is None else np.asarray(_value(self.off, values)) != 0.0
        known = np.isfinite([values[name] for name in self.names]).all(axis=0)
        return on & known, off & known


def _unit(node: ast.expr, known: Mapping[str, str]) -> str | None:
    """The unit of an expression, None for a number; raises PlanError if it may not be used."""
    match node:
        case ast.Constant(value=int() | float()):
            return None
        case ast.Name(id=name) if name in known:
            return known[name]
        case ast.Name(id=name):
            raise PlanError(_unknown(name, known))
        case ast.UnaryOp(op=ast.USub(), operand=part):
            return _unit(part, known)
        case ast.UnaryOp(op=ast.Not(), operand=part):
            parts = [part]
        case ast.BoolOp(values=parts):
            pass
        case ast.Compare(left=left, ops=ops, comparators=right) if all(
            type(op) in _OPERATORS for op in ops
        ):
            unit = _common(node, [_unit(part, known) for part in (left, *right)])
            for part in (left, *right):
                _check_number(node, part, unit)
            return TRUTH
        case _:
            raise PlanError(f"'{ast.unparse(node)}' may not be in a trigger; {_FORM}")
    for part in parts:
        if _unit(part, known) != TRUTH:
            raise PlanError(
                f"'{ast.unparse(part)}' in a trigger is neither true nor false; {_FORM}"
            )
    return TRUTH


def _common(node: ast.expr, units: Sequence[str | None]) -> str | None:
    """The unit of values that are compared."""
    stated = sorted({unit for unit in units if unit is not None})
    if TRUTH in stated or len(stated) > 1:
        raise PlanError(
            f"the trigger's '{ast.unparse(node)}' compares {' with '.join(stated) or 'numbers'}; "
            "compare columns of one unit, and use actions and zones without a comparison"
        )
    return stated[0] if stated else None


def _check_number(node: ast.expr, part: ast.expr, unit: str | None) -> None:
    """Refuse a threshold that no value of this unit reaches."""
    try:
        number = abs(float(ast.literal_eval(part)))
    except (ValueError, TypeError):
        return
    if unit == "rad" and number > 2.0 * np.pi:
        raise PlanError(
            f"the trigger's '{ast.unparse(node)}' compares an angle in radians with more than a "
            f"whole turn; {number:g} degrees are {np.radians(number):.4g}"
        )
    if unit == "mm/s" and number >= IMPOSSIBLE_MM_S:
        raise PlanError(
            f"the trigger's '{ast.unparse(node)}' compares a speed with {number:g} mm/s, but above "
            f"{IMPOSSIBLE_MM_S:g} mm/s nothing is measured; state it in mm/s"
        )


def _unknown(name: str, known: Mapping[str, str]) -> str:
    """The sentence on a name that is not known."""
    truths = [one for one, unit in known.items() if unit == TRUTH]
    zones = [one.removeprefix("in_") for one in truths if one.startswith("in_")]
    if name in _LATER:
        return (
            f"{name} is known only when the tail has turned back, which is too late for a trigger; "
            "use tail_angle_rad or tail_mm"
        )
    if name.startswith("in_"):
        there = f"the zones are {', '.join(zones)}" if zones else "the plan draws none"
        return f"there is no zone {name[3:]}: {there}; draw it in the file of arena.zones"
    near = difflib.get_close_matches(name, known, 3, cutoff=0.0)
    actions = [one for one in truths if not one.startswith("in_")]
    return (
        f"{name} is no column, action or zone of this plan; the nearest names are "
        f"{', '.join(near)}, and the actions {', '.join(actions) or '(none)'}"
    )


def _value(node: ast.AST, values: Mapping[str, Array]) -> Any:
    """The value (n,) of a checked expression."""
    match node:
        case ast.Name(id=name):
            return values[name]
        case ast.Constant(value=number):
            return number
        case ast.UnaryOp(op=op, operand=part):
            return _OPERATORS[type(op)](_value(part, values))
        case ast.BoolOp(op=op, values=parts):
            return reduce(_OPERATORS[type(op)], (_value(part, values) for part in parts))
    assert isinstance(node, ast.Compare)
    sides = [_value(part, values) for part in (node.left, *node.comparators)]
    each = zip(node.ops, sides, sides[1:], strict=False)
    return reduce(np.logical_and, (_OPERATORS[type(op)](a, b) for op, a, b in each))


def values_of(
    names: Iterable[str], rows: Rows, moved: Mapping[str, Any], acts: Mapping[str, Any]
) -> dict[str, Array]:
    """The values (n,) of a rule's names in n frames, NaN if unknown.

    Args:
        names: see `usable_names`.
        rows: the track of the frames.
        moved: columns of the table `kinematics` of the frames, (n,).
        acts: of each action among the names (n,) whether a frame is part of it.
    """
    track = rows.track
    joints = {name: k for k, name in enumerate(track.skeleton.names)}
    found: dict[str, Array] = {}
    for name in names:
        if name in acts:
            found[name] = np.where(track.posed, acts[name], np.nan)
        elif name in moved:
            found[name] = np.asarray(moved[name], float)
        elif name.startswith("in_"):
            (inside,) = inside_zones(rows.frames_table, [name[3:]])
            found[name] = np.where(np.isfinite(track.centroid_mm[:, 0]), inside, np.nan)
        elif (joint := name[:-5]) in joints:  # without _x_mm
            found[name] = track.joints_mm[:, joints[joint], "xyz".index(name[-4])]
        else:
            found[name] = rows.frames_table[name].to_numpy(float)
    return found


def words_in(name: str, words: Iterable[str]) -> list[str]:
    """The words of a vocabulary that an action's name in a rule means; `rear` is every rear."""
    return [word for word in words if word == name or (word in rears_of([word]) and name == "rear")]


@dataclass
class Onsets:
    """Finds the events of a rule, frame by frame.

    Attributes:
        duration_s: the condition must hold so long, without an unknown frame, before an event.
        refractory_s: least time between two events; onsets within it are passed over.
    """

    duration_s: float = 0.0
    refractory_s: float = 0.0
    _active: bool = False
    _since_s: float | None = None
    _last_s: float = -np.inf

    def add(self, time_s: float, on: bool, off: bool) -> bool:
        """Whether an event is in the next frame.

        Args:
            time_s: of the frame.
            on: whether the condition holds in it.
            off: whether the condition that ends it holds.
        """
        if self._active:
            self._active, self._since_s = not off, None
            return False
        self._since_s = (time_s if self._since_s is None else self._since_s) if on else None
        if self._since_s is None or time_s - self._since_s < self.duration_s - 1e-9:
            return False
        self._active = True
        if time_s - self._last_s < self.refractory_s - 1e-9:
            return False
        self._last_s = time_s
        return True

    def of_frames(self, time_s: Array, on: Mask, off: Mask) -> Array:
        """Onsets and ends (k, 2), s, of the events in n frames, each (n,) as for `add`."""
        found: list[list[float]] = []
        for now, *holds in zip(time_s.tolist(), on.tolist(), off.tolist(), strict=True):
            if self.add(now, *holds):
                found.append([now, float(time_s[-1])])
            elif found and not self._active:
                found[-1][1] = min(found[-1][1], now)
        return np.array(found).reshape(-1, 2)


@dataclass(frozen=True)
class Agreement:
    """Agreement of live events with those of the finished session.

    Attributes:
        precision: share of the live events that match one of the session; None without any.
        recall: share of the session's events that match a live one; None without any.
        offset_s: (n,) time of each live event after the onset of its match, s; NaN if it has none.
        missed_s: onsets of the session's events without a live one, s.
    """

    precision: float | None
    recall: float | None
    offset_s: Array
    missed_s: Array

    @staticmethod
    def of(live_s: Array, session_s: Array, tolerance_s: float = TOLERANCE_S) -> "Agreement":
        """Match events one to one, in order of time.

        Args:
            live_s: (n,) times of the live events, in order, s.
            session_s: (m, 2) onsets and ends of those of the finished session, s.
            tolerance_s: a live event may be this much before the onset or after the end.
        """
        offset = np.full(len(live_s), np.nan)
        missed = np.ones(len(session_s), np.bool_)
        k = 0
        for j, (start_s, stop_s) in enumerate(session_s):
            while k < len(live_s) and live_s[k] < start_s - tolerance_s:
                k += 1
            if k < len(live_s) and live_s[k] <= stop_s + tolerance_s:
                offset[k], missed[j] = live_s[k] - start_s, False
                k += 1
        n = int((~missed).sum())
        return Agreement(
            n / len(live_s) if len(live_s) else None,
            n / len(session_s) if len(session_s) else None,
            offset,
            session_s[missed, 0],
        )
