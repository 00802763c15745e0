"""A step of editing and the way back: what goes, what comes, what counts differently, what is held.

A factor that was rejected and comes back has another id.  So steps call factors by the id they had first, and what
each is called now is looked up when the step is made.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

from factorbus.client import Changes
from factorbus.proto.messages import Batch, Factors


class EditStep(NamedTuple):
    """Made together or not at all.

    weigh: ids of factors, and a weight for each.  reject: factors that go and can be restored.  remove: ids of factors
    that go for good.  forget: keys of variables that no factor is on afterwards.  fix, free: keys.  insert: what is
    new.  restore: factors that were rejected, with the ids they had.  accept, disbelieve: ids of closures that the map
    tests, which are in for good, or out.
    """

    weigh: tuple[tuple[int, ...], tuple[float, ...]] = ((), ())
    reject: tuple[Factors, ...] = ()
    remove: tuple[int, ...] = ()
    forget: tuple[int, ...] = ()
    fix: tuple[int, ...] = ()
    free: tuple[int, ...] = ()
    insert: Batch = Batch()
    restore: tuple[Factors, ...] = ()
    accept: tuple[int, ...] = ()
    disbelieve: tuple[int, ...] = ()

    def changes(self, called: Callable[[int], int]) -> Changes | None:
        """What of it is changes; None: nothing.  called: what a factor is called now."""
        changes = Changes()
        if self.weigh[0]:
            changes.weigh([called(each) for each in self.weigh[0]], list(self.weigh[1]))
        gone = [*ids_of(self.reject), *self.remove]
        if gone:
            changes.remove_factors([called(each) for each in gone])
        if self.forget:
            changes.remove_variables(*self.forget, alone=True)
        if self.fix:
            changes.fix(*self.fix)
        if self.free:
            changes.free(*self.free)
        if self.accept:
            changes.accept([called(each) for each in self.accept])
        if self.disbelieve:
            changes.reject([called(each) for each in self.disbelieve])
        return changes if changes.listed() else None

    def batch(self) -> Batch:
        """What of it is inserted: the new first."""
        back = tuple(group._replace(ids=None) for group in self.restore)
        return Batch(self.insert.variables, (*self.insert.factors, *back))


class EditPlan(NamedTuple):
    """what: for people, as it will have been.  step: to be made.  back: what undoes it, by the ids of what was new."""

    what: str
    step: EditStep
    back: Callable[[list[int]], EditStep]


def ids_of(groups: Iterable[Factors]) -> list[int]:
    """What factors of a whole graph are called."""
    return [each for group in groups if group.ids is not None for each in group.ids.tolist()]
