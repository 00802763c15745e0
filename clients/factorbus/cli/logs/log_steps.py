"""The inserts of a log: a pose, a velocity and a bias at each moment, joined by the IMU's samples between.

Keys: x0, v0, b0 and so on; f0 is the pose of the map in the frame of GNSS, a0 where the antenna is on the body, m0
where the odometry's sensor is.  Moments are those of the odometry, of poses or of fixes, `every_s` apart, and others
where there were too many samples between.  A front end does not know the future, and neither does this one but for
f0: fixes wait until the robot has moved `_FAR` times as far as they are uncertain, and enter with f0.
"""

import warnings
from collections.abc import Sequence
from typing import overload

import numpy as np

from factorbus.cli.logs.sensor_log import SensorLog, Way
from factorbus.cli.logs.start import Start, course, started
from factorbus.client.draft import Draft
from factorbus.client.frames import compose, inverse
from factorbus.client.imu import cut_samples
from factorbus.client.imu_samples import GAP, ImplausibleSamples, implausible_units
from factorbus.formats import FormatError
from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.symbols import symbol
from factorbus.wording import counted

_MOST, _FAR, _TOLERANCE_NS = 1000, 20.0, 5_000_000
_FEWEST = 4  # samples of a factor: of one, the errors of way and velocity are the same number, and no covariance
_FRAME = (100.0, 100.0, 100.0, 0.02, 0.02, 3.0)


