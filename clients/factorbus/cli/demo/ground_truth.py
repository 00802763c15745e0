"""The demo's drive once more, as the robot cannot see it: what it measured, and where it really was."""

from collections.abc import Iterable, Sequence
from typing import Any

from factorbus.cli.driving.columns import merged, position_errors
from factorbus.cli.driving.local import chi2_unsolved
from factorbus.cli.driving.picture import reckoned
from factorbus.proto.arrays import F64
from factorbus.proto.messages import Batch, Variables
from factorbus.simulate import WORLDS
from factorbus.viz import loops_of

_POSES, _POINTS = ("se2", "se3"), ("point2", "point3")


class World:
    """A simulated world, driven through again from the same seed."""

    def __init__(self, name: str, poses: int, seed: int) -> None:
        steps = list(WORLDS[name.replace("-", "_")](poses=poses, seed=seed))
        self.batches = [step.batch for step in steps]
        self.truth = merged(Batch(step.truth) for step in steps).variables

    def judge(self, estimate: Sequence[Variables]) -> dict[str, Any]:
        """Errors in metres of the estimate and of odometry alone; the first pose is fixed at the truth in both."""
        graph = merged(self.batches)
        odometry = reckoned(graph)
        return {
            "loop_closures": len(loops_of(graph)),
            "chi2_initial": chi2_unsolved(self.batches),
            "error_m": self._error(estimate, _POSES),
            "error_landmarks_m": self._error(estimate, _POINTS),
            "error_odometry_m": self._error(odometry, _POSES),
        }

    def _error(self, variables: Iterable[Variables], kinds: Iterable[str]) -> dict[str, float] | None:
        errors = position_errors(variables, self.truth, kinds)
        return _spread(errors) if errors.size else None


def _spread(errors: F64) -> dict[str, float]:
    return {"rms": float((errors**2).mean() ** 0.5), "max": float(errors.max())}
