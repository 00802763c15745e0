"""The state of a solver as one flat dict, to be compared byte by byte."""

from collections.abc import Mapping
from typing import Any

import numpy as np


def flattened(state: Any, path: str = "") -> dict[str, Any]:
    """What there is at each path: of an array its shape, its type and its bytes."""
    if isinstance(state, Mapping):
        inside = state.items()
    elif isinstance(state, list):
        inside = enumerate(state)
    else:
        whole = (state.shape, str(state.dtype), state.tobytes()) if isinstance(state, np.ndarray) else repr(state)
        return {path: whole}
    found = dict[str, Any]()
    for name, value in inside:
        found |= flattened(value, f"{path}/{name}")
    return found
