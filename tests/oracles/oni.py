"""The 16z code of .oni files as OpenNI's own decoder reads it: slow, and what the fast code is
tested against.
"""

import numpy as np


def unpack_16z(stream: bytes) -> list[int]:
    """The numbers of a whole stream; IndexError where it ends in the middle of one."""
    at, out = 2, [stream[0] | stream[1] << 8]
    while at < len(stream):
        byte, at = stream[at], at + 1
        if 0xE0 <= byte < 0xFF:  # a run of unchanged pixels, counted in pairs
            out += [out[-1]] * (2 * (byte - 0xE0))
            continue
        low = 15
        if byte != 0xFF:  # two steps of -6..6; 13 in the second is padding
            out.append((out[-1] - (byte >> 4) + 6) & 0xFFFF)
            low = byte & 15
            if low not in (13, 15):
                out.append((out[-1] - low + 6) & 0xFFFF)
        if low == 15:  # a wide step, or a whole number, high byte first
            byte, at = stream[at], at + 1
            if byte & 0x80:
                out.append((out[-1] - byte + 192) & 0xFFFF)
            else:
                out.append(byte << 8 | stream[at])
                at += 1
    return out


def unpack_frame(payload: bytes, codec: str) -> list[int]:
    """The depths of a frame, as stored, of any of the three codecs."""
    if codec == "NONE":
        return np.frombuffer(payload, "<u2").tolist()
    if codec == "16zP":
        return unpack_16z(payload)
    n = payload[0] | payload[1] << 8
    table = np.frombuffer(payload, "<u2", n, 2)
    return [int(table[index]) for index in unpack_16z(payload[2 + 2 * n :])]
