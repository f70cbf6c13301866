"""Reading of a user's own triangle mesh: STL, OBJ, PLY or glTF, by Open3D.

Open3D reads the file and simplifies it by quadric edge collapse (Garland and Heckbert 1997) when a
skeleton's TOML is loaded; the mesh then becomes part of the skeleton's table, so that a trained
model includes its body and needs neither the file nor Open3D.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.errors import LiexError, how_to_install

_MOST_FACES = 4000
_FEWEST_FACES = 4


def read_mesh(path: Path, unit_mm: float, origin: str) -> dict[str, Any]:
    """The entries of a [surface] table for the mesh of a file.

    Simplified to the resolution of a depth image: at most 4000 triangles; vertices are rounded to a
    thousandth of a mm.

    Args:
        path: of the file (.stl, .obj, .ply, .glb ...).
        unit_mm: length of one unit of the file, mm.
        origin: name of the TOML in errors.

    Returns:
        vertices_mm, V triples of mm, and faces, F triples of vertex numbers.

    Raises:
        LiexError: there is no such file, no Open3D, or no triangles in it.
    """
    if not path.is_file():
        raise LiexError(
            f"{origin}: [surface] mesh should be a file next to the TOML, but there is no {path}"
        )
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise LiexError(
            f"{origin}: reading {path.name} needs Open3D ({error}); {how_to_install('mesh')}"
        ) from None
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh = open3d.io.read_triangle_mesh(path)
        mesh.merge_close_vertices(1e-9)
        mesh.remove_degenerate_triangles()
        if len(mesh.triangles) > _MOST_FACES:
            mesh = mesh.simplify_quadric_decimation(_MOST_FACES)
        mesh.remove_unreferenced_vertices()
    vertices = np.asarray(mesh.vertices) * unit_mm
    faces = np.asarray(mesh.triangles)
    if len(faces) < _FEWEST_FACES or not np.isfinite(vertices).all():
        raise LiexError(
            f"{origin}: [surface] mesh should be a file with the triangles of a body, but {path} "
            f"contains {len(faces)} of them; export it as STL, OBJ or PLY"
        )
    return {"vertices_mm": np.round(vertices, 3).tolist(), "faces": faces.tolist()}
