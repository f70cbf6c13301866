"""Groups of mice or fish that interact, with the truth of their interactions: `synthetic:pair`.

A group plays encounters in turn: one animal goes up to another, does one of `ENCOUNTERS`, and one
of the two leaves. Each animal steers towards goals in the floor, around the others; its body and
postures are those of `stage.draw_animal`. The script is that of mice at 30 steps/s; what is
different for other animals, `Kind` states: their lengths over those of mice, their encounters, and
the heights at which they swim. Truth are the intentions of the script (`Act`), not distances:
thresholds of the rules that are to be scored play no part.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from liex_lab.arrays import Array
from liex_lab.geometry import SE3, so3
from liex_lab.simulation.locomotion import GLIDE_S, smoothed, strokes
from liex_lab.simulation.recording import Actor, RenderedRecording, Take
from liex_lab.simulation.rendering import Solid
from liex_lab.simulation.scene import SimulatedScene, turned
from liex_lab.simulation.scenes.catalogue import RECIPES, Making, SceneRecipe
from liex_lab.simulation.scenes.places import Mesh
from liex_lab.simulation.scenes.stage import draw_animal, free_spot, timing_of
from liex_lab.simulation.sensors import (
    KINECT_V2_SENSOR,
    PRIMESENSE_SENSOR,
    RAYTRIX_R5_SENSOR,
    Sensor,
    unseen,
)
from liex_lab.simulation.species import FishSpecies, MouseSpecies, Species

_HZ = 30.0
_TURN = 6.0 / _HZ  # rad per frame, the fastest turn
_AWAY = np.full(2, np.inf)
_WALKERS = ("side_by_side_opposite", "mount", "huddle")  # acts that swimmers do not do
_HUNCH = 3  # of `pose_prior.KINDS`, the posture of animals that rest
_AHEAD, _BEHIND = 0.5, 0.45  # from the body's centre to the nose and to the tail base, spines
_ROOM_MM = 110.0  # between the centres of animals that pass each other
_RAISED = 0.5  # nearest centres of one that mounts and is not raised, over both spines
_CLIMB = 110.0 / _HZ  # per frame, of animals that swim
ENCOUNTERS: Final = (
    "follow",
    "chase",
    "cross",
    "nose_to_nose",
    "nose_to_tail_base",
    "nose_to_side",
    "side_by_side_same",
    "side_by_side_opposite",
    "mount",
    "huddle",
    "avoid",
    "escape",
    "apart",
)


@dataclass(frozen=True)
class Kind:
    """What groups of one kind of animal have that those of others have not.

    Attributes:
        species: of the animals.
        recipe: of the arena.
        sensors: makes of cameras, the usual one first.
        hz: frames/s.
        lengths_mm: of the longest animal, mm, from and to.
        unit: length in the arena of 1 mm of the script.
        wide: of two bodies side by side, between their mid-axes, for spines of 65.
        encounters: the acts.
        water: lowest and highest position above the floor, in `unit`.
        swims: whether it goes in bouts, keeps off the walls, and turns head first.
    """

    species: Callable[[], Species]
    recipe: SceneRecipe
    sensors: tuple[Sensor, ...]
    hz: float = _HZ
    lengths_mm: tuple[float, float] = (60.0, 74.0)
    unit: float = 1.0
    wide: float = 36.0
    encounters: tuple[str, ...] = ENCOUNTERS
    water: tuple[float, float] = (0.0, 0.0)
    swims: bool = False


KINDS: Final[Mapping[str, Kind]] = {
    "mouse": Kind(
        MouseSpecies,
        RECIPES["plain"],
        (KINECT_V2_SENSOR, PRIMESENSE_SENSOR, *unseen((KINECT_V2_SENSOR,))),
    ),
    "fish": Kind(
        FishSpecies,
        replace(
            RECIPES["plain"],
            title="fish in a small tank",
            camera_mm=330.0,
            half_mm=(62.0, 58.0),
            wall_mm=60.0,
            scale=0.3,
        ),
        (RAYTRIX_R5_SENSOR, *unseen((RAYTRIX_R5_SENSOR,))),
        hz=50.0,
        lengths_mm=(23.0, 28.0),
        unit=0.27,
        wide=14.0,
        encounters=tuple(word for word in ENCOUNTERS if word not in _WALKERS),
        water=(35.0, 200.0),
        swims=True,
    ),
}


class Act(NamedTuple):
    """What one animal did to another, by numbers, in the frames [start, stop)."""

    agent: int
    target: int
    action: str
    start: int
    stop: int


class Group:
    """The paths of a group and its acts, frame by frame.

    Args:
        rng: random number generator.
        deep: random number generator of the heights.
        arena: the arena, in the lengths of the script.
        spines: (A,) length of each animal, likewise.
        kind: of the animals.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        deep: np.random.Generator,
        arena: SimulatedScene,
        spines: Array,
        kind: Kind,
    ) -> None:
        self.rng, self.deep, self.arena, self.spine, self.kind = rng, deep, arena, spines, kind
        self.acts: list[Act] = []
        # of each frame (A, 6): x, y, heading, resting, raised, height
        self.rows: list[Array] = []
        self.height = self.level = deep.uniform(*kind.water, len(spines))
        self.at = np.zeros((len(spines), 2))
        for i in range(len(spines)):
            self.at[i] = self._spot(i)
        self.way = rng.uniform(-np.pi, np.pi, len(spines))
        self.resting = np.zeros(len(spines))
        self.mounted = np.arange(len(spines))  # by each animal, itself if it mounts none

    def _spot(
        self, mover: int, apart_mm: float = 130.0, middle: Array = _AWAY, far_mm: float = 1.0
    ) -> Array:
        """A free place, away from all other animals and `far_mm` from a point, or the best."""
        others = self.at[np.arange(len(self.at)) != mover]
        spots = [free_spot(self.rng, self.arena, 0.8 * float(self.spine[mover])) for _ in range(24)]
        room = [
            min(
                np.linalg.norm(others - spot, axis=1).min() / apart_mm,
                float(np.linalg.norm(spot - middle)) / far_mm,
            )
            for spot in spots
        ]
        good = np.array(room) > 1.0
        return spots[int(np.argmax(good if good.any() else room))]

    def ahead(self, mover: int) -> Array:
        """Unit vector of an animal's heading."""
        return np.array([np.cos(self.way[mover]), np.sin(self.way[mover])])

    def left(self, mover: int) -> Array:
        """Unit vector to an animal's left."""
        return self.ahead(mover)[::-1] * [-1.0, 1.0]

    def frame(self) -> None:
        """Keep the present frame."""
        self.height = self.height + np.clip(self.level - self.height, -_CLIMB, _CLIMB)
        far = np.linalg.norm(self.at - self.at[self.mounted], axis=1)
        raised = (far > 0) & (far < _RAISED * (self.spine + self.spine[self.mounted]))
        state = (self.at, self.way, self.resting, raised, self.height)
        self.rows.append(np.column_stack(state))

    def dive(self, agent: int, target: int, action: str) -> None:
        """Choose heights: two that meet are level, two that cross pass over each other."""
        low, top = self.kind.water
        self.level = self.deep.uniform(low, top, len(self.spine))
        if action != "apart":
            gap = (top - low) * self.deep.uniform(
                *((0.25, 0.5) if action == "cross" else (0, 0.05))
            )
            self.level[[agent, target]] = self.deep.uniform(low, top - gap)
            self.level[self.deep.choice([agent, target])] += gap

    def stroke(self, mover: int) -> float:
        """Speed over the usual one: a bout of swimming every 0.8 s, and a glide."""
        now = (len(self.rows) + 7 * mover) % 24 / _HZ
        return 2.5 * float(np.exp(-now / GLIDE_S)) if self.kind.swims else 1.0

    def step(self, mover: int, goal: Array, mm_s: float, shy: Sequence[int] = ()) -> float:
        """Go one frame towards a goal, around the animals of `shy`; returns the distance left."""
        if self.kind.swims:
            room, yaw = self.arena.half - 0.65 * self.spine[mover], self.arena.yaw
            local = np.clip(turned(goal - self.arena.centre, -yaw), -room, room)
            goal = self.arena.centre + turned(local, yaw)
        gap = goal - self.at[mover]
        left = float(np.linalg.norm(gap))
        ahead = float(np.arctan2(gap[1], gap[0]))
        for other in shy:
            toward = self.at[other] - self.at[mover]
            far = float(np.linalg.norm(toward))
            off = (ahead - np.arctan2(toward[1], toward[0]) + np.pi) % (2 * np.pi) - np.pi
            outwards = max(0.0, 1.0 - far / _ROOM_MM)  # if it is too near
            clear = np.arcsin(min(1.0, _ROOM_MM / max(far, 1.0))) + outwards
            if far < left + 40.0 and abs(off) < clear:
                ahead += (np.sign(off) or 1.0) * (clear - abs(off))
        turn = (ahead - self.way[mover] + np.pi) % (2 * np.pi) - np.pi
        self.way[mover] += np.clip(turn, -_TURN, _TURN)
        run = (
            min(mm_s * self.stroke(mover), 8.0 * left + 20.0) * max(float(np.cos(turn)), 0.1) / _HZ
        )
        self.at[mover] += min(run, left) * self.ahead(mover)
        return left

    def walk(
        self,
        mover: int,
        goal: Array,
        mm_s: float,
        shy: Sequence[int] = (),
        near_mm: float = 3.0,
    ) -> None:
        """Walk to a goal, at most 6 s."""
        for _ in range(180):
            left = self.step(mover, goal, mm_s, shy)
            self.frame()
            if left < near_mm:
                return

    def face(self, mover: int, way: float) -> None:
        """Turn in place."""
        for _ in range(40):
            turn = (way - self.way[mover] + np.pi) % (2 * np.pi) - np.pi
            if abs(turn) < 0.03:
                return
            self.way[mover] += np.clip(turn, -_TURN, _TURN)
            self.frame()

    def wait(self, seconds: float) -> None:
        """Stand."""
        for _ in range(int(seconds * _HZ)):
            self.frame()

    def act(self, agent: int, target: int, action: str, start: int) -> None:
        """Note an act that began at a frame and ends now."""
        self.acts.append(Act(agent, target, action, start, len(self.rows)))


