"""Groups of mice that interact: what the script says is what the bodies do."""

from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.evaluation.several import skin_gaps
from scipy.spatial import cKDTree

from liex_lab.recordings import open_recording
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.scenes.groups import ENCOUNTERS, film_group
from tests.recordings.asking import refusal


def common(recording: RenderedRecording, frame: int) -> float:
    """Share of the vertices of one of two bodies that lie in the other one."""
    solids = [actor[frame : frame + 1].solids[0] for actor in recording.stage.actors]
    shares = []
    for one, other in (solids, solids[::-1]):
        corners, points = one.vertices()[0][one.faces], other.vertices()[0]
        outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        nearest = cKDTree(corners.mean(axis=1)).query(points)[1]
        off = points - corners.mean(axis=1)[nearest]
        shares.append(float((np.sum(off * outwards[nearest], axis=1) < 0).mean()))
    return max(shares)


def test_a_seed_gives_the_same_animals_acts_and_depth():
    one, acts = film_group(3, 240, animals=3)
    again, same = film_group(3, 240, animals=3)
    assert acts == same
    np.testing.assert_array_equal(one.frame(120).depth, again.frame(120).depth)
    assert len(one.stage.actors) == 3
    shorter = film_group(3, 200, animals=3)[0].stage.actors
    for actor, other in zip(one.stage.actors, shorter, strict=True):
        assert actor.spine_mm == other.spine_mm


def test_lengths_are_equal_or_apart():
    spines = [one.spine_mm for one in film_group(1, 30, animals=4, apart=0.15)[0].stage.actors]
    np.testing.assert_allclose(np.divide(spines[:-1], spines[1:]), 1.15)
    equal = {one.spine_mm for one in film_group(1, 30, spine_mm=66.0)[0].stage.actors}
    assert equal == {66.0}


@pytest.mark.parametrize("action", ["follow", "nose_to_nose", "mount", "huddle", "avoid"])
def test_bodies_do_what_the_script_says(action):
    recording, acts = film_group(7, 600, encounters=(action,))
    assert max(common(recording, i) for i in range(0, 600, 6)) < 0.3
    joints = [one.joints for one in recording.stage.actors]
    (agent, target, _, start, stop), *_ = [act for act in acts if act.action == action]
    middle = slice((2 * start + stop) // 3, (start + 2 * stop) // 3 + 1)
    a, b = joints[agent][middle], joints[target][middle]
    centres = np.linalg.norm(np.diff(joints[agent].mean(axis=1), axis=0), axis=1) * 30.0
    pace = float(np.median(centres[middle]))
    if action == "follow":
        assert pace > 80.0
        assert np.linalg.norm(a[:, -1] - b[:, 0], axis=1).max() < 60.0
    elif action == "nose_to_nose":
        assert np.linalg.norm(a[:, -1] - b[:, -1], axis=1).mean() < 26.0
    elif action == "mount":
        assert (a[:, 2, 2] - b[:, 2, 2]).min() > 10.0
    elif action == "huddle":
        assert pace < 20.0
        assert skin_gaps(recording)[middle, 0, 1].max() < 8.0
    else:
        gap = np.linalg.norm(joints[agent].mean(axis=1) - joints[target].mean(axis=1), axis=1)
        assert gap[start:stop].min() > 70.0


@pytest.mark.parametrize("action", ["cross", "side_by_side_same", "follow"])
def test_fish_swim_over_beside_and_behind_each_other_in_the_water(action):
    recording, acts = film_group(7, 400, animal="fish", encounters=(action,))
    a, b = (one.joints for one in recording.stage.actors)
    assert min(a[..., 2].min(), b[..., 2].min()) > 3.0
    assert recording.stage.scene.wall_clearance(np.stack([a, b])[..., :2]).min() > -3.0
    off = a.mean(axis=1) - b.mean(axis=1)
    if action == "cross":
        nearest = int(np.linalg.norm(off[:, :2], axis=1).argmin())
        assert np.linalg.norm(off[nearest, :2]) < 8.0
        assert abs(off[nearest, 2]) > 8.0
        return
    start, stop = next((one.start, one.stop) for one in acts if one.action == action)
    rows = slice((2 * start + stop) // 3, (start + 2 * stop) // 3)
    speed = np.linalg.norm(np.diff(a[rows].mean(axis=1), axis=0), axis=1) * 50.0
    assert np.median(speed) > 15.0
    assert np.abs(off[rows, 2]).max() < 5.0
    apart = np.linalg.norm(off[rows], axis=1)
    assert apart.max() < 10.0 if action.startswith("side") else apart.min() > 15.0


def test_an_address_opens_a_group_and_a_wrong_one_is_told():
    address = "synthetic:pair?seed=4&frames=40&animals=3&apart=0.1&act=cross&sensor=primesense"
    with open_recording(address) as recording:
        assert isinstance(recording, RenderedRecording)
        assert (recording.name, len(recording)) == ("pair-4", 40)
        assert len(recording.animals) == 3
    assert "one of " + ENCOUNTERS[0] in refusal(Path("synthetic:pair?act=fight"))
    with open_recording("synthetic:pair?animal=fish&frames=10&seed=4") as recording:
        assert isinstance(recording, RenderedRecording)
        assert (recording.name, recording.skeleton.name) == ("pair-fish-4", "fish")
    assert "act is of a fish one of follow" in refusal(Path("synthetic:pair?animal=fish&act=mount"))
    assert "animal is one of mouse, fish" in refusal(Path("synthetic:pair?animal=hand"))
    assert "animals is 2, 3 or 4" in refusal(Path("synthetic:pair?animals=1"))
    assert "kept for" in refusal(Path("synthetic:pair?seed=958204401"))
