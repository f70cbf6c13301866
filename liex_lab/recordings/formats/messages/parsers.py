"""Which parser turns a channel's messages into ours."""

from __future__ import annotations

from liex_lab.recordings.formats.messages.message_file import Channel
from liex_lab.recordings.formats.messages.messages import (
    CALIBRATION_SCHEMAS,
    CLOUD_SCHEMAS,
    PICTURE_SCHEMAS,
    UNIT_SCHEMA,
    UNIT_TOPIC,
    Parser,
)


def plain_schema(channel: Channel) -> str:
    """A schema's name without the 'msg' that ROS 2 puts into it."""
    return channel.schema.replace("/msg/", "/")


def parser_of(channel: Channel) -> Parser | None:
    """What turns this channel's messages into ours; None for messages that say nothing
    about depth.
    """
    schema = plain_schema(channel)
    if schema == UNIT_SCHEMA and not channel.topic.endswith(UNIT_TOPIC):
        return None
    if schema not in (*PICTURE_SCHEMAS, *CLOUD_SCHEMAS, *CALIBRATION_SCHEMAS, UNIT_SCHEMA):
        return None
    if schema.startswith("foxglove."):
        from liex_lab.recordings.formats.messages import foxglove

        return foxglove.parser(schema, channel.encoding)
    from liex_lab.recordings.formats.messages import ros

    return ros.parser(schema, channel.encoding)
