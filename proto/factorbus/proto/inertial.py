"""How the numbers of an inertial factor are laid out, and what bounds them.  Kernels have them as constants.

A measurement has the noise of the sensor (5), gravity in the map (3), the bias at which the noise is propagated (6),
and of each sample its duration, what the gyroscopes measure and what the accelerometers measure (7).
"""

import re

# Offsets in a measurement.
GYROSCOPE = 0  # noise densities: rad/s/√Hz
ACCELEROMETER = 1  # m/s²/√Hz
GYROSCOPE_WALK = 2  # how the biases wander: rad/s/√s
ACCELEROMETER_WALK = 3  # m/s²/√s
INTEGRATION = 4  # what integration adds to positions, m/√s
GRAVITY = 5
BIAS = 8  # gyroscopes, then accelerometers
SAMPLES = 14

SAMPLE = 7  # numbers of a sample: its duration, gyroscopes, accelerometers
MOST_SAMPLES = 2000
KEPT = 45  # numbers that a solver keeps behind a measurement: what whitens nine of the residual
RESIDUAL = 15  # rotation, position, velocity, bias
ENDS = ("se3", "vector3", "vector6", "se3", "vector3", "vector6")
ROLES = ("", "axes", "") * 2  # velocities turn with the map

PREFIX = "imu_"
NAME = "imu_SAMPLES"
_FORM = re.compile(r"imu_([1-9][0-9]{0,3})")
MEASURED = (
    "noise densities of gyroscopes (rad/s/√Hz) and accelerometers (m/s²/√Hz), random walk of their biases (rad/s/√s, "
    "m/s²/√s), noise of integration (m/√s); gravity in the map (m/s², 3); bias at which noise is propagated (6); of "
    "each sample its duration (s), angular velocity (rad/s, 3), acceleration less gravity (m/s², 3)"
)
DIFFERENCE = (
    "W (log(ΔRᵀ Rₐᵀ R_b), Rₐᵀ (t_b − tₐ − vₐ T − ½ g T²) − Δp, Rₐᵀ (v_b − vₐ − g T) − Δv), then (β_b − βₐ) / (σ √T); "
    "Δ of the samples at βₐ"
)
EXAMPLE = (0.01, 0.1, 0.001, 0.01, 0.001, 0.0, 0.0, -9.8125, *(0.0,) * 6)
EXAMPLE_SAMPLE = (0.125, 0.25, -0.125, 0.5, 0.5, 0.25, 9.75)


def imu_name(samples: int) -> str:
    """The name of the kind with that many samples.  Raises ValueError: none, or too many."""
    if not 1 <= samples <= MOST_SAMPLES:
        raise ValueError(f"{samples} samples; wanted 1 to {MOST_SAMPLES}")
    return f"{PREFIX}{samples}"


def samples_of(name: str) -> int:
    """How many samples the kind of that name has.  Raises ValueError: there is no such kind, and why."""
    if (found := _FORM.fullmatch(name)) is None:
        raise ValueError("wanted a number of samples from 1 on")
    imu_name(int(found[1]))
    return int(found[1])
