"""Words for what a batch optimum was found from, and for one whose search ended before it had converged."""

_WORDS = {"values": "the map's own values", "odometry": "composed odometry", "rotations": "averaged rotations"}


# After the name of an optimum, or a ratio to it.
NOT_CONVERGED = "not converged, the true optimum may be lower"


_ROUNDING = 1e-9  # a χ² below this is what rounding left of a fit without any residual


def ratio_to(chi2: float, batch: float) -> str:
    """χ² over that of the batch optimum; "-" where there is nothing but rounding to compare.

    Where the optimum's is nothing but rounding: what the ratio is above.
    """
    if max(chi2, batch) < _ROUNDING:
        return "-"
    return f"{chi2 / batch:.9f}" if batch >= _ROUNDING else f"above {chi2 / _ROUNDING:.0e}"


def optimum_from(start: str, file_values: bool = False, converged: bool = True) -> str:
    """ "optimum from averaged rotations".  file_values: the map began with the values of a file.

    converged: whether the search for it had when it ended; if not, that is said.
    """
    words = (
        "the file's values" if file_values and start == "values" else _WORDS.get(start, "a start that is not reported")
    )
    return f"optimum from {words}" + ("" if converged else f", {NOT_CONVERGED}")
