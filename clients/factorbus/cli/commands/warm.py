"""`factorbus warm`: compile every kernel ahead, so that no robot waits for it."""

import os
import tempfile
from pathlib import Path

import click

from factorbus.cli.output.console import document, print_note
from factorbus.cli.output.exits import Stopped, require
from factorbus.cli.process.options import json_option


@click.command()
@json_option
def command(as_json: bool) -> None:
    """Compile the kernels of solver, service and workers into the cache, and say how long it took.

    Do it once after installing or upgrading, on each machine that runs `factorbus serve` or `factorbus work`.
    A second time it only loads them.

    \b
    factorbus warm
    """
    require("service", "factorbus warm")
    _check_cache()
    from factorbus.service.operations.warm import seconds_compiling, warm_service

    compiled: list[str] = []

    def show(kernel: str) -> None:
        compiled.append(kernel)
        print_note(f"  compiling {kernel}")

    seconds = warm_service(show)
    if as_json:
        document({"seconds": seconds, "compiling_seconds": seconds_compiling(), "compiled": compiled})
        return
    click.echo(f"kernels ready in {seconds:.1f} s, {seconds_compiling():.1f} s of it compiling")


def _check_cache() -> None:
    """Kernels that cannot be kept would be compiled for nothing.  Raises Stopped."""
    base = Path(os.environ.get("FACTORBUS_CACHE") or Path.home() / ".cache" / "factorbus").expanduser()
    try:
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=base).close()
    except OSError as error:
        raise Stopped(
            "cannot_write",
            f"compiled kernels cannot be kept in {base}: {error.strerror}; name a folder that can be written with "
            "FACTORBUS_CACHE, or make this one so",
            path=str(base),
        ) from error