def _meet(group: Group, agent: int, target: int, place: tuple[float, float], turn: float) -> int:
    """Approach an animal that stands in the middle: go straight to a place (forward, left; mm) in
    its frame, then stand at an angle `turn` to it; returns the frame of arrival.
    """
    every = range(len(group.at))
    middle = group.arena.centre + group.rng.uniform(-25.0, 25.0, 2)
    for k in every:
        room = 150.0 if k == agent else 190.0
        if k != target and np.linalg.norm(group.at[k] - middle) < room:
            shy = [one for one in every if one != k]
            group.walk(k, group._spot(k, 150.0, middle, room), 200.0, shy)
    group.walk(target, middle, 150.0, [k for k in every if k != target])
    toward = group.at[agent] - group.at[target]
    side = np.arctan2(toward[1], toward[0]) + group.rng.uniform(-0.5, 0.5)
    group.face(target, float(side - np.arctan2(place[1], place[0])))
    goal = group.at[target] + place[0] * group.ahead(target) + place[1] * group.left(target)
    out = (goal - middle) / np.linalg.norm(goal - middle)
    start = goal + float(group.rng.uniform(90.0, 120.0)) * out
    group.walk(agent, start, 180.0, [k for k in every if k != agent], near_mm=15.0)
    group.face(agent, float(np.arctan2(-out[1], -out[0])))
    group.wait(0.2)
    begun, mm_s = len(group.rows), float(group.rng.uniform(110.0, 220.0))
    group.walk(agent, goal, mm_s)
    group.act(agent, target, "approach", begun)
    arrived = len(group.rows)
    group.face(agent, group.way[target] + turn)
    return arrived


