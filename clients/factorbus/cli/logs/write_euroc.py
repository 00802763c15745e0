"""A simulated drive with an IMU as an EuRoC folder, with what is true beside it."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from factorbus.client.geodetic import geodetic
from factorbus.proto.arrays import F64
from factorbus.proto.linear_in_frame import rotation_of
from factorbus.simulate.inertial import InertialWorld

ORIGIN = (48.1, 11.6, 520.0)
_BEGIN_NS = 1_700_000_000_000_000_000
_POSE = "p_x [m],p_y [m],p_z [m],q_w,q_x,q_y,q_z"


def write_world(folder: Path, world: InertialWorld) -> list[Path]:
    """Write it; returns the files.  Of sensors what is believed is written; what is true is in truth.json alone."""
    mav, files, errors = folder / "mav0", list[Path](), world.errors
    noise = {
        "gyroscope_noise_density": errors.gyroscope, "accelerometer_noise_density": errors.accelerometer,
        "gyroscope_random_walk": errors.gyroscope_walk, "accelerometer_random_walk": errors.accelerometer_walk,
    }  # fmt: skip
    files += _sensor(
        mav / "imu0", "w_x [rad/s],w_y,w_z,a_x [m/s^2],a_y,a_z", world.imu, [f"{k}: {v}" for k, v in noise.items()]
    )
    places = np.array([[t, *geodetic(enu, ORIGIN), *errors.gnss] for t, *enu in world.gnss.tolist()])
    files += _sensor(
        mav / "gps0", "latitude [deg],longitude [deg],height [m],sigma_east [m],sigma_north [m],sigma_up [m]", places,
        [f"origin: {list(ORIGIN)}", *_mount(np.array([0, 0, 0, 0, 0, 0, 1.0]), [*errors.lever.tolist(), 1, 1, 1])],
    )  # fmt: skip
    sigmas = [f"sigma_position: {errors.odometry[0]}", f"sigma_angle: {errors.odometry[3]}"]
    files += _sensor(
        mav / "odom0", _POSE, _scalar_first(world.odometry), [*sigmas, *_mount(errors.camera, errors.mount.tolist())]
    )
    truth = np.column_stack([_scalar_first(world.truth), world.velocity])
    files += _sensor(mav / "state_groundtruth_estimate0", f"{_POSE},v_x [m/s],v_y,v_z", truth, [])
    told = {
        "frame": world.frame.tolist(), "origin": list(ORIGIN), "lever": world.lever.tolist(),
        "mount": world.mount.tolist(), "bias": world.bias.tolist(),
    }  # fmt: skip
    about = folder / "truth.json"
    about.write_text(json.dumps(told, indent=1) + "\n")
    return [*files, about]


def _sensor(folder: Path, columns: str, rows: F64, settings: list[str]) -> Iterable[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"#timestamp [ns],{columns}"]
    for time, *numbers in rows.tolist():
        lines.append(",".join([str(_BEGIN_NS + round(time * 1e9)), *map(repr, numbers)]))
    (folder / "data.csv").write_text("\n".join(lines) + "\n")
    if not settings:
        return [folder / "data.csv"]
    (folder / "sensor.yaml").write_text("\n".join(settings) + "\n")
    return [folder / "data.csv", folder / "sensor.yaml"]


def _mount(pose: F64, sigmas: list[float]) -> list[str]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_of(pose), pose[:3]
    numbers = ", ".join(map(repr, T.ravel().tolist()))
    return ["T_BS:", "  cols: 4", "  rows: 4", f"  data: [{numbers}]", f"sigma_T_BS: [{', '.join(map(str, sigmas))}]"]


def _scalar_first(rows: F64) -> F64:
    """(n, 8) time, x y z, qx qy qz qw with the last one first, as EuRoC has it."""
    return rows[:, [0, 1, 2, 3, 7, 4, 5, 6]]
