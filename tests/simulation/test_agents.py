"""Virtual animals act as the definitions say, stay where they can be, and are the same for
a seed.
"""

import numpy as np
import pytest

from liex_lab.simulation.agents import fish as fish_acts
from liex_lab.simulation.agents import mouse as mouse_acts
from liex_lab.simulation.agents.agent import SPEED, STEP_S, Individual
from liex_lab.simulation.species import FishSpecies, MouseSpecies


@pytest.fixture(scope="module")
def fish() -> fish_acts.FishActor:
    one = Individual.draw(np.random.default_rng(2), (1.0, 1.0))
    return fish_acts.FishActor(one, 30.0, (14.0, 125.0), 325.0)


@pytest.fixture(scope="module")
def mouse() -> mouse_acts.MouseActor:
    rng, species = np.random.default_rng(3), MouseSpecies()
    return mouse_acts.MouseActor.of(
        Individual.draw(rng, (1.1, 1.1)),
        species.skeleton,
        species.shapes(rng, "train", 1),
        np.array([300.0, 260.0]),
    )


def measured(fish: fish_acts.FishActor, word: str, n: int = 15) -> dict[str, np.ndarray]:
    """Of n actions: length s, mean speed and climb in lengths (a second), net turn and largest bend
    in degrees.
    """
    rows = []
    for seed in range(n):
        motion = fish.cut(np.random.default_rng(seed), word)
        steps = np.flatnonzero(motion.word == word)
        pose = fish_acts.fish_poses(np.random.default_rng(seed), FishSpecies(), motion, steps, 1.0)
        bend = np.degrees(np.abs(pose.angles[..., 2].sum(axis=1)).max())
        rise = (motion.position[steps[-1], 2] - motion.position[steps[0], 2]) / fish.length_mm
        turn = np.degrees(abs(motion.heading[steps[-1]] - motion.heading[steps[0]]))
        speed = motion.channels[steps, SPEED].mean() / fish.length_mm
        rows.append([len(steps) * STEP_S, speed, rise, turn, bend])
    return dict(zip(("seconds", "speed", "rise", "turn", "bend"), np.array(rows).T, strict=True))


def test_the_nine_actions_of_a_fish_follow_their_definitions(fish: fish_acts.FishActor) -> None:
    found = {word: measured(fish, word) for word in fish_acts.ACTIONS}
    for word, rows in found.items():
        assert 0.12 <= rows["seconds"].min() <= rows["seconds"].max() <= 2.75, word
    assert found["freeze"]["speed"].max() < 0.15
    assert found["surface"]["rise"].min() > 0.0 > found["dive"]["rise"].max()
    assert np.median(found["c_turn"]["bend"]) > 90 > np.median(found["r_turn"]["bend"]) > 45
    assert found["c_turn"]["bend"].min() < found["r_turn"]["bend"].max()  # neighbours overlap
    assert np.median(found["scoot"]["turn"]) < 20 < np.median(found["r_turn"]["turn"])
    assert np.median(found["thrash"]["bend"]) > np.median(found["scoot"]["bend"])
    assert found["thrash"]["speed"].max() < 1.0


def test_an_uncut_recording_stays_in_the_water_holds_every_action_and_nameless_stretches(
    fish,
) -> None:
    motion = fish.uncut(np.random.default_rng(1), 120.0)
    assert fish.fits(motion.position[::7], motion.heading[::7]) or (
        np.ptp(motion.position[:, 2]) < 112.0
    )
    words, counts = np.unique(motion.word, return_counts=True)
    assert set(words) == {"", *fish_acts.ACTIONS}
    assert 0.15 < counts[list(words).index("")] / len(motion.word) < 0.6
    again = fish.uncut(np.random.default_rng(1), 30.0).position
    np.testing.assert_array_equal(again, motion.position[: len(again)])


def test_a_mouse_turns_to_its_own_side_rears_at_walls_and_stays_in_its_box(mouse) -> None:
    motion = mouse.uncut(np.random.default_rng(4), 200.0)
    assert set(motion.word) == {"", *mouse_acts.ACTIONS}
    assert (np.abs(motion.position[:, :2]) < mouse.half).all()
    edges = np.flatnonzero(np.diff(motion.act)) + 1
    for part in np.split(np.arange(len(motion.word)), edges):
        turn = motion.heading[part[-1]] - motion.heading[part[0]]
        word = motion.word[part[0]]
        assert word != "turn_left" or turn > 0
        assert word != "turn_right" or turn < 0
    near = (mouse.half - np.abs(motion.position[:, :2])).min(axis=1)
    supported, free = (
        np.median(near[motion.word == f"rear_{kind}"]) for kind in ("supported", "unsupported")
    )
    assert supported < 65.0 < free
    speed = motion.channels[:, SPEED] / mouse.mouse.size
    assert (
        np.median(speed[motion.word == "run"]) > 250 > np.median(speed[motion.word == "walk"]) > 50
    )
    assert np.median(speed[motion.word == "freeze"]) < 5
