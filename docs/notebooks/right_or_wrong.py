# %% [markdown]
# # Right or wrong: gates, losses and whys
#
# Places look alike, so a front end makes wrong loop closures. What the map can say about them, before and after they
# are in. It wants a service: `factorbus serve`.

# %%
import os

from factorbus.client import Draft, connect
from factorbus.simulate import manhattan

ENDPOINT = os.environ.get("FACTORBUS_ENDPOINT", "tcp/127.0.0.1:7447")
bus = connect(ENDPOINT, client="notebook")
town = bus.map(f"notebook-{os.getpid()}")
for step in manhattan(poses=200, seed=4):
    town.send(step.batch)
town.flush()
print(len(town.estimate), "poses, χ²", round(town.chi2().chi2, 1))

# %% [markdown]
# A closure that puts pose 150 on pose 20, where it is not. The gate knows before it goes in: d² is the squared
# distance between what is claimed and what the map expects, in standard deviations of both; for three numbers, 95 %
# of right ones are below 7.8.

# %%
wrong = Draft().between_se2("x20", "x150", (0, 0, 0), sigmas=(0.1, 0.1, 0.05))
gate = town.uncertainty.gate(wrong)
print("d²", gate.distance.round(0), "allowed", gate.threshold.round(1), "plausible", gate.plausible)

# %% [markdown]
# Say it goes in nevertheless, but with a loss: dynamic covariance scaling lets a factor that all others contradict
# lose its weight. The pose hardly moves.

# %%
before = town.estimate["x150"].copy()
robust = Draft().between_se2("x20", "x150", (0, 0, 0), sigmas=(0.1, 0.1, 0.05), loss=("dcs", 1.0))
done = town.insert(robust, settle=True)
moved_robust = abs(town.estimate["x150"] - before)[:2].max()
print(f"moved by {moved_robust:.3f} m")

# %% [markdown]
# And the map can be asked why a pose is where it is: each factor with its misfit, and its leverage, the share of what
# it measures that is known from it alone.

# %%
why = town.uncertainty.why("x150").variable
for factor in sorted(why["factors"], key=lambda each: -each["chi2"]):
    print(f"{factor['kind']}  χ² {factor['chi2']:.3g}  leverage {factor['influence'] / factor['dims']:.0%}")

# %%
assert not gate.plausible[0]
assert moved_robust < 0.5
name = town.name
town.close()
bus.drop(name)
bus.close()
