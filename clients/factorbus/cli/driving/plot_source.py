"""What `factorbus plot` draws: a graph file, a data set by its name, or a map on the bus."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from factorbus.proto.messages import Batch, Variables
from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.formats import GraphFile
    from factorbus.viz import Spread


@dataclass(frozen=True, slots=True)
class Drawn:
    """A graph with values, what to call it, and where its variables really were, if that is known."""

    name: str
    graph: Batch
    about: str
    truth: tuple[Variables, ...] = ()

    def unsolved(self) -> Batch:
        """The same without the values of what is estimated: what odometry alone starts from."""
        bare = [g if g.fixed else Variables(g.kind, g.keys) for g in self.graph.variables]
        return Batch(tuple(bare), self.graph.factors)

    def file(self, what: str, out: Path | None) -> Path:
        """Where the picture goes: `out`, or a name made from this one's in the folder we are in."""
        return out or Path(f"{self.name}-{what}.png")


def graph_of(
    source: str, connect: str | None, zenoh: str = "", dialect: str | None = None, strict: bool = False
) -> Drawn:
    """The graph of a file, or, with an endpoint, of the map of that name.  Raises Stopped, FormatError, Problem."""
    if connect is not None:
        return _from_bus(source, connect, zenoh)
    file = file_named(source, dialect, strict)
    truth = file.log.ground_truth if file.log else ()
    return Drawn(Path(file.path).stem, file.whole(), f"values as in {Path(file.path).name}", truth)


def file_named(source: str, dialect: str | None = None, strict: bool = False) -> "GraphFile":
    """The file of that name, or the data set; says what was left out.  Raises Stopped, FormatError."""
    from factorbus.cli.driving.replay_source import source_of
    from factorbus.cli.process.reading import read_graph

    file = source_of(Path(source), else_="; or the name of a map on the bus, with --connect tcp/127.0.0.1:7447, say")
    return read_graph(file, dialect, strict)


def with_values(drawn: Drawn) -> Drawn:
    """The same graph with a value for every pose: where the file has none, composed from odometry.  Raises Stopped."""
    bare = [group for group in drawn.graph.variables if group.values is None and group.keys.size]
    if not bare:
        return drawn
    from factorbus.cli.driving.picture import reckoned
    from factorbus.cli.output.console import print_note

    have = [group for group in drawn.graph.variables if group.values is not None]
    missing = np.concatenate([group.keys for group in bare])
    for group in reckoned(drawn.graph):
        rows = np.isin(group.keys, missing)
        if rows.any() and group.values is not None:
            have.append(Variables(group.kind, group.keys[rows], group.values[rows]))
    left = np.setdiff1d(missing, np.concatenate([np.empty(0, np.int64), *(group.keys for group in have)])).size
    composed = missing.size - left
    print_note(
        f"{drawn.name}: {counted(missing.size, 'variable')} without a value; "
        f"{counted(composed, 'pose')} composed from odometry"
        + (f", {left} are not drawn (--solve places them)" if left else "")
    )
    about = "values composed from odometry" if composed == sum(g.keys.size for g in have) else drawn.about
    return replace(drawn, graph=Batch(tuple(have), drawn.graph.factors), about=about)


def solved(drawn: Drawn, on_file: bool = True) -> Drawn:
    """The same graph at its optimum, found from scratch in this process.  Raises Stopped, SolverError.

    on_file: its values are those of a file.
    """
    from factorbus.cli.output.exits import require
    from factorbus.cli.output.starts import optimum_from

    require("service", "--solve")
    from factorbus.cli.driving.optimum import optimum_of

    result, graph = optimum_of(drawn.graph)
    found = optimum_from(result.start, on_file, result.converged)
    about = f"χ² {result.chi2:.6g}, {found}, after {counted(result.iterations, 'iteration')}"
    return replace(drawn, graph=graph, about=about)


def spread_in(drawn: Drawn, connect: str | None, most: int, zenoh: str = "") -> "Spread":
    """Where about `most` poses, and points, may be: asked of the map on the bus, or computed at the values drawn.

    Raises Stopped, SolverError, Problem.
    """
    from factorbus.cli.output.exits import require
    from factorbus.viz import spread_of
    from factorbus.viz.certainty import blocks_of, chosen

    keys = chosen(drawn.graph.variables, most)
    if connect is not None:
        from factorbus.cli.process.bus import open_bus

        with open_bus(connect, "plot", zenoh) as bus, bus.map(drawn.name, create=False, mirror=False) as joined:
            return spread_of(drawn.graph.variables, blocks_of(joined.uncertainty.covariance(keys.tolist())))
    require("service", "--ellipses of a file")
    from factorbus.cli.driving.local import covariances_at

    return spread_of(drawn.graph.variables, covariances_at(drawn.graph, keys))


def _from_bus(name: str, endpoint: str, zenoh: str) -> Drawn:
    from factorbus.cli.process.bus import open_bus

    with open_bus(endpoint, "plot", zenoh) as bus, bus.map(name, create=False, mirror=False) as joined:
        graph, chi2 = joined.graph(), joined.chi2()
    return Drawn(name, graph.batch, f"revision {graph.revision}, χ² {chi2.chi2:.6g}")
