"""How a solver is set up."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from factorbus.solver.errors import BadOption
from factorbus.solver.modes import MODES, mode_named
from factorbus.solver.option_ranges import check_numbers

__all__ = ["MODES", "Options"]


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of a Solver; the defaults are meant for every graph.

    mode            "inc-l": R is updated, and made anew when that is better (2013 paper, Algorithm 1); "inc-l-b10",
                    "inc-l-b100": the same with a batch after every 10 or 100 new variables and none in between;
                    "all-batch": every step that solves factorises anew; "bayes-tree": only the part of R that a step
                    affects is made again, and only variables that need it are relinearised (MATH §9); "auto" is that
    clock           seconds, for the phases in the report; without one they are zero
    tolerance       all-batch: an ordinary step stops when the next one would lower χ² by less than this share of it
    tol             inc-l: the same, and a first step that would is not made.  The paper's tol, with the length of δ
                    measured in standard deviations: |δ|² = δᵀΛδ = dᵀd ≤ tol χ²  (MATH §8.5)
    small_loop      smallLoopThresh: Ω-updates reach no more block rows of R than this
    big_loop        bigLoopThresh: Λ-updates reach no more; above it R is made anew in a new order
    loop_share      in small maps both are smaller: no more than 40 rows and this share of all, since making R anew
                    costs what the map is large
    keep_factor     R stays in use after a step was made with it, as long as it leads there (MATH §8.6); False: it is
                    made anew at every new linearisation point, as the paper has it
    place_new       new variables first go where their own factors want them, the rest held
    negligible      a χ² below this is nothing: 1e-12 is a millionth of a standard deviation, squared.  A step whose new
                    factors add less solves nothing, and no step goes on for less
    max_iterations  maxIT: at most this many tries (accepted or not) in an ordinary step; the next step goes on
    nonmonotone_steps   where an undamped step would raise χ², at most this many in a row may, until it is lower than
                    before; else they are taken back, and Levenberg-Marquardt's damping follows.  0: it is damped at
                    once
    settle_tolerance, settle_iterations   the same for a step that is to converge
    last_pose_last  constrain the ordering: the last pose last, the landmarks seen lately right before it
    recent_poses    "lately": from the last so many poses
    bent            tree: a variable with a factor that is bent by more than this many of the residuals that factors of
                    the map have on average waits to be relinearised (MATH §9.6)
    bent_soon, bent_most, patience   tree: all that wait are so in the next step when together they add more than this
                    share to χ², if they have `many` scalars, when a factor is bent by more than so many, or when one
                    has waited for so many steps
    rest, reluctance, dear   tree: for so many steps after a relinearisation both shares are more, up to so many times;
                    after one that took k times `dear` flops for k times as many steps, up to √k times as much as that,
                    and `patience` is k times as long
    bent_now, rounds   tree: and solved for again in the same step, in up to `rounds` rounds, at more than this share,
                    if what waits has `many` scalars
    many            tree: for fewer scalars much less is worth it; poses in space and landmarks have to be worth more
    converged_share tree: a step has converged if what is left to gain is at most this share of χ² (MATH §9.6); it
                    goes on for up to ten rounds until it has, and one that raised χ² by more is replaced by
                    Levenberg–Marquardt from where the estimate stood
    ripple          tree: δ follows where it is off by more than would add the square of this as a share to χ², if all
                    scalars were; in wide cliques, which take longer, by more than that (MATH §9.7)
    recent_steps    tree: variables that had a factor in the last so many steps are eliminated last
    heavy, near, around, worth   tree: an elimination of F flops, more than `heavy`, brings what surrounds the newest
                    factors near the root, near ∛F scalars or around ∛F² of them, whichever is more, once the share
                    `worth` of what that took last has been spent since (MATH §9.4)
    rings, detour   tree: ring by ring, each with what is inside it `rings` times as large as the next; what would take
                    more than this share of F in addition stays where it is
    split_pivots, split_share   tree: cliques of more scalars, less than this share of them touched, are split
    backend         "blocks": block multifrontal Cholesky; "cholmod": CHOLMOD on scalars, through scikit-sparse
    """

    mode: str = "auto"
    clock: Callable[[], float] | None = None
    tolerance: float = 1e-6
    tol: float = 5e-5
    small_loop: int = 400
    big_loop: int = 500
    loop_share: float = 0.1
    keep_factor: bool = True
    place_new: bool = True
    negligible: float = 1e-12
    max_iterations: int = 10
    nonmonotone_steps: int = 20
    settle_tolerance: float = 1e-14
    settle_iterations: int = 500
    last_pose_last: bool = True
    recent_poses: int = 1
    bent: float = 5e-4
    bent_soon: float = 1e-4
    bent_now: float = 1e-4
    many: int = 1500
    bent_most: float = 2.0
    patience: int = 1000
    rest: int = 96
    reluctance: float = 6.0
    dear: float = 5e8
    converged_share: float = 5e-4
    rounds: int = 3
    ripple: float = 0.01
    recent_steps: int = 2
    heavy: float = 1e5
    near: float = 1.4
    around: float = 0.0055
    worth: float = 0.1
    rings: float = 4.0
    detour: float = 0.5
    split_pivots: int = 24
    split_share: float = 0.5
    backend: Literal["blocks", "cholmod"] = "blocks"

    def __post_init__(self) -> None:
        mode_named(self.mode)
        if self.backend not in ("blocks", "cholmod"):
            raise BadOption("backend", repr(self.backend), '"blocks" or "cholmod"')
        if self.clock is not None and not callable(self.clock):
            raise BadOption("clock", repr(self.clock), "None, or a function that returns seconds")
        check_numbers(self)
        if not self.small_loop <= self.big_loop:
            raise BadOption("small_loop, big_loop", f"{self.small_loop}, {self.big_loop}", "0 ≤ small_loop ≤ big_loop")

    def as_dict(self) -> dict[str, Any]:
        """All settings but the clock, as plain types: what a solver reports of itself."""
        return {name: getattr(self, name) for name in self.__slots__ if name != "clock"}
