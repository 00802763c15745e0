"""The picture that `demo` and `replay --plot` draw."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from factorbus.cli.driving.columns import merged
from factorbus.cli.driving.drive import Compared
from factorbus.proto.arrays import F64
from factorbus.proto.messages import Batch, Variables
from factorbus.viz import DriveHistory, MapLayers, Odometry, Spread, loops_of, save_map


def draw(
    path: Path,
    batches: Iterable[Batch],
    estimate: Sequence[Variables],
    history: DriveHistory,
    title: str,
    subtitle: str = "",
    truth: Sequence[Variables] = (),
    spread: Spread | None = None,
) -> None:
    """Odometry, estimate, truth, loop closures, and below them how the drive went, into the file `path`.

    spread: where some of the estimate may be.
    """
    graph = merged(batches)
    layers = MapLayers(estimate, reckoned(graph), truth, loops_of(graph), spread)
    save_map(path, layers, history=history, title=title, subtitle=subtitle)


def reckoned(graph: Batch) -> tuple[Variables, ...]:
    """Where odometry alone puts the poses."""
    odometry = Odometry()
    odometry.add(graph)
    return odometry.variables()


def history_of(reports: Sequence[Mapping[str, Any]], compared: Sequence[Compared]) -> DriveHistory:
    """χ², time and work of every step, and χ² of the batch optimum where it was found, those not converged apart."""
    names = ("new_variables", "eliminated", "relinearized")
    work = np.array([[report[name] for name in names] for report in reports], float).reshape(-1, 3)
    work[:, 0] = work[:, 0].cumsum()
    return DriveHistory(
        np.array([report["chi2"] for report in reports]),
        np.array([report["step_ms"] for report in reports]),
        _optima(each for each in compared if each.batch_converged),
        work,
        _optima(each for each in compared if not each.batch_converged),
    )


def _optima(compared: Iterable[Compared]) -> F64:
    return np.array([(each.revision, each.batch) for each in compared], float).reshape(-1, 2)
