# %% [markdown]
# # Right or wrong: gates, losses and whys
#
# Places look alike, so a front end makes wrong loop closures. What the map can say about them, before and after they
# are in. It wants a service: `factorbus serve`. Below a cell is what it printed.

# %%
import os

from matplotlib import pyplot

from factorbus.client import Draft, connect
from factorbus.proto.symbols import symbol
from factorbus.simulate import manhattan

ENDPOINT = os.environ.get("FACTORBUS_ENDPOINT", "tcp/127.0.0.1:7447")
bus = connect(ENDPOINT, client="notebook")
town = bus.map(f"notebook-{os.getpid()}")
for step in manhattan(poses=200, seed=4):
    town.send(step.batch)
town.flush()
print(len(town.estimate), "poses, χ²", round(town.chi2().chi2, 1))

# %% [markdown]
# ```text
# 200 poses, χ² 54.3
# ```
#
# A closure that puts pose 150 on pose 20, where it is not. The gate knows before it goes in: d² is the squared
# distance between what is claimed and what the map expects, in standard deviations of both; for three numbers, 95 %
# of right ones are below 7.8.

# %%
wrong = Draft().between_se2("x20", "x150", (0, 0, 0), sigmas=(0.1, 0.1, 0.05))
gate = town.uncertainty.gate(wrong)
print("d²", gate.distance.round(0), "allowed", gate.threshold.round(1), "plausible", gate.plausible)

# %% [markdown]
# ```text
# d² [4088.] allowed [7.8] plausible [False]
# ```
#
# Say it goes in nevertheless, but with a loss: dynamic covariance scaling lets a factor that all others contradict
# lose its weight. The pose hardly moves.

# %%
before = town.estimate["x150"].copy()
robust = Draft().between_se2("x20", "x150", (0, 0, 0), sigmas=(0.1, 0.1, 0.05), loss=("dcs", 1.0))
done = town.insert(robust, settle=True)
moved_robust = abs(town.estimate["x150"] - before)[:2].max()
print(f"moved by {moved_robust:.3f} m")

# %% [markdown]
# ```text
# moved by 0.000 m
# ```
#
# And the map can be asked why a pose is where it is: each factor with its misfit, and its leverage, the share of what
# it measures that is known from it alone.

# %%
why = town.uncertainty.why("x150").variable
for factor in sorted(why["factors"], key=lambda each: -each["chi2"]):
    print(f"{factor['kind']}  χ² {factor['chi2']:.3g}  leverage {factor['leverage'] / factor['dims']:.0%}")

# %% [markdown]
# ```text
# between_se2  χ² 1.3e+05  leverage 0%
# between_se2  χ² 0.00227  leverage 99%
# between_se2  χ² 0.000995  leverage 99%
# ```
#
# The false one has no leverage left: what it says of x150 comes to nothing. In the picture it is the red line.

# %%
keys, poses = town.estimate.columns("se2")
at = dict(zip(keys.tolist(), poses, strict=True))
figure, axes = pyplot.subplots(figsize=(6, 5), layout="constrained")
axes.plot(poses[:, 0], poses[:, 1], ".-", color="tab:blue", linewidth=1, label="the map")
for group in town.graph().batch.factors:
    for first, second in group.keys.tolist() if group.kind == "between_se2" else ():
        if abs(first - second) > 1:
            wrong = {first, second} == {symbol("x", 20), symbol("x", 150)}
            ends = [at[first][:2], at[second][:2]]
            axes.plot(*zip(*ends, strict=True), color="tab:red" if wrong else "tab:green", linewidth=2 if wrong else 1)
axes.set(aspect="equal", xlabel="x, m", ylabel="y, m")
axes.legend()
figure.savefig("right-or-wrong.png", dpi=100)

# %% [markdown]
# ![streets of a town, right closures in green, and a red line from x20 to x150](../figures/right-or-wrong.png)

# %%
assert not gate.plausible[0]
assert moved_robust < 0.5
name = town.name
town.close()
bus.drop(name)
bus.close()
