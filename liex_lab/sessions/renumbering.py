"""Rewriting of an MCAP file with other channel and schema ids.

Foxglove's writer numbers channels as they come; the last part of a log that has no depth begins
with others than the parts before it, to which it is to be joined (see `liex_lab.sessions.joining`).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, IndexType, Writer

_CHUNK_BYTES = 128 * 1024
Known = tuple[list[Schema], list[Channel]]


def renumber(path: Path, first: Known, last: Known, out: Path) -> Known:
    """Write an MCAP file again with the channel and schema ids of another one.

    What only the file itself knows gets ids of its own, beyond those taken.

    Args:
        path: the MCAP file.
        first: schemas and channels with the wanted ids.
        last: schemas and channels of `path`.
        out: the file to write.

    Returns:
        Schemas and channels of both, as `out` has them.
    """
    schemas, schema_of = _joined(first[0], last[0], "name")
    channels, channel_of = _joined(first[1], last[1], "topic")
    ours = {channel.id for channel in first[1]}
    channels = [
        channel
        if channel.id in ours
        else replace(channel, schema_id=schema_of.get(channel.schema_id, 0))
        for channel in channels
    ]
    with path.open("rb") as source, out.open("wb") as target:
        writer = Writer(target, _CHUNK_BYTES, CompressionType.ZSTD, IndexType.ALL)
        writer.start(profile="liex_lab")
        for schema in sorted(schemas, key=lambda one: one.id):
            assert writer.register_schema(schema.name, schema.encoding, schema.data) == schema.id
        for channel in sorted(channels, key=lambda one: one.id):
            assert (
                writer.register_channel(
                    channel.topic, channel.message_encoding, channel.schema_id, channel.metadata
                )
                == channel.id
            )
        for _, channel, message in make_reader(source).iter_messages(log_time_order=False):
            writer.add_message(
                channel_of[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
        writer.finish()
    return schemas, channels


def _joined(first: list, last: list, name: str) -> tuple[list, dict[int, int]]:
    """All records of both lists, and the new id of each one of `last`.

    Records of `last` that `first` does not have get new ids.
    """
    joined = {getattr(one, name): one for one in first}
    ids = {}
    for one in last:
        key = getattr(one, name)
        if key not in joined:
            joined[key] = replace(
                one, id=max((known.id for known in joined.values()), default=0) + 1
            )
        ids[one.id] = joined[key].id
    return list(joined.values()), ids
