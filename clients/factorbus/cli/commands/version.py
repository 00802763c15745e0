"""`factorbus version`."""

import platform

import click

from factorbus.cli.output.versions import LIBRARIES, installed


@click.command()
def command() -> None:
    """The version, and those of the libraries it runs on.

    \b
    factorbus version
    """
    from factorbus.proto.version import __version__

    click.echo(f"factorbus {__version__}")
    click.echo(f"  python         {platform.python_version()} on {platform.system()} {platform.machine()}")
    for name in LIBRARIES:
        click.echo(f"  {name:<14} {installed(name) or 'not installed'}")
