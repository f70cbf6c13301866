"""Choice of the parser of a channel's messages, by schema and encoding.

Foxglove's schemas go to `foxglove` (protobuf, JSON), ROS's to `ros` (ROS 1, CDR).
"""

from __future__ import annotations

from collections.abc import Callable

from liex_lab.recordings.formats.messages.message_file import Channel
from liex_lab.recordings.formats.messages.messages import (
    CALIBRATION_SCHEMAS,
    CLOUD_SCHEMAS,
    PICTURE_SCHEMAS,
    STATEMENT_SCHEMAS,
    Parser,
)
from liex_lab.recordings.formats.messages.realsense import STATES


def plain_schema(channel: Channel) -> str:
    """Name of a schema without the 'msg' that ROS 2 puts into it.

    Args:
        channel: topic, schema and encoding.

    Returns:
        The name, such as "sensor_msgs/Image".
    """
    return channel.schema.replace("/msg/", "/")


def parser_of(channel: Channel) -> Parser | None:
    """The function that turns a channel's messages into ours.

    Args:
        channel: topic, schema and encoding.

    Returns:
        The parser; None for messages that say nothing about depth.
    """
    schema = plain_schema(channel)
    if schema in STATEMENT_SCHEMAS and not STATES.search(channel.topic):
        return None
    if schema not in (
        *PICTURE_SCHEMAS,
        *CLOUD_SCHEMAS,
        *CALIBRATION_SCHEMAS,
        *STATEMENT_SCHEMAS,
    ):
        return None
    if schema.startswith("foxglove."):
        from liex_lab.recordings.formats.messages import foxglove

        return foxglove.parser(schema, channel.encoding)
    from liex_lab.recordings.formats.messages import ros

    return ros.parser(schema, channel.encoding)


def stamp_reader(channel: Channel) -> Callable[[memoryview], int | None] | None:
    """The function that reads the sensor's stamp, ns, from the first bytes of a channel's messages.

    It says what the channel's parser does of the whole message, or None where these bytes do not
    tell.

    Args:
        channel: topic, schema and encoding.

    Returns:
        The function; None for messages that hold no depth, or whose beginning tells nothing.
    """
    schema = plain_schema(channel)
    if schema not in (*PICTURE_SCHEMAS, *CLOUD_SCHEMAS):
        return None
    if schema.startswith("foxglove."):
        from liex_lab.recordings.formats.messages import foxglove

        return foxglove.stamp_in if channel.encoding == "protobuf" else None
    from liex_lab.recordings.formats.messages import ros

    return ros.stamp_reader(channel.encoding)
