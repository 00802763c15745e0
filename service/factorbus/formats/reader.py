"""Read a graph file: sniff the dialect, convert record by record, put variables and factors together."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from factorbus.formats.assemble import EdgeColumns, VertexColumns, assembled, numbered_apart
from factorbus.formats.edges import Lead, Reading, read_edges, read_switches
from factorbus.formats.errors import FormatError
from factorbus.formats.graph import GraphFile, unnamed
from factorbus.formats.jrl import JRL
from factorbus.formats.left_out import LeftOut, shown
from factorbus.formats.lines import Bucket, buckets_of, read_content
from factorbus.formats.mixtures import best_components
from factorbus.formats.numbers import read_numbers
from factorbus.formats.offsets import Offsets, leave_cameras, read_offsets
from factorbus.formats.parallax import lone_bearings
from factorbus.formats.pyfg import PYFG
from factorbus.formats.ranging import lone_ranges
from factorbus.formats.read_bal import BAL, is_bal, read_bal
from factorbus.formats.read_colmap import COLMAP, is_colmap, read_colmap
from factorbus.formats.read_glim import GLIM, is_glim, read_glim
from factorbus.formats.read_jrl import is_jrl, read_jrl
from factorbus.formats.read_nuscenes import NUSCENES, is_nuscenes, read_nuscenes
from factorbus.formats.read_pyfg import is_pyfg, read_pyfg
from factorbus.formats.read_tum import TUM, is_trajectory, read_trajectory
from factorbus.formats.records import DIALECTS, FIX, G2O, SWITCH_PRIOR, Dialect, Vertex
from factorbus.formats.rotations import normalized_poses
from factorbus.formats.sniff import dialect_named, sniffed
from factorbus.proto.arrays import I64
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import MAX_INDEX, format_symbol, symbol_parts
from factorbus.wording import counted

READS = (*DIALECTS, PYFG, JRL, TUM, BAL, GLIM, COLMAP, NUSCENES)
_NAMED = (PYFG, JRL, GLIM)  # forms whose keys are symbols, and not ids

# A prior of a point that names a pose is one of its position: RTAB-Map writes them so.
_OF_POSES = {"prior_point2": "position_se2", "prior_point3": "position_se3"}
_SWITCHES = ("VERTEX_SWITCH", SWITCH_PRIOR)
_CAMERAS = ("PARAMS_CAMERACALIB", "PARAMS_STEREOCAMERACALIB")


def read(
    path: str | os.PathLike[str], dialect: str | None = None, strict: bool = False, whole: bool = False
) -> GraphFile:
    """The graph in `path`: g2o, TORO, iSAM, SLAM++, PyFactorGraph, JRL, BAL or TUM text, plain or gzipped, or the
    folder of a map that GLIM has saved, or of a COLMAP model, or nuScenes's ego_pose.json.

    dialect: one of READS; without it the names of the records decide, and the ending where they do not; a guess is in
    the notes.  TUM, COLMAP and nuScenes are trajectories: poses with time stamps, and no factors.  BAL is cameras,
    their lenses and points, all in one step (`read_bal`).  GLIM: `read_glim`.
    Keys are symbol("x", id) for poses and symbol("l", id) for points; where an id is 2^56 or more, as GTSAM's symbols
    and time stamps are, all keys are the ids themselves; of pyfg they are its names, A12 is symbol("A", 12).  JRL
    is JSON: its keys are symbols, what it says beside the graph is `log`, and errors name the place in place of a line.
    Quaternions are normalized; angles stay as they are.  Records that have no kind here are left out, which `notes` and
    `left_out` say; with `strict` they are refused.  So are vertices that no step of a replay would have, unless the
    graph is wanted `whole`, as it is written to another file.  Raises FormatError, which names the file and the line.
    """
    with np.errstate(all="ignore"):  # what overflows is not finite or not positive definite, and refused as such
        return _read(Path(path), dialect, strict, whole)


def _read(path: Path, dialect: str | None, strict: bool, whole: bool) -> GraphFile:
    file = str(path)
    if dialect == GLIM or (dialect is None and is_glim(path)):
        left = LeftOut(file, strict, whole)
        return _graph(file, GLIM, *read_glim(path, left), left, "ids")
    if dialect == COLMAP or (dialect is None and is_colmap(path)):
        return read_colmap(path)
    content = read_content(path)
    if dialect == JRL or (dialect is None and (is_jrl(content) or path.suffix.lower() == f".{JRL}")):
        left = LeftOut(file, strict, whole)
        batch, turns, log = read_jrl(file, content, left)
        return replace(_graph(file, JRL, batch, turns, left, "keys"), log=log)
    if dialect == NUSCENES or (dialect is None and is_nuscenes(content)):
        return read_nuscenes(file, content)
    if dialect == BAL or (dialect is None and is_bal(content)):
        return read_bal(file, content)
    buckets = buckets_of(file, content)
    if dialect == PYFG or (dialect is None and is_pyfg(path, buckets)):
        left = LeftOut(file, strict, whole)
        return _graph(file, PYFG, *read_pyfg(file, buckets, left), left, "keys")
    if dialect == TUM or (dialect is None and is_trajectory(buckets)):
        return read_trajectory(file, buckets)
    guess = sniffed(path, buckets) if dialect is None else dialect_named(file, dialect)
    chosen, left = guess.dialect, LeftOut(file, strict, whole)
    if guess.why:
        left.say(guess.why)
    vertices = [
        _vertices(file, name, chosen.vertices[name], buckets[name]) for name in buckets if name in chosen.vertices
    ]
    edges = _edges(file, chosen, buckets, vertices, left)
    fixes = _fixes(file, buckets[FIX]) if FIX in chosen.others and FIX in buckets else None
    if dialect is None:
        _refuse_mixed(file, chosen, buckets)
    _leave_foreign(file, chosen, buckets, left)
    are_keys = any((columns.ids > MAX_INDEX).any() for columns in (*vertices, *edges))
    apart = chosen.one_numbering and not are_keys and numbered_apart(vertices)
    batch, lines = assembled(file, are_keys, chosen.one_numbering and not apart, vertices, edges, fixes)
    if are_keys:
        _say_without_letter(batch, left)
    if apart:
        left.say("poses and points are numbered separately")
    numbering = "keys" if are_keys else "apart" if apart else "ids"
    return _graph(file, chosen.name, batch, lines, left, numbering)


def _graph(file: str, dialect: str, batch: Batch, lines: tuple[I64, ...], left: LeftOut, numbering: str) -> GraphFile:
    """The file, with what no step of its replay has set aside.  Raises FormatError when strict."""

    def names(keys: I64) -> list[str]:
        return list(map(format_symbol, keys.tolist())) if dialect in _NAMED else _ids_in_file(keys, numbering == "keys")

    lone = names(unnamed(batch)) if batch.factors else []
    left.set_aside("vertices", len(lone), f"no edge names {shown(lone)}")
    lost = names(lone_bearings(batch))
    left.set_aside("points", len(lost), f"bearings from a single pose do not place {shown(lost)}")
    far = names(lone_ranges(batch))
    left.set_aside("points", len(far), f"so few ranges do not place {shown(far)}")
    return GraphFile(file, dialect, batch, lines, tuple(left.notes), dict(left.counts), numbering)


def _say_without_letter(batch: Batch, left: LeftOut) -> None:
    """Say which ids are keys without a letter for the sake of others that are too large to get one."""
    keys = np.concatenate([np.empty(0, np.int64), *(group.keys for group in batch.variables)])
    plain = [str(key) for key in keys[keys <= MAX_INDEX].tolist()]
    if plain:
        left.say(
            f"{len(plain):,} of {counted(len(keys), 'id')} are below 2^56, the others symbols as GTSAM packs them, or "
            f"time stamps: every id is the key itself, so {shown(plain)} have no letter; in a file of such ids alone "
            "they would get x, or l for points"
        )


def _ids_in_file(keys: I64, are_keys: bool) -> list[str]:
    """As the file has them, so that one finds them there."""
    return [str(key if are_keys else symbol_parts(key)[1]) for key in keys.tolist()]


def _edges(
    file: str, chosen: Dialect, buckets: Mapping[str, Bucket], vertices: list[VertexColumns], left: LeftOut
) -> list[EdgeColumns]:
    is_g2o = chosen is G2O
    offsets = read_offsets(file, buckets) if is_g2o else Offsets({"se2": {}, "se3": {}}, {})
    reading = Reading(file, offsets, read_switches(file, buckets) if is_g2o else {}, left, set())
    columns: list[EdgeColumns] = []
    for name in buckets:
        if name in chosen.edges:
            columns += [
                best_components(file, found, vertices, left) if isinstance(found, Lead) else found
                for found in read_edges(name, chosen.edges[name], buckets[name], reading)
            ]
    leave_cameras(offsets, reading.named, left)
    return _priors_of_poses(columns, vertices) if is_g2o else columns


def _refuse_mixed(file: str, dialect: Dialect, buckets: Mapping[str, Bucket]) -> None:
    """Refuse a file of no named dialect that has vertices or edges of two.  Raises FormatError."""
    with_all = [other.name for other in DIALECTS.values() if set(buckets) <= set(other.names)]
    for name in sorted(buckets, key=lambda name: buckets[name].numbers[0]):
        others = [other.name for other in DIALECTS.values() if name in other.vertices or name in other.edges]
        if others and name not in dialect.names and name not in dialect.refused:
            seen = f"{name}, a record of {' and '.join(others)}, in what is read as {dialect.name} text"
            instead = f"{with_all[0]}, which has them all" if with_all else f"{others[0]} to read its alone"
            wanted = f"records of one dialect, or --dialect {instead}"
            raise FormatError(file, buckets[name].numbers[0], seen, wanted)


def _leave_foreign(file: str, dialect: Dialect, buckets: Mapping[str, Bucket], left: LeftOut) -> None:
    """Leave out the records that the dialect does not have.

    Raises FormatError for the first one without which the file would be another graph, or any when strict.
    """
    foreign = [name for name in buckets if name not in dialect.names and name not in dialect.unspoken]
    refused = [name for name in foreign if name in dialect.refused]
    for name in sorted(refused, key=lambda name: buckets[name].numbers[0])[:1]:
        reason = f"a record that can be read here ({dialect.refused[name]})"
        raise FormatError(file, buckets[name].numbers[0], f"record {name}", reason)
    for name, note in dialect.unspoken.items():
        if name in buckets:
            left.say(f"{len(buckets[name].rests)} {note}")
    switched = any(dialect.edges[name].lead == "switch" for name in buckets if name in dialect.edges)
    of_switches = "its edge has a loss instead" if switched else "no edge that is read has a switch"
    for name in foreign:
        if not (dialect is G2O and name in _CAMERAS):
            short = name if len(name) <= 40 else name[:37] + "..."
            instead = of_switches if name in _SWITCHES else f"no {dialect.name} record that is read"
            left.leave(short, buckets[name].numbers, instead)


def _vertices(file: str, name: str, record: Vertex, bucket: Bucket) -> VertexColumns:
    ids, values = read_numbers(file, name, bucket, record.ids, record.width, record.fields)
    lines = np.array(bucket.numbers, np.int64)
    if record.kind == "se3":
        values = normalized_poses(file, name, lines, values)
    return VertexColumns(record.kind, lines, ids[:, 0], np.ascontiguousarray(values))


def _priors_of_poses(columns: list[EdgeColumns], vertices: Sequence[VertexColumns]) -> list[EdgeColumns]:
    """The same, with each prior of a point that names a pose as a prior of that pose's position."""
    if not any(group.kind in _OF_POSES for group in columns):
        return columns
    found = []
    for group in columns:
        if group.kind in _OF_POSES:
            kind = _OF_POSES[group.kind]
            points, poses = (
                _ids_of(end, columns, vertices) for end in (FACTOR_KINDS[g].connects[0] for g in (group.kind, kind))
            )
            of_pose = np.isin(group.ids[:, 0], poses) & ~np.isin(group.ids[:, 0], points)
            lever = ((0, 0), (0, FACTOR_KINDS[kind].size - group.measured.shape[1]))
            if of_pose.any():
                mine = _rows(group, of_pose)
                found.append(replace(mine, kind=kind, measured=np.pad(mine.measured, lever)))
            group = _rows(group, ~of_pose)
        if len(group.lines):
            found.append(group)
    return found


