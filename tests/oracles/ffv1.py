"""The check sum of FFV1 slices, one bit at a time: polynomial 0x04C11DB7, high bit first, from
zero.
"""


def remainder(data: bytes) -> int:
    """What is left of the data, 0 for a slice that holds its own check sum."""
    rest = 0
    for byte in data:
        for bit in range(7, -1, -1):
            top = rest >> 31 ^ byte >> bit & 1
            rest = (rest << 1 & 0xFFFFFFFF) ^ (0x04C11DB7 if top else 0)
    return rest


def slices_agree(data: bytes) -> bool:
    """Whether the slices of a picture, from its last byte backwards, all have a remainder of 0."""
    while len(data) > 8:
        size = int.from_bytes(data[-8:-5], "big")
        if size + 8 > len(data) or remainder(data[len(data) - size - 8 :]):
            return False
        data = data[: len(data) - size - 8]
    return not data
