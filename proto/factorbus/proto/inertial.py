"""How the numbers of an inertial factor are laid out, and what bounds them.  Kernels have them as constants.

A measurement of samples has the noise of the sensor (5), the bias at which that is propagated (6), gravity in the map
(3), the mount (7), and of each sample its duration, what the gyroscopes measure and what the accelerometers measure
(7).  One that is integrated already has the bias at which it was (6), gravity, the mount, and Δ with its derivatives by
the bias (56).  What is a variable, gravity or the mount, is not in the measurement.
"""

import re
from dataclasses import dataclass

# Offsets in what is known of the noise.
GYROSCOPE = 0  # noise densities: rad/s/√Hz
ACCELEROMETER = 1  # m/s²/√Hz
GYROSCOPE_WALK = 2  # how the biases wander: rad/s/√s
ACCELEROMETER_WALK = 3  # m/s²/√s
INTEGRATION = 4  # what integration adds to positions, m/√s
NOISE = 5  # how many these are

BIAS = 6  # numbers of a bias: gyroscopes, then accelerometers
GRAVITY = 3
MOUNT = 7
SAMPLE = 7  # of a sample: its duration, gyroscopes, accelerometers
# Of Δ: T, ΔR (qx qy qz qw), Δp, Δv; the derivatives of ΔR's right increment by gyroscopes, of Δp and of Δv by the bias.
DELTA = 1 + 4 + 3 + 3 + 9 + 18 + 18
MOST_SAMPLES = 2000
# What a solver keeps behind samples: what whitens nine of the residual; Δ where noise is propagated, what its 45
# derivatives change by with each gyroscope's bias, and how far the velocity changes on the way.
ROOT = 45
KEPT = ROOT + DELTA + 3 * 45 + 1
RESIDUAL = 15  # rotation, position, velocity, bias

PREFIX = "imu_"
NAME = "imu_SAMPLES"
PREINTEGRATED = "preintegrated"  # in a name in place of the number of samples
_FORM = re.compile(r"imu_([1-9][0-9]{0,3}|preintegrated)(_mount)?(_gravity)?")
_MOMENT = "se3", "vector3", "vector6"
MOMENTS = 2 * len(_MOMENT)  # how many variables every inertial factor has

_DENSITIES = (
    "noise densities of gyroscopes (rad/s/√Hz) and accelerometers (m/s²/√Hz), random walk of their biases (rad/s/√s, "
    "m/s²/√s), noise of integration (m/√s)"
)
_SAMPLES = "of each sample its duration (s), angular velocity (rad/s, 3), acceleration less gravity (m/s², 3)"
_DELTA = (
    "T (s), ΔR (qx qy qz qw), Δp (m, 3), Δv (m/s, 3); row by row the derivatives J_R of ΔR's right increment by the "
    "gyroscopes' bias (3 × 3), J_p and J_v of Δp and Δv by the bias (3 × 6 each)"
)
_RESIDUALS = "(log(ΔRᵀ Rₐᵀ R_b), Rₐᵀ (t_b − tₐ − vₐ T − ½ g T²) − Δp, Rₐᵀ (v_b − vₐ − g T) − Δv"
_EXAMPLE_NOISE = (0.01, 0.1, 0.001, 0.01, 0.001)
_EXAMPLE_BIAS = (0.0,) * BIAS
_EXAMPLE_GRAVITY = (0.0, 0.0, -9.8125)
_EXAMPLE_MOUNT = (0.25, 0.0, 0.5, 0.0, 0.0, 0.6, 0.8)
_EXAMPLE_SAMPLE = (0.125, 0.25, -0.125, 0.5, 0.5, 0.25, 9.75)
_EXAMPLE_DELTA = (
    *(0.5, 0.0, 0.0, 0.28, 0.96, 0.125, 0.0, 1.25, 0.5, 0.0, 4.875),
    *(-0.5, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0, 0.0, -0.5),
    *(0.0, 0.25, 0.0, -0.125, 0.0, 0.0, -0.25, 0.0, 0.0, 0.0, -0.125, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.125),
    *(0.0, 1.25, 0.0, -0.5, 0.0, 0.0, -1.25, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.5),
)


