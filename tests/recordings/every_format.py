"""Every format that is read, as the common laws need it: one entry is all that a new reader adds to
be held to them.

An entry writes given frames and says which of them must come out whole when a file is damaged. The
laws are in test_laws.py, the damage in test_damage.py.
"""

import struct
import tarfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from mcap.reader import make_reader
from mcap.writer import CompressionType
from numpy.typing import NDArray

from liex_lab.recordings.formats.messages.mcap import McapFile
from liex_lab.recordings.formats.messages.messages import Envelope, MessageFile
from liex_lab.recordings.formats.messages.rosbag import BagFile
from liex_lab.runtime.progress import silent
from tests.recordings.oni_files import Codec, depth_builder, plain_payload
from tests.recordings.picture_writers import (
    write_folder,
    write_nyu,
    write_pclzf,
    write_pgm,
    write_ply,
    write_raytrix,
    write_tiff,
    write_xyz,
)
from tests.recordings.ros_writers import write_bag, write_db3, write_ros_mcap
from tests.recordings.video_writers import write_video_session
from tests.recordings.writers import (
    Frames,
    write_archive,
    write_camera,
    write_mcap,
    write_mcap_parts,
    write_moseq_folder,
    write_oni_file,
    write_png_folder,
    write_tiff_stack,
)

Survivors = Callable[[Path, int], Sequence[int] | None]


@dataclass(frozen=True)
class Format:
    """A format.

    write: put frames (n, H, W) uint16 mm of the camera `SMALL` and even times into an empty folder,
    and return what to open. survivors: given a file and its first damaged byte, the frames that
    must still come out exactly; None where the recording may be refused. atol_mm: how far depth may
    be from what was written. streams: its file is large, and so must never be read at once.
    promise: change the header to one that promises 2^31
    frames, where it counts them.
    """

    name: str
    write: Callable[[Path, Frames], Path]
    survivors: Survivors
    atol_mm: float = 0.0
    streams: bool = True
    promise: Callable[[Path], None] | None = None


def others(suffix: str) -> Survivors:
    """Images in files of their own: damage to one costs none of the others, and may cost all if
    it is the camera.
    """

    def survivors(path: Path, at: int) -> Sequence[int] | None:
        if not path.name.endswith(suffix):
            return None
        files = sorted(path.parent.glob(f"*{suffix}"), key=lambda p: int(p.stem.split("_")[-1]))
        return [k for k, file in enumerate(files) if file != path]

    return survivors


def before(ends: Callable[[Path], Sequence[int]], suffix: str) -> Survivors:
    """Images one after the other in one file: those that end before the damage come out. ends:
    where each does.
    """

    def survivors(path: Path, at: int) -> Sequence[int] | None:
        if not path.name.endswith(suffix):
            return None
        n = int(np.searchsorted(ends(path), at, side="right"))
        return range(n) if n else None

    return survivors


def overwrite(path: Path, at: int, number: int, n_bytes: int = 4) -> None:
    """A little endian number put into a file."""
    content = bytearray(path.read_bytes())
    content[at : at + n_bytes] = number.to_bytes(n_bytes, "little")
    path.write_bytes(content)


def _promise_avi(folder: Path) -> None:
    """The count in the stream's header, and the one in the file's."""
    content = (folder / "depth.avi").read_bytes()
    overwrite(folder / "depth.avi", content.index(b"strh") + 8 + 32, 2**31)
    overwrite(folder / "depth.avi", content.index(b"avih") + 8 + 16, 2**31)


def _promise_ply(folder: Path) -> None:
    """The vertices of every cloud: a frame each, so this is the number that a header has."""
    for path in folder.glob("*.ply"):
        head, _, rest = path.read_bytes().partition(b"element vertex ")
        path.write_bytes(head + b"element vertex 2147483648" + rest[rest.index(b"\n") :])


def _tiff_ends(path: Path) -> list[int]:
    """Of each page the last byte of its pixels and of all directories up to its own."""
    ends, last = [], 0
    with tifffile.TiffFile(path) as tif:
        for page in tif.pages:
            last = max(
                last,
                page.offset + 400,
                *(o + c for o, c in zip(page.dataoffsets, page.databytecounts, strict=True)),
            )
            ends.append(last)
    return ends


