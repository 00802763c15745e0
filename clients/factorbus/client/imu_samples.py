"""What samples of an IMU cannot be: no numbers, lost for a while, or in other units than m/s² and rad/s."""

from __future__ import annotations

import warnings
from numbers import Real

import numpy as np

from factorbus.client.arguments import seen
from factorbus.proto.arrays import F64
from factorbus.proto.problems import BadOption, NotFiniteNumbers

_ENDLESS_S = 1e12  # whatever is longer; a whole number may be beyond all floats
GAP = 10.0  # times the median interval that a sample may hold
_COLUMNS = ("duration", *(f"{sensor} {axis}" for sensor in ("gyroscope", "accelerometer") for axis in "xyz"))
_STANDARD = 9.80665  # m/s²
# The median of |accelerometer| of samples in g, m/s²: no vehicle has so little for as long as a factor's half, but in
# free fall, where there is still less.
_IN_G = 0.5, 1.6
_LARGEST = 40.0 * _STANDARD  # m/s², a median of it: beyond what sensors measure, unless it is mm/s² or thousandths of g
# A sample that lasts longer, seconds, or this number of which each lasts longer than the one before: times.
_LONGEST_S, _IN_A_ROW = 60.0, 8
_FASTEST = 70.0  # rad/s, 4,000 °/s: the widest range of gyroscopes


class ImplausibleSamples(UserWarning):
    """Samples of an IMU that are most likely in other units, or times where durations are wanted.

    `warnings.filterwarnings` silences it.
    """


def refuse_gaps(times: F64, held: F64, end_s: float, longest_s: float | None) -> None:
    """Raises BadOption: a sample holds for too long.  held (m,): how long each holds between the poses, if above 0."""
    steps = np.diff(times)
    if longest_s is None and not steps.size:
        return
    if longest_s is not None and not (isinstance(longest_s, Real) and longest_s > 0.0):
        raise BadOption("longest_s", seen(longest_s), "seconds above 0, or None")
    limit = GAP * float(np.median(steps)) if longest_s is None else float(min(longest_s, _ENDLESS_S))
    whole = np.append(steps, end_s - times[-1])
    if not (bad := np.flatnonzero((held > 0.0) & (whole > limit))).size:
        return
    k = int(bad[0])
    usual = f", {GAP:g} times the median interval" if longest_s is None else ""
    wanted = (
        f"one every {limit:.3g} s (longest_s{usual}); join the poses before and after by another sensor, with no "
        "inertial factor between, or give longest_s= if the last one held"
    )
    raise BadOption("times_s", f"no sample for {whole[k]:.3g} s after {times[k]:.6g} s", wanted)


def refuse_not_finite(what: str, rows: F64) -> None:
    """Raises NotFiniteNumbers, with the first sample and number of it that is none.  rows (n, 7)."""
    if not (bad := np.argwhere(~np.isfinite(rows))).size:
        return
    row, column = bad[0].tolist()
    samples = len(np.unique(bad[:, 0]))
    more = f", and in {samples - 1} more" if samples > 1 else ""
    raise NotFiniteNumbers(what, f"{rows[row, column]} in sample {row}, {_COLUMNS[column]}{more}")


def warn_implausible(rows: F64, gravity: F64, stacklevel: int = 4) -> None:
    """ImplausibleSamples, where gravity (3,) is about that of the Earth.  rows (n, 7): checked samples.

    A wrong sign is not seen here: which way is up in the samples depends on the pose.  The text is much the same for
    all factors of a drive, so that Python shows it once for each place that drafts them.
    """
    wrong = implausible_units(rows, gravity)
    if wrong:
        warnings.warn(f"imu: samples: {'; '.join(wrong)}", ImplausibleSamples, stacklevel)


def implausible_units(rows: F64, gravity: F64) -> list[str]:
    """What in samples (n, 7), or none, looks as if it had other units than s, rad/s and m/s², or was times."""
    held = rows[:, 0]
    turning = float(np.linalg.norm(rows[:, 1:4], axis=1).max())
    force = float(np.median(np.linalg.norm(rows[:, 4:], axis=1)))
    wrong = []
    if held.max() > _LONGEST_S or (len(held) >= _IN_A_ROW and (np.diff(held) > 0.0).all()):
        wrong.append(
            f"they last {held[0]:.3g} s, ... {held[-1]:.3g} s: are these times? Wanted is how long each sample lasts, "
            "as cut_samples has it"
        )
    if turning > _FASTEST:
        wrong.append(f"gyroscopes say {turning:.1g} rad/s, more than any measures: are they in degrees per second?")
    if np.linalg.norm(gravity) > 0.5 * _STANDARD and _IN_G[0] <= force <= _IN_G[1]:
        wrong.append(f"the median of |accelerometer| is about {force:.1g} m/s²: is it in g? Multiply by {_STANDARD}")
    if force > _LARGEST:
        wrong.append(f"the median of |accelerometer| is about {force:.1g} m/s²: is it in mm/s², or thousandths of g?")
    return wrong
