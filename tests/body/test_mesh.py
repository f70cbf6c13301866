"""A body from a user's own mesh file: read, thinned out, carried in the table, and moving with the
bones.
"""

from pathlib import Path

import numpy as np
import pytest

from liex_lab.body import Pose, Skeleton
from liex_lab.body.shape import MeshBody, Surface
from liex_lab.body.variation import vary_body
from liex_lab.catalog import find_sample
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3

SNAKE = Skeleton.load(find_sample("snake.toml"))
FLESH = Surface.of(SNAKE)


def snake_toml(folder: Path, surface: str) -> Path:
    """The snake's TOML with another [surface]."""
    text = find_sample("snake.toml").read_text(encoding="utf-8")
    first, last = text.index("[surface]"), text.index("[view]")
    path = folder / "own.toml"
    path.write_text(text[:first] + "[surface]\n" + surface + "\n\n" + text[last:], encoding="utf-8")
    return path


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture(scope="module")
def meshed(tmp_path_factory: pytest.TempPathFactory) -> Skeleton:
    """The snake whose body is a file in cm, that of its own capsules."""
    folder = tmp_path_factory.mktemp("mesh")
    write_obj(folder / "snake.obj", FLESH.vertices(Pose.home(SNAKE)) / 10.0, FLESH.faces)
    skeleton = Skeleton.load(snake_toml(folder, 'mesh = "snake.obj"\nmesh_unit_mm = 10.0'))
    (folder / "snake.obj").unlink()
    return skeleton


def winding(n: int) -> Pose:
    rng = np.random.default_rng(5)
    angles = np.zeros((n, SNAKE.n_joints, 3))
    angles[:, 1:-1, 2] = rng.uniform(-0.4, 0.4, (n, SNAKE.n_joints - 2))
    root = SE3.exp(
        np.concatenate(
            [np.zeros((n, 2)), rng.uniform(-3, 3, (n, 1)), rng.uniform(-50, 50, (n, 3))], axis=1
        )
    )
    return Pose(root, angles, rng.uniform(0.8, 1.2, n))


def test_the_home_pose_has_the_file_s_vertices(meshed):
    mesh = Surface.of(meshed)
    home = mesh.vertices(Pose.home(meshed))
    wanted = FLESH.vertices(Pose.home(SNAKE))
    off = np.linalg.norm(home[:, None] - wanted[None], axis=-1).min(axis=1)
    assert off.max() < 0.01
    assert mesh.area_mm2 == pytest.approx(FLESH.area_mm2, rel=0.2)


def test_a_bent_body_lies_where_the_capsules_lie(meshed):
    pose = winding(6)
    mesh, flesh = Surface.of(meshed).vertices(pose), FLESH.vertices(pose)
    for one, other in zip(mesh, flesh, strict=True):
        off = np.linalg.norm(one[:, None] - other[None], axis=-1).min(axis=1)
        assert np.quantile(off, 0.95) < 3.0
        assert off.max() < 8.0  # at the bends, where a vertex follows two bones


def test_individuals_differ_in_girth_and_not_in_length(meshed):
    n = 200
    body = vary_body(np.random.default_rng(3), meshed, "augmented", n)
    assert isinstance(body, MeshBody)
    vertices = Surface.of(meshed).vertices(Pose.home(meshed, n), body)
    length, width = np.ptp(vertices[..., 0], axis=1), np.ptp(vertices[..., 1], axis=1)
    assert length.std() / length.mean() < 0.01
    assert 0.05 < width.std() / width.mean() < 0.5


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        ('mesh = "absent.stl"', "there is no"),
        ('mesh = "empty.obj"', "export it as STL"),
        ("mesh = 3", "name of a file"),
        ('mesh = "empty.obj"\nmesh_unit_mm = -1.0', "mesh_unit_mm"),
        ("vertices_mm = [[0.0, 1.0]]\nfaces = [[0, 0, 0]]", "vertices_mm"),
        ("vertices_mm = [[0.0, 1.0, 2.0]]\nfaces = [[0, 0, 3]]", "faces"),
    ],
)
def test_what_is_not_a_mesh_is_refused_in_a_sentence(tmp_path, surface, words):
    (tmp_path / "empty.obj").write_text("# nothing\n", encoding="utf-8")
    with pytest.raises(LiexError, match=words):
        Surface.of(Skeleton.load(snake_toml(tmp_path, surface)))


def test_a_fine_mesh_is_thinned_out(tmp_path):
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 121)[:-1], np.linspace(0.02, np.pi - 0.02, 100))
    ball = np.stack(
        [120 * np.cos(v) - 120, 15 * np.sin(v) * np.cos(u), 15 * np.sin(v) * np.sin(u)], -1
    ).reshape(-1, 3)
    at = np.arange(120 * 99).reshape(99, 120)
    right = np.roll(at, -1, axis=1)
    faces = np.concatenate(
        [np.stack([at, right, at + 120], -1), np.stack([right, right + 120, at + 120], -1)]
    )
    write_obj(tmp_path / "ball.obj", ball, faces.reshape(-1, 3))
    surface = Surface.of(Skeleton.load(snake_toml(tmp_path, 'mesh = "ball.obj"')))
    assert 2000 < len(surface.faces) <= 4000
    assert np.ptp(surface.vertices(Pose.home(SNAKE))[:, 0]) == pytest.approx(240.0, rel=0.02)
