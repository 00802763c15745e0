"""Own kinds of a map under other names: where two maps that are to be one mean different things by a name.

    kitchen.merge(rename_kinds(hall.graph(), {"wheel": "wheel_of_hall"}), anchors=...)

A name is for people: the formula behind it is the same, so a factor says what it has said.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

from factorbus.client.arguments import of_type
from factorbus.proto.expressions.declaration import BadExpression
from factorbus.proto.kinds import FACTOR_KINDS, own_kind
from factorbus.proto.messages import Batch, Factors, MapGraph
from factorbus.proto.nearest import nearest
from factorbus.proto.problems import BadOption, Refused


def rename_kinds(graph: MapGraph, names: Mapping[str, str]) -> MapGraph:
    """The same graph with other names of its own kinds, old to new.

    Raises BadOption: it has no own kind of an old name, or a new one is none or is that of another kind.
    """
    named = of_type("names", names, Mapping, 'a mapping of names, such as {"wheel": "wheel_of_hall"}')
    has = {FACTOR_KINDS[group.kind].called for group in graph.batch.factors if FACTOR_KINDS[group.kind].own}
    for old in named:
        if old not in has:
            wanted = f"one of {', '.join(sorted(has))}{nearest(old, has)}" if has else "no names: it has no own kinds"
            raise BadOption("names", f"{old!r}, of which the map has no factors", wanted)
    factors = tuple(_renamed(group, named) for group in graph.batch.factors)
    return replace(graph, batch=Batch(graph.batch.variables, factors))


def _renamed(group: Factors, names: Mapping[str, str]) -> Factors:
    own = FACTOR_KINDS[group.kind].own
    if own is None or own.name not in names:
        return group
    try:
        return group._replace(kind=own_kind(replace(own, name=names[own.name])).name)
    except BadExpression as problem:
        raise BadOption("names", repr(names[own.name])[:80], f"another name ({problem})") from None


@contextmanager
def saying_how_to_rename() -> Iterator[None]:
    """Of a merge that is refused as both maps have one name for two kinds: what to do.  Raises Refused."""
    try:
        yield
    except Refused as problem:
        if problem.code != "kind_taken":
            raise
        name = str(problem.detail.get("kind", "NAME"))
        told = problem.message.rpartition("; wanted")[0] or problem.message
        how = (
            f"; nothing was merged. Give that of the other map another name: "
            f"merge(rename_kinds(other.graph(), {{{name!r}: '{name}_2'}}), ...)"
        )
        raise Refused(problem.code, told + how, problem.detail) from problem
