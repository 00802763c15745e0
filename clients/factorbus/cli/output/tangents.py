"""What rows and columns of covariances are, by name and unit: for people and for `--json`."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.variable_kinds import VARIABLE_KINDS

ORDER = "each along the axes of its own frame: poses translation first, rx ry rz a rotation vector"


def tangent_document(kind: str) -> list[dict[str, str | None]]:
    """For `--json`: name and unit of each row; null: whatever unit the variable has."""
    return [{"name": each.name, "unit": each.unit} for each in VARIABLE_KINDS[kind].tangent]


def named_sigmas(kind: str, sigmas: Sequence[float]) -> str:
    """Standard deviations in a line."""
    told = zip(VARIABLE_KINDS[kind].tangent, sigmas, strict=True)
    return "  ".join(f"{each.name} {sigma:.4g}{_unit(each.unit)}" for each, sigma in told)


def matrix_lines(rows: Sequence[tuple[str, str]], covariance: F64) -> list[str]:
    """A joint covariance of variables (key, kind), with a name at each row and column, and its unit at the row."""
    told: list[Any] = [(key, each) for key, kind in rows for each in VARIABLE_KINDS[kind].tangent]
    names = [f"{key} {each.name}" for key, each in told]
    units = [_unit(each.unit).strip() for _, each in told]
    cells = [[f"{number:.6g}" for number in row] for row in covariance.tolist()]
    widths = [max(len(names[n]), *(len(row[n]) for row in cells)) for n in range(len(names))]
    first, second = (max(map(len, column)) for column in (names, units))
    head = [name.rjust(width) for name, width in zip(names, widths, strict=True)]
    lines = [" ".join([" " * (first + 1 + second), *head])]
    for name, unit, row in zip(names, units, cells, strict=True):
        numbers = " ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        lines.append(f"{name.ljust(first)} {unit.ljust(second)} {numbers}")
    return lines


def sigmas_of(covariance: F64) -> list[float]:
    """Standard deviations."""
    return np.sqrt(np.maximum(covariance.diagonal(), 0.0)).tolist()


def _unit(unit: str | None) -> str:
    return f" {unit}" if unit else ""
