"""Our MCAP files are what the format's own library reads, whole or cut after any flush."""

import io
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from liex_lab.errors import SessionError
from liex_lab.sessions.checkpoint import append_chunks
from liex_lab.sessions.mcap import McapLog

TOPICS = {
    "/a": ("one", "jsonschema", b"{}", "json"),
    "/b": ("other", "jsonschema", b'{"type": "object"}', "json"),
}
Messages = list[tuple[str, int, bytes]]


def messages(n: int = 60) -> Messages:
    """Messages of two topics, out of turn, of 0 to 3,000 bytes that compress and that do not."""
    rng = np.random.default_rng(5)
    made = []
    for k in range(n):
        data = rng.bytes(k * 50) if k % 3 else bytes(k * 50)
        made.append((f"/{'ab'[k % 2]}", int(rng.integers(1, 10**12)), data))
    return made


def new_log(sink: Any, chunk_size: int = 4_000, **settings: Any) -> McapLog:
    return McapLog(sink, TOPICS, library="l", chunk_size=chunk_size, **{"level": 1, **settings})


def log_all(file: McapLog, made: Messages) -> None:
    for topic, time_ns, data in made:  # in two parts, either of which may be empty
        file.log(topic, [data[:70], memoryview(data)[70:]], time_ns)


def written(made: Messages, flush_at: int = 0, **settings: Any) -> io.BytesIO:
    sink = io.BytesIO()
    file = new_log(sink, **settings)
    log_all(file, made[:flush_at])
    for _ in range(2 if flush_at else 0):  # what does not wait is not written
        file.flush()
    log_all(file, made[flush_at:])
    file.close()
    sink.seek(0)
    return sink


def in_order_of_time(file: BinaryIO) -> Messages:
    reader = make_reader(file, validate_crcs=True)
    found = [(channel.topic, one.log_time, one.data) for _, channel, one in reader.iter_messages()]
    file.seek(0)
    return found


@pytest.mark.parametrize(
    "settings",
    [
        *({"chunk_size": size, "level": 19} for size in (1, 10**9)),
        *({"window": window} for window in (1, 1 << 33)),
    ],
    ids=str,
)
def test_every_message_is_found_by_the_index_in_the_order_of_time(settings: dict[str, int]) -> None:
    made = messages()
    file = written(made, **settings)
    assert in_order_of_time(file) == sorted(made, key=lambda one: one[1])
    summary = make_reader(file).get_summary()
    file.seek(0)
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(made)
    assert summary.statistics.message_start_time == min(one[1] for one in made)
    assert summary.statistics.message_end_time == max(one[1] for one in made)
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count
    expected = {name: data for name, _, data, _ in TOPICS.values()}
    assert {s.name: s.data for s in summary.schemas.values()} == expected
    names = [type(one).__name__ for one in StreamReader(file, validate_crcs=True).records]
    assert (names[0], names[-1], names.count("Message")) == ("Header", "Footer", 60)
    assert "Message" not in names[names.index("DataEnd") :]


def test_a_file_that_ends_after_a_flush_contains_the_messages_before_it() -> None:
    made = messages()
    whole = io.BytesIO()
    file = new_log(whole, 10**9)
    log_all(file, made[:25])
    file.flush()
    log_all(file, made[25:])
    found = []
    with suppress(McapError, EOFError):  # it has no end
        for record in StreamReader(io.BytesIO(whole.getvalue()), validate_crcs=True).records:
            if type(record).__name__ == "Message":
                found.append(record.data)  # type: ignore[attr-defined]
    assert found == [data for _, _, data in made[:25]]


def test_the_same_messages_and_flushes_are_the_same_bytes() -> None:
    made = messages()
    assert written(made, flush_at=7).getvalue() == written(made, flush_at=7).getvalue()
    assert in_order_of_time(written([])) == []


def test_similar_images_are_stored_once() -> None:
    rng = np.random.default_rng(6)
    still = rng.integers(0, 2**16, (240, 320)).astype("<u2")
    images = []
    for k in range(10):
        image = still.copy()
        image[20 + k : 40 + k, 30:60] = k
        images.append(image.tobytes())
    file = written([("/a", k, data) for k, data in enumerate(images)], chunk_size=10**9)
    assert len(file.getvalue()) < 1.2 * len(images[0])


@pytest.mark.parametrize("first_topics", ["/a", "/b", "/a/b"])
def test_a_file_that_was_cut_after_a_flush_is_resumed_and_shards_are_appended(
    tmp_path: Path, first_topics: str
) -> None:
    first = [one for one in messages(20) if one[0] in first_topics]
    pieces, place = [first, messages(30)[20:], messages(50)[30:]], tmp_path / "log.mcap"
    for k, piece in enumerate(pieces[:2]):  # a first run that was killed, and a shard
        with (tmp_path / f"{k}.mcap").open("wb") as sink:
            file = new_log(sink)
            log_all(file, piece)
            file.flush()
        append_chunks(tmp_path / f"{k}.mcap", place)
    with place.open("a+b") as sink:
        file = new_log(sink, resume=True)
        log_all(file, pieces[2])
        file.close()
    with place.open("rb") as whole:
        found = in_order_of_time(whole)
        assert found == sorted([one for part in pieces for one in part], key=lambda one: one[1])
        summary = make_reader(whole).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        counts = summary.statistics.channel_message_counts
        of_topics = {channel.topic: counts[i] for i, channel in summary.channels.items()}
        assert of_topics == Counter(topic for topic, _, _ in found)
        whole.seek(0)
        walked = StreamReader(whole, validate_crcs=True).records
        assert sum(type(record).__name__ == "Message" for record in walked) == len(found)


def test_a_log_that_is_cut_within_a_record_is_not_resumed() -> None:
    cut = io.BytesIO(written(messages()).getvalue()[:-500])
    with pytest.raises(SessionError, match="not written whole"):
        new_log(cut, resume=True)
