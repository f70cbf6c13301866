"""The scenes by name: mice from a recipe, a fish in a small tank, a hand, and a mirrored hand."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.errors import RecordingError
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.simulation.hand.simulator import HandSpecies
from liex_lab.simulation.recording import Actor, RenderedRecording, Stage, Take, in_motion
from liex_lab.simulation.rendering import Solid
from liex_lab.simulation.scene import (
    BOX,
    OBJECT_FACES,
    ROUND,
    SimulatedScene,
    draw_object,
    floor_point,
    overhead_pose,
    turned,
)
from liex_lab.simulation.scenes import places
from liex_lab.simulation.scenes.places import Bedding, Ground, Mesh, box, render_still
from liex_lab.simulation.scenes.stage import (
    calm_script,
    draw_animal,
    keeping_apart,
    timing_of,
    visiting,
)
from liex_lab.simulation.sensors import KINECT_V2_SENSOR, Sensor
from liex_lab.simulation.species import FishSpecies, MouseSpecies, Species


@dataclass(frozen=True)
class SceneRecipe:
    """The recipe of a scene of mice.

    Attributes:
        title: a description of the scene.
        camera_mm: height of the camera above the floor, mm.
        tilt_rad: of the camera, rad.
        kind: outline of the arena, 'box' or 'round'.
        half_mm: half the arena's sides, mm.
        wall_mm: height of its walls, mm.
        n_arenas: arenas in the image, 1, 2 or 4, each with its own animal.
        around: 'bench', 'untidy' or 'table', see `places`.
        n_animals: in one arena.
        presence: of the animals, see `stage.timing_of`.
        worn: '', 'head stage' or 'tether'.
        fixture: '', 'house', 'object' (added during the recording), 'object out' (removed), or
            'lid'.
        bedding: whether there is bedding on the floor.
        glossy: whether the floor reflects and is partly unread.
        drift_mm: drift of the sensor's depth while it warms up, mm.
        scale: of the floor's unevenness.
    """

    title: str
    camera_mm: float = 660.0
    tilt_rad: float = 0.06
    kind: str = BOX
    half_mm: tuple[float, float] = (260.0, 220.0)
    wall_mm: float = 160.0
    n_arenas: int = 1
    around: str = "bench"
    n_animals: int = 1
    presence: str = "always"
    worn: str = ""
    fixture: str = ""
    bedding: bool = False
    glossy: bool = False
    drift_mm: float = 0.0
    scale: float = 1.0


_PLAIN = SceneRecipe("one mouse in a clean open field whose floor is the largest plane")
# what a scene has that is unlike a plain one
_UNLIKE: Mapping[str, Mapping[str, Any]] = {
    "small": {
        "title": "an arena of 30 cm among objects of all heights, 15 % of the image",
        "camera_mm": 610.0,
        "half_mm": (150.0, 150.0),
        "wall_mm": 140.0,
        "around": "untidy",
    },
    "raised": {
        "title": "an arena on a stool, the room's floor in view 48 cm below",
        "half_mm": (190.0, 190.0),
        "wall_mm": 150.0,
        "around": "table",
    },
    "tilted": {
        "title": "the camera tilted by 35 degrees",
        "camera_mm": 560.0,
        "tilt_rad": float(np.radians(35.0)),
        "half_mm": (230.0, 200.0),
        "wall_mm": 90.0,
    },
    "glossy": {"title": "a glossy floor, unread in places", "glossy": True},
    "round": {
        "title": "a round open field",
        "kind": ROUND,
        "half_mm": (230.0, 230.0),
        "wall_mm": 220.0,
    },
    "two-arenas": {
        "title": "two arenas in one image, a mouse in each",
        "camera_mm": 720.0,
        "half_mm": (170.0, 210.0),
        "wall_mm": 120.0,
        "n_arenas": 2,
    },
    "four-arenas": {
        "title": "four arenas in one image, a mouse in each",
        "camera_mm": 800.0,
        "half_mm": (165.0, 150.0),
        "wall_mm": 110.0,
        "n_arenas": 4,
    },
    "tether": {"title": "a cable from the head to a commutator above", "worn": "tether"},
    "head-stage": {"title": "a head stage of 10 x 8 x 12 mm", "worn": "head stage"},
    "bedding": {
        "title": "bedding with lumps of 18 mm that change where the animal walks",
        "half_mm": (210.0, 180.0),
        "bedding": True,
    },
    "house": {
        "title": "a shelter into which the animal goes",
        "half_mm": (240.0, 210.0),
        "fixture": "house",
    },
    "object": {
        "title": "a novel object, put in during the recording, that stays",
        "fixture": "object",
    },
    "object-out": {
        "title": "an object that is taken out during the recording",
        "fixture": "object out",
    },
    "asleep": {"title": "motionless for 78 % of the recording", "presence": "asleep"},
    "still": {"title": "the animal never moves", "presence": "still"},
    "late": {"title": "the animal is put in after two thirds", "presence": "late"},
    "leaves": {
        "title": "the animal is taken out before the middle",
        "presence": "leaves",
    },
    "empty": {"title": "no animal at all", "presence": "never", "n_animals": 0},
    "two-animals": {"title": "two mice in one arena", "n_animals": 2},
    "drift": {"title": "the sensor warms up by 5 mm", "drift_mm": 5.0},
    "cage": {
        "title": "a home cage with sloping walls, its rim, and its lid over a third",
        "camera_mm": 560.0,
        "half_mm": (185.0, 115.0),
        "wall_mm": 130.0,
        "fixture": "lid",
    },
}


RECIPES: Final[Mapping[str, SceneRecipe]] = MappingProxyType(
    {"plain": _PLAIN} | {name: replace(_PLAIN, **changes) for name, changes in _UNLIKE.items()}
)


# Recordings of mice from a recipe and a seed.


_COMMUTATOR_MM = np.array([80.0, 110.0, 300.0])  # from the centre of the arena
_OBJECTS = {"object": 0.4, "object out": 0.6}  # time of the change, share of the recording


@dataclass(frozen=True)
class Making:
    """Builds one recording; every part has its own stream of random numbers.

    Attributes:
        recipe: the scene's recipe.
        seed: seed of all random numbers.
        take: settings of the recording.
        species: of the animals.
    """

    recipe: SceneRecipe
    seed: int
    take: Take
    species: Species = field(default_factory=MouseSpecies, kw_only=True)

    def _rng(self, part: str) -> np.random.Generator:
        parts = ("camera", "place", "floor", "bedding", "worn", "sensor", "noise", "object")
        return np.random.default_rng([self.seed, 77, parts.index(part)])

    def recording(self) -> RenderedRecording:
        """The recording with the truth of all animals in it."""
        recipe, n = self.recipe, self.take.n_frames
        arenas = self._arenas()
        animals, moving, parts = self._cast(arenas)
        floor = self._rng("floor")
        grounds = [Ground.draw(floor, arena, recipe.scale) for arena in arenas]
        bedding = None
        if recipe.bedding:
            there = np.where(animals[0].present[:, None], _middle(animals[0]), np.nan)
            bedding = Bedding.draw(self._rng("bedding"), grounds[0], there, self._epoch_frames)
            lift = SE3.identity(n)
            lift.translation[:, 2] = bedding.below(np.nan_to_num(there))
            animals[0] = replace(animals[0], pose=animals[0].pose.moved(lift))
        moving += self._worn(arenas[0], animals, parts)
        stills, epoch = self._stills(arenas, grounds, bedding, parts)
        fur = animals[0].body.fur if animals else np.array([0.5])
        warming = 1.0 - np.exp(-np.arange(n) / max(1.0, 0.35 * n))
        stage = Stage(
            arenas[0],
            self.species.skeleton,
            tuple(animals),
            tuple(moving),
            self.take.parameters(self._rng("sensor"), fur),
            self._rng("noise").integers(1, 2**63, n).astype(np.uint64),
            np.arange(n) * self.species.frame_ns,
            stills,
            epoch,
            offset_mm=recipe.drift_mm * warming if recipe.drift_mm else None,
        )
        return RenderedRecording(self.take.name, in_motion(stage, self.take.sensor.exposure_ms))

    @property
    def _epoch_frames(self) -> int:
        # at most 64 still depth images
        return max(12, -(-self.take.n_frames // 64))

    def _arenas(self) -> list[SimulatedScene]:
        """The arenas in the image, around the point where the camera's axis meets the floor,
        without their depth images.
        """
        recipe = self.recipe
        rng = self._rng("camera")
        camera = self.take.sensor.camera
        toward = np.pi / 2 + float(rng.uniform(-0.3, 0.3))
        T_arena_camera = overhead_pose(
            *np.array([[recipe.camera_mm], [recipe.tilt_rad], [toward]])
        )[0]
        whole = SimulatedScene(
            camera,
            T_arena_camera,
            recipe.kind,
            floor_point(camera, T_arena_camera, np.array([camera.cx, camera.cy])),
            np.asarray(recipe.half_mm, float),
            float(rng.uniform(-0.08, 0.08)),
            recipe.wall_mm,
        )
        if recipe.fixture in ("house", *_OBJECTS):
            whole = replace(whole, clutter=self._clutter(whole))
        cells = {1: [(0, 0)], 2: [(-1, 0), (1, 0)], 4: [(-1, -1), (1, -1), (-1, 1), (1, 1)]}
        steps = (whole.half + 18.0) * np.array(cells[recipe.n_arenas], float)
        return [replace(whole, centre=whole.centre + turned(step, whole.yaw)) for step in steps]

    def _house(self, arena: SimulatedScene) -> tuple[Array, float]:
        """Position of a house, (2,) mm, and the direction of its exit, rad."""
        corner = turned(arena.half - [85.0, 75.0], arena.yaw)
        return arena.centre + corner, float(np.pi + arena.yaw)

    def _clutter(self, arena: SimulatedScene) -> Array:
        """Outlines (n, 2) mm of obstacles for animals."""
        if self.recipe.fixture in _OBJECTS:
            return np.asarray(self._object(arena).vertices[:, :2])
        place, yaw = self._house(arena)
        edge = np.linspace(-1.0, 1.0, 13)[:, None]
        local = np.concatenate([edge * [60.0, 0.0] + [0.0, side * 48.0] for side in (-1, 1)])
        return place + turned(np.concatenate([local, edge * [0.0, 48.0] - [60.0, 0.0]]), yaw)

    def _object(self, arena: SimulatedScene) -> Mesh:
        """A novel object: a block of about 5 x 4 x 6 cm."""
        rng = self._rng("object")
        half = rng.uniform([22.0, 18.0, 24.0], [30.0, 26.0, 34.0])
        spot = arena.centre + turned(arena.half * [-0.45, 0.4], arena.yaw)
        return box([*spot, half[2]], half, float(rng.uniform(-np.pi, np.pi)))

    def _cast(self, arenas: list[SimulatedScene]) -> tuple[list[Actor], list[Solid], list[Mesh]]:
        """The animals, the objects that move with them, and the still objects they need."""
        recipe = self.recipe
        timing = timing_of(recipe.presence, self.take.n_frames)
        script = path = None
        still: list[Mesh] = []
        moving: list[Solid] = []
        if recipe.fixture == "house":
            place, out = self._house(arenas[0])
            ahead = np.array([np.cos(out), np.sin(out)])
            path = visiting(place + 105.0 * ahead, place - 6.0 * ahead, ((0.1, 0.55), (0.72, 0.95)))
            script = calm_script
            still += places.house(place, out)
        animals: list[Actor] = []
        for which in range(max(recipe.n_animals, recipe.n_arenas) if recipe.n_animals else 0):
            if which and recipe.n_arenas == 1:
                path = keeping_apart(_middle(animals[0]), animals[0].spine_mm)
            animals.append(
                draw_animal(
                    self.seed,
                    which,
                    self.species,
                    arenas[which % len(arenas)],
                    self.take,
                    timing,
                    script,
                    path,
                )
            )
        if recipe.fixture in _OBJECTS:
            change = int(_OBJECTS[recipe.fixture] * self.take.n_frames)
            later = np.arange(self.take.n_frames) >= change
            item = self._object(arenas[0])
            moving.append(Solid.of(*item, later if recipe.fixture == "object" else ~later))
            moving.append(self._hand(item.vertices[:, :2].mean(axis=0), change))
        if recipe.presence in ("late", "leaves") and animals:
            there = animals[0].present
            change = int(np.argmax(there)) if recipe.presence == "late" else int(there.sum())
            spot = _middle(animals[0])[min(change, self.take.n_frames - 1)]
            moving.append(self._hand(spot, change))
        return animals, moving, still

    def _hand(self, spot: Array, change: int) -> Solid:
        """A hand that moves down to a position, releases or takes something, and leaves."""
        mesh = draw_object(self._rng("object"), "hand", 65.0)
        mesh[:, 2] -= mesh[:, 2].min()
        # frames before and after the moment
        reach = 8
        height = 45.0 + 22.0 * np.abs(np.arange(-reach, reach + 1))
        vertices = mesh + np.column_stack([np.tile(spot, (len(height), 1)), height])[:, None]
        moment = np.arange(self.take.n_frames) - change + reach
        there = (moment >= 0) & (moment < len(height))
        return Solid(OBJECT_FACES, np.where(there, moment, -1), vertices.__getitem__)

    def _worn(
        self,
        arena: SimulatedScene,
        animals: list[Actor],
        parts: list[Mesh],
    ) -> list[Solid]:
        """Objects worn by the first animal."""
        if not self.recipe.worn:
            return []
        rng = self._rng("worn")
        animal = animals[0]
        mount = places.on_head(self.species.skeleton, animal.pose, animal.body[0], animal.girth)
        sides = places.HEAD_STAGE_MM if self.recipe.worn == "head stage" else places.PLUG_MM
        moving = [Solid.of(*places.stage_on(mount, sides), animal.present)]
        if self.recipe.worn == "tether":
            spot = arena.centre + _COMMUTATOR_MM[:2] + rng.normal(0.0, 15.0, 2)
            above = np.array([*spot, _COMMUTATOR_MM[2]])
            parts += places.holder(above)
            cable = places.tether(rng, mount, above, float(rng.uniform(3.0, 5.0)))
            moving.append(Solid.of(*cable, animal.present))
        return moving

    def _stills(
        self,
        arenas: list[SimulatedScene],
        grounds: list[Ground],
        bedding: Bedding | None,
        parts: list[Mesh],
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """The still scene by epoch (E, H, W) mm, and the epoch of every frame (n,)."""
        recipe = self.recipe
        rng = self._rng("place")
        fixed = list(parts)
        for arena in arenas:
            lid = recipe.fixture == "lid"
            fixed.append(places.walls_of(arena, *((14.0, 13.0) if lid else ())))
            fixed += places.lid_bars(arena) if lid else []
        if recipe.around == "table":
            fixed += places.table(rng, arenas[0], 480.0)
        elif recipe.around == "untidy":
            fixed += places.untidy(rng, arenas[0])
        else:
            fixed.append(places.level(np.mean([arena.centre for arena in arenas], axis=0)))
        camera, T_camera_arena = arenas[0].camera, arenas[0].T_arena_camera.inverse()
        floors = [ground.mesh() for ground in grounds]
        base, bare = (
            render_still(parts, camera, T_camera_arena) for parts in ([*fixed, *floors], floors)
        )
        changes = bedding is not None or recipe.glossy
        epoch = np.arange(self.take.n_frames) // self._epoch_frames * changes
        stills = np.repeat(base[None], epoch[-1] + 1, axis=0)
        for e, still in enumerate(stills):
            if bedding:
                lain = bedding.ground.mesh(bedding.heights[e])
                still[:] = render_still([*fixed, lain], camera, T_camera_arena)
            if recipe.glossy:
                unread = _reflections(self._rng("floor"), rng, camera, still.shape)
                still[(bare == base) & unread] = 0.0
        return stills, epoch


def _middle(animal: Actor) -> Array:
    """The mean of an animal's joints (n, 2), mm, in the floor."""
    return np.asarray(animal.joints.mean(axis=1)[:, :2])


