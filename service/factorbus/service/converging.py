"""When a map whose last step had not converged takes further steps, without an insert.  Pure: the core asks.

    converged ──a step that could not finish──▶ waits ──no insert for a moment──▶ goes on ──▶ converged
                                                  ▲                                  │
                                                  └───────── an insert ──────────────┴──▶ gave up

It gives up, until something else changes the map, where further steps are of no use, and where there were too many.
A map that has converged, but that a step would still bring nearer to its optimum by what χ² shows, goes on as well
when it has been left alone for longer.
Reasons and figures: docs/decisions/further-steps.md.
"""

import math

from factorbus.service.events import Stepped

QUIET_S = 0.1  # without a step of another sort, before the first further one
FINISH_S = 1.0  # the same, of a map that has converged and is not at its optimum to what χ² shows
FULL_SPEED_S = 2.0  # of a core, for further steps in a row; then the solver rests after each for as long as it worked
MOST, MOST_S = 10_000, 300.0  # so many in a row, and so much of a core for them
# Without use is a step that does not lower χ² by this share, below the least so far; and one that changes nothing.
_SHARE, _NOTHING = 1e-7, 1e-12
_USELESS, _STILL = 20, 3  # so many in a row


class Converging:
    """Whether a map has converged at the revision that is told, and what is done about it."""

    def __init__(self) -> None:
        self.converged = True
        self.gave_up = ""  # why no further step is made; empty: it is, or need not be
        self.steps = 0  # further ones since the last of another sort
        self._unfinished = False  # a step would still bring it nearer to its optimum, though it may have converged
        self._enough = False  # further steps are of no more use, or were too many
        self._untold = False  # a further step is under way, or not told yet
        self._goes_on = False
        self._under_way = ""  # "further", "inserts", or neither
        self._busy_at = self._rests_until = -math.inf
        self._spent_s = 0.0
        self._least, self._useless, self._still = math.inf, 0, 0

    @property
    def converging(self) -> bool:
        """Has not converged, and will have further steps by itself."""
        return not self.converged and not self.gave_up

    def is_due(self, now: float) -> bool:
        """Whether the solver, which is free, is to take a further step now."""
        wanted = (self.converging or self._unfinished) and not self._enough
        return wanted and self._goes_on and not self._untold and now >= self._rests_until

    def look(self, now: float) -> None:
        """Time went by: was it quiet for long enough?"""
        self._goes_on = self._goes_on or now - self._busy_at >= (FINISH_S if self.converged else QUIET_S)

    def left(self, unfinished: bool) -> None:
        """How the solver left the map: whether a step without an insert would still be of use."""
        self._unfinished = unfinished

    def began(self, further: bool) -> None:
        """The solver was given a further step, or inserts."""
        self._untold = self._untold or further
        self._goes_on = further
        self._under_way = "further" if further else "inserts"

    def ended(self, worked_s: float, now: float) -> None:
        """The solver is free again.  worked_s: what it used of a core."""
        if self._under_way == "further":
            self._spent_s += worked_s
            self._rests_until = now + worked_s if self._spent_s > FULL_SPEED_S else now
        elif self._under_way:
            self._busy_at = now
        self._under_way = ""

    def failed(self) -> None:
        """The further step could not be made: nothing has changed, so the next one could not either."""
        self._untold, self._enough = False, True
        self.gave_up = "" if self.converged else "the solver refused it, see the service's log"

    def undone(self) -> None:
        """What was not told did not happen."""
        self._untold = False

    def moved_on(self, converged: bool, chi2: float) -> None:
        """A step of another sort is told."""
        self.converged, self.gave_up, self.steps, self._spent_s = converged, "", 0, 0.0
        self._enough = False
        self._least, self._useless, self._still = chi2, 0, 0

    def went_on(self, stepped: Stepped) -> None:
        """A further step is told: was it of use?"""
        self._untold, self.converged = False, stepped.converged
        self.steps += 1
        useful = stepped.chi2 < (1.0 - _SHARE) * self._least - _NOTHING
        if useful:
            self._least = stepped.chi2
        self._useless = 0 if useful else self._useless + 1
        self._still = self._still + 1 if not stepped.changed else 0
        why = self._why_give_up(stepped)
        self._enough, self.gave_up = bool(why), "" if stepped.converged else why

    def _why_give_up(self, stepped: Stepped) -> str:
        if stepped.rebuilt:
            return "the solver failed in a further step and was replaced, see the service's log"
        # With damping left the next step tries another way, of which there are no more than _USELESS.
        if self._still >= _STILL and not stepped.damping:
            return f"{self._still} further steps in a row changed nothing"
        if self._useless >= _USELESS:
            return f"{self._useless} further steps in a row did not lower χ²"
        if self.steps >= MOST or self._spent_s >= MOST_S:
            return f"{self.steps} further steps in a row, {self._spent_s:.0f} s of a core, were not enough"
        return ""
