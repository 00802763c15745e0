"""`factorbus access`: from a list of names by role to the Zenoh configurations that enforce it, and that meet it."""

import json
import os
from pathlib import Path
from typing import Any

import click

from factorbus.cli.output.console import document
from factorbus.cli.output.exits import USAGE, Stopped, input_file, output_file
from factorbus.cli.process.options import file_argument, json_option, out_option


@click.command()
@file_argument("file")
@click.option(
    "--certificates", default="/etc/factorbus/certificates", show_default=True, metavar="FOLDER", help="Of ca.pem etc."
)
@click.option("--name", default="solver", show_default=True, metavar="NAME", help="NAME.pem and NAME.key serve.")
@click.option("--users", default="", metavar="FILE", help="Know clients by password; lines NAME:PASSWORD.")
@click.option("--client", default="", metavar="NAME", help="Write the configuration of client NAME instead.")
@out_option("--out", "out", "Write it here instead of to standard output.", "FILE.json5")
@json_option
def command(file: Path, certificates: str, name: str, users: str, client: str, out: Path | None, as_json: bool) -> None:
    """Write the Zenoh configuration that lets everybody in FILE.toml do their part, and nobody else anything.

    The file has a table for each role: front_end, viewer, worker, operator, replica, and at a router also service and
    router.

    A name is the common name of a certificate (deploy/zenoh/certificates.sh), or with --users a user with a password.
    Give the result to `factorbus serve --zenoh`, or to the Zenoh router that everybody connects to. It is JSON already:
    with --json and --out the document says which file was written.

    \b
      [front_end]                       # inserts under its own name
      robot1 = ["kitchen"]              # the maps it works on
      robot2 = ["kitchen", "site7-*"]
      [viewer]
      wall = ["*"]
      [worker]
      worker1 = []
      [operator]
      ops = ["*"]

    \b
    factorbus access access.toml --out service.json5
    factorbus access access.toml --client robot1 --out robot1.json5
    factorbus access access.toml --users /etc/factorbus/users.txt --out service.json5
    """
    from factorbus.service.bus.access import access_control, read_grants

    with input_file(file):
        grants = read_grants(file.read_text(), str(file))
    if client:
        if client not in (grant.name for grant in grants):
            raise Stopped("bad_option", f"{file} has no {client}; add it under its role first", USAGE)
        configuration = {"transport": _client(certificates, client, users, out)}
    else:
        configuration = {
            "transport": _server(certificates, name, users),
            "access_control": access_control(grants, "usernames" if users else "cert_common_names"),
        }
    _write(json.dumps(configuration, indent=2) + "\n", out, secret=bool(client and users))
    if as_json and out is not None:
        document({"files": [str(out)]})


def _server(certificates: str, name: str, users: str) -> dict[str, Any]:
    """Both sides of TLS: a service or router is connected to, and may itself connect to routers."""
    tls: dict[str, Any] = {"root_ca_certificate": f"{certificates}/ca.pem", "enable_mtls": not users}
    for side in ("listen", "connect"):
        tls[f"{side}_certificate"] = f"{certificates}/{name}.pem"
        tls[f"{side}_private_key"] = f"{certificates}/{name}.key"
    # A certificate that has run out ends its connections, too.
    tls["close_link_on_expiration"] = True
    transport: dict[str, Any] = {"link": {"tls": tls}}
    if users:
        transport["auth"] = {"usrpwd": {"dictionary_file": users}}
    return transport


def _client(certificates: str, client: str, users: str, out: Path | None) -> dict[str, Any]:
    tls: dict[str, Any] = {"root_ca_certificate": f"{certificates}/ca.pem"}
    if not users:
        tls |= {
            "enable_mtls": True,
            "connect_certificate": f"{certificates}/{client}.pem",
            "connect_private_key": f"{certificates}/{client}.key",
        }
        return {"link": {"tls": tls}}
    if out is None:
        raise Stopped("bad_option", "a password is not for the screen: give --out FILE.json5", USAGE)
    password = _password(Path(users), client)
    return {"link": {"tls": tls}, "auth": {"usrpwd": {"user": client, "password": password}}}


def _password(users: Path, client: str) -> str:
    with input_file(users):
        lines = users.read_text().splitlines()
    for line in lines:
        user, _, password = line.partition(":")
        if user == client and password:
            return password
    raise Stopped("bad_option", f"{users} has no line {client}:PASSWORD; add it", USAGE)


def _write(text: str, out: Path | None, secret: bool) -> None:
    if out is None:
        click.echo(text, nl=False)
        return
    with output_file(out), os.fdopen(os.open(out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
        os.fchmod(file.fileno(), 0o600 if secret else 0o644)
        file.write(text)
    click.echo(f"{out} written", err=True)
