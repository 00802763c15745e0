# %% [markdown]
# # What a loop closure does
#
# A robot drives round a block. Odometry drifts; then it recognizes where it began. This uses the solver by itself,
# without a bus, so that every step can be looked at.

# %%
import numpy as np

from factorbus.client import Draft
from factorbus.solver import Options, Solver

solver = Solver(Options(mode="bayes-tree"))
rng = np.random.default_rng(3)


def insert(draft: Draft):
    """Stage a draft and step."""
    solver.stage(draft.batch())
    return solver.step()


def places() -> np.ndarray:
    """x, y and heading of all poses, in the order of their keys."""
    groups = solver.estimate()
    order = np.argsort(np.concatenate([group.keys for group in groups]))
    return np.concatenate([group.values for group in groups])[order]


# %% [markdown]
# Forty poses round a square of ten metres a side. What the wheels measure has an error of 2 cm and half a degree a
# metre.

# %%
insert(Draft().se2("x0", (0, 0, 0), fixed=True))
for i in range(1, 41):
    turn = np.pi / 2 if i % 10 == 0 else 0.0
    measured = np.array([1.0, 0.0, turn]) + rng.normal(size=3) * (0.02, 0.02, 0.009)
    report = insert(Draft().se2(f"x{i}").between_se2(f"x{i - 1}", f"x{i}", measured, sigmas=(0.02, 0.02, 0.009)))
before = places()
print("after the drive it should be at 0, 0 and is at", before[-1, :2].round(2), "χ²", round(report.chi2, 6))

# %% [markdown]
# Nothing contradicts anything yet: χ² is zero, however wrong the map is. Then the last pose sees the first place
# again.

# %%
report = insert(Draft().between_se2("x40", "x0", (0, 0, 0), sigmas=(0.01, 0.01, 0.005)))
after = places()
print("now it is at", after[-1, :2].round(2), "χ²", round(report.chi2, 2))
moved = np.linalg.norm(after[:, :2] - before[:, :2], axis=1)
print("poses moved by", moved[[10, 20, 30, 40]].round(2), "m: the further along, the more")
print(
    f"{report.strategy}, because {report.because}: {report.eliminated} eliminated, {report.relinearized} relinearized"
)

# %% [markdown]
# χ² is now the price of bending the odometry into a closed square. It is of the size of the number of redundant
# measurements (three: x, y and heading), as it should be when the sigmas are right.

# %%
assert 0.01 < report.chi2 < 16.3, "as rare as one in a thousand"
assert np.linalg.norm(after[-1, :2]) < 0.05 < np.linalg.norm(before[-1, :2])
