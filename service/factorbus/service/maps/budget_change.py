"""Another budget for the steps of a map that is there: first in its journal, then at work."""

import logging
import secrets
from collections.abc import Callable

from factorbus.journal.settings import note_option
from factorbus.proto.budget import BUDGET_OPTION
from factorbus.proto.problems import Internal, Problem
from factorbus.service.maps.host import Host

log = logging.getLogger(__name__)


def change_budget(
    host: Host, budget_ms: float, units_per_ms: Callable[[], float], done: Callable[[Problem | None], None]
) -> None:
    """Have steps of the map that begin later take no more than `budget_ms`; 0: no bound.  Returns at once.

    done: a restart would know it, and so do the next steps; with a problem nothing has changed.  It may be called on
    the thread of the journal.  units_per_ms: of a map that had no budget.
    """
    keeper = host.keeper
    rate = units_per_ms() if budget_ms else 1.0  # measured here, and not on the thread of the journal

    def change() -> None:
        try:
            if keeper is not None:
                # What was accepted before is in the journal by now, with the units that its steps had.
                note_option(keeper.store, BUDGET_OPTION, budget_ms or None)
            host.change_budget(budget_ms, rate)
        except Problem as problem:
            done(problem)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: the budget of map %s stays", reference, host.core.name)
            done(Internal(reference))
        else:
            log.info("map %s: budget %g ms", host.core.name, budget_ms, extra={"map": host.core.name})
            done(None)

    if keeper is None:
        change()
    else:
        keeper.when_written(change, done)
