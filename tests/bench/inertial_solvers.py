"""A drive with an IMU, step by step, by our solver and by iSAM2, with the same factors."""

import time
from importlib.metadata import version
from typing import Any

import gtsam
import numpy as np
from bench.drives_with_imu import Drive
from gtsam.symbol_shorthand import B, V, X

from factorbus.client import Draft
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.proto.version import __version__
from factorbus.solver import Options, Solver


class Ours:
    """The default mode of our solver."""

    versions = f"factorbus {__version__}"
    preintegrate_s = 0.0

    def __init__(self, drive: Drive) -> None:
        self._drive, self._solver = drive, Solver(Options())

    def step(self, n: int) -> float:
        """Add what step n brings and estimate; CPU seconds."""
        batch = self._drafted(n).batch()
        before = time.process_time()
        self._solver.stage(batch)
        self._solver.step()
        return time.process_time() - before

    def _drafted(self, n: int) -> Draft:
        drive, draft = self._drive, Draft()
        if n == 0:
            pose = np.concatenate([drive.positions[0], drive.attitude])
            draft.se3("x0", pose).vector("v0", drive.velocity).vector("b0", np.zeros(6))
            draft.prior_se3("x0", pose, sigmas=drive.sigmas_pose)
            draft.linear(["v0"], [drive.velocity], [np.eye(3)], np.zeros(3), sigmas=drive.sigmas_velocity)
            draft.linear(["b0"], [np.zeros(6)], [np.eye(6)], np.zeros(6), sigmas=drive.sigmas_bias)
        else:
            draft.se3(f"x{n}").vector(f"v{n}", size=3).vector(f"b{n}", size=6)
            moments = [(f"x{k}", f"v{k}", f"b{k}") for k in (n - 1, n)]
            draft.imu(*moments, drive.samples[n - 1], noise=drive.noise, gravity=drive.gravity)
        if drive.used[n]:
            draft.position_se3(f"x{n}", drive.positions[n], sigmas=[drive.sigma_position] * 3)
        return draft

    def position(self, n: int) -> np.ndarray:
        """Of pose n at the estimate."""
        graph = self._solver.content()
        (group,) = graph.variables(np.array([graph.find(symbol("x", n))]))
        return group.values[0, :3].copy()

    def chi2_and_optimum(self) -> tuple[float, float]:
        """χ² at the estimate, and at the batch optimum from there."""
        batch, (variables, factors) = Solver(Options(mode="all-batch")), self._solver.graph()
        batch.stage(
            Batch(
                tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in variables),
                tuple(Factors(g.kind, g.keys, g.measured, g.information) for g in factors),
            )
        )
        batch.step(settle=True)
        return self._solver.chi2(), batch.chi2()


class Isam2:
    """GTSAM's, with its usual parameters: what moved by 0.1 is relinearized, at every tenth step."""

    versions = f"gtsam {version('gtsam')}"

    def __init__(self, drive: Drive) -> None:
        self._drive, self.preintegrate_s = drive, 0.0
        self._isam, self._all = gtsam.ISAM2(self.parameters()), gtsam.NonlinearFactorGraph()
        noise = gtsam.PreintegrationParams(drive.gravity)
        noise.setGyroscopeCovariance(np.eye(3) * drive.noise.gyroscope**2)
        noise.setAccelerometerCovariance(np.eye(3) * drive.noise.accelerometer**2)
        noise.setIntegrationCovariance(np.eye(3) * drive.noise.integration**2)
        self._noise, self._values = noise, gtsam.Values()

    def parameters(self) -> gtsam.ISAM2Params:
        """Of iSAM2."""
        return gtsam.ISAM2Params()

    def step(self, n: int) -> float:
        """Add what step n brings and estimate; CPU seconds of update() and of reading the newest pose."""
        graph, values = self._brought(n)
        before = time.process_time()
        self._isam.update(graph, values)
        newest = [self._isam.calculateEstimatePose3(X(n)), self._isam.calculateEstimateVector(V(n))]
        took = time.process_time() - before
        self._newest = (*newest, self._isam.calculateEstimateConstantBias(B(n)))
        self._all.push_back(graph)
        return took

    def _brought(self, n: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        drive, graph, values = self._drive, gtsam.NonlinearFactorGraph(), gtsam.Values()
        sigmas = gtsam.noiseModel.Diagonal.Sigmas
        if n == 0:
            x, y, z, w = drive.attitude
            pose = gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), drive.positions[0])
            velocity, bias = drive.velocity, gtsam.imuBias.ConstantBias()
            turned = np.concatenate([drive.sigmas_pose[3:], drive.sigmas_pose[:3]])  # rotations first
            graph.add(gtsam.PriorFactorPose3(X(0), pose, sigmas(turned)))
            graph.add(gtsam.PriorFactorVector(V(0), velocity, sigmas(drive.sigmas_velocity)))
            bias_sigmas = np.concatenate([drive.sigmas_bias[3:], drive.sigmas_bias[:3]])  # accelerometers first
            graph.add(gtsam.PriorFactorConstantBias(B(0), bias, sigmas(bias_sigmas)))
        else:
            pose, velocity, bias = self._newest
            before = time.process_time()
            made = gtsam.PreintegratedImuMeasurements(self._noise, bias)
            for row in drive.samples[n - 1]:
                made.integrateMeasurement(row[4:], row[1:4], row[0])
            self.preintegrate_s += time.process_time() - before
            graph.add(gtsam.ImuFactor(X(n - 1), V(n - 1), X(n), V(n), B(n - 1), made))
            T = made.deltaTij()
            walk = np.repeat([drive.noise.accelerometer_walk, drive.noise.gyroscope_walk], 3) * np.sqrt(T)
            graph.add(gtsam.BetweenFactorConstantBias(B(n - 1), B(n), gtsam.imuBias.ConstantBias(), sigmas(walk)))
            state = made.predict(gtsam.NavState(pose, velocity), bias)
            pose, velocity = state.pose(), state.velocity()
        if drive.used[n]:
            at = sigmas(np.full(3, drive.sigma_position))
            graph.add(gtsam.GPSFactor(X(n), drive.positions[n], at))
        values.insert(X(n), pose)
        values.insert(V(n), velocity)
        values.insert(B(n), bias)
        return graph, values

    def position(self, n: int) -> np.ndarray:
        """Of pose n at the estimate."""
        return self._isam.calculateEstimatePose3(X(n)).translation()

    def chi2_and_optimum(self) -> tuple[float, float]:
        """χ² at the estimate, and at its Levenberg-Marquardt's optimum from there."""
        estimate = self._isam.calculateEstimate()
        best = gtsam.LevenbergMarquardtOptimizer(self._all, estimate).optimize()
        return 2.0 * self._all.error(estimate), 2.0 * self._all.error(best)


class FineIsam2(Isam2):
    """The same where what moved by 0.001 is relinearized at every step, and no change is too small to go on."""

    def parameters(self) -> gtsam.ISAM2Params:
        """Of iSAM2."""
        parameters = gtsam.ISAM2Params()
        parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(1e-5))
        parameters.setRelinearizeThreshold(0.001)
        parameters.relinearizeSkip = 1
        return parameters


SOLVERS: dict[str, Any] = {"factorbus": Ours, "isam2": Isam2, "isam2-fine": FineIsam2}
