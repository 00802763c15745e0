"""`factorbus ask covariance`: how certain variables are, with the name and the unit of each number."""

from typing import TYPE_CHECKING, Any

import click

from factorbus.cli.output.advice import advising, of_what_is_there
from factorbus.cli.output.console import document, table
from factorbus.cli.output.exits import OK
from factorbus.cli.process.options import MapAddress, asks_map
from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.client import Map
    from factorbus.proto.asking import Covariances


@click.command()
@asks_map
@click.argument("keys", nargs=-1)
@click.option("--joint", is_flag=True, help="Of all KEYS together, one matrix.")
@click.option("--relative", is_flag=True, help="Of the second as seen from the first, pair by pair.")
@click.option("--last", is_flag=True, help="Of the pose that was inserted last.")
def covariance_command(address: MapAddress, keys: tuple[str, ...], as_json: bool, **asked: bool) -> int:
    """How certain the variables KEYS are, or all of them: standard deviations, each with its name and unit.

    They are along the axes of each variable's own frame: of a pose in the plane x, y (m), theta (rad), of one in space
    x, y, z (m) and rx, ry, rz, a rotation vector (rad). --json has covariances, and in "tangent" what the rows and
    columns are, in their order.

    \b
    factorbus ask covariance warehouse x12 l3
    factorbus ask covariance warehouse x12 x300 --relative
    factorbus ask covariance warehouse --last --json
    """
    blocks = _blocks(keys, asked)
    from factorbus.cli.process.bus import joined_map

    with advising(of_what_is_there(address.name)), joined_map(address, "ask") as joined:
        found = joined.uncertainty.ask.covariance(blocks or "diagonal", keys or None, None, address.timeout_s).result()
        kinds = _kinds(joined, found, address.timeout_s)
    if found.covariance is not None:
        _tell_joint(found, kinds, as_json)
    else:
        _tell_each(found, blocks, as_json)
    return OK


def _blocks(keys: tuple[str, ...], asked: dict[str, bool]) -> str | None:
    """Which covariances.  Raises UsageError."""
    chosen = [name for name in ("joint", "relative", "last") if asked[name]]
    if len(chosen) > 1:
        raise click.UsageError(f"{' and '.join(f'--{name}' for name in chosen)} exclude each other")
    blocks = chosen[0] if chosen else None
    if blocks == "last" and keys:
        raise click.UsageError(f"--last is of the pose inserted last: it takes no KEYS, and got {' '.join(keys)}")
    if blocks in ("joint", "relative") and not keys:
        raise click.UsageError(f"--{blocks} needs KEYS")
    if blocks == "relative" and len(keys) % 2:
        verb = "is" if len(keys) == 1 else "are"
        raise click.UsageError(
            f"--relative wants KEYS in pairs, such as x12 x300; there {verb} {counted(len(keys), 'key')}"
        )
    return blocks


def _kinds(joined: "Map", found: "Covariances", timeout_s: float) -> dict[int, str]:
    """Of the variables of a joint covariance, which has their sizes alone.  Raises Refused, Unavailable."""
    if found.keys is None:
        return {}
    groups = joined.ask_estimate(found.keys.tolist(), timeout_s=timeout_s).variables
    return {key: group.kind for group in groups for key in group.keys.tolist()}


def _tell_joint(found: Any, kinds: dict[int, str], as_json: bool) -> None:
    from factorbus.cli.output.tangents import ORDER, matrix_lines, tangent_document
    from factorbus.proto.symbols import format_symbol

    rows = [(format_symbol(key), kinds[key]) for key in found.keys.tolist()]
    if as_json:
        told = {"revision": found.revision, "keys": [key for key, _ in rows], "kinds": [kind for _, kind in rows]}
        tangent = [{"key": key, **each} for key, kind in rows for each in tangent_document(kind)]
        document({**told, "tangent": tangent, "covariance": found.covariance.tolist()})
        return
    click.echo(f"Joint covariance at revision {found.revision}; {ORDER}")
    click.echo("\n".join(matrix_lines(rows, found.covariance)))


def _tell_each(found: Any, blocks: str | None, as_json: bool) -> None:
    import numpy as np

    from factorbus.cli.output.tangents import ORDER, named_sigmas, sigmas_of, tangent_document
    from factorbus.proto.symbols import format_symbol

    rows = [
        (" ".join(format_symbol(int(key)) for key in np.atleast_1d(one)), group.kind, block)
        for group in found.groups
        for one, block in zip(group.keys, group.covariance, strict=True)
    ]
    if as_json:
        content = [
            {"keys": keys.split(), "kind": kind, "tangent": tangent_document(kind), "covariance": block.tolist()}
            for keys, kind, block in rows
        ]
        document({"revision": found.revision, "blocks": content})
        return
    if not rows:
        click.echo(f"There is no variable in the map at revision {found.revision}.")
        return
    seen = "; of the second as seen from the first" if blocks == "relative" else ""
    title = f"Standard deviations at revision {found.revision}{seen}; {ORDER}"
    table([(keys, named_sigmas(kind, sigmas_of(block))) for keys, kind, block in rows], title=title)