def _leave(group: Group, agent: int, target: int, fast: bool = False) -> None:
    """Go straight away from another animal; it runs if `fast`."""
    away = group.at[agent] - group.at[target]
    far = float(group.rng.uniform(*((150.0, 180.0) if fast else (110.0, 150.0))))
    ways = np.arctan2(away[1], away[0]) + group.rng.uniform(-0.8, 0.8, 8)
    goals = group.at[agent] + far * np.stack([np.cos(ways), np.sin(ways)], axis=1)
    off = goals[:, None] - np.delete(group.at, agent, axis=0)
    room = np.linalg.norm(off, axis=2).min(axis=1)
    way, goal = float(ways[room.argmax()]), goals[room.argmax()]
    if not fast:
        group.face(agent, way)
    begun = len(group.rows)
    mm_s = float(group.rng.uniform(450.0, 550.0) if fast else group.rng.uniform(110.0, 220.0))
    group.walk(agent, goal, mm_s, near_mm=10.0)
    group.act(agent, target, "escape" if fast else "leave", begun)


def _play(group: Group, agent: int, target: int, action: str) -> None:
    """One encounter from meeting to leaving; an animal apart only walks."""
    rng, spines = group.rng, group.spine
    wide = group.kind.wide * float(spines[[agent, target]].mean()) / 65.0
    side = float(rng.choice([-1.0, 1.0]))
    nose, other = _AHEAD * spines[agent], spines[target]
    seconds = float(rng.uniform(1.0, 2.5))
    if action in ("apart", "cross"):
        goals = [group._spot(k, 220.0) for k in (agent, target)]
        shy = ([target], [agent])
        if action == "cross":  # each to where the other was, past it on one side
            way = group.at[target] - group.at[agent]
            aside = np.array([-way[1], way[0]]) / np.linalg.norm(way) * rng.uniform(22.0, 40.0)
            aside *= group.kind.wide / 36.0
            goals, shy = [group.at[target] + aside, group.at[agent] - aside], ([], [])
        for _ in range(int(3.0 * _HZ)):
            for k, mover in enumerate((agent, target)):
                if np.linalg.norm(goals[k] - group.at[mover]) > 12.0:
                    group.step(mover, goals[k], 170.0, shy[k])
            group.frame()
        return
    if action in ("follow", "chase") or (group.kind.swims and action == "side_by_side_same"):
        _pursue(group, agent, target, action, side * (wide + 3.0))
        return
    if action == "avoid":
        _shun(group, agent, target)
        return
    # places (forward, left) of the agent's centre in the target's frame, and its angle there
    gap = float(rng.uniform(6.0, 13.0))
    places = {
        "nose_to_nose": ((_AHEAD * other + gap + nose, 0.0), np.pi),
        "nose_to_tail_base": ((-_BEHIND * other - gap - nose, 0.0), 0.0),
        "nose_to_side": ((0.0, side * (0.4 * wide + 3.0 + nose)), -side * np.pi / 2),
        "escape": ((0.0, side * (0.4 * wide + 3.0 + nose)), -side * np.pi / 2),
        "side_by_side_same": ((0.0, side * (wide + 3.0)), 0.0),
        "side_by_side_opposite": ((0.0, side * (wide + 3.0)), np.pi),
        "huddle": ((0.0, side * 0.82 * wide), 0.0),
        "mount": ((-_BEHIND * other - 6.0 - nose, 0.0), 0.0),
    }
    arrived = _meet(group, agent, target, *places[action])
    begun = arrived if action.startswith("nose") else len(group.rows)
    if action == "huddle":
        group.resting[[agent, target]] = 1.0
        seconds = float(rng.uniform(5.0, 9.0))
    if action == "mount":
        group.wait(0.5)
        group.act(agent, target, "nose_to_tail_base", begun)
        ride = group.at[target] + (0.45 * spines[agent] - 0.45 * other - 8.0) * group.ahead(target)
        group.mounted[agent] = target
        group.walk(agent, ride, 120.0)
        begun = len(group.rows)
    group.wait(seconds)
    group.resting[[agent, target]] = 0.0
    group.act(agent, target, "nose_to_side" if action == "escape" else action, begun)
    if action == "huddle":  # they rest side by side
        group.act(agent, target, "side_by_side_same", begun)
    leaver = target if action == "escape" or rng.random() < 0.3 or action == "mount" else agent
    _leave(group, leaver, agent + target - leaver, action == "escape")
    group.mounted[agent] = agent  # it is down once the other one has gone from under it


