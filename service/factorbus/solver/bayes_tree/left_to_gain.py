"""What is left to gain after a step of the tree, where Σ error² does not say it.  MATH §9.6

Σ error² takes the force of each factor by itself; what it says nothing of where the linear problem is not solved, see
`kernels/bayes_tree/convergence.py`.
"""

import math

from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.convergence import SLOW
from factorbus.solver.kernels.bayes_tree.thresholds import LEAST_CHI2
from factorbus.solver.optimize.gauss_newton import Minimization

# By what share of χ² a step of Levenberg-Marquardt may lower it that is the last one, where pivots were raised.
AT_END = 1e-7
_ROUNDING = 1e-12


def is_left(tree: CliqueTree, share: float) -> bool:
    """Whether a Gauss-Newton step from the estimate would take more than this share off χ², by the gradient of all
    factors.  The totals have it then, and what the optimum is at least."""
    totals = tree.totals
    chi2 = max(totals.item(tl.T_CHI2), 0.0)
    most = share * (chi2 + LEAST_CHI2)
    left = tree.remaining(most)
    totals[tl.T_EXCESS] = max(left - totals.item(tl.T_ERROR), 0.0) if left > most else 0.0
    if left <= most or not tree.raised:
        totals[tl.T_LEAST] = max(chi2 - left, 0.0)
    return left > most


def judge_batch(tree: CliqueTree, result: Minimization, share: float, last: float) -> None:
    """Whether `result` has converged, to which the tree has added a step of its own or not; and T_LEAST.

    last: what the step as a whole gained, if it began with nothing new, else infinite
    """
    totals = tree.totals
    chi2 = totals.item(tl.T_CHI2)
    totals[tl.T_EXCESS] = 0.0
    is_there = chi2 <= (1.0 + AT_END) * result.chi2 + LEAST_CHI2
    is_last = result.converged or last <= AT_END * (max(chi2, 0.0) + LEAST_CHI2)
    if not is_there:
        # The tree could not be eliminated where these steps ended, and is elsewhere.
        result.converged = False
    elif not result.converged and math.isfinite(last):
        # Where a valley is curved damped steps are short and many: what a whole one would gain tells whether
        # there is anything left, and the map rests where they hardly gain.  Undamped ones that came to their limit tell
        # it themselves: R of the tree may have lost what is left.
        most = SLOW * share * (max(chi2, 0.0) + LEAST_CHI2)
        goes_on = math.isfinite(result.left) and result.left > most
        result.converged = not goes_on and not is_left(tree, SLOW * share)
    elif result.converged and chi2 < (1.0 - _ROUNDING) * result.chi2:
        # Beside a saddle point a step that gains nothing leads to where much is left.
        result.converged = not is_left(tree, share)
    tree.state[tl.S_SLOW] = 0 if result.converged else 1
    if is_last or not result.converged:
        totals[tl.T_LEAST] = chi2 if result.converged else 0.0
