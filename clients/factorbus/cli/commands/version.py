"""`factorbus version`."""

import platform

import click

from factorbus.cli.output.versions import LIBRARIES, installed
from factorbus.cli.process.options import json_option


@click.command()
@json_option
def command(as_json: bool) -> None:
    """The version, and those of the libraries it runs on.

    \b
    factorbus version
    """
    from factorbus.cli.output.console import document
    from factorbus.proto.version import __version__

    if as_json:
        libraries = {name: installed(name) or None for name in LIBRARIES}
        document({"factorbus": __version__, "python": platform.python_version(), "libraries": libraries})
        return
    click.echo(f"factorbus {__version__}")
    click.echo(f"  python         {platform.python_version()} on {platform.system()} {platform.machine()}")
    for name in LIBRARIES:
        click.echo(f"  {name:<14} {installed(name) or 'not installed'}")
