"""`factorbus stats`: what services count and time, asked over the bus."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import click

from factorbus.cli.commands.components import components_document, components_line
from factorbus.cli.output.exits import FAILED, OK
from factorbus.cli.process.options import connect_option, json_option, timeout_option, zenoh_option
from factorbus.proto.problems import UnknownMap
from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.client import Bus


@click.command()
@click.argument("name", metavar="[MAP]", required=False)
@connect_option
@zenoh_option
@timeout_option(5)
@json_option
def command(name: str | None, endpoint: str, zenoh: str, timeout_s: float, as_json: bool) -> int:
    """Show how services are, what their maps hold, and how long steps and inserts take; with MAP, of that map alone.

    The mode is how a map is solved: bayes-tree unless somebody chose another (see factorbus replay --help).
    Of one map it also says which parts of it no factor joins, which `factorbus ask components` has in full.
    At a router every service answers. Where access control is on, ask as an operator. The exit code is 1 when a
    service says that it is not alive: one of its threads is stuck.

    \b
    factorbus stats
    factorbus stats warehouse
    factorbus stats --connect tls/solver.local:7447 --zenoh ops.json5 --json
    """
    from factorbus.cli.output import console as screen
    from factorbus.cli.process.bus import open_bus

    with open_bus(endpoint, "stats", zenoh, timeout_s) as bus:
        services = sorted(bus.stats(), key=lambda each: str(each.get("service")))
        if name is not None:
            services = _of_map(services, name)
            _ask_components(bus, name, services)
    if as_json:
        screen.document({"services": services})
    else:
        for each in services:
            screen.table(_rows(each), title=f"service {each['service']}")
    return OK if all(each["alive"] for each in services) else FAILED


def _of_map(services: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """The services that have map `name`, with its row alone.  Raises UnknownMap."""
    found = []
    for each in services:
        own = {rows: [row for row in each.get(rows, ()) if row["name"] == name] for rows in ("maps", "unopened")}
        interests = [row for row in each.get("interests", ()) if row["map"] == name]
        if any(own.values()):
            found.append(each | own | {"interests": interests})
    if not found:
        rows = [row for each in services for row in (*each["maps"], *each.get("unopened", ()))]
        raise UnknownMap(name, sorted(row["name"] for row in rows))
    return found


def _ask_components(bus: "Bus", name: str, services: list[dict[str, Any]]) -> None:
    """Put which parts of map `name` nothing joins into its row; where no answer comes, all else is shown."""
    from factorbus.proto.problems import Problem

    try:
        with bus.map(name, mirror=False, create=False) as joined:
            found = components_document(joined.components())
    except Problem:
        return
    for row in (row for each in services for row in each["maps"]):
        row["components"] = found


def _rows(service: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    state = "ready" if service["ready"] else "alive, not ready" if service["alive"] else "stuck"
    stuck = f": {', '.join(service['stuck'])}" if service["stuck"] else ""
    yield "state", f"{state}{stuck}, for {_span(service['uptime_s'])}, version {service['version']}"
    memory = service["memory"]
    yield "memory", f"{memory['resident_bytes'] >> 20} MiB of {memory['limit_bytes'] >> 20} MiB"
    workers = service.get("workers", ())
    told = ", ".join(f"{each['name']} ({each['in_flight']} of {each['slots']})" for each in workers)
    yield "workers", told or "none: jobs are done in place"
    for row in service["maps"]:
        yield f"map {row['name']}", _map(row)
        if follows := row.get("upstream"):
            yield f"map {row['name']} follows", _upstream(follows)
    for row in service.get("interests", ()):
        yield f"interest in {row['map']}", interest_line(row)
    for row in service.get("unopened", ()):
        yield f"map {row['name']}", f"does not open ({row['state']}): {row['problem']}"
    for name, value in shown_fields(service.get("journal", {})):
        yield f"journal {name}", value


def _upstream(row: Mapping[str, Any]) -> str:
    link = f"{'connected' if row['connected'] else 'out of reach'} for {_span(row['since_s'])}"
    told = f"{row['endpoint']}, {link}, behind by {counted(row['behind'], 'insert')}"
    told += f", rebased {counted(row['rebased'], 'time')}" if row["rebased"] else ""
    return told + (f": {row['problem']}" if row["problem"] else "")


def _map(row: Mapping[str, Any]) -> str:
    inserts = row["inserts"]
    lines = [
        f"{counted(row['variables'], 'variable')}, {counted(row['factors'], 'factor')}, revision {row['revision']:,}, "
        f"mode {row['mode']}",
        f"χ² {row['chi2']:.6g}, {_convergence(row)}; {_steps(row['strategies'])}",
        f"steps take {_times(row['step_s'])}; inserts {_times(row['insert_s'])}",
        f"inserts: {inserts['accepted']} accepted, {inserts['refused']} refused{_codes(row['refusals'])}, "
        f"{inserts['busy']} answered busy; {row['waiting']} waiting, {row['parked']} parked; "
        f"{counted(row['clients'], 'client')}",
        *([budget_line(row["budget"])] if "budget" in row else []),
        *([_closures(row["closure_states"], row.get("closures", ""))] if "closure_states" in row else []),
        *([_kept(row)] if "kept" in row else []),
        *([components_line(row["components"])] if "components" in row else []),
        *([f"not reproducible: {row['reason']}"] if row.get("reproducible") is False else []),
        *(f"journal {name}: {value}" for name, value in shown_fields(row.get("journal", {}))),
    ]
    return "\n".join(lines)


def _closures(states: Mapping[str, int], policy: str) -> str:
    """How many loop closures are in each state."""
    told = ", ".join(f"{count} {state}" for state, count in states.items())
    return f"loop closures are {'weighed' if policy == 'robust' else 'tested'}: {told}"


def _kept(row: Mapping[str, Any]) -> str:
    """What the map keeps, and what became of the rest since the service has it open."""
    kept = row["kept"]
    lost = f"which lost {kept['loss']:.3g} nats, {kept['largest_loss']:.3g} of one at most" if kept["loss"] else ""
    left = f"{kept['left']} more cannot go" if kept["left"] else ""
    gone = ", ".join(filter(None, (f"{counted(kept['removed_poses'], 'pose')} taken out", lost, left)))
    return f"keeps {row['keep']}: {gone}" + ("; the last try failed, see the service's log" if kept["failed"] else "")


def budget_line(row: Mapping[str, Any]) -> str:
    """The budget of a map's steps, and what the last one left."""
    told = f"the last took {row['step_ms']:.2f} ms and left {left_of(row)}"
    return f"steps have a budget of {row['budget_ms']:g} ms; {told}; {row['units_per_ms']:.3g} units for a millisecond"


