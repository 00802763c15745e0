"""Batches put together, and estimates compared, column by column."""

from collections.abc import Iterable

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.stamps import NO_STAMP

_POSITION = {"se2": 2, "se3": 3, "point2": 2, "point3": 3, "sim3": 3}  # an idp's first three numbers are a camera's


def merged(batches: Iterable[Batch]) -> Batch:
    """All of `batches` as one: a group for each kind and loss of factors; of variables, kind, fixed and valued."""
    variables: dict[tuple[str, bool, bool], list[Variables]] = {}
    factors: dict[tuple[str, str], list[Factors]] = {}
    for batch in batches:
        for group in batch.variables:
            variables.setdefault((group.kind, group.fixed, group.values is None), []).append(group)
        for group in batch.factors:
            factors.setdefault((group.kind, group.loss), []).append(group)
    return Batch(
        tuple(_variables(kind, fixed, groups) for (kind, fixed, _), groups in variables.items()),
        tuple(
            Factors(
                kind,
                np.concatenate([group.keys for group in groups]),
                np.concatenate([group.measured for group in groups]),
                np.concatenate([group.information for group in groups]),
                loss,
                np.concatenate([_scale(group) for group in groups]) if loss else None,
            )
            for (kind, loss), groups in factors.items()
        ),
    )


def position_errors(estimate: Iterable[Variables], truth: Iterable[Variables], kinds: Iterable[str]) -> F64:
    """Distances (metres) between estimate and truth of the variables of `kinds` that are in both; ordered by key."""
    kinds = tuple(kinds)
    keys, found = positions(estimate, kinds)
    true_keys, wanted = positions(truth, kinds)
    _, here, there = np.intersect1d(keys, true_keys, return_indices=True)
    return np.linalg.norm(found[here] - wanted[there], axis=1)


def positions(variables: Iterable[Variables], kinds: Iterable[str]) -> tuple[I64, F64]:
    """(keys (n,), positions (n, 2 or 3)) of the variables of `kinds` that have a value, ordered by key."""
    groups = [group for group in variables if group.kind in kinds and group.values is not None]
    if not groups:
        return np.empty(0, np.int64), np.empty((0, 2))
    keys = np.concatenate([group.keys for group in groups])
    places = np.concatenate([_values(group)[:, : _POSITION[group.kind]] for group in groups])
    order = np.argsort(keys)
    return keys[order], places[order]


def _values(group: Variables) -> F64:
    if group.values is None:
        raise ValueError(f"variables of kind {group.kind} have no values")
    return group.values


def _scale(group: Factors) -> F64:
    if group.scale is None:
        raise ValueError(f"factors of kind {group.kind} with the loss {group.loss} have no scale")
    return group.scale


def _variables(kind: str, fixed: bool, groups: list[Variables]) -> Variables:
    keys = np.concatenate([group.keys for group in groups])
    values = None if groups[0].values is None else np.concatenate([_values(group) for group in groups])
    if all(group.stamps is None for group in groups):
        return Variables(kind, keys, values, fixed)
    none = (np.full(group.keys.size, NO_STAMP) for group in groups)
    stamps = [own if group.stamps is None else group.stamps for group, own in zip(groups, none, strict=True)]
    return Variables(kind, keys, values, fixed, np.concatenate(stamps))
