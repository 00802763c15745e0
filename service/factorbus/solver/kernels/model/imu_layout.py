"""Where in the measurement of an inertial factor what is, and which of its variables is what."""

from typing import NamedTuple

from factorbus.proto import inertial as of
from factorbus.solver.kernels.jit.compile import inline_kernel


class ImuLayout(NamedTuple):
    """samples: how many; 0: it is integrated already.  mount, gravity: which variable that is; −1: it is measured.
    bias_at, gravity_at, mount_at: where in the measurement they are, if they are; start: samples, or Δ."""

    samples: int
    mount: int
    gravity: int
    bias_at: int
    gravity_at: int
    mount_at: int
    start: int


@inline_kernel
def imu_layout(samples: int, mounted: bool, ends: int) -> ImuLayout:
    """Of a factor with that many samples and variables; mounted: the mount is one of them."""
    mount = of.MOMENTS if mounted else -1
    gravity = ends - 1 if ends > of.MOMENTS + (1 if mounted else 0) else -1
    bias_at = of.NOISE if samples > 0 else 0
    gravity_at = bias_at + of.BIAS
    mount_at = gravity_at + (of.GRAVITY if gravity < 0 else 0)
    return ImuLayout(samples, mount, gravity, bias_at, gravity_at, mount_at, mount_at + (of.MOUNT if mount < 0 else 0))


@inline_kernel
def numbers_of_imu(form: ImuLayout) -> int:
    """Numbers of a measurement, and of what is kept behind it."""
    if form.samples == 0:
        return form.start + of.DELTA
    return form.start + of.SAMPLE * form.samples + of.KEPT
