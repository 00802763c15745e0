"""Real tracks, outliers and all: the filter on EuRoC V1_01 with its features from the bus, against motion capture.

    python tests/bench/idp_euroc.py [--json] [--tum FOLDER] [--workers N]

The tracks are of optical flow in the left camera (radial–tangential lens), a tenth of them off by more than 25 pixels.
A single camera does not know how large the world is, so the trajectory is aligned with the true one by a similarity;
the error is what is left.  `--tum` writes both trajectories for evo (`evo_ape tum truth.tum filter.tum --align
--correct_scale`), which is asked itself where it is installed.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.idp_bus import process

from factorbus.cli.demo.ekf import CAMERA, Filter
from factorbus.cli.demo.visual import VisualFilter, VisualSettings
from factorbus.client import Camera, Features, connect

_FIRST, _RATE_HZ = 90, 20.0  # before, the camera stands still and no depth can be seen
_RHO, _SIGMA_RHO = 0.3, 0.3
_SETTINGS = VisualSettings(sigma_pixel=2.5, velocity=0.06, turn=0.06, most=45)


def main() -> None:
    """Run, align, print."""
    options = _options()
    folder = options.data or try_find_tracks()
    if folder is None:
        sys.exit("bench idp_euroc: no tracks: set FACTORBUS_DATASETS to a folder with monocular/euroc_v101, or --data")
    with TemporaryDirectory() as scratch:
        found = run(folder, options.workers, options.tum or Path(scratch))
    print(json.dumps(found, indent=1) if options.json else report(found))


def run(folder: Path, workers: int, out: Path) -> dict[str, Any]:
    """The filter over the bus, and its error."""
    with ExitStack() as stack:
        endpoint = stack.enter_context(process("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--no-warm"))
        for number in range(workers):
            name = f"w{number}"
            stack.enter_context(process("-m", "factorbus.workers", "--connect", endpoint, "--name", name, "--no-warm"))
        bus = stack.enter_context(connect(endpoint, client="euroc", timeout_s=60))
        prior = {"rho": _RHO, "sigma_rho": _SIGMA_RHO, "sigma_pixel": _SETTINGS.sigma_pixel}
        front = stack.enter_context(bus.features(camera_of(folder), **prior))
        visual, way = drive(folder, front)
    truth = np.loadtxt(folder / "poses.txt")
    truth = truth[np.isin(truth[:, 0], way[:, 0])]
    way = way[np.isin(way[:, 0], truth[:, 0])]
    out.mkdir(parents=True, exist_ok=True)
    for name, frames, poses in (("truth", truth[:, 1], truth[:, 2:]), ("filter", truth[:, 1], way[:, 1:])):
        np.savetxt(out / f"{name}.tum", np.column_stack([frames, poses]), fmt="%.9f")
    aligned, scale = similar(way[:, 1:4], truth[:, 2:5])
    errors = np.linalg.norm(aligned - truth[:, 2:5], axis=1)
    return {
        "frames": len(way),
        "way_m": float(np.linalg.norm(np.diff(truth[:, 2:5], axis=0), axis=1).sum()),
        "error_m": {"rms": float(np.sqrt((errors**2).mean())), "max": float(errors.max())},
        "scale": scale,
        "evo": ask_evo(out),
        "features": visual.counts["features"],
        "pixels_used": visual.counts["matched"],
        "dropped_as_wrong": visual.counts["wrong"],
        "made_by": dict(visual.workers),
    }


def drive(folder: Path, front: Features) -> tuple[VisualFilter, np.ndarray]:
    """(the filter at the end, rows of frame, x y z, qx qy qz qw)."""
    table = np.loadtxt(folder / "tracks.txt")
    table = table[table[:, 0] >= _FIRST]
    x = np.zeros(CAMERA)
    x[3] = 1.0
    P = np.diag([1e-12] * 7 + [0.3**2] * 3 + [0.1**2] * 3)
    visual, way = VisualFilter(front, _SETTINGS, Filter(x, P)), []
    before = None
    for number in np.unique(table[:, 0]).astype(int):
        seen = table[table[:, 0] == number]
        tracks, pixels = seen[:, 1].astype(np.int64), np.ascontiguousarray(seen[:, 4:6])
        visual.look(number, (number - before) / _RATE_HZ if before is not None else 0.0, tracks, pixels)
        inside = usable(front.camera, pixels)
        visual.grow(number, tracks, pixels, np.flatnonzero(inside).tolist())
        before = number
        x = visual.filter.x
        way.append([number, *x[:3], *x[[4, 5, 6, 3]]])
    return visual, np.array(way)


def usable(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Which pixels are inside the image: a flow tracker goes on beyond it."""
    size = np.array([camera.width, camera.height])
    return ((pixels >= 0) & (pixels <= size - 1)).all(axis=1)


