"""`factorbus demo monocular`: a camera among points it does not know; rays without an end become points."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from factorbus.cli.output.exits import output_file, require
from factorbus.cli.process.options import Number, WholeNumber, json_option, out_option
from factorbus.wording import counted

_RHO, _SIGMA_RHO = 0.28, 0.2  # 1/metre: anything from 1.5 metres to behind the horizon


@click.command()
@click.option("--frames", type=WholeNumber(2, 100_000), default=200, show_default=True, metavar="N")
@click.option("--points", type=WholeNumber(20, 100_000), default=300, show_default=True, metavar="N")
@click.option(
    "--features",
    type=WholeNumber(8, 500),
    default=60,
    show_default=True,
    metavar="N",
    help="In the filter at a time.",
)
@click.option("--noise", type=Number(0.01, 20.0), default=1.0, show_default=True, metavar="PIXELS")
@click.option("--outliers", type=Number(0.0, 0.5), default=0.05, show_default=True, metavar="SHARE")
@click.option("--seed", type=WholeNumber(0), default=1, show_default=True, help="The same seed, the same world.")
@click.option("--workers", type=WholeNumber(0, 64), default=2, show_default=True, metavar="N")
@out_option("--plot", "plot", "The picture.  [default: out/monocular.png]", "FILE.png")
@json_option
def command(as_json: bool, plot: Path | None, **asked: Any) -> None:
    """A camera moves through points; its filter gets its features over the bus.

    What a camera sees for the first time is a ray: a direction, and a distance that may be anything. Each becomes a
    feature in the inverse-depth form, made with its covariance by the service and its workers; pixels of later frames
    shorten the rays to points. At the end: how well the filter knew what it knew, against the truth.

    \b
    factorbus demo monocular
    factorbus demo monocular --points 1000 --noise 0.5 --plot sharp.png
    factorbus demo monocular --json
    """
    require("service", "factorbus demo monocular")
    require("viz", "factorbus demo monocular")
    from factorbus.cli.output import console as screen

    if plot is None:
        plot = Path("out") / "monocular.png"
        plot.parent.mkdir(exist_ok=True)
    result = run_monocular_demo(plot=plot, **asked)
    if as_json:
        screen.document(result)
    else:
        screen.table(
            _rows(result),
            title=f"a camera among {counted(result['points'], 'point')}, {counted(result['frames'], 'frame')}",
        )


def run_monocular_demo(
    plot: Path, frames: int, points: int, features: int, noise: float, outliers: float, seed: int, workers: int
) -> dict[str, Any]:
    """Run it, with progress on standard error; returns the document."""
    from factorbus.cli.demo.evaluate_filter import FilterEvaluator, verdict
    from factorbus.cli.output.console import print_note, progress
    from factorbus.cli.process.children import STARTING, service, worker
    from factorbus.cli.process.stopping import interrupt_on_sigterm
    from factorbus.client import connect
    from factorbus.simulate import monocular
    from factorbus.viz.monocular import save_monocular_drive

    world = monocular(frames, seed, points=points, sigma_pixel=noise, outlier_share=outliers)
    with ExitStack() as stack:
        stack.enter_context(interrupt_on_sigterm())
        print_note(STARTING)
        _, endpoint = stack.enter_context(service(say=print_note))
        for number in range(1, workers + 1):
            stack.enter_context(worker(endpoint, f"worker{number}"))
        bus = stack.enter_context(connect(endpoint, client="camera"))
        front = bus.features(world.camera, rho=_RHO, sigma_rho=_SIGMA_RHO, sigma_pixel=noise)
        evaluator = FilterEvaluator(world, front, features)
        seen = []
        with progress("the camera looks", frames) as show:
            for frame in evaluator.run():
                seen.append(frame)
                show(
                    frame.number + 1,
                    f"{counted(len(frame.rays), 'feature')}, {frame.error_m * 100:.1f} cm from the truth",
                )
    truth = [frame.pose[:3] for frame in world]
    result = {**verdict(seen, evaluator), "points": points, "seed": seed, "workers": workers, "plot": str(plot)}
    shares = [history.share for _, history in evaluator.ended]
    shown = [(f.number, f.position, f.rays, f.spread) for f in seen]
    with output_file(plot):
        save_monocular_drive(plot, shown, truth, world.points, shares, _said(result))
    return result


def _said(result: dict[str, Any]) -> str:
    depth = result["relative_depth"]
    return f"depths known to {depth['first']:.0%} at the first observation, to {depth['last']:.2%} at last"


def _rows(result: dict[str, Any]) -> list[tuple[str, str]]:
    depth, nees, error = result["relative_depth"], result["nees"], result["error_m"]
    made = ", ".join(f"{name} {count}" for name, count in sorted(result["made_by"].items()))
    within = result["inverse_depth_within_3_sigma"]
    return [
        ("features", f"{result['features']} made ({made}), {result['dropped_as_wrong']} found wrong and dropped"),
        ("pixels used", f"{result['pixels_used']:,}"),
        ("depth, σ/depth, median", f"{depth['first']:.0%} at the first observation → {depth['last']:.2%} at last"),
        ("inverse depths within 3σ", f"{within:.1%} of {result['features_judged']}"),
        (
            "trajectory within 3σ",
            f"{nees['within_3_sigma']:.1%} of frames; NEES {nees['mean']:.2f}, wanted {nees['wanted']:g}",
        ),
        (
            "error of the trajectory",
            f"{error['rms'] * 100:.2g} cm rms, {error['end'] * 100:.2g} cm at the end of {result['way_m']:.2f} m",
        ),
        (
            "time a frame",
            f"filter {result['filter_ms']:.1f} ms; new features over the bus {result['grow_ms']:.1f} ms",
        ),
        ("picture", result["plot"]),
    ]
