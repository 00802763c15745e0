"""How what is missing is installed, for the copy of factorbus that runs: nothing of it need be in a package index."""

import json
import os
import shlex
import shutil
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

_NAME = "factorbus"


def install_command(*extras: str) -> str:
    """The command that adds `extras` to the installation at hand, as it is typed in the working directory."""
    return f"{_pip()} install {requirement(extras, origin())}"


def requirement(extras: tuple[str, ...], installed_from: Mapping[str, Any]) -> str:
    """What pip is to install, quoted for a shell.  installed_from: as `origin` returns it."""
    bracket, url = f"[{','.join(extras)}]", str(installed_from.get("url", ""))
    if not url:
        return shlex.quote(_NAME + bracket)
    if "dir_info" in installed_from:
        folder = Path(unquote(urlsplit(url).path))
        path = "." if folder == Path.cwd() else str(folder)
        editable = "-e " if installed_from["dir_info"].get("editable") else ""
        return editable + shlex.quote(path + bracket)
    if "vcs_info" in installed_from:
        version = installed_from["vcs_info"]
        url = f"{version['vcs']}+{url}@{version.get('requested_revision') or version['commit_id']}"
    return shlex.quote(f"{_NAME}{bracket} @ {url}")


def origin() -> Mapping[str, Any]:
    """Where this copy was installed from (PEP 610): a folder, a wheel, a repository; empty for a package index."""
    try:
        told = distribution(_NAME).read_text("direct_url.json")
    except PackageNotFoundError:  # it runs from its sources, without being installed
        return {}
    return json.loads(told) if told else {}


def _pip() -> str:
    """`pip` where that is the one of this interpreter, else the interpreter and its module."""
    here = Path(sys.executable)
    if (found := shutil.which("pip")) and Path(found).parent == here.parent:
        return "pip"
    python = os.path.relpath(here) if here.is_relative_to(Path.cwd()) else str(here)
    return f"{shlex.quote(python)} -m pip"
