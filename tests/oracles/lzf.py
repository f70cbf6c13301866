"""LZF unpacked one byte at a time, as a reader of its description would."""


def unpack_lzf(packed: bytes) -> bytes:
    """The bytes that were packed; IndexError where the data are cut, ValueError where they point
    before the start.
    """
    out, at = bytearray(), 0
    while at < len(packed):
        control = packed[at]
        at += 1
        if control < 32:
            for _ in range(control + 1):
                out.append(packed[at])
                at += 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[at]
            at += 1
        distance = (control & 31) * 256 + packed[at] + 1
        at += 1
        if distance > len(out):
            raise ValueError("a copy from before the start")
        for _ in range(length + 2):
            out.append(out[-distance])
    return bytes(out)
