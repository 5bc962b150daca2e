"""Numeric arrays of MAT files, version 5 (`save` of MATLAB up to -v7, and of Octave, SciPy).

SciPy reads these files too, but a damaged one can end the process with a bus error, so its reader is not for files
from anywhere. What is needed of the format is short: after 128 bytes of header come elements, each a tag (type, size)
and its bytes, alone or in a zlib stream; a matrix holds the elements flags, dimensions, name, and values column by
column, in a type that may be narrower than the matrix is (MAT-File Format, The MathWorks, 2019).
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from torchdls._files import Array
from torchdls.io.containers import Archive, check_declared

_COMPRESSED, _MATRIX = 15, 14
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_LOGICAL, _COMPLEX = 0x200, 0x800
_HEAD = 4096  # bytes of a matrix in which its name and dimensions must lie


class _Matrix(NamedTuple):
    """Where a numeric matrix lies in the file, and where its values lie in it."""

    name: str
    at: int
    size: int
    packed: bool
    shape: tuple[int, ...]
    dtype: np.dtype[np.generic]
    stored: np.dtype[np.generic]
    start: int


def open_mat(path: Path) -> Archive:
    """The numeric arrays of a MAT file; ValueError if it is damaged or of version 7.3."""
    with open(path, "rb") as file:
        head = file.read(128)
        if head[124:128] not in (b"\x00\x01IM", b"\x01\x00MI"):
            late = "it is of version 7.3; store it with save(..., '-v7')" if b"7.3" in head[:16] else "damaged header"
            raise ValueError(late)
        order = "<" if head.endswith(b"IM") else ">"
        found = {matrix.name: matrix for matrix in _matrices(file, order)}
    return Archive(path, "MAT", list(found), lambda name: _values(path, found[name]))


def _matrices(file: BinaryIO, order: str) -> Iterator[_Matrix]:
    end = os.fstat(file.fileno()).st_size
    at = 128
    while at + 8 <= end:
        file.seek(at)
        kind, size = struct.unpack(order + "II", file.read(8))
        if kind not in (_COMPRESSED, _MATRIX) or at + 8 + size > end:
            raise ValueError("a part of it is cut or damaged")
        head = file.read(min(size, _HEAD))
        skip = 0
        if kind == _COMPRESSED:
            head = zlib.decompressobj().decompress(head, _HEAD)
            skip = 8  # the tag of the matrix is in the stream
        matrix = _matrix(head, skip, order)
        if matrix is not None:
            yield matrix._replace(at=at + 8, size=size, packed=kind == _COMPRESSED)
        at += 8 + size


def _matrix(head: bytes, at: int, order: str) -> _Matrix | None:
    """The matrix that begins so, or None if it is not one of real numbers."""
    _, _, start, at = _tag(head, at, order)
    (flags,) = struct.unpack_from(order + "I", head, start)
    if flags & 255 not in _CLASSES or flags & _COMPLEX:
        return None
    _, size, start, at = _tag(head, at, order)
    shape = struct.unpack_from(f"{order}{size // 4}i", head, start)
    _, size, start, at = _tag(head, at, order)
    name = head[start : start + size].decode("ascii")
    kind, size, start, _ = _tag(head, at, order)
    dtype = np.dtype(bool if flags & _LOGICAL else order + _CLASSES[flags & 255])
    stored = np.dtype(order + _STORED[kind])
    if min(shape, default=-1) < 0 or math.prod(shape) * stored.itemsize != size or not name.isidentifier():
        raise ValueError("the header of a matrix is damaged")
    return _Matrix(name, 0, 0, False, shape, dtype, stored, start)


def _tag(data: bytes, at: int, order: str) -> tuple[int, int, int, int]:
    """Type, size, first byte of an element, and where the next one begins; short elements share the tag's 8 bytes."""
    kind, size = struct.unpack_from(order + "II", data, at)
    if kind >> 16:
        return kind & 0xFFFF, kind >> 16, at + 4, at + 8
    return kind, size, at + 8, at + 8 + -(-size // 8) * 8


def _values(path: Path, matrix: _Matrix) -> Array:
    count = math.prod(matrix.shape)
    size = matrix.start + count * matrix.stored.itemsize
    if matrix.packed:
        check_declared(size, matrix.size)
    else:
        check_declared(size, matrix.size, ratio=1)
    with open(path, "rb") as file:
        file.seek(matrix.at)
        content = file.read(matrix.size if matrix.packed else size)
    if matrix.packed:
        stream = zlib.decompressobj()
        content = stream.decompress(content, size)
        stream.decompress(stream.unconsumed_tail, 64)  # at the end of the stream its checksum is compared
        if not stream.eof:
            raise ValueError("its end is missing")
    values = np.frombuffer(content, matrix.stored, count, matrix.start)
    return values.reshape(matrix.shape[::-1]).T.astype(matrix.dtype)
