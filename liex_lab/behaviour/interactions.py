"""Interactions of two to four animals of one arena, from their 3D joints: which one did what to
which other.

The words are `actions.vocabulary.INTERACTIONS`, their limits the plan's section `interactions`. A
rule is the least of relative margins, 1 - d / D of a distance d within D and v / V - 1 of a speed v
above V: an interaction begins and ends with a margin of 0 or more, and pauses above -hysteresis
belong to it; then short pauses are bridged and short ones dropped, as for bouts. Distances between
skins are those of two tubes around the mid-axes, as thick as the skeleton's body:

    gap = min_ij |a_i - b_j| - r_i - r_j    (mm),  a_i, b_j: points along the two mid-axes.

Frames in which either animal has no trusted pose are not observed: no interaction includes them,
and shares are of the observed time of the pair. Poses are interpolated over pauses up to `merge_s`.
Frames in which it is not clear which of them is which count for mutual words only, without a
direction; where it is not clear which end is the head, words that depend on it neither begin nor
end, and pauses so far within their limits belong to them. Sources: Live Mouse Tracker (de Chaumont
et al. 2019, Nature Biomedical Engineering 3:930) and deepof (Bordes et al. 2023, Nature
Communications 14:4319).

An animal that another one lies over has no pose, but their outline distinguishes it from one that
is merely hidden: its area lacks part of an animal, the volume below it does not, as the upper one
is raised. The agent of such a mount was behind the other in most of the time before it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise, permutations
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from liex_lab.actions.vocabulary import INTERACTIONS as WORDS
from liex_lab.arrays import Array, Mask, NDArray
from liex_lab.behaviour.body import SWIMS, BodyAxis
from liex_lab.behaviour.bouts import hysteresis, tidy
from liex_lab.behaviour.kinematics import neighbours, segments
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface
from liex_lab.body.skeleton import Skeleton
from liex_lab.plan.sections import InteractionThresholds
from liex_lab.runtime.memory import blocks
from liex_lab.tables.rows import Rows, frame_count, stop_times
from liex_lab.tables.schema import INTERACTIONS, to_pandas
from liex_lab.tracking.identity import UNCLEAR
from liex_lab.tracking.track import CORRECTED, Track, whole_gaps

_ALONG = np.linspace(0.0, 1.0, 13)  # places along the body, from the front (0) to the rear (1)
_TRUNK = _ALONG >= 0.25  # behind the head
_REST = _ALONG >= 0.45  # what touches when animals rest together
_NECK, _CHEST = 3, 4  # places of a quarter and a third of the body
_WALKERS = ("mount", "huddle")  # words that swimming animals do not have
_BLOCK = 4096
PAIR = "pair_"  # begins the name of a measure of an arena
TABLES = ("interactions", "interaction_totals")


@dataclass(frozen=True)
class Individual:
    """One animal of an arena in n frames.

    Attributes:
        name: its name in the column `individual`.
        skeleton: a chain of J joints.
        joints_mm: (n, J, 3) arena frame; NaN without a pose.
        trusted: (n,) bool, whether the pose was measured and nothing contradicts it.
        clear: (n,) bool, whether it is clear that this is the animal.
        ends: (n,) bool, whether it is clear which end is the head.
    """

    name: str
    skeleton: Skeleton
    joints_mm: Array
    trusted: Mask
    clear: Mask
    ends: Mask

    @staticmethod
    def of_track(name: str, track: Track) -> "Individual":
        """The animal of a track."""
        clear = np.asarray(track.flag != "unclear")
        trusted = track.observed & (np.isin(track.flag, ["", CORRECTED]) | ~clear)
        turned = ~clear & (track.p_flip > UNCLEAR)
        return Individual(name, track.skeleton, track.joints_mm, trusted, clear, ~turned)

    def bridged(self, time_s: Array, most_s: float) -> "Individual":
        """The animal with poses interpolated where it has none for most_s or less."""
        known = self.trusted & np.isfinite(self.joints_mm).all(axis=(1, 2))
        flat = np.where(known[:, None], self.joints_mm.reshape(len(known), -1), np.nan)
        joints = pd.DataFrame(flat, time_s).interpolate("index").to_numpy()
        last = np.maximum.accumulate(np.where(known, np.arange(len(known)), 0))
        return Individual(
            self.name,
            self.skeleton,
            joints.reshape(self.joints_mm.shape),
            known | whole_gaps(time_s, known, most_s),
            self.clear[last],
            self.ends[last],
        )


@dataclass(frozen=True)
class Interactions:
    """The interactions of an arena.

    Attributes:
        events: the table `interactions` without session_id.
        totals: the table `interaction_totals` without session_id.
        limits: the thresholds.
        animals: in the order of the arena.
    """

    events: pd.DataFrame
    totals: pd.DataFrame
    limits: InteractionThresholds
    animals: tuple[Individual, ...]

    def states(self) -> dict[tuple[str, str], list[tuple[int, int, float, float, str]]]:
        """What each agent does to each target: spans in order, without those of nothing.

        Returns:
            By agent and target: first frame, frame after the last, start and stop, s, and the words
            at that time with ", " between them.
        """
        found: dict[tuple[str, str], list[tuple[int, int, float, float, str]]] = {}
        events = self.events[self.events["target"] != ""]
        for (agent, target), own in events.groupby(["agent", "target"], sort=False):
            start, stop, words = (
                own[name].to_numpy() for name in ("start_frame", "stop_frame", "action")
            )
            ends, starts = (
                dict(zip(*one, strict=True))
                for one in ((stop, own["stop_s"]), (start, own["start_s"]))
            )
            spans = found.setdefault((str(agent), str(target)), [])
            for (a, a_s), (b, b_s) in pairwise(sorted((ends | starts).items())):
                now = words[(start <= a) & (stop > a)]
                if len(now):
                    spans.append((int(a), int(b), a_s, b_s, ", ".join(now)))
        return found

    def for_session(self, rows: Rows, measured: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
        """Tables, descriptions of their columns and notes, as `SessionWriter.close` takes them.

        Args:
            rows: the track of the session.
            measured: its tables of behaviour, by name.
        """
        tables = zip(TABLES, (self.events, self.totals), strict=True)
        about = {
            "individuals": [one.name for one in self.animals],
            "limits": self.limits.model_dump(),
            "definitions": definitions(self.limits),
        }
        return {
            "results": {
                name: to_pandas(
                    [column for column in INTERACTIONS if column.table == name],
                    {"session_id": rows.session_id, **table},
                )
                for name, table in tables
            },
            "columns": INTERACTIONS,
            "record": {"interactions": about},
            "together": self,
        }


def definitions(limits: InteractionThresholds) -> dict[str, str]:
    """The definition of each word with these thresholds, as sentences."""
    return {word: one.meaning.format(**limits.model_dump()) for word, one in WORDS.items()}


def find_interactions(
    time_s: Array,
    animals: Sequence[Individual],
    limits: InteractionThresholds,
    frame_index: NDArray[np.int64] | None = None,
    outlines: NDArray[np.floating] | None = None,
) -> Interactions:
    """The interactions of the animals of one arena.

    Args:
        time_s: (n,) times of the frames, s since the first, increasing.
        animals: two or more, each with n frames.
        limits: the thresholds.
        frame_index: (n,) index of each frame in the recording; None counts from 0.
        outlines: (n, K, 4) centre, mm, with the mean height, and area, mm^2, of what is in view;
            NaN if absent. None if there was no depth.
    """
    whole = [one.bridged(time_s, limits.merge_s) for one in animals]
    arena = _Arena(time_s, whole, limits, outlines)
    found = sorted(arena.events(), key=lambda event: (event.start, event.stop, event.word))
    start, stop = np.array([(one.start, one.stop) for one in found], np.int64).reshape(-1, 2).T
    count = frame_count(np.arange(len(time_s)) if frame_index is None else frame_index)
    names = [one.name for one in animals]
    events = pd.DataFrame(
        {
            "agent": [names[one.agent] for one in found],
            "target": [names[one.target] if one.target >= 0 else "" for one in found],
            "action": [one.word for one in found],
            "start_s": time_s[start],
            "stop_s": arena.stop_s[stop - 1],
            "duration_s": arena.stop_s[stop - 1] - time_s[start],
            "start_frame": count[start],
            "stop_frame": count[stop],
            "score": np.array([one.score for one in found], float),
            "directed": np.array([one.directed for one in found], bool),
        }
    )
    return Interactions(events, _totals(arena, found, names), limits, tuple(animals))


def arena_measures(totals: pd.DataFrame) -> dict[str, float]:
    """Number per minute and share of each interaction in an arena, the mean over its pairs.

    They are measures of the arena, the same for each of its animals: both directions are added.

    Args:
        totals: the table `interaction_totals`.

    Returns:
        `pair_WORD_per_min` and `pair_WORD_share`; NaN if no pair was observed.
    """
    means = totals[totals["target"] != ""].groupby("action")[["per_min", "share"]].mean()
    return {
        f"{PAIR}{word}_{name}": float(value) * (1.0 if WORDS[str(word)].mutual else 2.0)
        for name, values in means.items()
        for word, value in values.items()
        if word in WORDS
    }


class _Event(NamedTuple):
    """An interaction in the rows [start, stop); the target of `isolated` is -1."""

    agent: int
    target: int
    word: str
    start: int
    stop: int
    score: float
    directed: bool


class _Course(NamedTuple):
    """Body and motion of one animal in n frames, NaN where it has no trusted pose.

    Heading and velocity of an animal that stands are level.
    """

    along: Array  # (n, M, 3) mm, points of the mid-axis at `_ALONG`
    radius: Array  # (M,) mm, of the body there
    heading: Array  # (n, 3) unit vectors
    centre: Array  # (n, 3) mm
    velocity: Array  # (n, 3) mm/s
    swims: bool

    @property
    def speed(self) -> Array:
        return np.asarray(np.linalg.norm(self.velocity, axis=1))

    @staticmethod
    def of(animal: Individual, time_s: Array, limits: InteractionThresholds) -> "_Course":
        skeleton = animal.skeleton
        body = BodyAxis.of(skeleton.names, skeleton.parents.tolist())
        flat = np.array([1.0, 1.0, float(body.kind == SWIMS)])
        joints = np.where(animal.trusted[:, None, None], animal.joints_mm, np.nan)
        spine = joints[:, body.spine]
        length = np.linalg.norm(np.diff(spine, axis=1), axis=2).sum(axis=1)
        known = np.isfinite(length)
        scale = float(np.median(length[known])) / skeleton.length if known.any() else 1.0
        reach = skeleton.reach / skeleton.length
        share = np.abs(reach[list(body.spine)] - reach[body.front])
        weight = np.stack([np.interp(_ALONG, share, unit) for unit in np.eye(len(share))], axis=1)
        centre = joints[:, body.trunk].mean(axis=1) * flat
        before, after = neighbours(time_s, known, limits.speed_half_window_s)
        since = np.where(after > before, time_s[after] - time_s[before], np.nan)
        ahead = (joints[:, body.axis[1]] - joints[:, body.axis[0]]) * flat
        return _Course(
            np.einsum("ms,nsd->nmd", weight, spine),
            scale * _radii(skeleton, body),
            ahead / np.linalg.norm(ahead, axis=1, keepdims=True),
            centre,
            (centre[after] - centre[before]) / since[:, None],
            body.kind == SWIMS,
        )


def _radii(skeleton: Skeleton, body: BodyAxis) -> Array:
    """Radius (M,) mm of the body at scale 1 at the places `_ALONG`: of the nearest skin, the
    median distance from the mid-axis.
    """
    home, surface = Pose.home(skeleton), Surface.of(skeleton)
    skin = surface.vertices(home)[: surface.n_trunk_vertices]
    ends = home.joints(skeleton)[[body.front, body.rear]]
    axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    along = (skin - ends[0]) @ axis
    across = np.linalg.norm(skin - ends[0] - along[:, None] * axis, axis=1)
    place = np.abs(along[:, None] / skeleton.length - _ALONG).argmin(axis=1)
    radius = [np.median(across[place == k]) if (place == k).any() else np.nan for k in range(13)]
    radius[0] = -along.min()  # at the tip of the nose: the tube ends where the skin does
    there = np.isfinite(radius)
    return np.asarray(np.interp(_ALONG, _ALONG[there], np.array(radius)[there]))


class _Toward(NamedTuple):
    """Where one animal, the agent, is in relation to another, the target, in n frames."""

    gap: Array  # mm, of the skins
    trunks: Array  # mm, of the skins of the rear halves
    part: Array  # the place of the target that is nearest to the agent's nose, see `_ALONG`
    nose_skin: Array  # mm, of the agent's nose from the skin of the target's trunk
    noses: Array  # mm
    tails: Array  # mm, of the tail bases
    nose_tail: Array  # mm, of the agent's nose from the target's tail base
    above: Array  # margin by which the agent's chest is above the target's trunk
    angle: Array  # rad, of the headings
    behind: Mask  # whether the target is ahead of the agent, and heads as for a mount
    at_nose: Array  # rad, of the agent's head and the direction of the target's nose
    at_tail: Array  # rad, of the agent's head and the direction of the target's tail base
    closing: Array  # mm/s, of the agent towards the target

    @staticmethod
    def of(a: _Course, b: _Course, limits: InteractionThresholds) -> "_Toward":
        n = len(a.centre)
        gap, trunks, place, skin, above = np.empty((5, n))
        for part in blocks(n, _BLOCK):
            off = a.along[part, :, None] - b.along[part, None]
            apart = np.linalg.norm(off, axis=-1) - a.radius[:, None] - b.radius
            gap[part] = apart.min(axis=(1, 2))
            trunks[part] = apart[:, _REST][:, :, _REST].min(axis=(1, 2))
            place[part] = _ALONG[apart[:, 0].argmin(axis=1)]
            skin[part] = apart[:, 0, _TRUNK].min(axis=1) + a.radius[0]
            chest = off[:, _CHEST, _TRUNK]
            within = 1.0 - np.linalg.norm(chest[..., :2], axis=-1) / b.radius[_TRUNK]
            higher = chest[..., 2] / limits.mount_above_mm - 1.0
            above[part] = np.minimum(within, higher).max(axis=1)
        way = b.centre - a.centre
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
        ends = [one.along[:, k] for one in (a, b) for k in (0, -1)]
        neck, angle = a.along[:, _NECK], _angle(a.heading, b.heading)
        ahead = [np.einsum("nd,nd->n", one.heading, way) > 0.0 for one in (a, b)]
        return _Toward(
            gap,
            trunks,
            place,
            skin,
            np.linalg.norm(ends[0] - ends[2], axis=1),
            np.linalg.norm(ends[1] - ends[3], axis=1),
            np.linalg.norm(ends[0] - ends[3], axis=1),
            above,
            angle,
            ahead[0] & ahead[1] & (angle <= limits.mount_angle_rad),
            _angle(ends[0] - neck, ends[2] - neck),
            _angle(ends[0] - neck, ends[3] - neck),
            np.einsum("nd,nd->n", a.velocity, way),
        )


def _angle(a: Array, b: Array) -> Array:
    """Angle (n,) between vectors (n, 3), rad."""
    across = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.arctan2(across, np.einsum("nd,nd->n", a, b)))


def _within(distance: Array, most: float) -> Array:
    return 1.0 - distance / most


def _where(mask: Mask) -> Array:
    return np.where(mask, np.inf, -np.inf)


def _over(value: Array, least: float) -> Array:
    return value / least - 1.0


class _Arena:
    """The animals of one arena and their interactions.

    Args:
        time_s: (n,) s.
        animals: with poses bridged.
        limits: the thresholds.
        outlines: see `find_interactions`.
    """

    def __init__(
        self,
        time_s: Array,
        animals: Sequence[Individual],
        limits: InteractionThresholds,
        outlines: NDArray[np.floating] | None,
    ) -> None:
        self.time_s, self.limits, self.outlines = time_s, limits, outlines
        self.animals = [_Course.of(one, time_s, limits) for one in animals]
        self.stop_s = stop_times(time_s)
        self.known, self.clear, self.ends = np.swapaxes(
            [(one.trusted, one.clear, one.ends) for one in animals], 0, 1
        )

    @cached_property
    def relations(self) -> dict[tuple[int, int], _Toward]:
        """Each animal in relation to each other one."""
        return {
            (i, j): _Toward.of(self.animals[i], self.animals[j], self.limits)
            for i, j in permutations(range(len(self.animals)), 2)
        }

    def observed(self, *animals: int, mutual: bool = False, ends: bool = False) -> Mask:
        """(n,) bool, the frames in which these animals, or all, have a trusted pose, and it is
        clear which is which unless the word is mutual, and if `ends` which end is the head.
        """
        known = self.known & (self.clear | mutual) & (self.ends | (not ends))
        return np.asarray(known[list(animals) or slice(None)].all(axis=0))

    def events(self) -> Iterator[_Event]:
        """Every interaction; pair by pair, not in order of time."""
        for i, j in combinations(range(len(self.animals)), 2):
            yield from self._of_pair(i, j)
        observed = self.observed()
        number = segments(self.time_s, observed)
        for i in range(len(self.animals)):
            nearest = np.min([one.gap for (a, _), one in self.relations.items() if a == i], axis=0)
            margin = _over(nearest, self.limits.isolated_mm)
            for start, stop, score in self._spans("isolated", margin, observed, number):
                yield _Event(i, -1, "isolated", start, stop, score, True)

    def _spans(
        self, word: str, margin: Array, free: Mask, number: NDArray[np.int64]
    ) -> list[tuple[int, int, float]]:
        """Rows [start, stop) and score of each interaction with a margin (n,) in free frames."""
        limits = self.limits
        least = {"huddle": limits.huddle_s, "isolated": limits.isolated_s}.get(word, limits.min_s)
        margin = np.where(free, margin, np.nan)
        mask = hysteresis(margin, 0.0, -limits.hysteresis, number, trim=True)
        spans = tidy(mask, free, number, self.time_s, self.stop_s, limits.merge_s, least)
        return [(a, b, float((margin[a:b] >= 0.0).mean())) for a, b in spans]

    def _covered(self, i: int, j: int) -> Iterator[_Event]:
        """The mounts of two animals that their outline shows. Single poses beside another animal
        may be turned round: most of those in the time before decide.
        """
        if self.outlines is None or self.animals[i].swims:
            return
        time_s, limits, both = self.time_s, self.limits, self.observed(i, j, mutual=True)
        free = np.delete(self.known, [i, j], axis=0).all(axis=0)
        mask, times = self.lies_over & ~both & free, (segments(time_s, free), time_s, self.stop_s)
        for start, stop in tidy(mask, free, *times, limits.merge_s, limits.min_s):
            before = time_s[:start] >= time_s[start] - limits.before_s
            rows = np.flatnonzero(both[:start] & before)
            for way in ((i, j), (j, i)):
                if 2 * self.relations[way].behind[rows].sum() > len(rows):
                    directed = bool(self.clear[list(way)][:, rows].all())
                    yield _Event(*way, "mount", start, stop, 0.0, directed)

    @cached_property
    def lies_over(self) -> Mask:
        """Whether (n,) there are fewer outlines than animals, and they lack `mount_hidden` animals
        in area or more, but less than half as much in the volume below them.

        Usual areas and volumes are those of frames in which all animals are known and apart.
        """
        count, outlines = len(self.animals), np.asarray(self.outlines, float)
        there, area = np.isfinite(outlines[..., 3]).sum(axis=1), outlines[..., 3]
        apart = self.known.all(axis=0) & (there == count)
        hidden, lost = (
            count * (1.0 - total / pd.Series(total[apart]).median())
            for total in (np.nansum(area, axis=1), np.nansum(area * outlines[..., 2], axis=1))
        )
        return np.asarray(
            (there < count) & (hidden >= self.limits.mount_hidden) & (lost < 0.5 * hidden)
        )

    def _of_pair(self, i: int, j: int) -> Iterator[_Event]:
        """The interactions of two animals."""
        observable = [self.observed(i, j, mutual=mutual) for mutual in (False, True)]
        covered = list(self._covered(i, j))
        yield from covered
        under = np.zeros(len(self.time_s), np.bool_)
        for mount in covered:
            under[mount.start : mount.stop] = True
        observable[True] |= under
        numbers = [segments(self.time_s, one) for one in observable]
        ways = ((i, j), (j, i))
        margins = {way: self._margins(*way, numbers[False]) for way in ways}
        free = {way: np.where(under, False, observable[True]) for way in ways}
        done = {
            word: np.zeros(len(observable[True]), np.bool_) for word in WORDS
        }  # by either animal
        margins[ways[0]]["contact"][under] = 0.0  # animals that lie over each other touch
        for word in (word for word in WORDS if word in margins[ways[0]]):
            rule = WORDS[word]
            observed, number = observable[rule.mutual], numbers[rule.mutual]
            without = np.any([done[one] for one in rule.not_in], axis=0)
            for way in ways[:1] if rule.mutual else ways:
                taken = ways if rule.mutual else (way,)
                room = np.all([free[one] for one in taken], axis=0) & observed
                room = observed & ~without if rule.layered else room
                for start, stop, score in self._spans(word, margins[way][word], room, number):
                    rows = slice(start, stop)
                    done[word][rows] = True
                    if not rule.layered:
                        for one in taken:
                            free[one][rows] = False
                    if rule.mutual:
                        yield self._came(i, j, word, start, stop, score, number)
                    elif word in ("approach", "leave"):
                        yield from self._crossing(way, word, start, stop, score, number)
                    else:
                        fast = np.median(self.animals[way[0]].speed[rows]) > self.limits.fast_mm_s
                        named = "chase" if word == "follow" and fast else word
                        yield _Event(*way, named, start, stop, score, True)

    def _margins(self, i: int, j: int, number: NDArray[np.int64]) -> dict[str, Array]:
        """Margin (n,) of each rule of animal i towards j; those of mutual words are alike."""
        a, b, limits = self.animals[i], self.animals[j], self.limits
        to, back = self.relations[i, j], self.relations[j, i]
        nearest, angle = self._trail(i, j, number)
        still = [_within(one.speed, limits.still_mm_s) for one in (a, b)]
        moving = [_over(one.speed, limits.moving_mm_s) for one in (a, b)]
        goes, comes = to.closing, back.closing
        doubt = np.where(self.ends[[i, j]].all(axis=0), np.inf, -1e-9)  # such frames only bridge
        straight = np.abs(goes) >= np.sqrt(0.5) * a.speed
        rules: dict[str, Sequence[Array]] = {
            "mount": (to.above, _within(to.angle, limits.mount_angle_rad)),
            "huddle": (_within(to.trunks, limits.contact_mm), *still),
            "follow": (
                _within(nearest, limits.follow_mm),
                _within(angle, limits.follow_angle_rad),
                *moving,
            ),
            "nose_to_nose": (
                _within(to.noses, limits.nose_mm),
                _within(np.minimum(to.at_nose, back.at_nose), limits.nose_angle_rad),
                _where(np.maximum(to.part, back.part) < 0.25),
            ),
            "nose_to_tail_base": (
                _within(to.nose_tail, limits.nose_mm),
                _within(to.at_tail, limits.nose_angle_rad),
                _where(to.part > 0.75),
            ),
            "side_by_side_same": (
                _within(to.noses, limits.side_by_side_mm),
                _within(to.tails, limits.side_by_side_mm),
            ),
            "side_by_side_opposite": (
                _within(to.nose_tail, limits.side_by_side_mm),
                _within(back.nose_tail, limits.side_by_side_mm),
            ),
            "nose_to_side": (
                _within(to.nose_skin, limits.contact_mm),
                _where((to.part >= 0.25) & (to.part <= 0.75)),
            ),
            "contact": (_within(to.gap, limits.contact_mm),),
            "approach": (
                _over(goes, limits.moving_mm_s),
                _over(goes + comes, limits.moving_mm_s),
                _where((goes > comes) & straight),
            ),
            "leave": (
                _over(-goes, limits.moving_mm_s),
                _over(-goes - comes, limits.moving_mm_s),
                _where((goes < comes) & straight),
            ),
            "avoid": (
                moving[0],
                _where(goes < 0.0),
                _over(comes, limits.moving_mm_s),
                _within(to.gap, limits.avoid_mm),
                _where(to.gap > limits.contact_mm),
            ),
        }
        without = _WALKERS if a.swims else ()
        return {
            word: np.minimum(np.min(own, axis=0), doubt if WORDS[word].ends else np.inf)
            for word, own in rules.items()
            if word not in without
        }

    def _trail(self, i: int, j: int, number: NDArray[np.int64]) -> tuple[Array, Array]:
        """Of the places of j's tail base within `follow_s`, the nearest to i's nose: its distance
        (n,) mm, and the angle (n,) rad between i's heading and j's when it was there.
        """
        a, b, n = self.animals[i], self.animals[j], len(number)
        nearest, angle = np.full((2, n), np.inf)
        for back in range(n):
            now, then = slice(back, n), slice(0, n - back)
            recent = self.time_s[now] - self.time_s[then] <= self.limits.follow_s
            if not recent.any():
                break
            away = np.linalg.norm(a.along[now, 0] - b.along[then, -1], axis=1)
            better = recent & (number[now] == number[then]) & (away < nearest[now])
            nearest[now][better] = away[better]
            angle[now][better] = _angle(a.heading[now], b.heading[then])[better]
        return nearest, angle

    def _crossing(
        self,
        way: tuple[int, int],
        word: str,
        start: int,
        stop: int,
        score: float,
        number: NDArray[np.int64],
    ) -> Iterator[_Event]:
        """An approach that ends near the target, or leaving that begins there; else nothing.

        The animal slows down at the near end, so that half a window beyond it is also searched.
        """
        limits, time_s = self.limits, self.time_s
        gap = self.relations[way].gap
        last = np.searchsorted(time_s, self.stop_s[stop - 1] + limits.speed_half_window_s)
        first = np.searchsorted(time_s, time_s[start] - limits.speed_half_window_s)
        rows = np.arange(start, last) if word == "approach" else np.arange(first, stop)[::-1]
        rows = rows[number[rows] == number[start]]
        near = gap[rows] <= limits.near_mm
        if near[0] or not near.any():
            return
        rows = np.sort(rows[: max(int(near.argmax()) + 1, stop - start)])
        speed = self.animals[way[0]].speed[rows]
        fast = word == "leave" and np.nanmax(speed) > limits.fast_mm_s
        start, stop = int(rows[0]), int(rows[-1]) + 1
        yield _Event(*way, "escape" if fast else word, start, stop, score, True)

    def _came(
        self,
        i: int,
        j: int,
        word: str,
        start: int,
        stop: int,
        score: float,
        number: NDArray[np.int64],
    ) -> _Event:
        """A mutual contact; its agent is the animal that came nearer by more before it."""
        first = np.searchsorted(self.time_s, self.time_s[start] - self.limits.before_s)
        rows = np.arange(first, start + 1)
        rows = rows[number[rows] == number[start]]
        hold = self.stop_s[rows] - self.time_s[rows]
        came = [
            float(np.nansum(np.maximum(self.relations[way].closing[rows], 0.0) * hold))
            for way in ((i, j), (j, i))
        ]
        pair = (i, j) if came[0] >= came[1] else (j, i)
        more = max(came) >= max(2.0 * min(came), self.limits.contact_mm)
        directed = more and bool(self.clear[[i, j], first:stop].all())
        return _Event(*pair, word, start, stop, score, directed)


def _totals(arena: _Arena, found: Sequence[_Event], names: Sequence[str]) -> pd.DataFrame:
    """The table `interaction_totals`: every word for every ordered pair."""
    hold = arena.stop_s - arena.time_s
    swims = arena.animals[0].swims
    rows = []
    pairs = [*permutations(range(len(names)), 2), *((i, -1) for i in range(len(names)))]
    for agent, target in pairs:
        for word, one in WORDS.items():
            if (word == "isolated") != (target < 0) or (swims and word in _WALKERS):
                continue
            both = () if target < 0 else (agent, target)
            observed = arena.observed(*both, mutual=one.mutual, ends=one.ends)
            either = ((agent, target), (target, agent)) if one.mutual else ((agent, target),)
            own = [event for event in found if event.word == word and event[:2] in either]
            for event in own:  # mounts are found without both poses, others bridge doubts
                observed[event.start : event.stop] = True
            observed_s = float(hold[observed].sum())
            first_s = float(arena.time_s[observed][0]) if observed.any() else np.nan
            total_s = float(sum(hold[event.start : event.stop].sum() for event in own))
            rows.append(
                {
                    "agent": names[agent],
                    "target": names[target] if target >= 0 else "",
                    "action": word,
                    "count": len(own),
                    "total_s": total_s,
                    "share": total_s / observed_s if observed_s else np.nan,
                    "per_min": 60.0 * len(own) / observed_s if observed_s else np.nan,
                    "latency_s": arena.time_s[own[0].start] - first_s if own else np.nan,
                    "observed_s": observed_s,
                }
            )
    return pd.DataFrame(rows)
