"""`factorbus version`."""

import platform
from importlib import metadata

import click

LIBRARIES = ("eclipse-zenoh", "msgpack", "numpy", "numba", "llvmlite", "scipy", "scikit-sparse", "matplotlib")


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


def installed(distribution: str) -> str | None:
    """The installed version of `distribution`, or None."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
