"""What was tuned on half of the worlds and reported on the other: for developers, and no part of the public promise."""

from dataclasses import dataclass

from factorbus.solver.option_ranges import check_numbers

__all__ = ["Tuning"]


@dataclass(frozen=True, slots=True)
class Tuning:
    """Thresholds of the modes; `docs/decisions/` says how they were chosen, `ask/stats` reports them.

    When variables are relinearized in the mode "bayes-tree" (MATH §9.6):
    relinearize_next_step_share   all that wait are relinearized in the next step once their linearization errors add
                                  more than this share to χ², if they have `relinearize_full_batch` scalars,
    relinearize_same_step_share   and in the same step, and solved for again, once they add more than this share
    relinearize_max_error         or once the error of one factor is more than this many residuals,
    relinearize_max_wait          or one has waited for this many steps
    relinearize_full_batch        scalars; for fewer the shares are smaller, for landmarks and poses in space larger
    relinearize_cooldown_steps    for this many steps after a relinearization both shares are larger,
    relinearize_cooldown_factor   up to this many times;
    relinearize_cooldown_flops    after one that took k times as many flops for k times as many steps, up to √k times as
                                  much as that, and `relinearize_max_wait` is k times as long

    The elimination order of a step (MATH §9.4):
    constrain_recent_steps        variables that had a factor in this number of last steps are eliminated last
    reroot_min_flops              an elimination of F flops, more than this, brings variables near the root: those that
    reroot_size_linear            surround the newest factors, this times ∛F scalars of them,
    reroot_size_area              or this times F^⅔, whichever is more,
    reroot_period                 once this share of what it took the last time has been spent since,
    reroot_ring_ratio             in rings, each with all inside it this many times as large as the next one,
    reroot_max_extra              unless one takes more than this share of F in addition
    clique_split_min_pivots       cliques of more scalars,
    clique_split_max_affected     less than this share of them touched, are split

    The incremental modes of the 2013 paper (MATH §8):
    small_loop_threshold          smallLoopThresh: Ω-updates reach no more block rows of R than this
    big_loop_threshold            bigLoopThresh: Λ-updates reach no more; above it R is computed anew in a new order
    loop_threshold_share          in small maps both are smaller: no more than 40 rows and this share of all
    reuse_factor                  R stays in use after a step was made with it, as long as it leads there (MATH §8.6);
                                  False: it is computed anew at every new linearization point, as the paper has it
    constrain_last_pose           constrain the ordering: the last pose last, the landmarks seen from the
    constrain_recent_poses        this number of last poses right before it

    All modes:
    chi2_epsilon                  a χ² below this is nothing: 1e-12 is a millionth of a standard deviation, squared.  A
                                  step whose new factors add less solves nothing, and no step goes on for less
    max_nonmonotone_steps         where an undamped step would raise χ², it and more may, until χ² is lower than before:
                                  this many in all.  Else they are taken back, and a step of Newton's or damping
                                  follows.  0: damped at once
    converge_tolerance            `Options.batch_tolerance` of a step that is to converge,
    converge_max_iterations       and its `Options.max_iterations`

    Raises BadOption: a value is no number of its range.
    """

    relinearize_next_step_share: float = 1.5e-5
    relinearize_same_step_share: float = 1.5e-5
    relinearize_max_error: float = 2.0
    relinearize_max_wait: int = 1000
    relinearize_full_batch: int = 1500
    relinearize_cooldown_steps: int = 96
    relinearize_cooldown_factor: float = 6.0
    relinearize_cooldown_flops: float = 5e8
    constrain_recent_steps: int = 2
    reroot_min_flops: float = 1e5
    reroot_size_linear: float = 1.4
    reroot_size_area: float = 0.0055
    reroot_period: float = 0.1
    reroot_ring_ratio: float = 4.0
    reroot_max_extra: float = 0.5
    clique_split_min_pivots: int = 24
    clique_split_max_affected: float = 0.5
    small_loop_threshold: int = 400
    big_loop_threshold: int = 500
    loop_threshold_share: float = 0.1
    reuse_factor: bool = True
    constrain_last_pose: bool = True
    constrain_recent_poses: int = 1
    chi2_epsilon: float = 1e-12
    max_nonmonotone_steps: int = 50
    converge_tolerance: float = 1e-14
    converge_max_iterations: int = 500

    def __post_init__(self) -> None:
        check_numbers(self)
