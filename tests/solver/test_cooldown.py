"""When what waits is due, MATH (9.19)."""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.thresholds import cooldown_share


def test_soon_after_a_relinearization_more_error_is_required() -> None:
    settings, state = np.zeros(tl.P_SIZE), np.zeros(tl.S_SIZE, np.int64)
    settings[tl.P_COOLDOWN_STEPS], settings[tl.P_COOLDOWN_FACTOR], state[tl.S_RELINEARIZED_AT] = 100, 8.0, 1000
    after = {}
    for cost_ratio in (1.0, 4.0):
        for step in (1001, 1035, 1050, 1100, 5000):
            state[tl.S_STEP] = step
            after[cost_ratio, step - 1000] = cooldown_share(cost_ratio, settings, state)
    assert [after[1.0, since] for since in (1, 35, 50, 100, 4000)] == [8.0, 8.0, 4.0, 1.0, 1.0]
    assert [after[4.0, since] for since in (1, 35, 50, 100, 4000)] == [16.0, 16.0, 16.0, 16.0, 1.0]
