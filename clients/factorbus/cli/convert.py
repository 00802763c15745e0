"""`factorbus convert`: from one file format to another."""

from pathlib import Path

import click

from factorbus.cli.options import file_argument
from factorbus.cli.screen import note

_WRITES = (".g2o", ".tum")


@click.command()
@file_argument("source")
@file_argument("target")
def command(source: Path, target: Path) -> None:
    """Read SOURCE (g2o, TORO .graph or iSAM text) and write TARGET (.g2o or .tum, by its ending).

    \b
    factorbus convert w10000.graph w10000.g2o
    factorbus convert estimate.g2o estimate.tum
    """
    if target.suffix not in _WRITES:
        raise click.BadParameter(f"{target} does not end in {' or '.join(_WRITES)}", param_hint="TARGET")
    from factorbus.formats import read, write_g2o, write_tum

    graph = read(source)
    for text in graph.notes:
        note(f"{source}: {text}")
    (write_g2o if target.suffix == ".g2o" else write_tum)(target, graph.batch)
    note(f"{target}: {graph.poses} poses, {graph.landmarks} landmarks, {graph.batch.factor_count} factors")
