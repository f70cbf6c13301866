"""Files that unpack to more than they should, never end, or name others: refused in a sentence, in
little time and memory.
"""

import gzip
import io
import json
import lzma
import re
import resource
import sqlite3
import struct
import tarfile
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from mcap.writer import Writer

from liex_lab.errors import LiexError, ModelError, RecordingError, StudyError
from liex_lab.estimation.model import Model
from liex_lab.plan.study import Study
from liex_lab.recordings import open_recording
from liex_lab.recordings.formats.images.files import open_tiffs
from liex_lab.runtime.memory import check_npz
from liex_lab.runtime.progress import silent

LENS = "[camera]\nfx = 300.0\nfy = 300.0\ncx = 160.0\ncy = 120.0\nfps = 30.0\n"
MOST_MB = 200
MOST_S = 20.0


def bounded(work: Callable[[], object], says: str, kind: type[LiexError] = RecordingError) -> None:
    """Check that something is refused in a sentence, in little time and memory."""
    began = time.monotonic()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(kind, match=says) as caught:
        work()
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert time.monotonic() - began < MOST_S
    assert grown < MOST_MB, f"{grown:.0f} MB"
    assert len(str(caught.value).splitlines()) == 1


def zeros_gz(path: Path, head: bytes, n_zeros: int) -> Path:
    """A gzip file of some bytes and then zeros: one member for every 4 MB of them, as gzip may."""
    member = gzip.compress(bytes(1 << 22))
    path.write_bytes(gzip.compress(head) + member * (n_zeros >> 22))
    return path


def head_of(name: str, size: int, kind: bytes = tarfile.REGTYPE) -> bytes:
    """The block that begins a member of a tar."""
    info = tarfile.TarInfo(name)
    info.size = size
    info.type = kind
    return info.tobuf(tarfile.GNU_FORMAT)


@pytest.mark.parametrize(
    ("name", "size", "kind", "says"),
    [
        ("x", 1 << 30, tarfile.GNUTYPE_LONGNAME, "name or note"),
        ("x", 1 << 30, tarfile.GNUTYPE_LONGLINK, "name or note"),
        ("x", 1 << 30, tarfile.XHDTYPE, "name or note"),
        ("x", 1 << 30, tarfile.XGLTYPE, "name or note"),
        ("metadata.json", 2 << 30, tarfile.REGTYPE, "holds no stamps or notes"),
        ("depth.dat", 1 << 60, tarfile.REGTYPE, "no room"),
    ],
)
def test_a_member_of_gigabytes_is_not_unpacked(
    name: str, size: int, kind: bytes, says: str, tmp_path: Path
) -> None:
    bomb = zeros_gz(tmp_path / "a.tar.gz", head_of(name, size, kind), 1 << 26)
    bounded(lambda: open_recording(bomb), says)


def test_depth_of_nothing_but_zeros_is_not_unpacked_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    bomb = zeros_gz(tmp_path / "a.tar.gz", head_of("depth.dat", 1 << 30), 5 << 27)
    assert bomb.stat().st_size < 4_000_000
    bounded(lambda: open_recording(bomb), "times its size")
    assert not list((tmp_path / "scratch").iterdir())
    ended = zeros_gz(tmp_path / "b.tar.gz", bytes(1024), 5 << 27)  # behind the end of the tar, too
    bounded(lambda: open_recording(ended), r"times its size|nothing can be")


def test_a_file_with_holes_is_not_filled(tmp_path: Path) -> None:
    path = tmp_path / "a.tar"
    head = bytearray(head_of("depth.dat", 512, tarfile.GNUTYPE_SPARSE))
    head[483:495] = b"77777777777\0"  # the size with its holes
    head[148:156] = b"        "
    head[148:156] = b"%06o\0 " % sum(head)
    path.write_bytes(bytes(head) + bytes(512 * 4))
    bounded(lambda: open_recording(path), "holes")


def pictures(folder: Path) -> Path:
    """A folder for TIFF images of 320 x 240."""
    folder.mkdir()
    (folder / "camera.toml").write_text(LENS)
    return folder


def test_a_directory_of_pictures_that_leads_back_to_itself_ends(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "loop")
    path = folder / "f0.tif"
    tifffile.imwrite(path, np.full((240, 320), 700, np.uint16))
    raw = bytearray(path.read_bytes())
    (first,) = struct.unpack_from("<I", raw, 4)
    (n_tags,) = struct.unpack_from("<H", raw, first)
    struct.pack_into("<I", raw, first + 2 + 12 * n_tags, first)
    path.write_bytes(raw)
    began = time.monotonic()
    with open_recording(folder) as recording:
        assert len(recording) == 1
        assert any("cut short" in problem for problem in recording.problems)
        assert float(recording.frame(0).depth.max()) == 700.0
    assert time.monotonic() - began < MOST_S


@pytest.mark.parametrize("code", [8, 34925])
def test_a_strip_that_unpacks_to_gigabytes_is_a_damaged_picture(code: int, tmp_path: Path) -> None:
    n = 1 << 26
    packed = zlib.compress(bytes(n)) if code == 8 else lzma.compress(bytes(n), preset=0)
    tags = [
        (256, 4, 1, 320),
        (257, 4, 1, 240),
        (258, 3, 1, 16),
        (259, 3, 1, code),
        (262, 3, 1, 1),
        (273, 4, 1, 8),
        (277, 3, 1, 1),
        (278, 4, 1, 240),
        (279, 4, 1, len(packed)),
    ]
    directory = struct.pack("<H", len(tags))
    directory += b"".join(struct.pack("<HHII", *tag) for tag in tags) + bytes(4)
    path = pictures(tmp_path / "strip") / "f0.tif"
    path.write_bytes(b"II*\0" + struct.pack("<I", 8 + len(packed)) + packed + directory)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    stack = open_tiffs([path], silent)
    assert stack.read(0) is None
    stack.close()
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024 < MOST_MB / 5


