"""The page of the commands: what `factorbus COMMAND --help` says, of each, in place of a mark and the line below it."""

from collections.abc import Iterator

import click
from sphinx.application import Sphinx

from factorbus.cli.main import cli

_WIDTH = 104


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", _fill)
    return {"parallel_read_safe": True}


def _fill(_app: Sphinx, _page: str, content: list[str]) -> None:
    before, mark, behind = content[0].partition("<!-- [commands] -->\n")
    if mark:  # below it is what somebody reads who has no site
        content[0] = before + "\n".join(_sections(cli, "factorbus", 2)) + "\n" + behind.partition("\n")[2]


def _sections(group: click.Group, name: str, level: int, parent: click.Context | None = None) -> Iterator[str]:
    """Heading and help of each command of a group, and of theirs."""
    above = click.Context(group, info_name=name if parent is None else name.split()[-1], parent=parent)
    for word in group.list_commands(above):
        command = group.get_command(above, word)
        assert command is not None
        context = click.Context(command, info_name=word, parent=above, terminal_width=_WIDTH)
        yield f"\n{'#' * level} {name} {word}\n\n```text\n{command.get_help(context)}\n```\n"
        if isinstance(command, click.Group):
            yield from _sections(command, f"{name} {word}", level + 1, above)
