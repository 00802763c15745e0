"""Put the records of a file together: keys, kinds, values and fixed variables, each said once."""

from dataclasses import dataclass

import numpy as np

from factorbus.formats.errors import refuse_first
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import FACTOR_KINDS, LOSSES, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

KIND_NAMES = tuple(VARIABLE_KINDS)
_BASE = np.array([symbol("l" if name.startswith("point") else "x", 0) for name in KIND_NAMES], np.int64)
KIND_WORDS = {"se2": "a 2D pose", "se3": "a 3D pose", "point2": "a 2D point", "point3": "a 3D point"}


@dataclass(frozen=True, slots=True)
class VertexColumns:
    """Vertex lines of one record: lines (n,), ids (n,), values (n, size)."""

    kind: str
    lines: I64
    ids: I64
    values: F64


@dataclass(frozen=True, slots=True)
class EdgeColumns:
    """Edge lines of one record: lines (n,), ids (n, arity), measured (n, size), information (n, r(r+1)/2).

    loss: of all of them, "": none; scale (n,): of the loss.
    """

    kind: str
    lines: I64
    ids: I64
    measured: F64
    information: F64
    loss: str = ""
    scale: F64 | None = None


@dataclass(frozen=True, slots=True)
class _Mentions:
    """Every place where a variable is named, in the order of the file, vertex lines before edges."""

    ids: I64
    kinds: I64
    lines: I64


def numbered_apart(vertices: list[VertexColumns]) -> bool:
    """Whether an id has a vertex line as a pose and one as a point, as in files that GTSAM writes."""
    empty = np.empty(0, np.int64)
    poses, points = (
        np.concatenate([empty, *(v.ids for v in vertices if v.kind.startswith("point") == is_point)])
        for is_point in (False, True)
    )
    return bool(np.isin(poses, points).any())


def assembled(
    file: str,
    are_keys: bool,
    one_numbering: bool,
    vertices: list[VertexColumns],
    edges: list[EdgeColumns],
    fixes: tuple[I64, I64] | None,
) -> tuple[Batch, tuple[I64, ...]]:
    """(the graph, the line of each factor for each group of factors).

    are_keys: ids are keys already, of poses and of points; otherwise a letter is added for what it is.
    Variables come per kind, fixed ones first, those with a value before those without, each in the order of the file.
    Raises FormatError for an id that names two different things or a FIX of nothing.
    """
    mentions = _mentions(vertices, edges)
    base = np.zeros_like(_BASE) if are_keys else _BASE
    names = mentions.ids if one_numbering or are_keys else mentions.ids + base[mentions.kinds]
    _, first, inverse = np.unique(names, return_index=True, return_inverse=True)
    clash = mentions.kinds != mentions.kinds[first][inverse]
    refuse_first(
        file, mentions.lines, clash, lambda row: _clash(mentions, int(first[inverse[row]]), row), "one vertex for an id"
    )
    order = np.argsort(first)  # variables in the order in which they first appear
    chosen = first[order]
    keys, kinds = mentions.ids[chosen] + base[mentions.kinds[chosen]], mentions.kinds[chosen]
    fixed = np.zeros(len(keys), bool)
    if fixes is not None:
        fixed[_fixed_rows(file, fixes, mentions.ids[chosen])] = True
    groups = _variables(keys, kinds, fixed, _values(file, vertices, base))
    factors, lines = _factors(edges, base)
    return Batch(tuple(groups), factors), lines


def _mentions(vertices: list[VertexColumns], edges: list[EdgeColumns]) -> _Mentions:
    parts = [[], [], [], []]
    for is_edge, columns in [*((0, v) for v in vertices), *((1, e) for e in edges)]:
        ids = columns.ids.reshape(len(columns.lines), -1)
        connects = FACTOR_KINDS[columns.kind].connects if is_edge else (columns.kind,)
        kinds = np.array([KIND_NAMES.index(kind) for kind in connects], np.int64)
        parts[0].append(ids.ravel())
        parts[1].append(np.broadcast_to(kinds, ids.shape).ravel())
        parts[2].append(np.repeat(columns.lines, ids.shape[1]))
        parts[3].append(np.full(ids.size, is_edge))
    ids, kinds, lines, is_edge = (np.concatenate([*part, np.empty(0, np.int64)]).astype(np.int64) for part in parts)
    order = np.lexsort((lines, is_edge))
    return _Mentions(ids[order], kinds[order], lines[order])