def _pursue(group: Group, agent: int, target: int, action: str, aside: float) -> None:
    """Follow or chase: the agent goes along the target's path, about a body length behind; or it
    comes up to it from there on one side, `aside` to the left, and goes with it.
    """
    rng, behind = group.rng, 0.5 * float(group.spine[[agent, target]].sum())
    behind += float(rng.uniform(8.0, 30.0))
    least, aside = (behind, 0.0) if action in ("follow", "chase") else (4.0, aside)
    _meet(group, agent, target, (-behind, aside), 0.0)
    trail = [group.at[agent] - aside * group.left(target)]
    trail += [trail[0] + s * (group.at[target] - trail[0]) for s in (0.33, 0.67, 1.0)]
    pace = float(rng.uniform(*((380.0, 450.0) if action == "chase" else (120.0, 230.0))))
    begun, round_mm = len(group.rows), float(rng.choice([-1.0, 1.0]) * rng.uniform(70.0, 90.0))
    for i in range(int(rng.uniform(1.6, 2.6) * _HZ)):
        begun += behind > least
        behind = max(behind - 6.0, least)
        run = pace * group.stroke(target) / _HZ * min(1.0, (i + 1) / 8.0)
        group.way[target] += run / round_mm
        group.at[target] += run * group.ahead(target)
        trail.append(group.at[target].copy())
        steps = np.linalg.norm(np.diff(trail, axis=0), axis=1)
        back = np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])  # mm behind the target
        here = np.array([np.interp(-behind, -back, axis) for axis in np.array(trail).T])
        then = np.array([np.interp(4.0 - behind, -back, axis) for axis in np.array(trail).T])
        group.at[agent], way = here + aside * group.left(target), then - here
        if np.linalg.norm(way) > 0.1:
            turn = (np.arctan2(way[1], way[0]) - group.way[agent] + np.pi) % (2 * np.pi) - np.pi
            group.way[agent] += np.clip(turn, -_TURN, _TURN)
        group.frame()
    group.act(agent, target, action, begun)
    if aside:  # two that turn side by side would touch
        low, top = group.kind.water
        group.level[agent] += np.copysign(0.3 * (top - low), 0.5 * (low + top) - group.level[agent])
        group.wait(0.8)
    _leave(group, agent, target)