@dataclass(frozen=True, slots=True)
class ImuForm:
    """What a kind of inertial factors is.

    samples: how many it has; 0: it is integrated already.  mount, gravity: whether that is a variable.
    Raises ValueError: too many samples, or less than none.
    """

    samples: int
    mount: bool = False
    gravity: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.samples <= MOST_SAMPLES:
            raise ValueError(f"{self.samples} samples; wanted 1 to {MOST_SAMPLES}")

    @property
    def name(self) -> str:
        """Of the kind."""
        further = "_mount" * self.mount + "_gravity" * self.gravity
        return f"{PREFIX}{self.samples or PREINTEGRATED}{further}"

    @property
    def ends(self) -> tuple[str, ...]:
        """The kinds of its variables: pose, velocity and bias of a and of b, then the mount, then gravity."""
        return (*_MOMENT, *_MOMENT, *["se3"] * self.mount, *["vector3"] * self.gravity)

    @property
    def roles(self) -> tuple[str, ...]:
        """Velocities and gravity turn with the map, a mount stays."""
        return (*("", "axes", "") * 2, *["mount"] * self.mount, *["axes"] * self.gravity)

    @property
    def bias_at(self) -> int:
        """Where in the measurement the bias is."""
        return NOISE if self.samples else 0

    @property
    def gravity_at(self) -> int:
        """Where gravity is, if it is no variable."""
        return self.bias_at + BIAS

    @property
    def mount_at(self) -> int:
        """Where the mount is, if it is no variable."""
        return self.gravity_at + (0 if self.gravity else GRAVITY)

    @property
    def start(self) -> int:
        """Where the samples begin, or Δ."""
        return self.mount_at + (0 if self.mount else MOUNT)

    @property
    def size(self) -> int:
        """Numbers of a measurement."""
        return self.start + (SAMPLE * self.samples or DELTA)

    @property
    def measured(self) -> str:
        """For people."""
        gravity = "" if self.gravity else "gravity in the map (m/s², 3); "
        mount = "" if self.mount else "the IMU's pose m on the robot (x y z, qx qy qz qw); "
        if not self.samples:
            return f"bias at which it was integrated (6); {gravity}{mount}{_DELTA}"
        return f"{_DENSITIES}; bias at which noise is propagated (6); {gravity}{mount}{_SAMPLES}"

    @property
    def residual(self) -> str:
        """For people."""
        if not self.samples:
            return f"{_RESIDUALS}, β_b − βₐ), Δ corrected to βₐ, (t, R) of a ∘ m and b ∘ m"
        return f"W {_RESIDUALS}), then (β_b − βₐ) / (σ √T); Δ of the samples at βₐ, (t, R) of a ∘ m and b ∘ m"

    @property
    def example(self) -> tuple[float, ...]:
        """A measurement."""
        gravity, mount = () if self.gravity else _EXAMPLE_GRAVITY, () if self.mount else _EXAMPLE_MOUNT
        if not self.samples:
            return (*_EXAMPLE_BIAS, *gravity, *mount, *_EXAMPLE_DELTA)
        return (*_EXAMPLE_NOISE, *_EXAMPLE_BIAS, *gravity, *mount, *_EXAMPLE_SAMPLE * self.samples)


def form_of_name(name: str) -> ImuForm:
    """What the kind of that name is.  Raises ValueError: there is no such kind, and why."""
    if (found := _FORM.fullmatch(name)) is None:
        wanted = f"a number of samples from 1 on, or {PREINTEGRATED!r}, and behind it _mount, _gravity, both or none"
        raise ValueError(f"wanted {wanted}")
    samples = 0 if found[1] == PREINTEGRATED else int(found[1])
    return ImuForm(samples, bool(found[2]), bool(found[3]))
