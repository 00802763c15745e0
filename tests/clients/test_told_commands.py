"""Every `factorbus` command that a document or a help text tells one to type is one that there is, with its options."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from factorbus.cli.main import COMMANDS, cli

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "[a-z]*/**/*.md")
    for path in ROOT.glob(pattern)
    if not {"out", "node_modules", ".venv"} & set(path.relative_to(ROOT).parts) and path.name != "CHANGELOG.md"
)
_SHELL = re.compile(r"\s*(?:&&|\|\||[|;>&#(]|2>)")


def typed(text: str) -> Iterator[str]:
    """The commands in lines of a shell, each without what the shell does with it."""
    formulas = re.sub(r"'\w+\([^'\n]*'", "FORMULA", text)  # what is quoted is no shell's
    for line in formulas.replace("\\\n", " ").splitlines():
        for part in re.split(r"&&|;|\|", line):
            found = re.match(r"\s*(?:\$ )?(?:sudo |exec )?(?:[A-Z_]+=\S+ )*factorbus (\S.*)", part)
            if found:
                yield re.split(r"\s{3,}", _SHELL.split(found[1] + " ")[0].strip())[0]


def in_documents() -> list[tuple[str, str]]:
    found = []
    for path in DOCUMENTS:
        for language, block in re.findall(
            r"^\s*```(\w*)\n(.*?)^\s*```$", path.read_text(encoding="utf-8"), re.M | re.S
        ):
            if language in ("bash", "sh", "console"):
                found += [(str(path.relative_to(ROOT)), command) for command in typed(block)]
    return found


def in_help() -> list[tuple[str, str]]:
    found = []

    def look(command: click.Command, name: str) -> None:
        found.extend((name, each) for each in typed(command.help or ""))
        if isinstance(command, click.Group):
            for inner in command.list_commands(click.Context(command)):
                if (sub := command.get_command(click.Context(command), inner)) is not None:
                    look(sub, f"{name} {inner}")

    for name in COMMANDS:
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        look(command, name)
    return found


def parse(words: list[str]) -> None:
    """Parse as the command line would, and run nothing.  Raises click.UsageError."""
    command: click.Command = cli
    context = click.Context(cli)
    while isinstance(command, click.Group):
        with command.make_context(command.name, words, parent=context) as context:
            # What click has of a group's command, and gives to nobody but itself.
            rest = [*context._protected_args, *context.args]
            if not rest:
                return
            name, found, words = command.resolve_command(context, rest)
            assert found is not None, name
            command = found
    command.make_context(command.name, words, parent=context).close()


@pytest.fixture(autouse=True)
def _somewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot1.yaml").write_text("/**:\n  ros__parameters:\n    map: yard\n")  # read while it is parsed
    monkeypatch.setattr("factorbus.cli.process.options.os.path.isdir", lambda _: True)
    monkeypatch.setattr(Path, "is_dir", lambda path: "." not in path.name)  # folders that examples write to
    monkeypatch.setattr("factorbus.cli.process.options.os.access", lambda *_: True)


@pytest.mark.parametrize(("where", "command"), in_documents() + in_help())
def test_a_command_that_is_told_is_one_that_there_is(where: str, command: str) -> None:
    try:
        parse(shlex.split(command))
    except click.exceptions.Exit:
        pass  # --help, --version
    except click.UsageError as error:
        pytest.fail(f"{where}: factorbus {command}\n{error.format_message()}")


def test_there_are_many_and_a_wrong_one_is_seen() -> None:
    assert len(in_documents()) > 40
    assert len(in_help()) > 80
    for wrong in ("replay --evry 100 a.g2o", "frobnicate", "ask covarianze hall", "plot map a.g2o --ellipses -1"):
        with pytest.raises(click.UsageError):
            parse(shlex.split(wrong))


def test_every_command_that_connects_takes_a_zenoh_configuration() -> None:
    """Where a service asks for a certificate a command without one is of no use."""
    without, many = [], 0

    def look(command: click.Command, name: str) -> None:
        nonlocal many
        if isinstance(command, click.Group):
            for inner in command.list_commands(click.Context(command)):
                if (sub := command.get_command(click.Context(command), inner)) is not None:
                    look(sub, f"{name} {inner}")
            return
        taken = {option for parameter in command.params for option in parameter.opts}
        many += "--connect" in taken
        if "--connect" in taken and "--zenoh" not in taken:
            without.append(name)

    look(cli, "factorbus")
    assert not without
    assert many > 20
