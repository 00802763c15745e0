"""The build of the solver: its sources, and all else that the bits of a step depend on."""

import hashlib
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType

from factorbus.proto import inertial, kinds
from factorbus.solver.kernels.jit.compile import code_environment

_LIBRARIES = ("scipy", "scikit-sparse")  # besides those that compile kernels


@cache
def present_build() -> Mapping[str, str]:
    """Its parts: `sources` (a hash), `processor`, `versions`, `flags`.  Equal builds make equal bits of equal steps."""
    parts = code_environment()
    versions = ", ".join([parts["versions"], *(f"{name} {_version(name)}" for name in _LIBRARIES)])
    return MappingProxyType({"sources": _sources(), **parts, "versions": versions})


def differences(made_by: Mapping[str, str], here: Mapping[str, str]) -> str:
    """The parts in which two builds differ, with both values of each; empty where they are equal."""
    names = [name for name in {**made_by, **here} if made_by.get(name) != here.get(name)]
    return "; ".join(f"{name} {made_by.get(name) or 'none'}, here {here.get(name) or 'none'}" for name in names)


def _sources() -> str:
    folder, digest = Path(__file__).parent, hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        text = path.read_bytes()
        digest.update(f"{path.relative_to(folder).as_posix()} {len(text)}\n".encode() + text)
    for module in (kinds, inertial):  # kernels have their names and sizes as constants
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()[:12]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"