class LogSteps(Sequence[Batch]):
    """The batches of a log, in order of time.  Raises FormatError."""

    def __init__(self, log: SensorLog) -> None:
        self._log, self.times = log, pose_times(log)
        self._at = {name: _nearest(self.times, each.times) for name, each in _aids(log).items()}
        self.start = started(log, self.times)
        self._framed = log.fixes is not None and log.way is not None and log.way.relative
        self._frame, self._frame_step = self._aligned() if self._framed else (None, 0)
        self._last_way: tuple[int, int] | None = None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ImplausibleSamples)  # once for the whole log, in its notes
            self._batches = [self._step(n) for n in range(len(self.times))]

    @property
    def poses(self) -> int:
        """Number of moments."""
        return len(self._batches)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed of the start, for people."""
        rates = self._log.imu.rates
        units = implausible_units(np.column_stack([np.ones(len(rates)), rates]), self._log.gravity)
        said = (self.start.why, *_gaps(self._log.imu.times), *(f"IMU: {each}" for each in units))
        if not self._framed:
            return said
        frame = "GNSS's frame f0 is found out" if self._frame is not None else "fixes are left out: it moved too little"
        return *said, frame

    def __len__(self) -> int:
        return len(self._batches)

    @overload
    def __getitem__(self, index: int) -> Batch: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Batch]: ...
    def __getitem__(self, index: int | slice) -> Batch | Sequence[Batch]:
        return self._batches[index]

    def truth(self) -> tuple[Variables, ...]:
        """Where the body was at the moments that the log knows of."""
        if self._log.truth is None:
            return ()
        times, poses = self._log.truth
        rows = _nearest(times, self.times)
        near = np.abs(times[rows] - self.times) <= _TOLERANCE_NS
        keys = symbol("x", 0) + np.flatnonzero(near)
        return (Variables("se3", keys, poses[rows[near]]),) if near.any() else ()

    def _step(self, n: int) -> Batch:
        log, draft = self._log, Draft()
        stamp = int(self.times[n])
        if n == 0:
            self._begin(draft, self.start, stamp)
        else:
            draft.se3(f"x{n}", stamp=stamp).vector(f"v{n}", size=3).vector(f"b{n}", size=6)
            before, here = ((f"x{k}", f"v{k}", f"b{k}") for k in (n - 1, n))
            samples = samples_between(log, *self.times[n - 1 : n + 1].tolist())
            draft.imu(before, here, samples, noise=log.imu.noise, gravity=log.gravity, bias=self.start.bias)
        if log.way is not None:
            self._moved(draft, n, log.way)
        self._fixed(draft, n)
        return draft.batch()

    def _begin(self, draft: Draft, start: Start, stamp: int) -> None:
        draft.se3("x0", start.pose, stamp=stamp).vector("v0", start.velocity).vector("b0", start.bias)
        draft.prior_se3("x0", start.pose, sigmas=start.sigmas_pose)
        draft.linear(["v0"], [start.velocity], [np.eye(3)], np.zeros(3), sigmas=[start.sigma_velocity] * 3)
        draft.linear(["b0"], [start.bias], [np.eye(6)], np.zeros(6), sigmas=start.sigmas_bias)
        if self._log.way is not None and self._log.way.sigma_mount is not None:
            mount = self._log.way.mount
            draft.se3("m0", mount).prior_se3("m0", mount, sigmas=self._log.way.sigma_mount)

    def _moved(self, draft: Draft, n: int, way: Way) -> None:
        """What odometry, or a room's cameras, say of the moment."""
        rows = np.flatnonzero(self._at["way"] == n)
        rows = rows[np.abs(way.times[rows] - self.times[n]) <= _TOLERANCE_NS]
        if not rows.size:
            return
        row = int(rows[np.argmin(np.abs(way.times[rows] - self.times[n]))])
        if not way.relative:
            body = compose(way.poses[row], inverse(way.mount)[None])[0]
            draft.prior_se3(f"x{n}", body, sigmas=way.sigmas)
            return
        last = self._last_way
        self._last_way = (n, row)
        if last is None:
            return
        measured = compose(inverse(way.poses[last[1]]), way.poses[row][None])[0]
        mount = "m0" if way.sigma_mount is not None else way.mount
        sigmas = way.sigmas * np.sqrt(row - last[1])
        draft.between_se3(f"x{last[0]}", f"x{n}", measured, mount=mount, sigmas=sigmas)

    def _fixed(self, draft: Draft, n: int) -> None:
        """Fixes of the moment; where the frame is to be found out, they wait for it."""
        fixes = self._log.fixes
        if fixes is None or (self._framed and (self._frame is None or n < self._frame_step)):
            return
        first = n
        known: dict[str, str] = {}
        if self._framed:
            known["frame"] = "f0"
            if n == self._frame_step and self._frame is not None:
                first = 0
                draft.se3("f0", self._frame).prior_se3("f0", self._frame, sigmas=_FRAME)
        lever: object = fixes.lever
        if fixes.sigma_lever is not None:
            lever = "a0"
            if first == 0:
                draft.vector("a0", fixes.lever)
                draft.linear(["a0"], [fixes.lever], [np.eye(3)], np.zeros(3), sigmas=fixes.sigma_lever)
        for moment, row in self._fixes_of(range(first, n + 1)):
            draft.position_se3(f"x{moment}", fixes.places[row], lever=lever, sigmas=fixes.sigmas[row], **known)  # pyright: ignore[reportArgumentType]

    def _fixes_of(self, wanted: range) -> list[tuple[int, int]]:
        """(moment, row) of the fix that is nearest to each moment, if one is near."""
        fixes, found = self._log.fixes, list[tuple[int, int]]()
        if fixes is None:
            return found
        for n in wanted:
            rows = np.flatnonzero(self._at["fixes"] == n)
            rows = rows[np.abs(fixes.times[rows] - self.times[n]) <= _TOLERANCE_NS]
            if rows.size:
                found.append((n, int(rows[np.argmin(np.abs(fixes.times[rows] - self.times[n]))])))
        return found

    def _aligned(self) -> tuple[F64 | None, int]:
        """(the pose of the map in GNSS's frame by the odometry so far, the step at which it has moved far enough)."""
        way, fixes = self._log.way, self._log.fixes
        if way is None or fixes is None:
            return None, 0
        there, here = list[F64](), list[F64]()
        body = _dead_reckoned(way, self.start.pose)
        for n, row in self._fixes_of(range(len(self.times))):
            k = int(_nearest(way.times, self.times[n : n + 1])[0])
            here.append(compose(body[k], np.append(fixes.lever, [0, 0, 0, 1.0])[None])[0, :3])
            there.append(fixes.places[row])
            moved = np.linalg.norm(np.array(there)[:, :2] - there[0][:2], axis=1).max()
            if len(there) >= 4 and moved > _FAR * float(fixes.sigmas[row, :2].max()):
                yaw, t = course(np.array(here), np.array(there))
                return np.array([*t, 0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]), n
        return None, 0


