"""`factorbus maps`: the maps that there are."""

from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from factorbus.cli.process.options import connect_option, json_option, timeout_option, zenoh_option
from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.client.map_row import MapRow

_POLICIES = {"test": "tested", "robust": "weighed"}


@click.command()
@connect_option
@zenoh_option
@timeout_option(5)
@json_option
def command(endpoint: str, zenoh: str, timeout_s: float, as_json: bool) -> None:
    """List the maps of the service at ENDPOINT; at a router, those of all services.

    The mode is how a map is solved: bayes-tree unless somebody chose another (see factorbus replay --help).
    A map that is on the service's disk and does not open is listed as that.

    \b
    factorbus maps
    factorbus maps --connect tls/solver.local:7447 --zenoh ops.json5 --json
    """
    from factorbus.cli.output import console as screen
    from factorbus.cli.process.bus import open_bus

    with open_bus(endpoint, "maps", zenoh, timeout_s) as bus:
        rows = sorted(bus.maps(), key=lambda row: row.name)
    if as_json:
        screen.document({"maps": [asdict(row) for row in rows]})
    elif rows:
        screen.table([(row.name, _shown(row)) for row in rows])
    else:
        screen.print_note(f"there is no map at {endpoint} yet")


def _shown(row: "MapRow") -> str:
    if row.problem:
        why, way = f"`factorbus stats {row.name}` says why", f"`factorbus drop {row.name} --damaged` gives it up"
        return f"does not open ({row.state}): {why}, {way}"
    blocked = "; blocked: its journal cannot be written" if row.state == "blocked" else ""
    held = f"{counted(row.variables, 'variable')}, {counted(row.factors, 'factor')}"
    caveat = "" if row.reproducible is not False else "; not reproducible"
    policies = [f"closures {_POLICIES[row.closures]}"] if row.closures in _POLICIES else []
    policies += [f"steps of {row.budget_ms:g} ms"] * bool(row.budget_ms)
    policies += [f"keep {row.keep}"] * (row.keep != "all")
    return ", ".join([f"{held}, revision {row.revision:,}, mode {row.mode}", *policies]) + caveat + blocked