def _ids_of(kind: str, columns: Sequence[EdgeColumns], vertices: Sequence[VertexColumns]) -> I64:
    """All ids that a vertex, or an edge of something else than a point alone, says are of this kind."""
    ids = [vertex.ids for vertex in vertices if vertex.kind == kind]
    for group in columns:
        if group.kind not in _OF_POSES:
            connects = FACTOR_KINDS[group.kind].connects
            ids += [group.ids[:, column] for column, end in enumerate(connects) if end == kind]
    return np.unique(np.concatenate([np.empty(0, np.int64), *ids]))


def _rows(group: EdgeColumns, chosen: np.ndarray) -> EdgeColumns:
    """Some of its edges; one without a loss."""
    return EdgeColumns(
        group.kind, group.lines[chosen], group.ids[chosen], group.measured[chosen], group.information[chosen]
    )


def _fixes(file: str, bucket: Bucket) -> tuple[I64, I64]:
    """(ids, lines) of FIX lines; one line may name several vertices."""
    words = [
        (word, line) for rest, line in zip(bucket.rests, bucket.numbers, strict=True) for word in rest.split() or [b""]
    ]
    flat = Bucket([word for word, _ in words], [line for _, line in words])
    ids, _ = read_numbers(file, FIX, flat, 1, 1, "the id of a vertex")
    return ids[:, 0], np.array(flat.numbers, np.int64)