def _clash(mentions: _Mentions, earlier: int, row: int) -> str:
    before, now = (KIND_WORDS[KIND_NAMES[mentions.kinds[k]]] for k in (earlier, row))
    return f"{mentions.ids[row]} as {now}, which is {before} on line {mentions.lines[earlier]}"


def _fixed_rows(file: str, fixes: tuple[I64, I64], ids: I64) -> I64:
    """Places of the fixed ids in `ids`."""
    wanted, lines = fixes
    order = np.argsort(ids, kind="stable")
    at = np.minimum(np.searchsorted(ids[order], wanted), max(len(ids) - 1, 0))
    unknown = ids[order][at] != wanted if len(ids) else np.ones(len(wanted), bool)
    refuse_first(file, lines, unknown, lambda row: f"FIX {wanted[row]}, which is no vertex", "the id of a vertex")
    both = np.searchsorted(ids[order], wanted, "right") - np.searchsorted(ids[order], wanted) > 1
    refuse_first(
        file, lines, both, lambda row: f"FIX {wanted[row]}, which is a pose and a point", "an id of one vertex"
    )
    return order[at]


def _values(file: str, vertices: list[VertexColumns], base: I64) -> dict[str, tuple[I64, F64]]:
    """Per kind the keys that have a value, sorted, and the values."""
    found = {}
    for kind in dict.fromkeys(columns.kind for columns in vertices):
        same = [columns for columns in vertices if columns.kind == kind]
        ids = np.concatenate([columns.ids for columns in same])
        values = np.concatenate([columns.values for columns in same])
        lines = np.concatenate([columns.lines for columns in same])
        unique, first, inverse = np.unique(ids, return_index=True, return_inverse=True)
        twice = (values != values[first][inverse]).any(axis=1)
        refuse_first(
            file,
            lines,
            twice,
            lambda row, ids=ids, first=first, inverse=inverse, lines=lines: (
                f"vertex {ids[row]} again, with other values than on line {lines[first[inverse[row]]]}"
            ),
            "one value for a vertex",
        )
        found[kind] = (unique + base[KIND_NAMES.index(kind)], values[first])
    return found


def _variables(keys: I64, kinds: I64, fixed: np.ndarray, values: dict[str, tuple[I64, F64]]) -> list[Variables]:
    groups = []
    for code, kind in enumerate(KIND_NAMES):
        known, table = values.get(kind, (np.empty(0, np.int64), np.empty((0, VARIABLE_KINDS[kind].size))))
        valued = np.isin(keys, known)
        for is_fixed in (True, False):
            for has_value in (True, False):
                mine = keys[(kinds == code) & (fixed == is_fixed) & (valued == has_value)]
                if len(mine):
                    given = table[np.searchsorted(known, mine)] if has_value else None
                    groups.append(Variables(kind, mine, given, is_fixed))
    return groups


def _factors(edges: list[EdgeColumns], base: I64) -> tuple[tuple[Factors, ...], tuple[I64, ...]]:
    """Factors per kind and loss in the order of the file, and their lines."""
    groups, all_lines = [], []
    for kind, loss in ((name, loss) for name in FACTOR_KINDS for loss in ("", *LOSSES)):
        same = [columns for columns in edges if (columns.kind, columns.loss) == (kind, loss)]
        if same:
            lines = np.concatenate([columns.lines for columns in same])
            order = np.argsort(lines, kind="stable")
            bases = base[[KIND_NAMES.index(name) for name in FACTOR_KINDS[kind].connects]]
            keys = np.concatenate([columns.ids for columns in same]) + bases
            measured = np.concatenate([columns.measured for columns in same])
            information = np.concatenate([columns.information for columns in same])
            scales = [columns.scale for columns in same if columns.scale is not None]
            scale = np.concatenate(scales)[order] if scales else None
            groups.append(Factors(kind, keys[order], measured[order], information[order], loss, scale))
            all_lines.append(lines[order])
    return tuple(groups), tuple(all_lines)
