"""What a database's log lost: SQLite reads it up to the first frame that is not whole, and is silent on the rest.

After a power cut that is right: the last transaction was being written, and had not been confirmed.  But each one is
made safe before the next begins.  So the log was damaged, and lost what was confirmed, where after the first frame that
is not whole

    two more transactions end    the first of them had been safe before the second was written
    the log's index has more     it counts a transaction once that is safe (a process that is killed leaves the index)

https://www.sqlite.org/fileformat2.html#the_write_ahead_log, https://www.sqlite.org/walformat.html
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

_MAGIC, _VERSION = 0x377F0682, 3007000  # the magic's last bit: checksums are of big-endian words
_HEAD, _FRAME_HEAD = 32, 24
_INDEX = np.dtype([("head", "V12"), ("begun", "u1"), ("order", "u1"), ("page", "<u2"), ("frames", "<u4"),
                   ("sizes", "V12"), ("salt", "V8"), ("checksum", "<u4", 2)])  # fmt: skip
_STEP = np.array([[1, 1], [1, 2]], np.uint64)  # (s₀, s₁) → (s₀ + s₁, s₀ + 2 s₁), and of the words:
_WORDS = np.array([[1, 0], [1, 1]], np.uint64)
_U32 = np.uint64(0xFFFFFFFF)
_AT_ONCE = 256  # frames
_INDEX_HEAD = 2 * _INDEX.itemsize + 4
_TRIES = 10


class _Log(NamedTuple):
    """A log's frames: their salts and ends of transactions, and how many are whole, up to the end of a transaction."""

    salt: bytes
    salts: list[bytes]
    ends: list[bool]
    whole: int


def lost_from(database: Path) -> str:
    """What the log of `database` lost, in words; empty where nothing tells that it lost anything."""
    log_file, index_file = (database.with_name(f"{database.name}-{end}") for end in ("wal", "shm"))
    for _ in range(_TRIES):
        index = _content(index_file, _INDEX_HEAD)
        lost = _lost(_read_log(_content(log_file)), *_counted(index))
        if not lost or _content(index_file, _INDEX_HEAD) == index:
            return lost
    return ""  # somebody writes it, and has what is before


def _lost(log: _Log, salt: bytes, counted: int) -> str:
    """salt, counted: the log's, by its index."""
    after = [salt for salt, ends in zip(log.salts[log.whole :], log.ends[log.whole :], strict=True) if ends]
    if (ends := after.count(log.salt) if log.salt else _most(after)) > 1:
        where = f"frame {log.whole + 1}" if log.salt else "its head"
        return f"its log is not whole from {where} on, after which {ends} transactions ended"
    if counted > log.whole and log.salt in (salt, b""):
        return f"its log has {log.whole} frames that are whole, and had {counted}"
    return ""


def _most(salts: list[bytes]) -> int:
    return max(map(salts.count, set(salts)), default=0)


def _content(path: Path, most: int = -1) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(most)
    except FileNotFoundError:
        return b""


def _read_log(content: bytes) -> _Log:
    head = np.frombuffer(content[:_HEAD].ljust(_HEAD, b"\0"), ">u4")
    magic, version, page = (int(number) for number in head[:3])
    known = (magic & ~1, version) == (_MAGIC, _VERSION) and page in (512 << n for n in range(8))
    page = page if known else 4096
    words = np.dtype(">u4" if magic & 1 else "<u4")
    begin = _sums(np.frombuffer(head[:6].tobytes(), words).reshape(1, -1), np.zeros(2, np.uint64))[0]
    known = known and begin.tolist() == head[6:].tolist()
    size = _FRAME_HEAD + page
    count = max(len(content) - _HEAD, 0) // size
    frames = np.frombuffer(content, np.uint8, count * size, min(_HEAD, len(content))).reshape(count, size)
    heads = np.ascontiguousarray(frames[:, :_FRAME_HEAD]).view(">u4")
    salts = [bytes(row) for row in frames[:, 8:16]]
    ends = [bool(first) and bool(last) for first, last in heads[:, :2].tolist()]
    if not known:
        return _Log(b"", salts, ends, 0)
    salt, whole = head[4:6].tobytes(), 0
    for number, (sums, right) in enumerate(zip(_each(frames, words, begin), heads[:, 4:], strict=False)):
        if salts[number] != salt or sums.tolist() != right.tolist():
            break
        whole = number + 1 if ends[number] else whole
    return _Log(salt, salts, ends, whole)


def _each(frames: np.ndarray, words: np.dtype, begin: np.ndarray) -> Iterator[np.ndarray]:
    """The checksum of each frame."""
    for first in range(0, len(frames), _AT_ONCE):
        some = frames[first : first + _AT_ONCE]
        summed = np.concatenate([some[:, :8], some[:, _FRAME_HEAD:]], axis=1).view(words)
        sums = _sums(summed, begin)
        begin = sums[-1]
        yield from sums


def _sums(words: np.ndarray, begin: np.ndarray) -> np.ndarray:
    """Checksums after each row of words (n, 2m), one going on from the other: s₀ += x₀ + s₁, s₁ += x₁ + s₀."""
    pairs = words.shape[1] // 2
    weights, power = _weights(pairs)
    added = np.einsum("nmj,mkj->nk", words.reshape(-1, pairs, 2).astype(np.uint64), weights) & _U32
    sums, present = np.empty_like(added), begin
    for row, more in enumerate(added):
        present = sums[row] = (power @ present + more) & _U32
    return sums


@cache
def _weights(pairs: int) -> tuple[np.ndarray, np.ndarray]:
    """What each pair of words adds to the sums at the end of a row (m, 2, 2), and what the sums before it add."""
    weights, power = np.empty((pairs, 2, 2), np.uint64), np.eye(2, dtype=np.uint64)
    for at in reversed(range(pairs)):
        weights[at] = power @ _WORDS & _U32
        power = power @ _STEP & _U32
    return weights, power


def _counted(content: bytes) -> tuple[bytes, int]:
    """The log's salt and frames by its index, but those that are in the database already; 0: it does not say."""
    size = _INDEX.itemsize
    if len(content) < _INDEX_HEAD or content[:size] != content[size : 2 * size]:
        return b"", 0
    (index,) = np.frombuffer(content, _INDEX, 1)
    (sums,) = _sums(np.frombuffer(content, "<u4", 10).reshape(1, -1), np.zeros(2, np.uint64))
    if not index["begun"] or sums.tolist() != index["checksum"].tolist():
        return b"", 0
    put_in = int.from_bytes(content[2 * size :][:4], "little")
    return bytes(index["salt"]), int(index["frames"]) if index["frames"] > put_in else 0
