"""A checkpoint's layout changes only together with `solver.state.FORMAT`, so no solver goes on from what it misreads.

`state_format.json` has the layout that goes with the number: the parts of a state in every mode, with the type of each
and the rows of its arrays, and the constants by which kernels find their way in these.  Where this test fails, raise
FORMAT and run `python tests/service/test_state_format.py`, which notes the new layout under the new number.
"""

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from naive.random_graphs import random_steps

from factorbus.service.config import Limits
from factorbus.service.journal.library import make_map_solver
from factorbus.solver.graph.factors import FACTOR_KINDS, LOSSES
from factorbus.solver.graph.variables import VARIABLE_KINDS
from factorbus.solver.kernels.bayes_tree import layout as tree_layout
from factorbus.solver.kernels.model import layout
from factorbus.solver.kernels.sparse import fronts
from factorbus.solver.lenses import layout as lens_layout
from factorbus.solver.modes import MODES
from factorbus.solver.state import FORMAT

NOTED = Path(__file__).with_name("state_format.json")
MODULES = (layout, tree_layout, fronts, lens_layout)
GROWING = {"lin", "scalars", "pattern"}  # rows of these are as long as the map needs
OF_THE_PROCESSOR = {"LANES"}  # which a state says itself
HOW = "raise FORMAT in solver/state.py, then run python tests/service/test_state_format.py"


def present() -> dict[str, Any]:
    """The layout of a state as it is now."""
    return {
        "state": {mode: dict(sorted(parts(state_in(mode)))) for mode in MODES},
        "variables": {kind.name: f"{kind.code}: {kind.size}, {kind.dim}" for kind in VARIABLE_KINDS.values()},
        "factors": {
            kind.name: f"{kind.code}: {', '.join(end.name for end in kind.connects)}; {kind.size}, {kind.dim}"
            for kind in FACTOR_KINDS.values()
        },
        "losses": dict(LOSSES),
        "constants": {module.__name__: constants(module) for module in MODULES},
    }


def state_in(mode: str) -> dict[str, Any]:
    """Of a map that has all that a state can have: kinds in plane and space, stamps, named factors."""
    folder = make_map_solver(mode, {}, 1, Limits())
    solver = folder.solver
    for batch in random_steps(1, steps=20):
        solver.stage(batch)
        solver.step()
    return folder.dump()


def parts(value: Any, path: str = "") -> list[tuple[str, str]]:
    """(path, type) of all that is in it; of an array n rows, and how long these are, m where they grow."""
    if isinstance(value, dict):
        return [each for name, item in value.items() for each in parts(item, f"{path}.{name}" if path else name)]
    if isinstance(value, np.ndarray):
        rows = "m" if path.rpartition(".")[2] in GROWING else value.shape[1:]
        return [(path, " ".join(map(str, [value.dtype.str, "n", *rows])))]
    if isinstance(value, list):
        return [(path, f"({', '.join(type(item).__name__ for item in value)})")]
    return [(path, type(value).__name__)]


def constants(module: ModuleType) -> dict[str, Any]:
    """Every number of the module, and every list of names."""
    found = {
        name: value
        for name, value in vars(module).items()
        if name.isupper() and name not in OF_THE_PROCESSOR and isinstance(value, int | float | tuple)
    }
    return {name: ", ".join(value) if isinstance(value, tuple) else value for name, value in sorted(found.items())}


def changes(one: Any, other: Any, path: str = "") -> list[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        names = sorted({*one, *other})
        return [line for name in names for line in changes(one.get(name), other.get(name), f"{path}/{name}")]
    return [] if one == other else [f"{path}: {one} is now {other}"]


def test_the_layout_of_a_state_is_that_of_its_format() -> None:
    noted, now = json.loads(NOTED.read_text()), json.loads(json.dumps(present()))
    changed = changes(noted["layout"], now)
    assert not changed, "\n".join([HOW, *changed[:40]])
    assert noted["format"] == FORMAT, "a new FORMAT without a new layout: note it as the head of this file says"


def note() -> None:
    now = json.loads(json.dumps(present()))
    noted = json.loads(NOTED.read_text()) if NOTED.exists() else {"format": 0, "layout": {}}
    if noted["format"] == FORMAT and changes(noted["layout"], now):
        raise SystemExit(f"the layout has changed and FORMAT is still {FORMAT}: {HOW}")
    NOTED.write_text(json.dumps({"format": FORMAT, "layout": now}, indent=1) + "\n")


if __name__ == "__main__":
    note()
