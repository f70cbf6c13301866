"""Our MCAP files are what the format's own library reads, whole or cut after any flush."""

from __future__ import annotations

import io
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from liex_lab.errors import SessionError
from liex_lab.sessions.checkpoint import append_chunks
from liex_lab.sessions.mcap import McapLog, MessageType

ONE = MessageType("one", "jsonschema", b"{}", "json")
OTHER = MessageType("other", "jsonschema", b'{"type": "object"}', "json")
Said = list[tuple[str, int, bytes]]


def said(n: int = 60) -> Said:
    """Messages of two topics, out of turn, of 0 to 3,000 bytes that compress and that do not."""
    rng = np.random.default_rng(5)
    told = []
    for k in range(n):
        data = rng.bytes(k * 50) if k % 3 else bytes(k * 50)
        told.append((f"/{'ab'[k % 2]}", int(rng.integers(1, 10**12)), data))
    return told


def parts(data: bytes) -> list[bytes | memoryview]:
    """A message in two parts, either of which may be empty."""
    return [data[:70], memoryview(data)[70:]]


def written(told: Said, chunk_size: int = 4_000, level: int = 1, flush_at: int = -1) -> io.BytesIO:
    sink = io.BytesIO()
    file = McapLog(sink, profile="p", library="l", level=level, chunk_size=chunk_size)
    for k, (topic, time_ns, data) in enumerate(told):
        if k == flush_at:
            file.flush()
            file.flush()  # what does not wait is not written
        file.log(topic, ONE if topic == "/a" else OTHER, parts(data), time_ns)
    file.close()
    sink.seek(0)
    return sink


@pytest.mark.parametrize("chunk_size", [1, 4_000, 10**9])
@pytest.mark.parametrize("level", [1, 3, 19])
def test_every_message_comes_back_by_the_index_in_the_order_of_time(
    chunk_size: int, level: int
) -> None:
    told = said()
    reader = make_reader(written(told, chunk_size, level), validate_crcs=True)
    found = [
        (channel.topic, message.log_time, message.data)
        for _, channel, message in reader.iter_messages()
    ]
    assert found == sorted(told, key=lambda one: one[1])
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(told)
    assert summary.statistics.message_start_time == min(one[1] for one in told)
    assert summary.statistics.message_end_time == max(one[1] for one in told)
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count
    assert {s.name: s.data for s in summary.schemas.values()} == {
        one.name: one.data for one in (ONE, OTHER)
    }


@pytest.mark.parametrize("window", [1, 40, 1 << 20, 1 << 33])
def test_pictures_of_any_size_have_a_window_that_readers_take(window: int) -> None:
    sink = io.BytesIO()
    file = McapLog(sink, profile="p", library="l", level=1, chunk_size=4_000, window=window)
    for _, time_ns, data in said():
        file.log("/a", ONE, parts(data), time_ns)
    file.close()
    sink.seek(0)
    found = [message.data for _, _, message in make_reader(sink).iter_messages()]
    assert sorted(found) == sorted(data for _, _, data in said())


def test_records_follow_each_other_as_the_format_says_and_checksums_hold() -> None:
    sink = written(said())
    names = [type(one).__name__ for one in StreamReader(sink, validate_crcs=True).records]
    assert names[0] == "Header"
    assert names[-1] == "Footer"
    assert names.count("Message") == 60
    assert names.index("DataEnd") > max(k for k, name in enumerate(names) if name == "Message")


def test_a_file_that_ends_after_a_flush_holds_what_was_written_before() -> None:
    told = said()
    whole = io.BytesIO()
    file = McapLog(whole, profile="p", library="l", level=1, chunk_size=10**9)
    for topic, time_ns, data in told[:25]:
        file.log(topic, ONE if topic == "/a" else OTHER, parts(data), time_ns)
    file.flush()
    for topic, time_ns, data in told[25:]:
        file.log(topic, ONE if topic == "/a" else OTHER, parts(data), time_ns)
    cut = io.BytesIO(whole.getvalue())
    found = []
    with suppress(McapError, EOFError):  # it has no end
        for record in StreamReader(cut, validate_crcs=True).records:
            if type(record).__name__ == "Message":
                found.append(record.data)  # type: ignore[attr-defined]
    assert found == [data for _, _, data in told[:25]]


def test_the_same_messages_and_flushes_are_the_same_bytes() -> None:
    told = said()
    assert written(told, flush_at=7).getvalue() == written(told, flush_at=7).getvalue()


def test_a_file_without_a_message_is_whole(tmp_path: Path) -> None:
    place = tmp_path / "empty.mcap"
    place.write_bytes(written([]).getvalue())
    with place.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert list(reader.iter_messages()) == []


def test_pictures_that_are_alike_are_stored_once() -> None:
    rng = np.random.default_rng(6)
    still = rng.integers(0, 2**16, (240, 320)).astype("<u2")
    pictures = []
    for k in range(10):
        picture = still.copy()
        picture[20 + k : 40 + k, 30:60] = k
        pictures.append(picture.tobytes())
    size = len(written([("/a", k, data) for k, data in enumerate(pictures)], 10**9).getvalue())
    assert size < 1.2 * len(pictures[0])


def log_all(file: McapLog, told: Said) -> None:
    for topic in ("/a", "/b"):
        file.declare(topic, ONE if topic == "/a" else OTHER)
    for topic, time_ns, data in told:
        file.log(topic, ONE if topic == "/a" else OTHER, parts(data), time_ns)


@pytest.mark.parametrize("first_topics", ["/a", "/b", "/a/b"])
def test_a_file_that_was_cut_after_a_flush_is_resumed_and_shards_are_appended(
    tmp_path: Path, first_topics: str
) -> None:
    told = [one for one in said(20) if one[0] in first_topics]
    pieces, place = [told, said(30)[20:], said(50)[30:]], tmp_path / "log.mcap"
    settings: dict[str, Any] = {"profile": "p", "library": "l", "level": 1, "chunk_size": 4_000}
    for k, piece in enumerate(pieces[:2]):  # a first run that was killed, and a shard
        with (tmp_path / f"{k}.mcap").open("wb") as sink:
            file = McapLog(sink, **settings)
            log_all(file, piece)
            file.flush()
        append_chunks(tmp_path / f"{k}.mcap", place)
    with place.open("a+b") as sink:
        file = McapLog(sink, **settings, written=sink)
        log_all(file, pieces[2])
        file.close()
    with place.open("rb") as whole:
        reader = make_reader(whole, validate_crcs=True)
        found = [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in reader.iter_messages()
        ]
        summary = reader.get_summary()
    assert found == sorted([one for piece in pieces for one in piece], key=lambda one: one[1])
    assert summary is not None
    assert summary.statistics is not None
    counts = {
        c.topic: summary.statistics.channel_message_counts[i] for i, c in summary.channels.items()
    }
    assert counts == Counter(topic for topic, _, _ in found)
    with place.open("rb") as whole:
        walked = StreamReader(whole, validate_crcs=True).records
        assert sum(type(record).__name__ == "Message" for record in walked) == len(found)


def test_a_log_that_is_cut_within_a_record_is_not_resumed(tmp_path: Path) -> None:
    place = tmp_path / "log.mcap"
    place.write_bytes(written(said()).getvalue()[:-500])
    with place.open("a+b") as sink, pytest.raises(SessionError, match="not written whole"):
        McapLog(sink, profile="p", library="l", level=1, chunk_size=1, written=sink)