def camera_of(folder: Path) -> Camera:
    """The left camera."""
    rows = [line.split() for line in (folder / "camera.txt").read_text().splitlines() if line[:1] != "#"]
    numbers = {row[0]: [float(number) for number in row[1:]] for row in rows}
    lens = [numbers[name][0] for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")]
    return Camera("radtan", tuple(lens), int(numbers["width"][0]), int(numbers["height"][0]))


def similar(way: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, float]:
    """`way` moved, turned and scaled to lie on `truth` as well as it can (Umeyama, 1991), and the scale."""
    a, b = way - way.mean(axis=0), truth - truth.mean(axis=0)
    U, D, Vt = np.linalg.svd(b.T @ a / len(a))
    signs = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ signs @ Vt
    scale = float(np.trace(np.diag(D) @ signs) / (a**2).sum(axis=1).mean())
    return scale * a @ R.T + truth.mean(axis=0), scale


def ask_evo(folder: Path) -> dict[str, float] | None:
    """What evo says of the two trajectories; None where it is not installed."""
    beside = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    if (program := shutil.which("evo_ape", path=beside)) is None:
        return None
    command = [program, "tum", "truth.tum", "filter.tum", "--align", "--correct_scale", "--no_warnings"]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    words = (line.split() for line in ran.stdout.splitlines())
    return {row[0]: float(row[1]) for row in words if len(row) == 2 and row[0] in ("rmse", "max", "mean", "median")}


def report(found: dict[str, Any]) -> str:
    """For a person."""
    made = ", ".join(f"{name} {count}" for name, count in sorted(found["made_by"].items()))
    evo, error = found["evo"], found["error_m"]
    said = f"rmse {evo['rmse']:.3f} m, max {evo['max']:.3f} m" if evo else "not installed (pip install evo)"
    aligned = f"aligned by a similarity of scale {found['scale']:.3f}"
    return "\n".join(
        [
            f"EuRoC V1_01, {found['frames']} frames, {found['way_m']:.2f} m of way",
            f"  features      {found['features']} made ({made}), {found['dropped_as_wrong']} found wrong and dropped",
            f"  pixels used   {found['pixels_used']:,}",
            f"  error         {error['rms']:.3f} m rms, {error['max']:.3f} m at most, {aligned}",
            f"  evo           {said}",
        ]
    )


def try_find_tracks() -> Path | None:
    """The folder of the tracks, where the data sets are here."""
    folder = Path(os.environ.get("FACTORBUS_DATASETS", "")) / "monocular" / "euroc_v101"
    return folder if (folder / "tracks.txt").is_file() else None


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--json", action="store_true", help="one document and nothing else")
    parser.add_argument("--tum", type=Path, metavar="FOLDER", help="write both trajectories there")
    parser.add_argument("--workers", type=int, default=1, metavar="N")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="with tracks.txt, poses.txt and camera.txt")
    return parser.parse_args()


if __name__ == "__main__":
    main()
