"""`factorbus ask suspects`: loop closures that a map has, and does not believe."""

import math

import click

from factorbus.cli.output.console import document, table
from factorbus.cli.output.exits import OK
from factorbus.cli.process.options import MapAddress, asks_map
from factorbus.wording import counted

_SHOWN = 40  # more closures than these are listed with --json only


@click.command()
@asks_map
@click.option("--all", "every", is_flag=True, help="Those that the estimate has, too.")
def suspects_command(address: MapAddress, every: bool, as_json: bool) -> int:
    """Which loop closures the estimate hardly has or not, why, and since when: of a map that tests or weighs them.

    d² is how far off a closure is, squared, in standard deviations of what the map knows; chance, the odds that it
    is false where every second one is; weight, of a map that weighs them (--closures robust), by how much of its
    information it counts. `factorbus change accept` and `reject` are the last word.

    \b
    factorbus ask suspects warehouse
    factorbus ask suspects warehouse --all --json
    """
    from factorbus.cli.process.bus import joined_map
    from factorbus.proto.symbols import format_symbol

    with joined_map(address, "ask") as joined:
        found = joined.suspects(every, timeout_s=address.timeout_s)
    listed = [
        {
            "factor": factor,
            "kind": found.kinds[k],
            "between": [format_symbol(key) for key in found.keys[k].tolist()],
            "state": found.states[k],
            "reason": found.reasons[k],
            "distance": _told(float(found.distance[k])),
            "chance": _told(float(found.chance[k])),
            **({} if found.weight is None else {"weight": _told(float(found.weight[k]))}),
            "came": int(found.came[k]),
            "since": int(found.changed[k]),
        }
        for k, factor in enumerate(found.factors.tolist())
    ]
    if as_json:
        content = {"revision": found.revision, "closures": found.policy, "counts": found.counts}
        document(content | {"listed": listed})
        return OK
    if found.policy == "trust":
        rows = [("closures", "are trusted: this map tests none (`factorbus serve --closures test`, or robust)")]
    else:
        rows = [(state, str(count)) for state, count in found.counts.items()]
        if not any(found.counts.values()):
            rows = [("closures", "none: no factor in the map closes a loop yet")]
    for row in listed[:_SHOWN]:
        rows.append((str(row["factor"]), _in_words(row)))
    if len(listed) > _SHOWN:
        rows.append(("", f"and {counted(len(listed) - _SHOWN, 'closure')} more: --json lists all"))
    table(rows, title=f"At revision {found.revision}")
    return OK


def _in_words(row: dict) -> str:
    distance = "" if row["distance"] is None else f", d² {row['distance']:.4g}"
    odds = "weight" if "weight" in row else "chance"
    numbers = distance + ("" if row[odds] is None else f", {odds} {row[odds]:.2g}")
    return f"{' '.join(row['between'])}: {row['state']}, {row['reason']}{numbers}, since revision {row['since']}"


def _told(number: float) -> float | None:
    """None of one that nobody has looked at."""
    return number if math.isfinite(number) else None
