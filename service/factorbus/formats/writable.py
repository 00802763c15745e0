"""What of a graph a form of file has records for; the rest is left out and said."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.left_out import FileNotes, LeftOut, shown
from factorbus.formats.weights import has_covariance
from factorbus.proto.arrays import I64
from factorbus.proto.kinds import FACTOR_KINDS, name_of_kind
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.roles import FRAME, MOUNT, keys_of_role, pick_factors, pick_variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import format_symbol

# How many of what are left out, by name and reason, or written as something less (`into`).
# A kind may come in several groups: each is said once for the file.
_Lost = Counter[tuple[str, str, str]]
# Poses that are no places in the map: their role, what they are called, and what there is no record for.
_ASIDE = ((MOUNT, "mounts", "where a sensor is on a robot"), (FRAME, "frames", "where the map is in another frame"))

_NO_COVARIANCE = "the information matrix has no inverse within what a double holds"


@dataclass(frozen=True, slots=True)
class Written:
    """The text of a file; notes: what was left out of it."""

    text: str
    notes: FileNotes

    @property
    def left_out(self) -> dict[str, int]:
        """How much of each name that is."""
        return self.notes.counts


@dataclass(frozen=True, slots=True)
class Form:
    """A form of file: its name for people, the kinds of variables it has, and of factors with how many numbers are
    measured.

    timed: the kinds of variables whose time it has.  fixes: whether it says which variables are fixed.
    covariances: whether it has covariances in place of information matrices.
    """

    name: str
    variables: frozenset[str]
    measured: Mapping[str, int]
    timed: frozenset[str] = frozenset()
    fixes: bool = True
    covariances: bool = False


def writable(batch: Batch, form: Form, left: LeftOut) -> Batch:
    """What of `batch` there are records for.  Raises FormatError for a factor of a variable that is not there."""
    _refuse_unknown(batch, form.name)
    lost = _Lost()
    for role, name, why in _ASIDE:
        batch = _without(batch, keys_of_role(batch, role), form, name, f"{form.name} has no record for {why}", lost)
    variables = []
    for group in batch.variables:
        if group.kind in form.variables:
            variables.append(group)
        else:
            lost[group.kind, f"{form.name} has no record for such variables", ""] += len(group.keys)
        if group.kind not in form.timed:
            stamps = 0 if group.stamps is None else int((group.stamps != NO_STAMP).sum())
            lost["time stamps", f"{form.name} has no record for the time of {group.kind} variables", ""] += stamps
        if group.fixed and not form.fixes:
            lost["fixed variables", f"{form.name} does not say which variables are fixed", "as free"] += len(group.keys)
    gone = np.concatenate(
        [np.empty(0, np.int64), *(group.keys for group in batch.variables if group.kind not in form.variables)]
    )
    factors = [kept for group in batch.factors if (kept := _writable_factors(group, gone, form, lost)) is not None]
    named = np.concatenate([np.empty(0, np.int64), *(group.keys.ravel() for group in factors)])
    told = tuple(_with_values(variables, named, lost))
    for (name, why, into), count in lost.items():
        if into:
            left.change(name, count, into, why)
        else:
            left.drop(name, count, why)
    return Batch(told, tuple(factors))


def number_text(numbers: Iterable[float]) -> str:
    """Shortest texts that read back as the same floats."""
    return " ".join([repr(number).removesuffix(".0") for number in numbers])


def _writable_factors(group: Factors, gone: I64, form: Form, lost: _Lost) -> Factors | None:
    if group.kind not in form.measured or np.isin(group.keys, gone).any():
        lost[name_of_kind(group.kind), _no_record(form), ""] += len(group.keys)
        return None
    kept = np.ones(len(group.keys), bool)
    if group.kind in ("position_se2", "position_se3"):
        kept = (group.measured[:, form.measured[group.kind] :] == 0.0).all(axis=1)
        lost[group.kind, f"{form.name} has no record for an antenna beside its pose", ""] += int((~kept).sum())
    if form.covariances:
        certain = has_covariance(group.information, FACTOR_KINDS[group.kind].dim)
        lost[group.kind, _NO_COVARIANCE, ""] += int((kept & ~certain).sum())
        kept = kept & certain
    if group.loss:
        why = f"{form.name} has no losses: the factors are written without their {group.loss}"
        lost[f"{group.kind} loss", why, ""] += len(group.keys)
    if not kept.any():
        return None
    return Factors(group.kind, group.keys[kept], group.measured[kept], group.information[kept])


def _no_record(form: Form) -> str:
    return f"{form.name} has no record for such factors"


def _without(batch: Batch, aside: I64, form: Form, name: str, why: str, lost: _Lost) -> Batch:
    """Without poses that are no places in the map, and all factors on them: as poses of the map they would mislead.

    aside: their keys; name, why: as `LeftOut.drop` says them.
    """
    if not aside.size:
        return batch
    variables, factors = [], []
    for group in batch.variables:
        stays = ~np.isin(group.keys, aside)
        lost[name, why, ""] += int((~stays).sum())
        if stays.any():
            variables.append(pick_variables(group, stays))
    for group in batch.factors:
        stays = np.asarray(~np.isin(group.keys, aside).any(axis=1))
        known = group.kind in form.measured
        lost[name_of_kind(group.kind), why if known else _no_record(form), ""] += int((~stays).sum())
        if stays.any():
            factors.append(pick_factors(group, stays))
    return Batch(tuple(variables), tuple(factors))


def _with_values(variables: list[Variables], named: I64, lost: _Lost) -> Iterator[Variables]:
    """The variables that a vertex line or an edge tells of."""
    untold: list[str] = []
    for group in variables:
        told = np.isin(group.keys, named) if group.values is None else np.ones(len(group.keys), bool)
        untold += [format_symbol(key) for key in group.keys[~told].tolist()]
        if told.all():
            yield group
        elif told.any():
            stamps = None if group.stamps is None else group.stamps[told]
            yield group._replace(keys=group.keys[told], stamps=stamps)
    lost["variables", f"neither a value nor an edge tells of {shown(untold)}", ""] += len(untold)


def _refuse_unknown(batch: Batch, form: str) -> None:
    known = np.concatenate([np.empty(0, np.int64), *(group.keys for group in batch.variables)])
    named = np.concatenate([np.empty(0, np.int64), *(group.keys.ravel() for group in batch.factors)])
    if not np.isin(named, known).all():
        lost = named[~np.isin(named, known)][0]
        raise FormatError(
            form, None, f"a factor of {format_symbol(int(lost))}, which is not in the graph", "all variables"
        )
