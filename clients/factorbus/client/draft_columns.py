"""The columns that a draft becomes: variables by kind, factors by kind and loss, in the order of their coming."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypedDict, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import checked_row, of_type
from factorbus.proto.arrays import F64
from factorbus.proto.camera import Camera
from factorbus.proto.kinds import FactorKinds
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.problems import UnknownKind
from factorbus.proto.stamps import NO_STAMP

_Kind = TypeVar("_Kind")
DOWN = (0.0, 0.0, -1.0)


class Held(TypedDict, total=False):
    """What may be said of a variable besides its value: see `Draft`."""

    fixed: bool
    stamp: int | None


class DraftColumns:
    """What a draft holds, one list for each column of a message.  Nothing is checked here."""

    def __init__(self) -> None:
        self._variables: dict[tuple[str, bool, bool], tuple[list[int], list[F64], list[int]]] = {}
        self._factors: dict[tuple[str, str, bool], tuple[list[list[int]], list[F64], list[F64], list[float]]] = {}
        self._linear: list[Factors] = []
        self._places: list[tuple[tuple[str, str, bool] | None, int]] = []  # of each factor its columns, and its row

    def add_variable(self, kind: str, key: int, value: F64 | None, fixed: bool, stamp: int) -> None:
        """value: None where it comes without."""
        keys, rows, stamps = self._variables.setdefault((kind, value is not None, fixed), ([], [], []))
        keys.append(key)
        stamps.append(stamp)
        if value is not None:
            rows.append(value)

    def add_factor(
        self, kind: str, keys: list[int], measured: F64, triangle: F64, loss: tuple[str, float], trusted: bool
    ) -> None:
        """triangle: the upper one of its information.  loss: name and scale, ("", 0) for none."""
        name, scale = loss
        alike = (kind, name, trusted)
        all_keys, all_measured, triangles, scales = self._factors.setdefault(alike, ([], [], [], []))
        self._places.append((alike, len(scales)))
        scales.append(scale)
        all_keys.append(keys)
        all_measured.append(measured)
        triangles.append(triangle)

    def add_linear(self, factor: Factors) -> None:
        """A linear factor, which is a group by itself."""
        self._places.append((None, len(self._linear)))
        self._linear.append(factor)

    def kinds(self) -> dict[int, str]:
        """The kind of each variable, by its key."""
        return {key: kind for (kind, *_), (keys, *_) in self._variables.items() for key in keys}

    def order(self) -> Sequence[int]:
        """The place in the message of each factor, in the order of their coming."""
        begins: dict[tuple[str, str, bool] | None, int] = {}
        count = 0
        for alike, (keys, *_) in self._factors.items():
            begins[alike] = count
            count += len(keys)
        begins[None] = count
        if len(begins) == 2 and not self._linear:
            return range(count)
        return [begins[alike] + row for alike, row in self._places]

    def batch(self) -> Batch:
        """All of it as a message has it."""
        variables = [
            Variables(
                kind,
                np.array(keys, np.int64),
                np.array(rows) if valued else None,
                fixed,
                np.array(stamps, np.int64) if any(stamp != NO_STAMP for stamp in stamps) else None,
            )
            for (kind, valued, fixed), (keys, rows, stamps) in self._variables.items()
        ]
        factors = [
            Factors(
                kind,
                np.array(keys, np.int64),
                np.array(measured),
                np.array(information),
                loss,
                np.array(scales) if loss else None,
                None,
                trusted,
            )
            for (kind, loss, trusted), (keys, measured, information, scales) in self._factors.items()
        ]
        return Batch(tuple(variables), (*factors, *self._linear))


def known_kind(kinds: Mapping[str, _Kind], kind: str) -> _Kind:
    """The kind of that name.  Raises UnknownKind."""
    if not isinstance(kind, str) or kind not in kinds:
        name = str(kind)
        if not isinstance(kinds, FactorKinds):
            raise UnknownKind("draft", name, tuple(kinds))
        own = "" if "(" in name else "; one of your own is given as what @factor made of its function"
        raise UnknownKind("draft", name, kinds.names(name), own)
    return kinds[kind]


def lens_numbers(camera: Camera) -> list[float]:
    """The numbers of a lens, as an observation has them.  Raises BadOption."""
    return [*of_type("camera", camera, Camera, "a Camera").lens()]


def seen_direction(seen: ArrayLike, direction: ArrayLike) -> list[float]:
    """A direction as a robot sees it, and the same in the map.  Raises BadShape."""
    return [*checked_row("seen", seen, 3), *checked_row("direction", direction, 3)]
