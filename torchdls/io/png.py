"""Whether a PNG is whole, before a decoder that is not made for damage sees it (PNG specification, W3C 2003)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from torchdls.io.containers import check_declared

_CHANNELS = {0: 1, 2: 3, 6: 4}
_PASSES = {
    0: ((0, 0, 1, 1),),
    1: ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)),
}


def check_png(path: Path) -> None:
    """ValueError unless chunks, checksums and compressed data of a picture of 8 or 16 bits are whole and agree.

    Gray, colours, and colours with alpha; the data must unpack to exactly the rows that the header declares.
    """
    header, data = b"", []
    for kind, body in _chunks(path.read_bytes()):
        if kind == b"IHDR":
            header = body
        elif kind == b"IDAT":
            data.append(body)
    width, height, depth, color, *rest = struct.unpack(">IIBBBBB", header)
    if not width or not height or rest not in ([0, 0, 0], [0, 0, 1]):
        raise ValueError("its header is damaged")
    pixel = depth // 8 * _CHANNELS[color]
    sizes = [(-(-(width - x) // dx), -(-(height - y) // dy)) for x, y, dx, dy in _PASSES[rest[2]]]
    blocks = [(1 + pixel * w, h) for w, h in sizes if w > 0 and h > 0]
    declared = sum(row * rows for row, rows in blocks)
    packed = b"".join(data)
    check_declared(declared, len(packed))
    raw = zlib.decompressobj().decompress(packed, declared + 1)
    if len(raw) != declared:
        raise ValueError("its compressed data is not whole")
    at = 0
    for row, rows in blocks:
        if max(raw[at : at + row * rows : row]) > 4:  # each row begins with its filter
            raise ValueError("its compressed data is damaged")
        at += row * rows


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 8
    while at + 12 <= len(content):
        (size,) = struct.unpack_from(">I", content, at)
        kind, body = content[at + 4 : at + 8], content[at + 8 : at + 8 + size]
        if len(body) < size or content[at + 8 + size : at + 12 + size] != zlib.crc32(kind + body).to_bytes(4):
            raise ValueError("one of its chunks is cut or damaged")
        yield kind, body
        at += 12 + size
        if kind == b"IEND":
            return
    raise ValueError("its end is missing")
