"""The last part of an MCAP file with its channels and schemas numbered as in the parts before it.

Foxglove's writer numbers them as they come; a part without depth begins with others.
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
    """Write the MCAP file `path`, which knows what `last` holds, to `out` in the numbers of
    `first`; returns all known.

    What only the last part knows gets numbers of its own.
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
    """All records, those of `last` that `first` does not have with new ids; and the new id of each
    one of `last`.
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
