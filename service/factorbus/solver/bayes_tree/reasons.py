"""Why a step of the tree did what it did, as reports say it."""

from factorbus.wording import counted

_NOTHING_TO_RELINEARIZE = "no linearization error above its threshold"
_ASKED = "asked to settle"
_CORRECTED = "residuals taken anew in a chord step"
_WOULD_RISE = "χ² would have risen: Levenberg-Marquardt from where the estimate stood"
_ROSE = "χ² rose from one round to the next: Levenberg-Marquardt"
_GOES_ON = "pivots were raised above rounding: conjugate gradients to the optimum"
_OPEN = "another step would gain more than is called converged: Levenberg-Marquardt"
_WITHIN = "numbers would have left their bounds: Levenberg-Marquardt within them"
_STALLS = "a step with nothing new did not lower χ²: Levenberg-Marquardt to the optimum"


def why_batch(settle: bool, escaped: bool, worse: bool, rises: bool, opened: bool, goes_on: bool) -> str:
    """Why all was solved: the first of these that holds; none: it stalls."""
    reasons = (
        (settle, _ASKED), (escaped, _WITHIN), (worse, _WOULD_RISE), (rises, _ROSE), (opened, _OPEN), (goes_on, _GOES_ON)
    )  # fmt: skip
    return next((reason for holds, reason in reasons if holds), _STALLS)


def why_tree(count: int, rounds: int, chords: int) -> str:
    """Why a step did more than solve.  In several rounds one variable counts as often as it was relinearized."""
    if not count:
        return _CORRECTED if chords else _NOTHING_TO_RELINEARIZE
    if rounds > 1:
        return f"{counted(count, 'relinearization')} in {rounds} rounds"
    return f"{counted(count, 'variable')} relinearized"
