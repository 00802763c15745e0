"""`factorbus budget`: what the steps of a map may take, from the next one on."""

import click

from factorbus.cli.process.options import connect_option, json_option, timeout_option, zenoh_option


# What begins with a minus is a number here, to be refused as one.
@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("name", metavar="MAP")
@click.argument("budget", metavar="MS|none")
@connect_option
@zenoh_option
@timeout_option(30)
@json_option
def command(name: str, budget: str, endpoint: str, zenoh: str, timeout_s: float, as_json: bool) -> None:
    """Give the steps of MAP a budget of MS milliseconds, from the next one on; none takes it away.

    What does not fit into a step follows in later ones. Without a budget the next step does all that was left. The
    journal has the budget, so it stays when the service is restarted, and a fork has it too. Where access control is
    on, ask as an operator. `factorbus maps` lists the budgets, and `factorbus stats MAP` says what steps make of them.

    \b
    factorbus budget yard 10
    factorbus budget yard none
    factorbus budget yard 2.5 --connect tls/router.local:7447 --zenoh ops.json5
    """
    from factorbus.cli.output.console import document
    from factorbus.cli.process.bus import open_bus

    budget_ms = _read(budget)
    with open_bus(endpoint, "budget", zenoh, timeout_s) as bus:
        row = bus.set_budget(name, budget_ms)
    if as_json:
        document({"map": name, "budget_ms": row.budget_ms or None})
        return
    click.echo(f"steps of {name} have " + (f"a budget of {row.budget_ms:g} ms" if row.budget_ms else "no bound"))


def _read(text: str) -> float:
    if text == "none":
        return 0.0
    from factorbus.proto.budget import BUDGET_WANTED, checked_budget

    try:
        return checked_budget(float(text))
    except ValueError:
        raise click.BadParameter(
            f"{text!r} is no number; wanted {BUDGET_WANTED}, such as 10, or none", param_hint="MS|none"
        ) from None
