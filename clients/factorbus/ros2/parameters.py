"""A parameters file of ROS 2 (`ros__parameters` under the name of a node), and which of it is of one node."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from factorbus.proto.problems import Problem

_UNDER, _WANTED = "ros__parameters", "/factorbus:, and below it ros__parameters: with name: value"


class BadParameters(Problem):
    """A parameters file that cannot be read, or has something that is none of ours."""

    code = "bad_file"

    def __init__(self, path: Path, found: str, wanted: str) -> None:
        super().__init__(f"{path}: {found}; wanted {wanted}", file=str(path), line=None, seen=found, wanted=wanted)


def node_parameters(path: Path, namespace: str, node: str) -> dict[str, Any]:
    """The parameters of `node`, as they are typed in YAML.  Where several names match (`/**`), the last one counts.

    Raises BadParameters, OSError.
    """
    try:
        read = YAML(typ="safe", pure=True).load(path.read_bytes())
    except (YAMLError, UnicodeDecodeError, ValueError) as error:
        raise BadParameters(path, f"no YAML ({' '.join(str(error).split())[:200]})", _WANTED) from error
    name = "/" + "/".join(part for part in (*namespace.split("/"), node) if part)
    found: dict[str, Any] = {}
    names: list[str] = []
    for pattern, parameters in _nodes(read, ""):
        if not isinstance(parameters, Mapping):
            raise BadParameters(path, f"{pattern}: {_UNDER} has no names", _WANTED)
        names.append(pattern)
        if re.fullmatch(_expression(pattern), name):
            found.update((str(each), value) for each, value in parameters.items())
    if not names:
        raise BadParameters(path, f"no {_UNDER}", _WANTED)
    if not any(re.fullmatch(_expression(each), name) for each in names):
        raise BadParameters(path, f"nothing of {name}, but of {', '.join(names[:9])}", f"{name}: or /**:")
    return found


def _nodes(read: Any, above: str) -> Iterator[tuple[str, Any]]:
    """(the name of a node, its parameters); namespaces may be nested."""
    if not isinstance(read, Mapping):
        return
    for key, below in read.items():
        if key == _UNDER:
            yield above or "/", below
        else:
            yield from _nodes(below, f"{above}/{str(key).strip('/')}")


def _expression(pattern: str) -> str:
    """`*` is one part of a name, `**` any number of them."""
    parts = {"*": "/[^/]+", "**": "(?:/[^/]+)*"}
    return "".join(parts.get(each, "/" + re.escape(each)) for each in pattern.split("/") if each)