def _reflections(
    same: np.random.Generator, own: np.random.Generator, camera: Camera, shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Unread parts of a glossy floor: around the camera's reflection, and in patches.

    Args:
        same: generator of patches that all epochs share.
        own: generator of the individual borders of an epoch.
        camera: the camera.
        shape: (H, W) of the image.

    Returns:
        (H, W) bool.
    """
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    strength = np.full(shape, -1.0)
    patches = [
        (same.uniform(0.2, 0.8) * camera.width, same.uniform(0.2, 0.8) * camera.height, r)
        for r in same.uniform(5.0, 16.0, 7)
    ]
    for at_u, at_v, radius in [(camera.cx, camera.cy, 26.0), *patches]:
        wide = same.uniform(0.8, 2.2)
        way = same.uniform(-np.pi, np.pi)
        x, y = (turned(np.stack([u - at_u, v - at_v], axis=-1), way) / radius).transpose(2, 0, 1)
        strength = np.maximum(strength, 1.0 - np.hypot(x / wide, y * wide))
    rough = own.normal(0.0, 1.0, (shape[0] // 4 + 1, shape[1] // 4 + 1))
    ragged = np.repeat(np.repeat(rough, 4, axis=0), 4, axis=1)[: shape[0], : shape[1]]
    return np.asarray(strength + 0.12 * ragged > 0.0)


SEALED_FROM: Final = 900_000_000  # seeds from here on are reserved for the sealed split
# name: (the plan of its animal, the scene it is compared with, '' for none)
SCENES: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    dict.fromkeys(RECIPES, ("mouse", "plain"))
    | {"fish": ("fish", ""), "hand": ("hand", ""), "mirrored-hand": ("hand", "hand")}
)


def film(
    name: str,
    seed: int,
    n_frames: int,
    *,
    sensor: Sensor = KINECT_V2_SENSOR,
    family: str = "other",
    spine_mm: float | None = None,
) -> RenderedRecording:
    """A recording of a scene.

    Args:
        name: of the scene, a key of `SCENES`.
        seed: seed of all random numbers.
        n_frames: its length, at 30 frames/s (fish: 50).
        sensor: the camera's make, for scenes with mice.
        family: of body shapes, see `body.shape.draw_shapes`; 'other' are builds not used in
            training.
        spine_mm: length of the animals, mm; None draws it.

    Returns:
        The recording with the truth of all animals in it.

    Raises:
        RecordingError: there is no such scene.
    """
    if name not in SCENES:
        raise RecordingError(f"there is no scene '{name}'; known are {', '.join(SCENES)}")
    settings: dict[str, Any] = {
        "family": family,
        "spine_mm": spine_mm,
        "name": f"scene-{name}-{seed}",
    }
    if name in RECIPES:
        return Making(RECIPES[name], seed, Take(n_frames, sensor, **settings)).recording()
    if name == "fish":
        return FishSpecies().motion([seed, 5], n_frames, **settings)
    hand = HandSpecies().motion([seed, 6], n_frames, **settings)
    return hand if name == "hand" else RenderedRecording(hand.name, hand.stage, mirrored=True)
