"""A solver's state as a file: written beside, made safe, then named; read only if not a bit of it has changed.

magic   8 bytes        FBCHKP01
size    8 bytes        of the head, little-endian
head    MessagePack    the state, where every array is {"array": n}; {"type", "shape", "bytes"} of each array
arrays                 one after the other, without the zero bytes at their ends
digest  32 bytes       BLAKE2b of all before
"""

import errno
import os
import shutil
from collections.abc import Iterator, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from factorbus.journal.folders import sync_folder
from factorbus.ownership import private_file

_MAGIC = b"FBCHKP01"
_BLOCK = 1 << 20


def file_of(folder: Path, record: int) -> Path:
    """Where the checkpoint after record `record` is."""
    return folder / f"checkpoint-{record}.fbs"


def write_checkpoint(path: Path, state: Mapping[str, Any]) -> int:
    """Write `state` to `path`, all of it or nothing; gives its bytes.  Raises OSError."""
    arrays: list[np.ndarray] = []
    tree = _without_arrays(state, arrays)
    packed = [memoryview(array.tobytes().rstrip(b"\0")) for array in arrays]
    rows = [
        {"type": array.dtype.str, "shape": list(array.shape), "bytes": len(data)}
        for array, data in zip(arrays, packed, strict=True)
    ]
    head: Any = msgpack.packb({"state": tree, "arrays": rows})
    beside = path.with_suffix(".part")
    _check_room(path, len(head) + sum(map(len, packed)))
    digest, size = blake2b(digest_size=32), 0
    try:
        with open(beside, "wb", opener=private_file) as file:
            for part in (_MAGIC, len(head).to_bytes(8, "little"), head, *packed):
                digest.update(part)
                file.write(part)
                size += len(part)
            file.write(digest.digest())
            file.flush()
            os.fsync(file.fileno())
        beside.rename(path)
        sync_folder(path.parent)
    except OSError:
        beside.unlink(missing_ok=True)
        raise
    return size + digest.digest_size


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The state in `path`.  Raises ValueError where a bit of it is wrong, OSError."""
    with path.open("rb") as file:
        content = file.read()
    body, digest = memoryview(content)[:-32], content[-32:]
    if blake2b(body, digest_size=32).digest() != digest or body[:8] != _MAGIC:
        raise ValueError(f"{path} is damaged or incomplete: its digest is another")
    end = 16 + int.from_bytes(body[8:16], "little")
    head = msgpack.unpackb(body[16:end], strict_map_key=False)
    return _with_arrays(head["state"], list(_arrays(head["arrays"], body[end:])))


def remove_strangers(folder: Path, known: set[int]) -> None:
    """Remove checkpoint files that the journal does not know: begun, and not noted before the end came."""
    names = {file_of(folder, record).name for record in known}
    for path in [*folder.glob("checkpoint-*.fbs"), *folder.glob("checkpoint-*.part")]:
        if path.name not in names:
            path.unlink(missing_ok=True)


def _without_arrays(value: Any, arrays: list[np.ndarray]) -> Any:
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {"array": len(arrays) - 1}
    if isinstance(value, Mapping):
        return {name: _without_arrays(item, arrays) for name, item in value.items()}
    if isinstance(value, list):
        return [_without_arrays(item, arrays) for item in value]
    return value


def _with_arrays(value: Any, arrays: list[np.ndarray]) -> Any:
    if isinstance(value, dict):
        if set(value) == {"array"}:
            return arrays[value["array"]]
        return {name: _with_arrays(item, arrays) for name, item in value.items()}
    if isinstance(value, list):
        return [_with_arrays(item, arrays) for item in value]
    return value


def _arrays(rows: list[dict[str, Any]], data: memoryview) -> Iterator[np.ndarray]:
    at = 0
    for row in rows:
        array = np.zeros(row["shape"], row["type"])
        stored = np.frombuffer(data[at : at + row["bytes"]], np.uint8)
        array.reshape(-1).view(np.uint8)[: stored.size] = stored
        at += row["bytes"]
        yield array


def _check_room(path: Path, size: int) -> None:
    """A checkpoint only makes a restart quick: it must not take the room that the journal needs.  Raises OSError."""
    free = shutil.disk_usage(path.parent).free
    if free < 2 * size:
        raise OSError(errno.ENOSPC, f"it has {size} bytes and {free} are free; there must be as much again", str(path))