@pytest.mark.parametrize("name", ["messages", "Topics"])
def test_a_view_that_never_ends_is_no_table_of_messages(name: str, tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as base:
        for table, columns in (
            ("topics", "id, name, type, serialization_format"),
            ("messages", "id, topic_id, timestamp, data"),
        ):
            if table == name.lower():
                selected = columns.replace("id,", "n as id,", 1).replace("topic_n", "topic_id")
                selected = ", ".join(
                    column if "as" in column else f"1 as {column}"
                    for column in selected.split(", ")
                )
                base.execute(
                    f"CREATE VIEW {name} AS WITH RECURSIVE r(n) AS "
                    f"(SELECT 1 UNION ALL SELECT n + 1 FROM r) SELECT {selected} FROM r"
                )
            else:
                base.execute(f"CREATE TABLE {table} ({columns})")
    base.close()
    bounded(lambda: open_recording(path), "not stored but worked out")


def test_thousands_of_topics_are_told_as_fast_as_one(tmp_path: Path) -> None:
    path = tmp_path / "many.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        for k in range(1 << 14):
            writer.register_channel(f"/topic{k}", "json", schema)
        writer.finish()
    bounded(lambda: open_recording(path), "holds no depth images: its topics are /topic0 ")


@pytest.mark.parametrize(
    "named",
    ["/etc/shadow", "../../secret.csv", "a/../../secret.csv", "~/x", "C:\\x", "a\\..\\..\\x"],
)
def test_a_camera_file_names_no_file_elsewhere(named: str, tmp_path: Path) -> None:
    (tmp_path / "secret.csv").write_text("root:secret\n")
    folder = pictures(tmp_path / "rec")
    tifffile.imwrite(folder / "f0.tif", np.full((240, 320), 700, np.uint16))
    (folder / "camera.toml").write_text(f"{LENS}timestamps = {json.dumps(named)}\n")
    bounded(lambda: open_recording(folder), "own folder")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("fx = 1e308", "focal length"),
        ("fx = 1e-308", "focal length"),
        ("fps = 1e-12", "frame rate"),
    ],
)
def test_a_camera_that_none_is_told(line: str, says: str, tmp_path: Path) -> None:
    folder = pictures(tmp_path / "rec")
    tifffile.imwrite(folder / "f0.tif", np.full((240, 320), 700, np.uint16))
    key = line.split(" ")[0]
    (folder / "camera.toml").write_text(re.sub(f"{key} = .*", line, LENS))
    bounded(lambda: open_recording(folder), says)


@pytest.mark.parametrize("named", ["/etc/passwd", "../x.toml", "%2fetc%2fpasswd", "..%2fx.toml"])
def test_a_study_s_virtual_recording_names_no_animal_elsewhere(named: str, tmp_path: Path) -> None:
    table = {
        "name": "s",
        "plan": "mouse",
        "animals": [{"id": "a"}],
        "sessions": [
            {"animal": "a", "session": "1", "recording": f"synthetic:move?seed=1&animal={named}"}
        ],
    }
    with pytest.raises(StudyError, match="own folder"):
        Study.from_table(table, tmp_path / "study.toml")


def npz(path: Path, parts: dict[str, bytes]) -> Path:
    """An archive of raw parts."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(f"{name}.npy", content)
    return path


def array(values: np.ndarray, shape: tuple[int, ...] | None = None) -> bytes:
    """An .npy file, which may claim another shape."""
    out = io.BytesIO()
    head = {"descr": values.dtype.str, "fortran_order": False, "shape": shape or values.shape}
    np.lib.format.write_array_header_1_0(out, head)
    return out.getvalue() + values.tobytes()


def test_a_model_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    path = npz(tmp_path / "m.npz", {"head": bytes(1 << 20)})
    content = path.read_bytes()
    size = (1 << 20).to_bytes(4, "little")
    path.write_bytes(content.replace(size, (1 << 31).to_bytes(4, "little")))  # as it states
    bounded(lambda: Model.load(path), "unpacks to", ModelError)


def test_a_model_that_claims_more_numbers_than_it_has_is_refused(tmp_path: Path) -> None:
    head = array(np.frombuffer(b"{}", np.uint8))
    path = npz(tmp_path / "m.npz", {"head": head, "000_a": array(np.zeros(3), (10**13,))})
    bounded(lambda: Model.load(path), "claims", ModelError)
    deep = np.frombuffer(b"[" * 200_000, np.uint8)
    bounded(
        lambda: Model.load(npz(tmp_path / "d.npz", {"head": array(deep)})),
        "complete model",
        ModelError,
    )
    with pytest.raises(ValueError, match="no archive"):
        check_npz(io.BytesIO(b"PK nothing"), 100)


def test_entities_of_xml_are_bounded_and_none_is_read_from_elsewhere(tmp_path: Path) -> None:
    import xml.etree.ElementTree as ET

    (tmp_path / "secret").write_text("secret")
    laughs = "".join(
        f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' if k else '<!ENTITY l0 "ha">' for k in range(12)
    )
    began = time.monotonic()
    with pytest.raises(ET.ParseError):
        ET.fromstring(f"<!DOCTYPE a [{laughs}]><a>&l11;</a>")
    with pytest.raises(ET.ParseError):
        ET.fromstring(f'<!DOCTYPE a [<!ENTITY x SYSTEM "{tmp_path}/secret">]><a>&x;</a>')
    assert time.monotonic() - began < MOST_S
