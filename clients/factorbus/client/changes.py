"""Putting together changes of what a map has: taking out, counting differently, holding.

    kitchen.change(Changes().remove_factors([17, 18]).loss([21], "dcs", 1.0).fix("x0"))

A factor is called by its id: `factors` of the answer to the insert that brought it has them, in the order in which they
were drafted; `Map.graph` tells the ids of all.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import all_finite, as_numbers, checked_flag, of_type
from factorbus.client.certainty import loss_of
from factorbus.client.draft import Draft, batch_of
from factorbus.client.key_numbers import Key, id_numbers, key_numbers
from factorbus.proto.arrays import F64, I64
from factorbus.proto.asking import Repaired
from factorbus.proto.messages import Accepted, Batch, Change, Chi2, Variables
from factorbus.proto.problems import BadLoss, BadShape, Problem


class FactorsOfAnother(Problem):
    """Ids that a map gave are those of other factors in another map, or in one that was made anew."""

    code = "wrong_epoch"

    def __init__(self, epoch: int, name: str, own: int) -> None:
        super().__init__(
            f"changes: they have ids of factors from an answer of epoch {epoch}; map {name!r} has epoch {own}, where "
            "these are other factors. Give them to the map that answered, or look the factors up with `Map.graph`; in "
            "a fork, where ids are the same, use `dataclasses.replace(answer, epoch=fork.epoch)`",
            epoch=own,
        )


class Changes:
    """Changes to be made together or not at all, in this order.  Every method returns the same object, to be chained.

    One without a key or a factor is refused (BadShape).  One that says what is so already, as `fix` of what is fixed,
    is taken: it makes a revision like any other, in which nothing differs.

    Raises BadSymbol, BadShape, BadLoss, BadOption.
    """

    def __init__(self) -> None:
        self._changes: list[Change] = []
        self._epochs: list[int] = []  # of answers whose ids of factors are among them

    def remove_factors(self, factors: Iterable[int] | int) -> Changes:
        """These factors go."""
        return self._add(Change("remove_factors", _factor_ids(factors)))

    def remove_variables(self, *keys: Key | Sequence[Key], alone: bool = False) -> Changes:
        """These variables go, with every factor on them; with `alone` it is refused (in_use) if there is any left."""
        return self._add(Change("remove_variables", keys=_keys(keys), alone=checked_flag("changes: alone", alone)))

    def undo(self, batch: Batch | Draft, accepted: Accepted) -> Changes:
        """What an insert brought goes again; refused (in_use) where something that came later rests on it.

        In the map that `accepted` is of: another one raises FactorsOfAnother when the changes are given to it.
        """
        batch = batch_of("changes: undo", batch)
        accepted = of_type("changes: undo", accepted, Accepted, "the answer to the insert, an Accepted")
        brought = [group.keys for group in batch.variables]
        first = accepted.first_factor
        self._epochs.append(accepted.epoch)
        if batch.factor_count:
            self._add(Change("remove_factors", np.arange(first, first + batch.factor_count)))
        if batch.variables:
            self._add(Change("remove_variables", keys=np.concatenate(brought), alone=True))
        return self

    def loss(self, factors: Iterable[int] | int, name: str, scale: ArrayLike | None = None) -> Changes:
        """These factors have this loss from now on; "none", or "", takes theirs away.

        scale: one, or one for each, standard deviations; None: that of `certainty.DEFAULT_SCALES`.
        """
        ids = _factor_ids(factors)
        if isinstance(name, str) and name in ("", "none"):
            return self._add(Change("loss", ids, loss=""))
        name, usual = loss_of("changes", name)
        scales = _each("scale", usual if scale is None else scale, ids)
        if not (np.isfinite(scales).all() and (scales > 0.0).all()):
            raise BadLoss("changes", f"the scale {scale!r}", "finite numbers above 0, standard deviations")
        return self._add(Change("loss", ids, loss=name, scale=scales))

    def weigh(self, factors: Iterable[int] | int, weight: ArrayLike) -> Changes:
        """The information matrices of these factors are multiplied by this (one, or one for each)."""
        ids = _factor_ids(factors)
        weights = all_finite("changes: weight", _each("weight", weight, ids))
        return self._add(Change("weigh", ids, weight=weights))

    def accept(self, factors: Iterable[int] | int) -> Changes:
        """These loop closures are in the estimate, for good: of a map that tests them (`Map.suspects`)."""
        return self._add(Change("accept", _factor_ids(factors)))

    def reject(self, factors: Iterable[int] | int) -> Changes:
        """These loop closures are out of the estimate, for good, and keep their ids: of a map that tests them."""
        return self._add(Change("reject", _factor_ids(factors)))

    def fix(self, *keys: Key | Sequence[Key]) -> Changes:
        """These variables are held where they are."""
        return self._add(Change("fix", keys=_keys(keys)))

    def free(self, *keys: Key | Sequence[Key]) -> Changes:
        """These variables are estimated again."""
        return self._add(Change("free", keys=_keys(keys)))

    def marginalize(self, *keys: Key | Sequence[Key]) -> Changes:
        """These variables go; what their factors say of the others is kept, as linear factors.

        Refused (too_connected) where what hangs together shares factors with more than 128 variables that stay.  Before
        any loss, weigh or place of the same insert.
        """
        return self._add(Change("marginalize", keys=_keys(keys)))

    def place(self, groups: Iterable[Variables], carry: bool = False) -> Changes:
        """Variables go to the values in `groups`, as in an estimate; the map goes on from there.

        carry: what is not in `groups`, and not fixed, goes along with what it hangs on.
        """
        carry, wanted = checked_flag("changes: carry", carry), "groups of variables, as `variables` of an Estimate"
        listed = [
            of_type("changes: place", each, Variables, wanted)
            for each in of_type("changes: place", groups, Iterable, wanted)
        ]
        for group in listed:
            self._add(Change("place", keys=group.keys, kind=group.kind, values=group.values, carry=carry))
        return self

    def adopt(self, found: Chi2) -> Changes:
        """The map goes to the optimum that was found from scratch: `found` is `Map.chi2(batch=True, values=True)`.

        Variables that came since go along with what they hang on.  Refused (unknown_variable, kind_mismatch) where a
        variable of the optimum is gone, or a feature has become a point: ask again.  `settle` it.  To undo it place
        what `Map.ask_estimate` said before.  Raises BadShape if the answer came without values.
        """
        if not of_type("changes: adopt", found, Chi2, "an answer of chi2(batch=True, values=True)").variables:
            raise BadShape("changes: adopt", "an answer without variables", "chi2(batch=True, values=True)")
        return self.place(found.variables, carry=True)

    def repair(self, repaired: Repaired, loss: tuple[str, float] | str | None = None) -> Changes:
        """What is false goes, or gets a loss, ("dcs", 1.0) say; the map goes on from the repaired values.

        In the map that `repaired` is of, as `undo`.
        """
        self._epochs.append(of_type("changes: repair", repaired, Repaired, "an answer of `Map.repair`").epoch)
        name_and_scale = None if loss is None else loss_of("repair", loss)
        if not repaired.factors.size:
            return self.place(repaired.variables)
        if name_and_scale is None:
            self.remove_factors(repaired.factors.tolist())
        else:
            self.loss(repaired.factors.tolist(), *name_and_scale)
        return self.place(repaired.variables)

    def listed(self) -> tuple[Change, ...]:
        """What has been put together so far."""
        return tuple(self._changes)

    def listed_in(self, name: str, epoch: int) -> tuple[Change, ...]:
        """The same, for the map of that epoch.  Raises FactorsOfAnother."""
        for other in self._epochs:
            if other != epoch:
                raise FactorsOfAnother(other, name, epoch)
        return self.listed()

    def _add(self, change: Change) -> Changes:
        self._changes.append(change)
        return self


def some_of(changes: Changes) -> Changes:
    """`changes`, if there are any.  Raises BadShape: they would make a revision in which nothing is changed."""
    wanted = "a Changes with one change or more, such as Changes().fix('x0')"
    if not of_type("changes", changes, Changes, wanted).listed():
        raise BadShape("changes", "none", wanted)
    return changes


def _factor_ids(factors: Iterable[int] | int) -> I64:
    return _some(id_numbers("changes", factors), "id of a factor")


def _keys(keys: Sequence[Key | Sequence[Key]]) -> I64:
    """Keys one by one, or in lists."""
    return _some(np.concatenate([np.empty(0, np.int64), *map(key_numbers, keys)]), "key")


def _some(numbers: I64, what: str) -> I64:
    if not numbers.size:
        raise BadShape("changes", f"no {what}", f"one {what} or more")
    return numbers


def _each(name: str, numbers: ArrayLike, ids: I64) -> F64:
    given = as_numbers(f"changes: {name}", numbers)
    if given.shape not in ((), ids.shape):
        raise BadShape(f"changes: {name}", f"shape {given.shape}", f"one number, or {ids.size}")
    return np.broadcast_to(given, ids.shape)
