"""Arrays in NPY and NPZ files, read one at a time and never larger than the file can hold; and written."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
from numpy.lib import format as npy

from torchdls._files import Array, naming

# No compression that is read here makes less than a byte of 1,100 (deflate: 1,032); below 64 MB any claim is harmless.
RATIO, HARMLESS = 1100, 2**26


def check_declared(declared: int, stored: int, ratio: int = RATIO) -> None:
    """ValueError for content that the bytes of the file cannot hold, before memory is asked for it."""
    if declared > max(ratio * stored, HARMLESS if ratio > 1 else 0):
        raise ValueError(f"it declares {declared:,} bytes of content, more than its {stored:,} bytes can hold")


def read_npy(path: Path) -> Array:
    """The array of an NPY file."""
    with open(path, "rb") as file:
        return _read_array(file, os.fstat(file.fileno()).st_size)


def _read_array(file: IO[bytes], size: int) -> Array:
    """One array in the NPY format out of `size` bytes; its header is believed only as far as they reach."""
    try:
        version = npy.read_magic(file)
        read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        shape, column_major, dtype = read_header(file)
    except Exception:  # the parser of Python reads it, and has many words for what it is not
        raise ValueError("its header is damaged") from None
    if dtype.kind not in "bfiu":
        raise ValueError(f"its entries are {dtype}, numbers are needed")
    count, left = math.prod(shape), size - file.tell()
    if min(shape, default=0) < 0:
        raise ValueError(f"its shape is {shape}")
    check_declared(count * dtype.itemsize, left, ratio=1)
    content = bytearray(count * dtype.itemsize)
    if file.readinto(content) != len(content):  # type: ignore[attr-defined]
        raise ValueError("its end is missing")
    array = np.frombuffer(content, dtype, count).reshape(shape[::-1] if column_major else shape)
    return array.T if column_major else array


class Archive(Mapping[str, Array]):
    """The arrays of a file by name, each read when it is asked for: what nobody asks for is never unpacked."""

    def __init__(self, path: Path, form: str, names: list[str], read: Callable[[str], Array]) -> None:
        self._path, self._form, self._names, self._read = path, form, names, read

    def __getitem__(self, name: str) -> Array:
        """The array of that name; ValueError, naming the file, if it is damaged."""
        if name not in self._names:
            raise KeyError(name)
        with naming(self._path, f"{self._form}, {name}"):
            return self._read(name)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def write_npz(file: BinaryIO, arrays: Mapping[str, Array]) -> None:
    """The arrays as an NPZ file, deflated at the quickest level: 2.8 times as quick as NumPy's, 1 % larger."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                npy.write_array(member, np.asanyarray(array), allow_pickle=False)


def open_npz(path: Path) -> Archive:
    """The arrays of an NPZ file."""
    with zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info.filename for info in archive.infolist()}

    def read(name: str) -> Array:
        with zipfile.ZipFile(path) as archive:
            info = archive.getinfo(members[name])
            if info.flag_bits & 1:
                raise ValueError("it is encrypted")
            stored = info.compress_type == zipfile.ZIP_STORED
            packed = min(info.compress_size, os.path.getsize(path))
            check_declared(info.file_size, packed, ratio=1 if stored else RATIO)
            with archive.open(info) as file:
                array = _read_array(file, info.file_size)
                file.read(1)  # at the end of a member its checksum is compared
                return array

    return Archive(path, "NPZ", list(members), read)
