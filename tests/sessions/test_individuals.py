"""The replay of each of several animals shows all of them, and what they do to each other."""

import json

import numpy as np
import pytest
from liex_lab.dashboards.replay.layouts import foxglove_layout
from mcap.reader import make_reader

from liex_lab.sessions import rrd
from tests.sessions.pair import write_pair
from tests.sessions.test_rrd import columns_of


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    return write_pair(tmp_path_factory.mktemp("together"))


def words_at(events, frame):
    now = events[(events["start_frame"] <= frame) & (events["stop_frame"] > frame)]
    return sorted(now["action"])


def test_rerun_shows_the_other_animal_and_a_lane_of_each_direction(pair):
    first, second = pair
    columns = columns_of(first, f"{rrd.ANIMALS}/animal2/joints")
    there = [row for row in columns["Points3D:positions"] if row]
    poses = second.pose_arrays()
    stored = poses.xyz_mm[np.isfinite(poses.xyz_mm).all(axis=(1, 2))] / 1000.0
    np.testing.assert_allclose(np.array(there), stored, atol=1e-6)
    events = first.interactions.query("agent == 'animal2' and target == 'animal1'")
    assert len(events)
    lane = columns_of(first, rrd.TOGETHER + r"/animal2\ to\ animal1")
    states = [row[0] for row in lane["StateChange:state"] if row]
    for frame, words in zip(lane["frame"], states, strict=True):
        assert sorted(filter(None, words.split(", "))) == words_at(events, frame)


def test_foxglove_shows_both_and_a_message_at_each_change(pair):
    first = pair[0]
    with (first.path / "session.mcap").open("rb") as file:
        reader = make_reader(file)
        scenes = list(reader.iter_messages(topics=["/skeleton/scene"]))
        assert all(b"skeleton of animal2" in message.data for *_, message in scenes)
        told = list(reader.iter_messages(topics=["/interactions"]))
    start_ns = scenes[0][2].log_time
    for *_, message in told:
        state = json.loads(message.data)
        frame = round((message.log_time - start_ns) * 30e-9)
        pairs = first.interactions.query("agent == @state['agent'] and target == @state['target']")
        assert sorted(filter(None, state["interactions"].split(", "))) == words_at(pairs, frame)
    assert told
    lanes = foxglove_layout(first.metadata)["configById"]["StateTransitions!actions"]["paths"]
    assert [lane["label"] for lane in lanes[1:]] == ["animal1 to animal2", "animal2 to animal1"]
