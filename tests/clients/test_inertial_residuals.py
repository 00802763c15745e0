"""What is drawn of inertial factors by their χ²: NumPy's residual against the dense twin."""

import numpy as np
import pytest
from naive.dense_factors import residual
from naive.random_imu import keys_of, random_ends, random_imu

from factorbus.proto.kinds import imu_kind
from factorbus.proto.messages import Factors, Variables
from factorbus.viz.residuals import Values, chi2_of_factors


@pytest.mark.parametrize("off", [0.01, 0.3, 3.0])
def test_the_residual_is_the_twins(off: float) -> None:
    rng, kind = np.random.default_rng(3), imu_kind(5).name
    many = [random_imu(5, rng) for _ in range(20)]
    ends = [random_ends(z, rng, off) for z in many]
    keys = np.array([keys_of(2 * n) + keys_of(2 * n + 1) for n in range(len(many))])
    unit = np.tile(np.eye(15)[np.triu_indices(15)], (len(many), 1))
    variables = [
        Variables(of, keys[:, n], np.array([each[n] for each in ends]))
        for n, of in enumerate(("se3", "vector3", "vector6") * 2)
    ]
    found = chi2_of_factors(Factors(kind, keys, np.array(many), unit), Values(variables))
    wanted = [float(r @ r) for r in (residual(kind, each, z) for each, z in zip(ends, many, strict=True))]
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
