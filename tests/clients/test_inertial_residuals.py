"""What is drawn of inertial factors by their χ²: NumPy's residual against the dense twin."""

import numpy as np
import pytest
from naive.dense_factors import residual
from naive.random_imu import keys_of, random_ends, random_imu

from factorbus.proto.inertial import ImuForm
from factorbus.proto.kinds import inertial_kind
from factorbus.proto.messages import Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.viz.residuals import Values, chi2_of_factors

FORMS = [ImuForm(n, mount, gravity) for n in (0, 5) for mount in (False, True) for gravity in (False, True)]


@pytest.mark.parametrize("form", FORMS, ids=[form.name for form in FORMS])
@pytest.mark.parametrize("off", [0.01, 0.3, 3.0])
def test_the_residual_is_the_twins(off: float, form: ImuForm) -> None:
    rng, kind = np.random.default_rng(3), inertial_kind(form)
    many = [random_imu(form, rng) for _ in range(10)]
    ends = [random_ends(form, z, rng, off) for z in many]
    further = [[symbol("m", n), symbol("g", n)] for n in range(len(many))]
    keys = np.array([keys_of(2 * n) + keys_of(2 * n + 1) + further[n] for n in range(len(many))])
    keys = np.ascontiguousarray(np.delete(keys, [*[6] * (not form.mount), *[7] * (not form.gravity)], axis=1))
    unit = np.tile(np.eye(15)[np.triu_indices(15)], (len(many), 1))
    variables = [Variables(of, keys[:, n], np.array([each[n] for each in ends])) for n, of in enumerate(kind.connects)]
    found = chi2_of_factors(Factors(kind.name, keys, np.array(many), unit), Values(variables))
    wanted = [float(r @ r) for r in (residual(kind.name, each, z) for each, z in zip(ends, many, strict=True))]
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
