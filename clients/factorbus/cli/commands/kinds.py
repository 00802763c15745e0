"""`factorbus kinds`: the kinds of factors, and what a formula of one's own means."""

from typing import TYPE_CHECKING, Any

import click

from factorbus.cli.output.exits import REFUSED, Stopped, require
from factorbus.cli.process.options import connect_option, json_option, timeout_option, zenoh_option
from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.proto.expressions.declaration import Declaration
    from factorbus.proto.kinds import FactorKind


@click.command()
@click.argument("formula", required=False)
@click.option("--map", "name", metavar="MAP", help="The own kinds that this map has factors of.")
@click.option("--operations", is_flag=True, help="What a formula may do, and what it may not.")
@click.option(
    "--test", is_flag=True, help="Hold the solver's Jacobian of FORMULA against differences, at random values."
)
@connect_option
@zenoh_option
@timeout_option(30)
@json_option
def command(
    formula: str | None,
    name: str | None,
    operations: bool,
    test: bool,
    endpoint: str,
    zenoh: str,
    timeout_s: float,
    as_json: bool,
) -> None:
    """List the kinds of factors; or say what FORMULA means, a kind of your own or the name of one in the list.

    \b
    factorbus kinds
    factorbus kinds range_se2_bias
    factorbus kinds --operations
    factorbus kinds 'near(a:se2,l:point2,z:1)=subtract(norm(act(inverse(a),l)),z)' --test
    factorbus kinds --map warehouse
    """
    if (formula is not None) + (name is not None) + operations > 1 or (test and formula is None):
        raise click.UsageError("give FORMULA (with --test or without), --map or --operations")
    from factorbus.cli.output import console as screen
    from factorbus.proto.expressions.operations import ABSENT, LEGEND

    if operations:
        found = _operations()
    elif name is not None:
        found = {kind.called: kind.name for kind in _of_map(name, endpoint, zenoh, timeout_s)}
    elif formula is None:
        found = _every()
    elif "(" not in formula:
        found = _of_name(formula, test)
    else:
        declared = _declared(formula)
        found = _meaning(declared) | ({"test": _tested(declared)} if test else {})
    notes = [LEGEND, ABSENT] if operations else []
    if as_json:
        screen.document({"kinds": found} | ({"notes": notes} if notes else {}))
    elif found:
        screen.table((called, str(means)) for called, means in found.items())
    else:
        screen.print_note(f"map {name} has factors of no kinds but the service's")
    for note in [] if as_json else notes:
        click.echo(note)


def _operations() -> dict[str, str]:
    from factorbus.proto.expressions.operations import OPERATIONS

    return {each.signature(): f"{each.forms}: {each.means}" for each in OPERATIONS.values()}


def _every() -> dict[str, str]:
    """Those that are in a table, and the families of those that are made when they are named."""
    from factorbus.proto import inertial
    from factorbus.proto.kinds import FACTOR_KINDS, LINEAR_NAME, linear_kind

    samples = inertial.ImuForm(1)
    families = {
        LINEAR_NAME: f"any: {linear_kind(1, ('se2',)).residual}",
        inertial.NAME: f"{', '.join(samples.ends)}: {samples.residual}",
    }
    return {kind.name: f"{', '.join(kind.connects)}: {kind.residual}" for kind in FACTOR_KINDS.values()} | families


def _of_name(name: str, test: bool) -> dict[str, Any]:
    """What a kind means that is no formula."""
    from factorbus.proto.kinds import FACTOR_KINDS
    from factorbus.proto.problems import UnknownKind

    if name not in FACTOR_KINDS:
        raise Stopped("unknown_kind", str(UnknownKind("FORMULA", name, FACTOR_KINDS.names(name))), REFUSED)
    if test:
        raise click.UsageError(f"--test is of a formula, and {name} is a kind of the service, whose tests hold it")
    kind = FACTOR_KINDS[name]
    return {
        "name": name,
        "variables": ", ".join(kind.connects),
        "measured": kind.measured,
        "residual": f"{counted(kind.dim, 'number')}: {kind.residual}",
    }


def _declared(formula: str) -> "Declaration":
    from factorbus.proto.expressions.declaration import BadExpression
    from factorbus.proto.expressions.formula import read_formula
    from factorbus.proto.kinds import own_kind

    try:
        own_kind(declared := read_formula(formula))
    except BadExpression as problem:
        raise Stopped("unknown_kind", str(problem), REFUSED) from None
    return declared


def _meaning(declared: "Declaration") -> dict[str, Any]:
    from factorbus.proto.expressions.frames import moving_ends
    from factorbus.proto.kinds import own_kind

    kind, moving, names = own_kind(declared), moving_ends(declared), declared.parameters
    on_robot = ", ".join(names[n] for n, role in enumerate(kind.each_role) if role)
    frame = "it says where they are in the map" if moving is None else "the same wherever the map lies"
    return {
        "name": kind.called,
        "variables": ", ".join(f"{called} ({of})" for called, of in declared.variables),
        "measured": kind.measured,
        "residual": counted(kind.dim, "number"),
        "frame": f"{frame}; on the robot: {on_robot}" if on_robot else frame,
        "nodes": len(declared.nodes),
        "formula": kind.name,
    }


def _tested(declared: "Declaration") -> str:
    require("service", "factorbus kinds --test")
    from factorbus.service.operations.check_kind import largest_difference

    found = largest_difference(declared)
    if found is None:
        raise Stopped(
            "not_finite", f"{declared.name} is no number at any of the random values that were tried", REFUSED
        )
    return f"at {found.tried} random values the solver's Jacobian is within {found.difference:.1e} of differences"


def _of_map(name: str, endpoint: str, zenoh: str, timeout_s: float) -> list["FactorKind"]:
    from factorbus.cli.process.bus import open_bus
    from factorbus.proto.kinds import FACTOR_KINDS

    with open_bus(endpoint, "kinds", zenoh, timeout_s) as bus, bus.map(name, mirror=False, create=False) as joined:
        kinds = {group.kind: FACTOR_KINDS[group.kind] for group in joined.graph().batch.factors}
    return [kind for kind in kinds.values() if kind.own]
