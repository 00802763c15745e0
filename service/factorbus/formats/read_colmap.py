"""Read the poses of a COLMAP model: its images.txt or images.bin, or the folder with one of them.

    IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME        in images.txt, then a line with what the image sees, often empty

A pose there takes coordinates of the world to the camera; here it is the inverse, where the camera is.  x7 is image 7.
Names that are times (1403636579763555584.png in nanoseconds, 1305031452.791720.png in seconds) become time stamps.
"""

import re
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from factorbus.formats.errors import FormatError, refuse_first
from factorbus.formats.graph import GraphFile
from factorbus.formats.lines import read_content
from factorbus.formats.rotations import inverse_poses, normalized_poses
from factorbus.formats.seconds import nanoseconds
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.symbols import symbol
from factorbus.wording import counted

COLMAP = "colmap"
TEXT, BINARY = "images.txt", "images.bin"
_HEAD, _COUNT, _SEEN = struct.Struct("<I7dI"), struct.Struct("<Q"), 24
_FIELDS = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_NANOSECONDS, _SECONDS = re.compile(r"\d{18,19}"), re.compile(r"\d{1,10}\.\d{1,9}")


class _Image(NamedTuple):
    line: int  # of a text file; 0 of a binary one
    number: int
    values: tuple[float, ...]  # qw qx qy qz tx ty tz
    name: str


def is_colmap(path: Path) -> bool:
    """Whether it is such a file, by its name, or a folder that has one."""
    return path.name in (TEXT, BINARY) or any((path / name).is_file() for name in (BINARY, TEXT))


def read_colmap(path: Path) -> GraphFile:
    """The poses as x1, x2, ... by the numbers of their images; there are no factors.  Raises FormatError."""
    if path.is_dir():
        path = next((path / name for name in (BINARY, TEXT) if (path / name).is_file()), path / TEXT)
    file, content = str(path), read_content(path)
    images = sorted(_text(file, content) if path.name != BINARY else _binary(file, content), key=lambda each: each[1])
    if not images:
        raise FormatError(file, None, "no image", f"lines such as {_FIELDS}")
    numbers = np.array([each.number for each in images], np.int64)
    lines = np.array([each.line for each in images], np.int64)
    twice = np.r_[False, numbers[1:] == numbers[:-1]]
    refuse_first(file, lines, twice, lambda row: f"image {numbers[row]} a second time", "each image once")
    rows = np.array([each.values for each in images])
    refuse_first(file, lines, ~np.isfinite(rows).all(axis=1), lambda row: f"image {numbers[row]} not finite", "numbers")
    of_world = np.concatenate([rows[:, 4:], rows[:, 1:4], rows[:, :1]], axis=1)
    poses = np.ascontiguousarray(inverse_poses(normalized_poses(file, "a COLMAP image", lines, of_world)))
    stamps = _stamps(file, images)
    note = f"{counted(len(images), 'image')} read as poses of cameras; the scale is COLMAP's, which need not be metres"
    group = Variables("se3", symbol("x", 0) + numbers, poses, False, stamps)
    return GraphFile(file, COLMAP, Batch((group,)), (), (note,))


def _text(file: str, content: bytes) -> list[_Image]:
    """Every second line that is no comment is what an image sees, and may be empty."""
    found, begun = [], False
    for line, text in enumerate(content.split(b"\n"), 1):
        words = text.split()
        if words[:1] and words[0].startswith(b"#"):
            continue
        if begun:
            begun = False
        elif words:
            found.append(_image(file, line, words))
            begun = True
    return found


def _image(file: str, line: int, words: list[bytes]) -> _Image:
    try:
        if len(words) < 10:
            raise ValueError
        number, values = int(words[0]), tuple(float(each) for each in words[1:8])
        if not 0 <= number < 2**32:
            raise ValueError
    except ValueError:
        shown = b" ".join(words[:10])[:60].decode("ascii", "backslashreplace")
        raise FormatError(file, line, f"{shown!r}", f"{_FIELDS}, and below it what the image sees") from None
    return _Image(line, number, values, b" ".join(words[9:]).decode("utf-8", "backslashreplace"))


def _binary(file: str, content: bytes) -> list[_Image]:
    at, found = _COUNT.size, []
    try:
        (count,) = _COUNT.unpack_from(content)
        while len(found) < count:
            number, *values, _ = _HEAD.unpack_from(content, at)
            end = content.index(b"\0", at + _HEAD.size)
            name = content[at + _HEAD.size : end].decode("utf-8", "backslashreplace")
            (seen,) = _COUNT.unpack_from(content, end + 1)
            at = end + 1 + _COUNT.size + _SEEN * seen
            if at > len(content):
                raise ValueError
            found.append(_Image(0, number, tuple(values), name))
    except (struct.error, ValueError):
        wanted = f"{TEXT} or {BINARY} as COLMAP writes them"
        raise FormatError(file, None, f"it ends within image {len(found) + 1} of it", wanted) from None
    return found


def _stamps(file: str, images: list[_Image]) -> I64 | None:
    """Of the names, if each of them is a time."""
    stems = [Path(each.name).stem for each in images]
    if all(_NANOSECONDS.fullmatch(each) for each in stems) and all(int(each) < 2**63 for each in stems):
        return np.array([int(each) for each in stems], np.int64)
    if all(_SECONDS.fullmatch(each) for each in stems):
        return np.array(
            [nanoseconds(file, each.line, stem) for each, stem in zip(images, stems, strict=True)], np.int64
        )
    return None
