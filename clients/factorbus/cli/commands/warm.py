"""`factorbus warm`: compile every kernel ahead, so that no robot waits for it."""

import click

from factorbus.cli.output.console import print_note
from factorbus.cli.output.exits import require


@click.command()
def command() -> None:
    """Compile the kernels of solver, service and workers into the cache, and say how long it took.

    Do it once after installing or upgrading, on each machine that runs `factorbus serve` or `factorbus work`.
    A second time it only loads them.

    \b
    factorbus warm
    """
    require("service", "factorbus warm")
    from factorbus.service.operations.warm import seconds_compiling, warm_service

    seconds = warm_service(lambda kernel: print_note(f"  compiling {kernel}"))
    click.echo(f"kernels ready in {seconds:.1f} s, {seconds_compiling():.1f} s of it compiling")