def left_of(row: Mapping[str, Any]) -> str:
    """What a step with a budget left for later ones."""
    if row["complete"]:
        return "nothing"
    deferred = counted(row["deferred_relinearizations"], "relinearization")
    above = "" if row["unsolved"] is None else f", χ² some {row['unsolved']:.3g} above its optimum"
    return f"{deferred} and more{above}"


def interest_line(row: Mapping[str, Any]) -> str:
    """An interest, and what its channel has carried."""
    carried = (counted(row[f"{name}s"], name) for name in ("message", "answer", "byte"))
    told = f"{', '.join(carried)}, {counted(row['waiting'], 'variable')} waiting"
    return f"{part_of(row)}, every {row['period_ms']} ms{_bound(row)}: {told}"


def part_of(row: Mapping[str, Any]) -> str:
    """Which part of a map an interest is about."""
    letters = ", ".join(letter or "no letter" for letter in row["letters"])
    parts = [letters, ", ".join(row["kinds"]), "box " + " ".join(f"{each:g}" for each in row["box"])]
    return (
        "; ".join(part for part, given in zip(parts, (letters, row["kinds"], row["box"]), strict=True) if given)
        or "all"
    )


def _bound(row: Mapping[str, Any]) -> str:
    return f", at most {counted(row['bytes_per_s'], 'byte')} a second" if row["bytes_per_s"] else ""


def shown_fields(fields: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Fields that have something to say: names in words, times to three digits."""
    for name, value in fields.items():
        if value not in ("", None):
            is_long = isinstance(value, float) and abs(value) < 1000
            shown = f"{value:.3g}" if is_long else f"{value:,.0f}" if isinstance(value, float) else str(value)
            yield name.replace("_", " "), shown


def _convergence(row: Mapping[str, Any]) -> str:
    state = "converged" if row["converged"] else "not converged"
    so_far = f" after {counted(row['further_steps'], 'further step')}"
    if row["converging"]:
        return f"{state}, converging,{so_far}"
    if not row["gave_up"]:
        return state
    if row["converged"]:
        return f"converged to a thousandth of χ²; gave up coming nearer{so_far}, as {row['gave_up']}"
    return f"{state}{so_far}: gave up, as {row['gave_up']}"


def _steps(strategies: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {strategy}" for strategy, count in strategies.items()) or "no step yet"


def _codes(refusals: Mapping[str, int]) -> str:
    told = ", ".join(f"{count} {code}" for code, count in refusals.items() if code != "busy")
    return f" ({told})" if told else ""


def _times(histogram: Mapping[str, Any]) -> str:
    """Half and 99 of 100 of them, by the bounds between which they were counted."""
    if not sum(histogram["counts"]):
        return "no time yet"
    return " and ".join(
        f"{_below(histogram, share)} ({name})" for name, share in (("half of them", 0.5), ("99 of 100", 0.99))
    )


def _below(histogram: Mapping[str, Any], share: float) -> str:
    reached, wanted = 0, share * sum(histogram["counts"])
    for bound, count in zip(histogram["bounds_s"], histogram["counts"], strict=False):
        reached += count
        if reached >= wanted:
            return f"at most {1e3 * bound:g} ms"
    return f"more than {histogram['bounds_s'][-1]:g} s"


def _span(seconds: float) -> str:
    for unit, size in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"
