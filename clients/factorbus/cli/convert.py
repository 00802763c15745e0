"""`factorbus convert`: from one file format to another."""

from pathlib import Path

import click

from factorbus.cli.options import file_argument
from factorbus.cli.screen import note

_WRITES = (".g2o", ".tum", ".kitti")


@click.command()
@file_argument("source")
@file_argument("target")
def command(source: Path, target: Path) -> None:
    """Read SOURCE (g2o, TORO .graph or iSAM text) and write TARGET (.g2o, .tum or .kitti, by its ending).

    \b
    factorbus convert w10000.graph w10000.g2o
    factorbus convert estimate.g2o estimate.tum
    """
    if target.suffix not in _WRITES:
        raise click.BadParameter(
            f"{target} does not end in {' or '.join((', '.join(_WRITES[:-1]), _WRITES[-1]))}", param_hint="TARGET"
        )
    from factorbus.formats import read, write_g2o, write_kitti, write_tum

    graph = read(source)
    for text in graph.notes:
        note(f"{source}: {text}")
    {".g2o": write_g2o, ".tum": write_tum, ".kitti": write_kitti}[target.suffix](target, graph.batch)
    note(f"{target}: {graph.poses} poses, {graph.landmarks} landmarks, {graph.batch.factor_count} factors")
