"""When a map to which nothing comes takes further steps, without an insert.  Pure: the core asks.

    converged ──a step that could not finish──▶ waits ──no insert for a moment──▶ goes on ──▶ converged
        │                                                                                        │
        └──no insert for longer──▶ goes on ──▶ finished: a step would not lower what χ² shows ◀───┘

An insert comes first at any time, and ends the waiting.  Where further steps are of no use, or were too many, the map
gives up until something else changes it.
Reasons and figures: docs/decisions/further-steps.md.
"""

import math

from factorbus.service.core.budget import MOST_DOUBLED
from factorbus.service.core.events import BudgetUse, Stepped
from factorbus.wording import counted

# Idle is a map whose last step of another sort ended so long ago: one that has not converged goes on, and one that has
# is polished, that is, goes on to its optimum.
CONVERGE_IDLE_S, POLISH_IDLE_S = 0.1, 1.0
GRAFT_IDLE_S = 3.0  # longer by so much where the last steps were those of another journal
FULL_SPEED_S = 2.0  # of a core, for further steps in a row; then the solver rests after each for as long as it worked
MOST, MOST_S = 10_000, 300.0  # further steps in a row, and the seconds of a core for them
# Without use is a step that does not lower χ² by this share, below the least so far; and one that changes nothing.
_SHARE, _NOTHING = 1e-7, 1e-12
_USELESS, _STILL = 20, 3  # steps in a row
_LESS = 0.01  # by which share a step with a budget has to lessen what is left, where χ² says nothing
_WHOLE = 0.25  # of a doubling: what a step of no use adds where nothing is left to defer
_SOLVED = 1e-8  # of χ²: where no more is unsolved, all that is left is to substitute back through the whole map


class Converging:
    """How near a map is to its optimum at the revision that is published, and what is done about it."""

    def __init__(self) -> None:
        self.converged = True
        self.gave_up = ""  # why no further step is made, though one is wanted
        self.steps = 0  # further ones since the last of another sort
        self._unfinished = False  # a step would still bring it nearer to its optimum, though it may have converged
        self._untold = False  # a further step is under way, or not told yet
        self._goes_on = False
        self._under_way = ""  # "further", "inserts", or neither
        self._busy_at = self._rests_until = -math.inf
        self._spent_s = 0.0
        self._least, self._useless, self._still = math.inf, 0, 0
        self._in_vain = 0.0  # doublings: of further steps in a row that had a budget, and were of no use with it
        self._solved = False  # the last step had a budget, and found next to nothing to solve
        self._complete, self._unsolved = True, math.inf  # of the last step with a budget; the least since

    @property
    def converging(self) -> bool:
        """Will have further steps by itself, unless an insert comes first."""
        return self._unfinished and not self.gave_up

    @property
    def doubled(self) -> int:
        """How often the budget of the next further step is doubled; more than MOST_DOUBLED: it has no bound."""
        return MOST_DOUBLED + 1 if self._solved else int(self._in_vain)

    def is_due(self, now: float) -> bool:
        """Whether the solver, which is free, is to take a further step now."""
        return self.converging and self._goes_on and not self._untold and now >= self._rests_until

    def look(self, now: float) -> None:
        """Time went by: has the map been idle for long enough?"""
        idle_s = POLISH_IDLE_S if self.converged and self._complete else CONVERGE_IDLE_S
        self._goes_on = self._goes_on or now - self._busy_at >= idle_s

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

    def hold(self, now: float) -> None:
        """What came last was made elsewhere, where further steps are taken, too."""
        self._busy_at = now + GRAFT_IDLE_S
        self._goes_on = False

    def refused(self) -> None:
        """The further step was refused: the map is where it was, so the next one would be, too."""
        self._untold, self.gave_up = False, "the solver refused it, see the service's log"

    def try_again(self) -> None:
        """Further steps may take another time from now on: what was of no use before may be."""
        self._in_vain, self.gave_up, self.steps, self._spent_s = 0.0, "", 0, 0.0
        self._useless = self._still = 0

    def undone(self) -> None:
        """What was not published did not happen."""
        self._untold = False

    def moved_on(self, converged: bool, unfinished: bool, chi2: float, use: BudgetUse | None = None) -> None:
        """A step of another sort is published.  use: of its budget, if it had one."""
        self.converged, self._unfinished, self.gave_up = converged, unfinished or not converged, ""
        self.steps, self._spent_s = 0, 0.0
        self._least, self._useless, self._still = chi2, 0, 0
        self._in_vain, self._complete = 0.0, use is None or use.complete
        self._solved = use is not None and _is_solved(use, chi2)
        self._unsolved = math.inf if use is None else use.unsolved

    def went_on(self, stepped: Stepped) -> None:
        """A further step is published: was it of use?"""
        self._untold, self.converged = False, stepped.converged
        self._unfinished = stepped.unfinished or not stepped.converged
        self.steps += 1
        useful = stepped.chi2 < (1.0 - _SHARE) * self._least - _NOTHING
        if useful:
            self._least = stepped.chi2
        self._complete = stepped.use is None or stepped.use.complete
        if stepped.use is not None:
            self._solved = _is_solved(stepped.use, stepped.chi2)
            self._went_on_within(stepped.use, useful)
            return
        self._solved, self._in_vain, self._unsolved = False, 0.0, math.inf
        self._useless = 0 if useful else self._useless + 1
        self._still = self._still + 1 if not stepped.changed else 0
        if self._unfinished and not self.gave_up:
            self.gave_up = self._why_give_up(stepped)

    def _went_on_within(self, use: BudgetUse, useful: bool) -> None:
        """The same of one with a budget.  χ² of an estimate of which a part is behind says little: what is left does.

        One that was of no use is no reason to give up, but to let the next one take more.
        """
        useful = useful or use.unsolved < (1.0 - _LESS) * self._unsolved
        self._unsolved = min(use.unsolved, self._unsolved)
        self._in_vain = 0.0 if useful else self._in_vain + (_WHOLE if use.complete else 1.0)
        if self._unfinished and (self.steps >= MOST or self._spent_s >= MOST_S):
            self.gave_up = self._too_many()

    def _why_give_up(self, stepped: Stepped) -> str:
        if stepped.rebuilt:
            return "the solver failed in a further step and was replaced, see the service's log"
        # With damping left the next step tries another way, of which there are no more than _USELESS.
        if self._still >= _STILL and not stepped.damping:
            return f"{counted(self._still, 'further step')} in a row changed nothing"
        if self._useless >= _USELESS:
            return f"{counted(self._useless, 'further step')} in a row did not lower χ²"
        if self.steps >= MOST or self._spent_s >= MOST_S:
            return self._too_many()
        return ""

    def _too_many(self) -> str:
        steps = counted(self.steps, "further step")
        return f"it was not at its optimum after {steps} in a row, which took {self._spent_s:.0f} s of a core"


def _is_solved(use: BudgetUse, chi2: float) -> bool:
    return use.complete and use.unsolved <= _SOLVED * chi2 + _NOTHING