def _shun(group: Group, agent: int, target: int) -> None:
    """Avoid: the target approaches and stops, the agent goes away before it is touched."""
    rng = group.rng
    near = float(rng.uniform(180.0, 210.0))  # between the centres
    for _ in range(180):
        group.step(target, group.at[agent], 170.0)
        group.frame()
        if np.linalg.norm(group.at[agent] - group.at[target]) < near:
            break
    away = group.at[agent] - group.at[target]
    goal = group.at[agent] + 160.0 * away / np.linalg.norm(away)
    if group.arena.freedom(goal) < 40.0:
        goal = group._spot(agent, 200.0)
    begun = len(group.rows) + 15
    for i in range(int(1.3 * _HZ)):
        turn = np.arctan2(*(goal - group.at[agent])[::-1]) - group.way[agent]
        if i < 15:  # it turns away
            group.way[agent] += np.clip((turn + np.pi) % (2 * np.pi) - np.pi, -_TURN, _TURN)
        else:
            group.step(agent, goal, 210.0, [target])
        group.step(target, group.at[agent].copy(), 110.0)
        group.frame()
    group.act(agent, target, "avoid", begun)
    group.walk(agent, goal, 200.0, [target], near_mm=15.0)


@dataclass(frozen=True)
class _Making(Making):
    """Builds one recording of a group.

    Attributes:
        group: its paths.
    """

    group: Group

    def _cast(self, arenas: list[SimulatedScene]) -> tuple[list[Actor], list[Solid], list[Mesh]]:
        """The animals of the group, and nothing else."""
        paths = np.stack(self.group.rows, axis=1)
        return [self._animal(k, path, arenas[0]) for k, path in enumerate(paths)], [], []

    def _animal(self, which: int, path: Array, arena: SimulatedScene) -> Actor:
        """An animal on its path (m, 6), see `Group.rows`."""
        kind = self.group.kind
        spine = kind.unit * float(self.group.spine[which])
        path[:, 2] = np.unwrap(path[:, 2])
        frames = np.arange(self.take.n_frames) * (_HZ / kind.hz)
        path = np.stack([np.interp(frames, np.arange(len(path)), row) for row in path.T], axis=1)
        place, heading = kind.unit * smoothed(path[:, [0, 1, 5]], 2.0), smoothed(path[:, 2], 2.0)
        speed = np.linalg.norm(np.gradient(place[:, :2], axis=0), axis=1) * kind.hz / spine
        kinds = np.where(path[:, 3] > 0, _HUNCH, 0)
        animal = draw_animal(
            self.seed,
            which,
            self.species,
            arena,
            replace(self.take, spine_mm=spine),
            timing_of("always", self.take.n_frames),
            (lambda rng, n, step_s: strokes(speed, heading, step_s))
            if kind.swims
            else (lambda rng, n: (kinds, speed)),
            lambda rng, scene, spine_mm, mm_s: (place, heading),
        )
        return (
            animal if kind.swims else _risen(_aligned(animal, heading), smoothed(path[:, 4], 4.0))
        )


