"""Putting together what goes into a map: variables and factors one by one, sent as columns.

Draft().se2("x1").between_se2("x0", "x1", (1.0, 0.0, 0.1), sigmas=(0.1, 0.1, 0.02))
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

from numpy.typing import ArrayLike

from factorbus.client.arguments import (
    all_finite,
    as_numbers,
    as_row,
    checked_flag,
    checked_keywords,
    checked_row,
    of_type,
)
from factorbus.client.certainty import (
    Certainty,
    FeatureCertainty,
    feature_sigmas,
    loss_of,
    triangle_of,
)
from factorbus.client.draft_columns import DOWN, DraftColumns, Held, known_kind, lens_numbers, seen_direction
from factorbus.client.further import (
    AntennaCertainty,
    CameraCertainty,
    GnssCertainty,
    Measured,
    OdometryCertainty,
    RangeCertainty,
    SensorCertainty,
    odometry,
    positioned,
    sensed,
    with_information,
)
from factorbus.client.geodetic import enu
from factorbus.client.imu import STANDARD_GRAVITY, ImuNoise, imu_factor, known_by_noise, moments
from factorbus.client.key_numbers import Key, key_number, key_numbers, stamp_number
from factorbus.client.linear import linear_factor
from factorbus.client.preintegration import PreintegratedImu, preintegrated_factor
from factorbus.proto.camera import Camera
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS, FactorKind
from factorbus.proto.messages import Batch
from factorbus.proto.problems import BadOption, BadShape
from factorbus.proto.symbols import format_symbol

_DOWN = 0.0, 0.0, -STANDARD_GRAVITY


class Draft:
    """Variables and factors to be inserted together or not at all.  Every method returns the draft, to be chained.

    A key is "x12" or an int64.  A variable without a value gets one from the first factor of the same insert that
    reaches it.  fixed: the variable is held where it is (a map's first pose, say).  stamp: when it was, nanoseconds as
    an int (`time.time_ns()`, or any other clock); the map keeps it, and gives it back with the value.
    Every factor needs a certainty: sigmas=, standard deviations in metres and radians (also of rotations in space), or
    information=, and may have a loss= (`factorbus.client.certainty.Certainty`).
    Raises BadSymbol, BadShape, BadStamp, BadInformation, BadLoss, BadOption, UnknownKind,
    NotFiniteNumbers.
    """

    def __init__(self) -> None:
        self._columns = DraftColumns()

    def se2(self, key: Key, value: ArrayLike | None = None, **held: Unpack[Held]) -> Draft:
        """A pose in the plane: x y (metres), theta (radians)."""
        return self.variable("se2", key, value, **held)

    def se3(self, key: Key, value: ArrayLike | None = None, **held: Unpack[Held]) -> Draft:
        """A pose in space: x y z (metres), unit quaternion qx qy qz qw."""
        return self.variable("se3", key, value, **held)

    def point2(self, key: Key, value: ArrayLike | None = None, **held: Unpack[Held]) -> Draft:
        """A point in the plane: x y (metres)."""
        return self.variable("point2", key, value, **held)

    def point3(self, key: Key, value: ArrayLike | None = None, **held: Unpack[Held]) -> Draft:
        """A point in space: x y z (metres)."""
        return self.variable("point3", key, value, **held)

    def idp(self, key: Key, value: ArrayLike | None = None, **held: Unpack[Held]) -> Draft:
        """A feature of inverse depth: x y z of the camera that saw it first, azimuth, elevation, 1/distance."""
        return self.variable("idp", key, value, **held)

    def so3(self, key: Key, value: ArrayLike | None = None, **held: Unpack[Held]) -> Draft:
        """A rotation in space: unit quaternion qx qy qz qw."""
        return self.variable("so3", key, value, **held)

    def sim3(self, key: Key, value: ArrayLike | None = None, **held: Unpack[Held]) -> Draft:
        """A pose in space with a scale: x y z (metres), qx qy qz qw, metres of its unit; p is at t + s R p."""
        return self.variable("sim3", key, value, **held)

    def vector(
        self, key: Key, value: ArrayLike | None = None, *, size: int | None = None, **held: Unpack[Held]
    ) -> Draft:
        """One to nine numbers of any units, which no frame moves: a bias, a scale, an offset of clocks, a velocity.

        What is known of it is said by `linear`.  It comes with a value, or with `size`, how many numbers, where it gets
        one as a velocity or bias at the end of an inertial factor (`imu`).
        """
        if value is not None:
            size = all_finite("vector", as_numbers("vector", value)).size
        elif size is None:
            raise BadOption("vector", "neither a value nor a size", "one of the two")
        return self.variable(f"vector{size}", key, value, **held)

    def prior_se2(self, key: Key, measured: ArrayLike, **certainty: Unpack[Certainty]) -> Draft:
        """Where a pose in the plane is in the map: x y (metres), theta (radians)."""
        return self.factor("prior_se2", (key,), measured, **certainty)

    def prior_se3(self, key: Key, measured: ArrayLike, **certainty: Unpack[Certainty]) -> Draft:
        """Where a pose in space is in the map: x y z (metres), qx qy qz qw.

        Six sigmas: x y z in metres, the rotation about x y z in radians; information= is of half angles, as in
        g2o: 4/s² for s radians.
        """
        return self.factor("prior_se3", (key,), measured, **certainty)

    def prior_point2(self, key: Key, measured: ArrayLike, **certainty: Unpack[Certainty]) -> Draft:
        """Where a point in the plane is in the map: x y (metres)."""
        return self.factor("prior_point2", (key,), measured, **certainty)

    def prior_point3(self, key: Key, measured: ArrayLike, **certainty: Unpack[Certainty]) -> Draft:
        """Where a point in space is in the map: x y z (metres)."""
        return self.factor("prior_point3", (key,), measured, **certainty)

    def between_se2(self, first: Key, second: Key, measured: ArrayLike, **sure: Unpack[OdometryCertainty]) -> Draft:
        """The second pose in the first one's frame: x y (metres), theta (radians).  Odometry, loop closures.

        mount=: where on the robot the sensor is, x y theta, if it has measured its own way rather than the robot's: one
        off the centre moves sideways when the robot turns.  The certainty is that of the sensor, in its frame, and is
        carried over to first order in the error (`factorbus.client.lever_arm`, MATH §3.7).
        Or the key of an se2 that is estimated: the mount is to be found out (MATH §3.8).
        scale=: the key of a vector1 that x and y are to be multiplied by, as of wheels of unknown radius (MATH §3.9).
        """
        return self._add(odometry("between_se2", (first, second), measured, sure))

    def between_se3(self, first: Key, second: Key, measured: ArrayLike, **sure: Unpack[OdometryCertainty]) -> Draft:
        """The second pose in the first one's frame: x y z (metres), qx qy qz qw.

        Six sigmas: x y z in metres, the rotation about x y z in radians; information= is of half angles, as in
        g2o: 4/s² for s radians.

        mount=: where on the robot the sensor is, x y z qx qy qz qw, if it has measured its own way; or the key of an
        se3.  scale=: as in `between_se2`, of x y z.
        """
        return self._add(odometry("between_se3", (first, second), measured, sure))

    def prior_so3(self, key: Key, measured: ArrayLike, **certainty: Unpack[Certainty]) -> Draft:
        """How a rotation is in the map: qx qy qz qw.  Three sigmas: about x y z, radians."""
        return self.factor("prior_so3", (key,), measured, **certainty)

    def between_so3(self, first: Key, second: Key, measured: ArrayLike, **certainty: Unpack[Certainty]) -> Draft:
        """The second rotation in the first one's frame: qx qy qz qw."""
        return self.factor("between_so3", (first, second), measured, **certainty)

    def prior_sim3(self, key: Key, measured: ArrayLike, **certainty: Unpack[Certainty]) -> Draft:
        """Where a sim3 is in the map.  Seven sigmas: x y z in its unit, about x y z in radians, of ln of the scale."""
        return self.factor("prior_sim3", (key,), measured, **certainty)

    def between_sim3(self, first: Key, second: Key, measured: ArrayLike, **certainty: Unpack[Certainty]) -> Draft:
        """The second sim3 in the first one's frame and unit, x y z qx qy qz qw scale.  Sigmas as of `prior_sim3`."""
        return self.factor("between_sim3", (first, second), measured, **certainty)

    def landmark_sim3(self, pose: Key, point: Key, measured: ArrayLike, **certainty: Unpack[Certainty]) -> Draft:
        """A point3 (metres) in the frame and unit of a sim3: x y z."""
        return self.factor("landmark_sim3", (pose, point), measured, **certainty)

    def position_sim3(self, key: Key, measured: ArrayLike, **certainty: Unpack[Certainty]) -> Draft:
        """Where a sim3 is in the map: x y z (metres)."""
        return self.factor("position_sim3", (key,), measured, **certainty)

    def landmark_se2(self, pose: Key, point: Key, measured: ArrayLike, **certainty: Unpack[SensorCertainty]) -> Draft:
        """A point2 in the pose's frame: x y (metres)."""
        return self._seen("landmark_se2", (pose, point), measured, certainty)

    def landmark_se3(self, pose: Key, point: Key, measured: ArrayLike, **certainty: Unpack[SensorCertainty]) -> Draft:
        """A point3 in the pose's frame: x y z (metres)."""
        return self._seen("landmark_se3", (pose, point), measured, certainty)

    def bearing_range_se2(self, pose: Key, point: Key, measured: ArrayLike, **sure: Unpack[SensorCertainty]) -> Draft:
        """A point2 seen from the pose: bearing (radians, from the x axis to the left), range (metres)."""
        return self._seen("bearing_range_se2", (pose, point), measured, sure)

    def position_se2(self, key: Key, measured: ArrayLike, **certainty: Unpack[AntennaCertainty]) -> Draft:
        """Where an antenna is in the map, or in another frame: x y (metres).

        lever=: where it is on the robot, x y, or the key of a vector2; frame=: the key of the se2 that is the map's
        pose in the frame that this is measured in; offset= and twist=, of its clock (MATH §3.9).
        """
        return self._add(positioned("position_se2", key, measured, certainty))

    def position_se3(self, key: Key, measured: ArrayLike, **certainty: Unpack[AntennaCertainty]) -> Draft:
        """Where an antenna is in the map, or in another frame: x y z (metres).  As `position_se2`."""
        return self._add(positioned("position_se3", key, measured, certainty))

    def gnss(
        self, key: Key, latitude: float, longitude: float, height: float, *, origin: ArrayLike,
        **certainty: Unpack[GnssCertainty],
    ) -> Draft:  # fmt: skip
        """Where an antenna is on the Earth: degrees, and metres above the ellipsoid of WGS 84.

        A `position_se3`, east north up (metres) of `origin`: latitude, longitude, height, near where the robot drives.
        covariance= (3, 3) of these, m², or sigmas= (3,), metres.  lever=, offset=, twist= as in `position_se2`.
        frame=: the key of the map's pose in that frame; without, the map itself has x to the east and y to the north.
        """
        there = enu((latitude, longitude, height), origin, f"gnss {format_symbol(key_number(key))}: ")
        return self._add(positioned("position_se3", key, there, with_information(key, certainty)))

    def velocity_frame_se2(self, frame: Key, velocity: Key, measured: ArrayLike, **sure: Unpack[Certainty]) -> Draft:
        """A vector2, a velocity along the axes of the map, in another frame (`position_se2`): vx vy (m/s)."""
        return self.factor("velocity_frame_se2", (frame, velocity), measured, **sure)

    def velocity_frame_se3(self, frame: Key, velocity: Key, measured: ArrayLike, **sure: Unpack[Certainty]) -> Draft:
        """The same of a vector3: where the frame is that of `gnss`, east north up (m/s), as Doppler shifts tell."""
        return self.factor("velocity_frame_se3", (frame, velocity), measured, **sure)

    def heading_se2(self, key: Key, theta: float, **certainty: Unpack[Certainty]) -> Draft:
        """Where a pose in the plane looks, in the map: theta (radians)."""
        return self.factor("heading_se2", (key,), as_row(theta), **certainty)

    def attitude_se3(
        self, key: Key, seen: ArrayLike, *, direction: ArrayLike = DOWN, **sure: Unpack[Certainty]
    ) -> Draft:
        """A direction of the map (down, unless said otherwise) as the robot sees it: vectors of any length."""
        return self.factor("attitude_se3", (key,), seen_direction(seen, direction), **sure)

    def attitude_so3(
        self, key: Key, seen: ArrayLike, *, direction: ArrayLike = DOWN, **sure: Unpack[Certainty]
    ) -> Draft:
        """The same of a rotation."""
        return self.factor("attitude_so3", (key,), seen_direction(seen, direction), **sure)

    def range_se2(self, pose: Key, point: Key, distance: float, **certainty: Unpack[SensorCertainty]) -> Draft:
        """How far a point2 is from the pose (metres)."""
        return self._seen("range_se2", (pose, point), as_row(distance), certainty)

    def range_se3(self, pose: Key, point: Key, distance: float, **certainty: Unpack[SensorCertainty]) -> Draft:
        """How far a point3 is from the pose (metres)."""
        return self._seen("range_se3", (pose, point), as_row(distance), certainty)

    def range_between_se2(self, first: Key, second: Key, distance: float, **certainty: Unpack[RangeCertainty]) -> Draft:
        """How far two poses in the plane are apart (metres): robots, or a robot and an anchor with an orientation."""
        return self._add(sensed("range_between_se2", (first, second), as_row(distance), certainty, RangeCertainty))

    def range_between_se3(self, first: Key, second: Key, distance: float, **certainty: Unpack[RangeCertainty]) -> Draft:
        """How far two poses in space are apart (metres)."""
        return self._add(sensed("range_between_se3", (first, second), as_row(distance), certainty, RangeCertainty))

    def bearing_se2(self, pose: Key, point: Key, bearing: float, **certainty: Unpack[SensorCertainty]) -> Draft:
        """Where a point2 is to be seen from the pose (radians, from the x axis to the left)."""
        return self._seen("bearing_se2", (pose, point), as_row(bearing), certainty)

    def bearing_se3(self, pose: Key, point: Key, direction: ArrayLike, **certainty: Unpack[SensorCertainty]) -> Draft:
        """Where a point3 is to be seen from the pose: a vector of any length in its frame; sigmas: nearly radians."""
        return self._seen("bearing_se3", (pose, point), checked_row("direction", direction, 3), certainty)

    def imu(
        self, first: Sequence[Key], second: Sequence[Key], samples: ArrayLike, *, noise: ImuNoise,
        gravity: Key | ArrayLike = _DOWN, bias: ArrayLike = (0.0,) * 6, mount: Key | ArrayLike | None = None,
        **certainty: Unpack[Certainty],
    ) -> Draft:  # fmt: skip
        """What an IMU measured between two moments, each a pose (se3), the IMU's velocity in the map (vector3) and a
        bias (vector6): ("x0", "v0", "b0"), ("x1", "v1", "b1").  Those of the second without a value get it from this.

        samples (n, 7), n up to 2000: duration (s), gyroscopes (rad/s), accelerometers (m/s²), as it measured them, from
        pose to pose (`cut_samples`); the service integrates them at every linearization.  At rest they read +9.8 along
        the axis that points up (specific force, not gravity).  ImplausibleSamples warns of g, of degrees
        and of times in place of durations.
        gravity: in the map, m/s², or the key of a vector3 (how long: the kind `length_vector3`).
        bias: where the noise of the samples is propagated, the best guess of it.
        mount: the IMU's pose on the robot, x y z qx qy qz qw, or the key of an se3; without, it is the robot's.
        How certain it is follows from the noise: sigmas= or information= are beside that, of a residual of sigma 1.
        """
        of = moments("imu", first, second, gravity, mount)
        kind, row = imu_factor(of, samples, noise, bias)
        return self.factor(kind, of.keys, row, **known_by_noise(certainty))

    def imu_preintegrated(
        self, first: Sequence[Key], second: Sequence[Key], made: PreintegratedImu, *,
        gravity: Key | ArrayLike = _DOWN, mount: Key | ArrayLike | None = None, **certainty: Unpack[Certainty],
    ) -> Draft:  # fmt: skip
        """The same of samples that are integrated already (`preintegrate_samples`): fewer bytes, and to first order in
        the bias.  Without sigmas= or information= (of radians, metres, m/s, and the change of the bias) it is as
        certain as its covariance says."""
        of = moments("imu_preintegrated", first, second, gravity, mount)
        known = of_type(f"{of.where}: made", made, PreintegratedImu, "a PreintegratedImu")
        kind, row = preintegrated_factor(of, known)
        return self.factor(kind, of.keys, row, **known_by_noise(certainty, known.information))

    def linear(
        self, keys: Sequence[Key], values: Sequence[ArrayLike], jacobians: Sequence[ArrayLike],
        residual: ArrayLike, *, kinds: Sequence[str] | None = None, **certainty: Unpack[Certainty],
    ) -> Draft:  # fmt: skip
        """What you have linearized yourself, of up to 128 variables: r = sum H (x - y) + b.

        x - y is the local increment of a pose, the difference of anything else; values: y of each, as it is stored;
        jacobians: H of each, (m, 3) of an se2 or point3, (m, 6) of an se3 or idp, (m, 2) of a point2, (m, n) of a
        vector of n; residual: b, (m,), of any m, and the certainty is of these m.
        kinds: of each, such as ["se3", "vector3"].  Without, that of the variables in this draft; of one of an earlier
        insert it is wanted where several kinds have that number of numbers: two, three or six.
        More rows than the variables have scalars are sent as the triangle that says the same.
        """
        numbers = key_numbers(keys).tolist()
        if kinds is None:
            known = self._columns.kinds()
            kinds = [known.get(number, "") for number in numbers]
        self._columns.add_linear(linear_factor(numbers, values, jacobians, residual, kinds, certainty))
        return self

    def idp_first(
        self, pose: Key, feature: Key, camera: Camera, pixel: ArrayLike, rho: float,
        **certainty: Unpack[FeatureCertainty],
    ) -> Draft:  # fmt: skip
        """A feature where the pose's camera (x right, y down, z forward) saw it first, about 1/rho metres away.

        sigma_rho=, of that guess, 1/metre; sigma_pixel=, sigma_anchor= and loss= where the usual ones do not do
        (`factorbus.client.certainty.FeatureCertainty`).
        """
        measured = [*checked_row("pixel", pixel, 2), rho, *lens_numbers(camera)]
        sigmas = feature_sigmas(" ".join(["idp_first", *map(str, (pose, feature))]), certainty)
        return self.factor("idp_first", (pose, feature), measured, sigmas=sigmas, loss=certainty.get("loss"))

    def idp_seen(
        self, pose: Key, feature: Key, camera: Camera, pixel: ArrayLike, **certainty: Unpack[Certainty]
    ) -> Draft:
        """An idp seen again by the pose's camera: u v (pixels)."""
        return self.factor(
            "idp_seen", (pose, feature), [*checked_row("pixel", pixel, 2), *lens_numbers(camera)], **certainty
        )

    def point_seen(
        self, pose: Key, point: Key, camera: Camera, pixel: ArrayLike, **certainty: Unpack[CameraCertainty],
    ) -> Draft:  # fmt: skip
        """A point3 seen by the pose's camera: u v (pixels).

        mount=: the key of the camera's pose on the robot; focal=, bundler= or intrinsics=: that of numbers of its lens,
        in place of the camera's (`factorbus.client.further.CameraCertainty`).
        """
        measured = [*checked_row("pixel", pixel, 2), *lens_numbers(camera)]
        return self._add(sensed("point_seen", (pose, point), measured, certainty, CameraCertainty))

    def variable(
        self, kind: str, key: Key, value: ArrayLike | None = None, **held: Unpack[Held],
    ) -> Draft:  # fmt: skip
        """A variable of any kind of `factorbus.proto.kinds`."""
        size = known_kind(VARIABLE_KINDS, kind).size
        number = key_number(key)
        where = f"{kind} {format_symbol(number)}"
        row = None if value is None else checked_row(where, value, size)
        checked_keywords(where, held, tuple(Held.__annotations__))
        fixed = checked_flag(f"{where}: fixed", held.get("fixed", False))
        self._columns.add_variable(kind, number, row, fixed, stamp_number(where, held.get("stamp")))
        return self

    def factor(
        self, kind: str | FactorKind, keys: Sequence[Key], measured: ArrayLike, **certainty: Unpack[Certainty],
    ) -> Draft:  # fmt: skip
        """A factor of any kind of `factorbus.proto.kinds`, or of one of your own (`factorbus.client.expressions`)."""
        of = kind if isinstance(kind, FactorKind) else known_kind(FACTOR_KINDS, kind)
        kind, numbers = of.name, key_numbers(keys).tolist()
        where = " ".join([of.called, *map(format_symbol, numbers)])
        if len(numbers) != len(of.connects):
            raise BadShape(f"{where}: keys", len(numbers), f"{len(of.connects)} ({', '.join(of.connects)})")
        row = checked_row(f"{where}: measured", measured, of.size)
        loss = loss_of(where, certainty.get("loss"))
        trusted = checked_flag(f"{where}: trusted", certainty.get("trusted", False))
        self._columns.add_factor(kind, numbers, row, triangle_of(where, of.dim, certainty, kind), loss, trusted)
        return self

    def _seen(self, kind: str, keys: tuple[Key, Key], measured: ArrayLike, certainty: SensorCertainty) -> Draft:
        """What a sensor measures that may have a mount, a bias, a clock."""
        return self._add(sensed(kind, keys, measured, certainty))

    def _add(self, made: Measured) -> Draft:
        return self.factor(made.kind, made.keys, made.measured, **made.certainty)

    def batch(self) -> Batch:
        """What has been drafted so far, as columns: factors by kind and loss."""
        return self._columns.batch()

    def order(self) -> Sequence[int]:
        """The place in `batch` of each factor, in the order of the calls; `Accepted.factors` has ids in that order."""
        return self._columns.order()


def batch_of(what: str, given: Batch | Draft) -> Batch:
    """What is to go into a map, as columns.  Raises BadOption."""
    return given.batch() if isinstance(given, Draft) else of_type(what, given, Batch, "a Draft or a Batch")
