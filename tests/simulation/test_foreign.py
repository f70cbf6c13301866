"""Foreign bodies: the truth lies in the depth images, and one address is one recording."""

import numpy as np
import pytest

from liex_lab.errors import RecordingError
from liex_lab.recordings import open_recording
from liex_lab.simulation.foreign import (
    KINDS,
    SEALED_BODY,
    ForeignRecording,
    _drawn,
    _mesh,
    _outside,
)


@pytest.fixture(scope="module", params=["mouse", "fish"])
def animal(request):
    return ForeignRecording(request.param, 1, 1, 4)


def test_the_depth_images_contain_the_true_surface(animal):
    truth = animal.truth
    for i in (0, 3):
        depth = animal.frame(i).depth
        u, v = np.rint(animal.camera.project(truth["joints"][i])).astype(int).T
        read = depth[v, u]
        middle = np.s_[2:-2]  # the ends are a pixel wide
        assert (read > 0)[middle].mean() > 0.7
        off = (read - truth["surface_mm"][i])[middle][(read > 0)[middle]]
        assert np.median(np.abs(off)) < 0.05 * animal.length_mm


def test_the_joints_run_from_the_plans_base_to_its_tip_inside_the_body(animal):
    joints, surface, thick = (
        animal.truth[name] for name in ("joints", "surface_mm", "thickness_mm")
    )
    arc = np.linalg.norm(np.diff(joints, axis=1), axis=-1).sum(axis=1)
    np.testing.assert_allclose(arc, animal.length_mm, rtol=0.03)
    inner = (joints[..., 2] - surface)[:, 1:-1]
    hit = np.isfinite(inner)
    assert hit.mean() > 0.8  # a ray may miss a thin tail
    assert (inner[hit] > 0).mean() > 0.95
    assert (inner < thick[:, 1:-1])[hit].mean() > 0.95
    thickest = np.nan_to_num(thick).max(axis=0)
    assert thickest[-1] < 0.5 * thickest.max()  # the nose, and the tail of a fish


def test_a_recording_is_the_same_in_any_order_and_another_seed_is_another(animal):
    name, body = animal.name.split("-")[1], 1
    again, other = (ForeignRecording(name, body, seed, 4) for seed in (1, 2))
    again.frame(3)
    np.testing.assert_array_equal(again.frame(1).depth, animal.frame(1).depth)
    assert not np.array_equal(other.frame(1).depth, animal.frame(1).depth)
    assert other.length_mm == animal.length_mm  # the body is the same


@pytest.mark.parametrize("kind", KINDS)
def test_the_vertices_lie_on_the_smooth_union(kind):
    parts = _drawn(np.random.default_rng(3), KINDS[kind]["parts"])
    blend = KINDS[kind]["blend"]
    vertices, faces = _mesh(parts, blend)
    assert faces.max() == len(vertices) - 1
    off = np.abs(_outside(parts, vertices, blend))
    assert np.quantile(off, 0.9) < 0.005


def test_an_address_opens_a_body():
    recording = open_recording("synthetic:foreign?animal=fish&body=2&seed=5&frames=3")
    assert (recording.name, len(recording), recording.rate_hz) == ("foreign-fish-2-5", 3, 50.0)


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("animal=hand", "animal is one of mouse, fish, got 'hand'"),
        (f"body={SEALED_BODY}", "body is a whole number below 953200"),
        ("body=two", "body is a whole number"),
        ("spine_mm=60", "spine_mm is no setting of it"),
        ("frames=0", "frames is a whole number from 1"),
    ],
)
def test_an_address_that_cannot_be_read_is_refused(query, expected):
    with pytest.raises(RecordingError, match=expected):
        open_recording(f"synthetic:foreign?{query}")
