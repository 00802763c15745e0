"""`factorbus doctor`: what is wrong on this machine, and how to mend it."""

from dataclasses import asdict

import click

from factorbus.cli.output import console as screen
from factorbus.cli.output.exits import FAILED, OK
from factorbus.cli.process.options import json_option, zenoh_option

_SIGNS = {"ok": "[green]ok[/]", "warn": "[yellow]warn[/]", "fail": "[red]FAIL[/]"}


@click.command()
@click.option("--connect", "endpoint", metavar="ENDPOINT", help="Look at the services there as well.")
@zenoh_option
@json_option
def command(endpoint: str | None, zenoh: str, as_json: bool) -> int:
    """Look at versions, extras, SuiteSparse and its BLAS, caches, clocks, shared memory, permissions, ports, bus.

    With --connect also at the services there: are they alive, is there memory left, do versions fit, who has to
    wait. A warning is something that works but could be better; with a failure the exit code is 1.

    \b
    factorbus doctor
    factorbus doctor --connect tls/solver.local:7447 --zenoh operator1.json5
    factorbus doctor --json
    """
    from factorbus.cli.doctor.checks import CHECKS
    from factorbus.proto.endpoints import checked_endpoint

    if endpoint:
        checked_endpoint(endpoint)  # before the checks of this machine, which take a while
    findings = []
    for look in CHECKS:
        screen.print_note(f"looking at {look.__doc__}")
        findings.append(look())
    if endpoint:
        from factorbus.cli.doctor.service_checks import services

        screen.print_note(f"looking at the services at {endpoint}")
        findings += services(endpoint, zenoh)
    failed = sum(finding.state == "fail" for finding in findings)
    if as_json:
        screen.document({"healthy": not failed, "checks": [asdict(finding) for finding in findings]})
    else:
        screen.table([(f.name, _line(f.state, f.seen, f.mend)) for f in findings], title="factorbus doctor")
        warned = sum(finding.state == "warn" for finding in findings)
        click.echo(f"{len(findings) - failed - warned} ok, {warned} to look at, {failed} to mend")
    return FAILED if failed else OK


def _line(state: str, seen: str, mend: str) -> str:
    from rich.markup import escape

    return f"{_SIGNS[state]}  {escape(seen)}" + (f"\n      → {escape(mend)}" if mend else "")
