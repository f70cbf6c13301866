"""The bundled sample recording: a rendered mouse as a camera's MCAP file, and its card.

154 frames of a walk in which the animal turns, crosses its arena and rears once, 320 x 240 px, four
of them dropped as by a camera; 16-bit depth, mm, in Foxglove messages. It is rendered from a seed,
so the same code and package versions write the same bytes.
"""

import hashlib
import json
from pathlib import Path

import numpy as np

from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import mcap, provenance
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.sensors import PRIMESENSE_QVGA_SENSOR
from liex_lab.simulation.species import MouseSpecies

SEED = 341  # a walk in which the animal turns, crosses its arena and rears once
SPINE_MM = 65.0
N_FRAMES = 154
# frames dropped as by a camera, so that the sample has gaps like real recordings
LEFT_OUT = (40, 101, 102, 103)


def write_sample(path: str | Path, *, progress: Progress = silent) -> Path:
    """Write the sample recording, and its card (.toml) next to it.

    Args:
        path: the MCAP file; an existing one is replaced.
        progress: called with the number of written frames.

    Returns:
        The path of the recording.
    """
    mouse = virtual_mouse()
    path = Path(path)
    path.unlink(missing_ok=True)
    origin = provenance.Provenance(
        name=path.stem,
        skeleton=mouse.skeleton,
        camera=mouse.camera,
        T_arena_camera=mouse.T_arena_camera,
        floor_distance_mm=mouse.floor.distance_mm,
        input_sha256="",
    )
    # slow but strong compression: packed once, downloaded often
    writer = mcap.McapWriter(path, origin, level=19, chunk_size=1 << 20)
    try:
        for frames in mouse.chunks(16):
            kept = [frame for frame in frames if frame.index not in LEFT_OUT]
            depth = [frame.depth.astype(np.uint16) for frame in kept]
            # the clock of a camera switched on a second ago: no date is implied
            writer.add([frame.time_ns + 10**9 for frame in kept], depth)
            progress(frames[-1].index + 1, N_FRAMES, "writing the sample")
    finally:
        writer.abandon()
    path.with_suffix(".toml").write_text(_card(path, mouse), encoding="utf-8")
    return path


def virtual_mouse() -> RenderedRecording:
    """The animal of the sample, with arena, camera and the exact truth of every frame."""
    return MouseSpecies().motion(
        SEED, N_FRAMES, sensor=PRIMESENSE_QVGA_SENSOR, spine_mm=SPINE_MM, name="mouse_walk"
    )


def _card(path: Path, mouse: RenderedRecording) -> str:
    """The sample's card, TOML."""
    facts = {
        "what": (
            "a virtual mouse that walks, turns and rears in a round arena, viewed from above by an "
            "imitated PrimeSense camera of 320 x 240 pixels; 16-bit depth in mm, the camera's "
            "calibration and its place above the floor as Foxglove protobuf messages"
        ),
        "origin": (
            "rendered from a seed by liex_lab/simulation/locomotion.py; no recording of an "
            "animal was used"
        ),
        "licence": "BSD-3-Clause, as the rest of liex_lab",
        "made_by": "liex_lab.pipelines.sample.write_sample",
        "made_with": f"zstandard {provenance.package_version('zstandard')}",
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "bytes": path.stat().st_size,
        "n_frames": N_FRAMES - len(LEFT_OUT),
        "frames_left_out": list(LEFT_OUT),
        "rate_hz": round(mouse.rate_hz, 3),
        "seed": SEED,
        "spine_mm": SPINE_MM,
        "floor_distance_mm": round(mouse.floor.distance_mm, 3),
    }
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in facts.items())
