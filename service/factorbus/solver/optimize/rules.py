"""When the minimization of a step stops, by the solver's options and what the step is for.  MATH §6."""

from factorbus.solver.kernels.bayes_tree.convergence import FINISHED
from factorbus.solver.optimize.gauss_newton import StoppingRule
from factorbus.solver.options import Options

_POLISH = 100
_CERTAIN = 1e-3  # of what `converged` promises: the R of an older point may be wrong by the rest


def ordinary_rule(options: Options, tolerance: float) -> StoppingRule:
    """Of a step with something new."""
    return StoppingRule(
        tolerance, options.tuning.chi2_epsilon, options.max_iterations,
        nonmonotone=options.tuning.max_nonmonotone_steps, newton=options.tuning.max_nonmonotone_steps > 0,
        certain=_CERTAIN * options.converged_share,
    )  # fmt: skip


def further_rule(options: Options, tolerance: float) -> StoppingRule:
    """Of a step with nothing new: until another one would take no more off χ² than `FINISHED` of it."""
    return ordinary_rule(options, min(FINISHED, tolerance))


def settling_rule(options: Options) -> StoppingRule:
    """Of a step that was asked to settle: to more digits than χ² has."""
    tuning = options.tuning
    return StoppingRule(
        tuning.converge_tolerance, 1e-8 * tuning.chi2_epsilon, tuning.converge_max_iterations, polish=_POLISH,
        nonmonotone=tuning.max_nonmonotone_steps, newton=tuning.max_nonmonotone_steps > 0,
    )  # fmt: skip
