"""`factorbus ask components`: the parts of a map that nothing joins, and what holds each."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from factorbus.cli.output.console import document, table
from factorbus.cli.output.exits import OK
from factorbus.cli.process.options import MapAddress, asks_map
from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.proto.components import Components

_IN_LINE = 3
_SHOWN = 20  # more components than these are listed with --json only


@click.command()
@asks_map
def components_command(address: MapAddress, as_json: bool) -> int:
    """Which parts of the map no factor joins, the largest first, with their letters and what holds each.

    A part in a frame of its own is held by one fixed pose or one prior of a pose, and nothing says how it lies to the
    others: `factorbus change attach` brings it into the frame of the rest. Parts that are held by more, such as GNSS,
    are in one frame without a factor between them. A linear factor, which marginalizing leaves, is among what holds a
    part where its numbers say where in the map's frame that is; between the poses of a part it does not.

    \b
    factorbus ask components warehouse
    factorbus ask components warehouse --json
    """
    from factorbus.cli.process.bus import joined_map

    with joined_map(address, "ask") as joined:
        found = joined.components(address.timeout_s)
    if as_json:
        document({"revision": found.revision, **components_document(found)})
    elif not found.count and not found.in_no_frame:
        click.echo(f"There is no variable in the map at revision {found.revision}.")
    else:
        table(_rows(components_document(found)), title=f"At revision {found.revision}")
    return OK


def components_document(found: "Components") -> dict[str, Any]:
    """For `--json`."""
    from factorbus.proto.symbols import format_symbol

    listed = [
        {
            "first": format_symbol(each.first),
            "variables": each.variables,
            "factors": each.factors,
            "letters": dict(each.letters),
            "held": dict(each.held),
            "own_frame": each.own_frame,
        }
        for each in found.listed
    ]
    return {"count": found.count, "in_no_frame": found.in_no_frame, "components": listed}


def components_line(found: Mapping[str, Any]) -> str:
    """Of such a document how many there are, in one line, and the largest of several."""
    count, listed = found["count"], found["components"]
    if count < 2:
        return "one component: all of it hangs together" if count else "no component: it is empty"
    own = sum(each["own_frame"] for each in listed)
    told = "; ".join(f"{_letters(each)} ({counted(each['variables'], 'variable')})" for each in listed[:_IN_LINE])
    more = "; …" if count > _IN_LINE else ""
    return f"{count:,} components that no factor joins, {own:,} in a frame of its own: {told}{more}"


def _rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    count, listed = found["count"], found["components"]
    rows = [("components", f"{count:,}"), *((_letters(each), _in_words(each, count > 1)) for each in listed[:_SHOWN])]
    if count > _SHOWN:
        rows.append(("", f"and {counted(count - _SHOWN, 'component')} more: --json lists the largest"))
    if aside := found["in_no_frame"]:
        rows.append(("in no frame", f"{counted(aside, 'variable')}: mounts, and numbers such as a bias"))
    return rows


def _letters(each: Mapping[str, Any]) -> str:
    return " ".join(letter or "no letter" for letter in sorted(each["letters"]))


def _in_words(each: Mapping[str, Any], is_one_of_several: bool) -> str:
    size = f"{counted(each['variables'], 'variable')}, the first {each['first']}, {counted(each['factors'], 'factor')}"
    held = ", ".join(f"{count} {kind}" for kind, count in each["held"].items()) or "nothing"
    return f"{size}; held by {held}" + (": in a frame of its own" if each["own_frame"] and is_one_of_several else "")
