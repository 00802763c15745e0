"""What came of a replay, as a table for people."""

from typing import Any

from factorbus.cli.output.starts import optimum_from, ratio_to
from factorbus.cli.process.reading import COUNTED
from factorbus.wording import counted

_SHOWN = 5  # of what is fixed


def replay_rows(result: dict[str, Any]) -> list[tuple[str, str]]:
    """(what, how it was), by the document of a replay."""
    step, bus = result["step_ms"], result["bus_ms"]
    rows = [
        ("graph", _size(result)),
        ("time", f"{result['seconds']:.2f} s, {result['poses_per_s']:.0f} poses/s"),
        ("solver CPU", f"{result['solver_cpu_s']:.2f} s"),
        ("step", _times(step)),
        ("fixed", _listed(result["fixed"]) or "nothing: the file's priors hold it"),
    ]
    if bus:
        rows.append(("bus", _times(bus)))
        rows.append(("estimates received", f"{result['deltas']}, at revision {result['revision']}"))
    initial = "" if result["chi2_initial"] is None else f", {result['chi2_initial']:.6g} by odometry"
    rows.append(("χ²", f"{result['chi2']:.8g}, {result['chi2_unsettled']:.8g} after the last step{initial}"))
    if states := result["closure_states"]:
        rows.append(("closures", ", ".join(f"{count} {state}" for state, count in states.items())))
    if error := result.get("error_m"):
        away = f"rms {error['rms']:.3g} m, max {error['max']:.3g} m of {counted(error['poses'], 'pose')}"
        rows.append(("from ground truth", f"{away}, aligned"))
    for each in result["against_batch"]:
        by = f"{_optimum(each, result)}; {each['worker']}, {each['seconds']:.2f} s"
        worse = "  better_optimum" if each["better_optimum"] else ""
        rows.append((f"χ² / batch at {each['revision']}", f"{ratio_to(each['chi2'], each['batch'])}  ({by}){worse}"))
    if result["adopted"]:
        was = f"{result['adopted']['chi2']:.8g}, {_optimum(result['adopted'], result)}"
        rows.append(("better_optimum", f"adopted: χ² was {was}"))
    rows.append(("strategies", ", ".join(f"{name} {count}" for name, count in result["strategies"].items())))
    if result["kernels_compiled_s"] > 0.1:
        rows.append(("compiling", f"{result['kernels_compiled_s']:.1f} s, once on this machine"))
    return rows


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def _size(result: dict[str, Any]) -> str:
    return ", ".join(counted(result[many], one) for many, one in COUNTED)


def _optimum(compared: dict[str, Any], result: dict[str, Any]) -> str:
    return optimum_from(compared["start"], result["use_values"], compared["batch_converged"])


def _times(times: dict[str, float]) -> str:
    return f"p50 {times['p50']:.2f}   p95 {times['p95']:.2f}   p99 {times['p99']:.2f}   max {times['max']:.2f} ms"
