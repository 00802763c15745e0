"""Read the factors of a graph that GTSAM has serialized into a binary archive.

The `gtsam` wheel cannot: it has the text archives alone, and GLIM's own factors, one of which comes first in every
graph of GLIM's, are unknown to it.
"""

from dataclasses import dataclass

from factorbus.formats.boost_archive import BoostArchive, UnreadableArchive
from factorbus.formats.gtsam_forms import ArchivedFactor, GtsamForms


@dataclass(frozen=True, slots=True)
class ArchivedGraph:
    """The factors of a graph.

    why: what ends the reading early, "" where all is read; missing: how many factors follow, 0 where that is unknown.
    """

    factors: tuple[ArchivedFactor, ...]
    missing: int = 0
    why: str = ""


def archived_graph(content: bytes) -> ArchivedGraph:
    """The factors in the binary archive of a NonlinearFactorGraph, as far as they can be read."""
    found = [_read(content, newer) for newer in (True, False)]
    return min(found, key=lambda graph: (graph.why != "", -len(graph.factors)))


def _read(content: bytes, newer: bool) -> ArchivedGraph:
    """newer: whether preintegrated measurements are as the last versions of GTSAM have them."""
    factors: list[ArchivedFactor] = []
    count, removed = 0, 0
    try:
        archive = BoostArchive(content)
        forms = GtsamForms(archive, newer)
        count = forms.begin_graph()
        for _ in range(count):
            factor = forms.factor()
            if factor is None:  # a factor that was removed leaves its place
                removed += 1
            else:
                factors.append(factor)
        if archive.left:
            raise UnreadableArchive(f"{archive.left} more bytes than the graph has")
    except UnreadableArchive as problem:
        return ArchivedGraph(tuple(factors), max(count - removed - len(factors), 0), str(problem))
    return ArchivedGraph(tuple(factors))