def _archive_ends(path: Path) -> list[int]:
    """For each frame, how many packed bytes it takes to unpack it."""
    packed = path.read_bytes()
    with tarfile.open(path) as tar:
        start = tar.getmember("depth.dat").offset_data
        n_bytes = tar.getmember("depth.dat").size
    inflate, got = zlib.decompressobj(31), [0]
    for k in range(0, len(packed), 64):
        got.append(got[-1] + len(inflate.decompress(packed[k : k + 64])))
    frame = 2 * 64 * 48
    return [
        64 * int(np.searchsorted(got, start + k * frame)) for k in range(1, n_bytes // frame + 1)
    ]


def _avi_ends(path: Path) -> list[int]:
    """The end of every chunk of images, found by looking for their names one after the other."""
    content, ends = path.read_bytes(), []
    at = content.index(b"movi") + 4
    while content[at : at + 4] == b"00dc":
        at += 8 + int.from_bytes(content[at + 4 : at + 8], "little")
        ends.append(at)
        at += at % 2
    return ends


def _mkv_ends(path: Path) -> list[int]:
    """The end of every image of the second track, found by looking for the blocks of its size."""
    content, ends, at = path.read_bytes(), [], 0
    block = b"\xa3" + (2 * 64 * 48 + 4 | 1 << 56).to_bytes(8, "big") + b"\x82"
    while (at := content.find(block, at)) >= 0:
        at += 9 + 2 * 64 * 48 + 4
        ends.append(at)
    return ends


def _mcap_ends(path: Path) -> list[int]:
    """For each depth image the end of its chunk, as the file's own index has it."""
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        times = [
            message.log_time for _, _, message in reader.iter_messages(topics=["/camera/depth"])
        ]
    chunks = summary.chunk_indexes
    return [
        next(c.chunk_start_offset + c.chunk_length for c in chunks if t <= c.message_end_time)
        for t in times
    ]


def _message_ends(file: MessageFile) -> list[int]:
    """For each depth image the end of its chunk, or its own where there are no chunks."""
    found = []
    for envelope in file.walk(lambda channel: "Image" in channel.schema, silent):
        assert isinstance(envelope, Envelope)  # it is walked, not listed by an index
        place = envelope.place
        chunk = file.chunks[place.chunk] if place.chunk >= 0 else None
        found.append(place.offset + place.length if chunk is None else chunk.offset + chunk.length)
    file.close()
    return found


def _mcap_message_ends(path: Path) -> list[int]:
    return _message_ends(McapFile(path, path.open("rb")))


def _bag_ends(path: Path) -> list[int]:
    return _message_ends(BagFile(path, path.open("rb")))


def _oni_ends(path: Path) -> list[int]:
    """The end of every frame's record, walking from record to record."""
    content, ends, at = path.read_bytes(), [], 24
    head = 28 if content[4:10] >= bytes([1, 0, 1, 0, 0, 0]) else 24
    while content[at : at + 4] == b"NIR\0":
        _, kind, _, fields, payload = struct.unpack_from("<IIIII", content, at)
        assert fields >= head
        at += fields + payload
        ends += [at] if kind == 0x0A else []
    return ends


def _oni(codec: Codec) -> Callable[[Path, Frames], Path]:
    return lambda folder, frames: write_oni_file(folder / "recording.oni", frames, codec=codec)


def _old_oni(folder: Path, frames: Frames) -> Path:
    """As programs before OpenNI 2 wrote them; the camera stated, for theirs is another one's."""
    write_camera(folder)
    payloads = [plain_payload(frame, "NONE") for frame in frames]
    return depth_builder(payloads, "NONE", old=True, table=True).write(folder / "recording.oni")


def _promise_oni(path: Path) -> None:
    """The frames that the depth node states."""
    content = path.read_bytes()
    at = content.index(b"16zT", content.index(b"Depth")) + 4
    overwrite(path, at, 2**31)


def _moseq(folder: Path, frames: Frames) -> Path:
    write_camera(write_moseq_folder(folder, frames))
    return folder


def _archive(folder: Path, frames: Frames) -> Path:
    order = ("camera.toml", "depth_ts.txt", "metadata.json", "depth.dat")
    return write_archive(_moseq(folder / "session", frames), folder / "session.tar.gz", order)


def _pictures(
    suffix: str, write: Callable[[Path, NDArray[Any]], object]
) -> Callable[[Path, Frames], Path]:
    return lambda folder, frames: write_folder(folder, frames, suffix, write)


FORMATS = (
    Format("png", write_png_folder, others(".png"), streams=False),
    Format("tiff", _pictures(".tif", write_tiff), lambda path, at: None, streams=False),
    Format(
        "tiff-stack",
        lambda f, s: write_tiff_stack(f / "depth.tif", s).parent,
        before(_tiff_ends, ".tif"),
    ),
    Format("pgm", _pictures(".pgm", write_pgm), others(".pgm"), streams=False),
    Format("pclzf", _pictures(".pclzf", write_pclzf), others(".pclzf"), streams=False),
    Format("nyu", write_nyu, others(".png"), streams=False),
    Format("moseq-dat", _moseq, before(lambda p: range(6144, p.stat().st_size + 1, 6144), ".dat")),
    Format("moseq-archive", _archive, before(_archive_ends, ".gz")),
    Format("moseq-avi", write_video_session, before(_avi_ends, ".avi"), promise=_promise_avi),
    Format(
        "azure-mkv", lambda f, s: write_video_session(f, s, "depth.mkv"), before(_mkv_ends, ".mkv")
    ),
    Format("oni-16zT", _oni("16zT"), before(_oni_ends, ".oni"), promise=_promise_oni),
    Format("oni-16zP", _oni("16zP"), before(_oni_ends, ".oni")),
    Format("oni-old", _old_oni, before(_oni_ends, ".oni")),
    Format(
        "mcap-foxglove",
        lambda f, s: write_mcap(f / "recording.mcap", s),
        before(_mcap_ends, ".mcap"),
    ),
    Format("mcap-parts", write_mcap_parts, lambda path, at: None),
    Format(
        "mcap-unchunked",
        lambda f, s: write_mcap(f / "recording.mcap", s, use_chunks=False),
        before(_mcap_message_ends, ".mcap"),
    ),
    Format(
        "mcap-png",
        lambda f, s: write_mcap(f / "recording.mcap", s, encoding="png", chunk_size=4096),
        before(_mcap_message_ends, ".mcap"),
    ),
    Format(
        "mcap-ros1",
        lambda f, s: write_ros_mcap(f / "recording.mcap", s, 1, compression=CompressionType.NONE),
        before(_mcap_message_ends, ".mcap"),
    ),
    Format(
        "mcap-ros2",
        lambda f, s: write_ros_mcap(
            f / "recording.mcap", s, 2, kind="rvl", compression=CompressionType.LZ4, chunk_size=4096
        ),
        before(_mcap_message_ends, ".mcap"),
    ),
    Format("bag-lz4", lambda f, s: write_bag(f / "recording.bag", s), before(_bag_ends, ".bag")),
    Format(
        "bag-bz2",
        lambda f, s: write_bag(
            f / "recording.bag", s, compression="bz2", kind="png", chunk_bytes=4096
        ),
        before(_bag_ends, ".bag"),
    ),
    Format(
        "bag-plain",
        lambda f, s: write_bag(
            f / "recording.bag", s, compression=None, chunk_bytes=1 << 18, kind="rvl"
        ),
        before(_bag_ends, ".bag"),
    ),
    # SQLite keeps its tables in pages of a tree, so that nothing is promised of what comes before
    Format("ros2-db3", lambda f, s: write_db3(f / "bag", s), lambda path, at: None),
    Format(
        "raytrix-float",
        lambda f, s: write_raytrix(
            f, -s.astype(np.float32), "raytrix-f32-negative-mm", ".tif", write_tiff
        ),
        lambda path, at: None,
        streams=False,
    ),
    Format(
        "raytrix-xyz",
        lambda f, s: write_raytrix(f, s, "raytrix-points-mm", ".xyz", write_xyz),
        others(".xyz"),
        atol_mm=1e-3,
        streams=False,
    ),
    Format(
        "raytrix-ply",
        lambda f, s: write_raytrix(f, s, "raytrix-points-mm", ".ply", write_ply),
        others(".ply"),
        atol_mm=1e-3,
        streams=False,
        promise=_promise_ply,
    ),
)