def _aligned(animal: Actor, heading: Array) -> Actor:
    """The animal turned about its centre, so that its trunk has the headings (n,) of its path."""
    trunk = animal.joints[:, -2] - animal.joints[:, 0]
    turn = np.zeros((len(heading), 3))
    turn[:, 2] = heading - np.arctan2(trunk[:, 1], trunk[:, 0])
    rotation, centre = so3.exp(turn), animal.joints.mean(axis=1)
    moved = SE3(rotation, centre - np.einsum("nij,nj->ni", rotation, centre))
    return replace(animal, pose=animal.pose.moved(moved))


def _risen(animal: Actor, share: Array) -> Actor:
    """The animal, its front raised about its tail base by a `share` (n,) of a mounting posture."""
    joints = animal.joints
    rump, ahead = joints[:, 0], joints[:, -1] - joints[:, 0]
    left = np.stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))], axis=1)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    pitch = so3.exp(-np.radians(32.0) * share[:, None] * left)
    lift = share[:, None] * [0.0, 0.0, 0.22 * animal.spine_mm]
    moved = SE3(pitch, rump + lift - np.einsum("nij,nj->ni", pitch, rump))
    return replace(animal, pose=animal.pose.moved(moved))


def film_group(
    seed: int,
    n_frames: int,
    *,
    animal: str = "mouse",
    animals: int = 2,
    apart: float = 0.0,
    encounters: Sequence[str] = (),
    sensor: Sensor | None = None,
    family: str = "other",
    spine_mm: float | None = None,
) -> tuple[RenderedRecording, list[Act]]:
    """A recording of animals that interact, and what they did.

    Args:
        seed: seed of all random numbers.
        n_frames: its length, at 30 frames/s (fish: 50).
        animal: their kind, of `KINDS`.
        animals: their number, 2 to 4.
        apart: difference in length between one animal and the next, share.
        encounters: the acts; () are all that this kind does.
        sensor: the camera's make; None is the usual one.
        family: of body shapes, see `body.variation`.
        spine_mm: length of the longest animal, mm; None draws it.

    Returns:
        The recording with the truth of all animals, and the acts within it.
    """
    kind = KINDS[animal]
    take = Take(
        n_frames,
        sensor or kind.sensors[0],
        family=family,
        spine_mm=spine_mm,
        name=f"pair-{seed}" if animal == "mouse" else f"pair-{animal}-{seed}",
    )
    rng, deep = (np.random.default_rng([seed, part]) for part in (78, 79))
    base = (spine_mm or float(rng.uniform(*kind.lengths_mm))) / kind.unit
    spines = base * (1.0 + apart) ** -np.arange(animals, dtype=float)
    arena = Making(kind.recipe, seed, take)._arenas()[0]
    arena = replace(
        arena,
        T_arena_camera=SE3(
            arena.T_arena_camera.rotation, arena.T_arena_camera.translation / kind.unit
        ),
        centre=arena.centre / kind.unit,
        half=arena.half / kind.unit,
    )
    group = Group(rng, deep, arena, spines, kind)
    while len(group.rows) * kind.hz < n_frames * _HZ:
        for action in rng.permutation(encounters or kind.encounters):
            agent, target = map(int, rng.permutation(animals)[:2])
            group.dive(agent, target, action)
            group.wait(float(rng.uniform(0.5, 1.0)))
            _play(group, agent, target, str(action))
    filmed = _Making(kind.recipe, seed, take, group, species=kind.species())
    frames = kind.hz / _HZ
    within = [
        act._replace(start=start, stop=min(round(act.stop * frames), n_frames))
        for act in group.acts
        if (start := round(act.start * frames)) < n_frames
    ]
    return filmed.recording(), within
