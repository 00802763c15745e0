"""Pages that are served to browsers know no users: they do not go beyond this machine unless one says so."""

import ipaddress
from collections.abc import Callable
from typing import Any, TypeVar

import click

from factorbus.cli.output.exits import USAGE, Stopped

F = TypeVar("F", bound=Callable[..., Any])


def insecure_option(command: F) -> F:
    """--insecure."""
    text = "Serve to other machines, too: everybody who reaches the port sees every map."
    return click.option("--insecure", is_flag=True, help=text)(command)


def refuse_open_page(host: str, insecure: bool) -> None:
    """Raises Stopped where other machines could reach `host`, and nobody said that they may."""
    if not insecure and not is_loopback(host):
        raise Stopped(
            "exposed",
            f"{host} can be reached from other machines, and a page for browsers asks nobody who they are; serve it at "
            "127.0.0.1, behind a proxy that asks if others are to see it, or say --insecure to be open to everybody",
            USAGE,
            host=host,
        )


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches `host`.  A name other than localhost may stand for anything."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
