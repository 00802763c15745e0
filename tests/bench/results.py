"""How a benchmark that is one set of figures prints them."""

import json
from typing import Any


def print_figures(figures: dict[str, Any], as_json: bool) -> None:
    """As JSON, or a line each."""
    if as_json:
        print(json.dumps(figures, indent=2))
    else:
        for name, value in figures.items():
            print(f"{name:24} {value}")
