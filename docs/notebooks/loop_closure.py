# %% [markdown]
# # What a loop closure does
#
# A robot drives round a block. Odometry drifts; then it recognizes where it began. This uses the solver by itself,
# without a bus, so that every step can be looked at (`pip install '.[service,viz]'`). Below a cell is what it printed.

# %%
import numpy as np
from matplotlib import pyplot

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
# ```text
# after the drive it should be at 0, 0 and is at [-0.16 -0.43] χ² 0.0
# ```
#
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
# ```text
# now it is at [ 0. -0.] χ² 5.13
# poses moved by [0.11 0.16 0.4  0.46] m: the further along, the more
# tree, because 67 relinearizations in 3 rounds: 84 eliminated, 67 relinearized
# ```
#
# χ² is now the price of bending the odometry into a closed square. It is of the size of the number of redundant
# measurements (three: x, y and heading), as it should be when the sigmas are right.

# %%
assert 0.01 < report.chi2 < 16.3, "as rare as one in a thousand"
assert np.linalg.norm(after[-1, :2]) < 0.05 < np.linalg.norm(before[-1, :2])

# %% [markdown]
# Before and after. In Jupyter the figure is shown, as a script it is saved.

# %%
figure, axes = pyplot.subplots(figsize=(6, 5), layout="constrained")
axes.plot([0, 10, 10, 0, 0], [0, 0, 10, 10, 0], color="0.8", linewidth=6, label="the block")
axes.plot(before[:, 0], before[:, 1], ".-", color="tab:orange", label="by odometry")
axes.plot(after[:, 0], after[:, 1], ".-", color="tab:blue", label="with the loop closure")
axes.set(aspect="equal", xlabel="x, m", ylabel="y, m")
axes.legend(loc="center")
figure.savefig("loop-closure.png", dpi=100)

# %% [markdown]
# ![a square by odometry, which ends beside its beginning, and with the loop closure](../figures/loop-closure.png)