def samples_between(log: SensorLog, begin: int, end: int) -> F64:
    """The IMU's samples from one moment to another."""
    times = log.imu.times
    rows = slice(max(int(np.searchsorted(times, begin, "right")) - 1, 0), int(np.searchsorted(times, end)))
    seconds = (times[rows] - begin) * 1e-9
    rates, lasts = log.imu.rates[rows], (end - begin) * 1e-9
    samples = cut_samples(seconds, rates[:, :3], rates[:, 3:], 0.0, lasts, longest_s=np.inf)  # gaps are said
    if len(samples) >= _FEWEST:
        return samples
    parts = np.repeat(samples, _FEWEST, axis=0)
    parts[:, 0] /= _FEWEST
    return parts


def _gaps(times: I64) -> tuple[str, ...]:
    """Where samples were lost, which the last one before is taken to hold for."""
    steps = np.diff(times)
    lost = steps[steps > GAP * np.median(steps)] if steps.size else steps
    if not lost.size:
        return ()
    gaps = counted(lost.size, "gap")
    return (f"{gaps} in the IMU's samples, of up to {1e-9 * lost.max():.3g} s: the sample before is taken to hold",)


def pose_times(log: SensorLog) -> I64:
    """The times of the poses (n,), n above 1.  Raises FormatError."""
    chosen, step = np.empty(0, np.int64), int(log.every_s * 1e9)
    for each in _aids(log).values():
        thin, last = list[int](), -(2**62)
        for time in each.times.tolist():
            if time - last >= 0.98 * step:
                thin.append(time)
                last = time
        times = np.array(thin, np.int64)
        new = times if not chosen.size else times[np.abs(chosen[_nearest(chosen, times)] - times) > _TOLERANCE_NS]
        chosen = np.sort(np.concatenate([chosen, new]))
    usual = int(np.median(np.diff(log.imu.times))) if len(log.imu.times) > 1 else 0
    chosen = chosen[(chosen >= log.imu.times[0]) & (chosen <= log.imu.times[-1] + 2 * usual)]
    if len(chosen) < 2:
        found = f"{len(chosen)} measured places while the IMU measures, {log.imu.times[0]} to {log.imu.times[-1]} ns"
        raise FormatError(log.path, None, found, "two or more: times of all sensors are of one clock")
    counts = np.searchsorted(log.imu.times, chosen)
    between = [
        np.linspace(a, b, -(-(j - i) // _MOST) + 1).astype(np.int64)[1:-1]
        for a, b, i, j in zip(chosen[:-1], chosen[1:], counts[:-1], counts[1:], strict=True)
        if j - i > _MOST
    ]
    return np.sort(np.concatenate([chosen, *between]))


def _aids(log: SensorLog) -> dict[str, Way]:
    return {name: each for name, each in (("way", log.way), ("fixes", log.fixes)) if each is not None}  # pyright: ignore


def _dead_reckoned(way: Way, first: F64) -> F64:
    """Poses (k, 7) of the body in the map by odometry alone, its mount as it is believed."""
    sensor = compose(compose(first, way.mount[None])[0], compose(inverse(way.poses[0]), way.poses))
    back = inverse(way.mount)
    return np.array([compose(each, back[None])[0] for each in sensor])


def _nearest(sorted_times: I64, times: I64) -> I64:
    """For each of `times`, the index of the nearest in `sorted_times`."""
    after = np.clip(np.searchsorted(sorted_times, times), 1, max(len(sorted_times) - 1, 1))
    if len(sorted_times) == 1:
        return np.zeros(len(times), np.int64)
    return after - (times - sorted_times[after - 1] < sorted_times[after] - times)
