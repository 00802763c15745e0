"""Rows for a person: a line for each drive as it is done, then a table by world, and the targets."""

from collections.abc import Sequence
from typing import Any

_RATIO = "ratio"
_FORMS = {
    "steps": ("steps", 6, "{:d}"),
    "p50": ("p50", 10, _RATIO),
    "p99": ("p99", 10, _RATIO),
    "max": ("max", 10, _RATIO),
    "above_1_001": (">1.001", 7, "{:d}"),
    "above_1_01": (">1.01", 6, "{:d}"),
    "odometry_excess": ("odo σ", 7, "{:.2f}"),
    "unconverged": ("unconv", 7, "{:d}"),
    "worst_converged": ("w.conv", 10, _RATIO),
    "chi2_untrue": ("untrue", 8, "{:.1e}"),
    "idle_steps": ("idle", 5, "{:d}"),
    "idle_s": ("idle s", 7, "{:.2f}"),
    "idle_off": ("off", 8, "{:.0e}"),
}
_THEIRS = ("p50", "p99", "max", "above_1_001", "above_1_01", "odometry_excess")
_NAME = 14
LEGEND = """\
p50, p99, max: χ² of the estimate over that of the batch optimum from there.  odo σ: the most that √(rᵀΩr) of a new
odometry factor exceeds the optimum's.  unconv: steps that said they have not converged; w.conv: the worst of those
that said they have.  untrue: the most that a report's χ² is off.  idle: steps without anything new until nothing is
left to do; off: χ² over the optimum's then, less 1.  Behind the bar: GTSAM's iSAM2 (0.1, skip 1), by its own error
function and optimum; *: not by Cholesky, or not to the end, as `isam2_note` of the document says."""


def head(isam2: bool) -> str:
    """Titles of columns."""
    ours = "".join(f"{title:>{width}}" for title, width, _ in _FORMS.values())
    theirs = "".join(f"{_FORMS[name][0]:>{_FORMS[name][1]}}" for name in _THEIRS) if isam2 else ""
    return f"{'':<{_NAME}}{'seed':>11}{ours}" + (f" |{theirs}" if isam2 else "")


def line(row: dict[str, Any]) -> str:
    """A drive, or all of a world."""
    numbers = {**row, "idle_off": row["idle_ratio"] - 1 if row["idle_done"] else float("inf")}
    ours = "".join(f"{_written(numbers[name], form):>{width}}" for name, (_, width, form) in _FORMS.items())
    told = f"{row['world']:<{_NAME}}{row.get('seed', str(row.get('drives')) + ' drives'):>11}{ours}"
    if "isam2_p50" not in row:
        return told
    theirs = "".join(f"{_written(row['isam2_' + name], _FORMS[name][2]):>{_FORMS[name][1]}}" for name in _THEIRS)
    return f"{told} |{theirs}" + (" *" if row.get("isam2_note") else "")


def targets(verdicts: Sequence[dict[str, str]]) -> str:
    """Met or missed, and by what."""
    return "\n".join(f"{each['verdict']:<13}{each['what']}: {each['seen']}" for each in verdicts)


def _written(number: float, form: str) -> str:
    """A ratio with the digits that matter: five behind the point near 1."""
    if form != _RATIO:
        return form.format(number)
    return f"{number:.5f}" if number < 10 else f"{number:.4g}"
