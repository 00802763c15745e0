"""`factorbus explain`: what an error code means, and what to do."""

import difflib
import re
from pathlib import Path

import click

from factorbus.cli.exits import USAGE, Stopped

_PAGES = Path(__file__).with_name("codes.md")


@click.command()
@click.argument("code", required=False)
def command(code: str | None) -> None:
    """Say what the error CODE means and what to do about it; without CODE, list all of them.

    The code of an error is what stands in brackets behind it.

    \b
    factorbus explain underconstrained
    factorbus explain
    """
    pages = read_pages()
    if code is None:
        for name, text in pages.items():
            click.echo(f"{name:<22} {text.splitlines()[0]}")
        return
    name = code.strip("[] ").lower()
    if name not in pages:
        near = difflib.get_close_matches(name, pages, n=3)
        hint = f"did you mean {' or '.join(near)}?" if near else "factorbus explain lists all of them"
        raise Stopped("unknown_code", f"there is no error code {name!r}; {hint}", USAGE, seen=name)
    click.echo(f"{name}\n\n{pages[name]}")


def read_pages() -> dict[str, str]:
    """Code → its page, from the file beside this one."""
    text = _PAGES.read_text(encoding="utf-8")
    return {name: page.strip() for name, page in re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", text, re.M | re.S)}
