# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Surfaces from photographs
#
# A solar tower photographs the spot of one heliostat at a time on a white target, to calibrate its
# tracking. The spot's shape depends on the mirror's surface. This notebook predicts that surface
# from the photographs, and checks it with photographs that were held out.
#
# It uses the demonstration's plant: four mirrors that are known, photographed by a Monte Carlo
# tracer and a synthetic camera. Give `heliotwin.open_plant` the folder of your own measurements.

# %%
import matplotlib.pyplot as plt
import numpy as np

import heliotwin

plant = heliotwin.make_demo("out/demo/plant")
print(plant)
plant.plot()

# %% [markdown]
# ## Photographs
#
# The library finds the target in each photograph, rectifies it, and separates the spot from the
# daylight. The flux of a photograph has a sum of 100.

# %%
name = "AB12"
plant = heliotwin.open_plant("out/demo/plant", [name])  # measures the photographs of one only
photographs = plant.photographs(name)
fig, axes = plt.subplots(1, 4, figsize=(12, 3.2), layout="constrained")
for ax, photograph in zip(axes, photographs[:4], strict=True):
    photograph.plot(ax=ax)

# %% [markdown]
# ## Surfaces
#
# Every second photograph is held out. The network needs a fraction of a second. The refinement fits
# its surface to the photographs through a differentiable ray tracer.

# %%
used = [photograph.identifier for photograph in photographs[::2]]
surfaces = {
    "ideal": plant.surface(name, "ideal"),
    "network": plant.predict(name, "network", images=used),
    "refined": plant.predict(name, "refined", images=used),
    "measured": plant.surface(name, "measured"),
}

# %% [markdown]
# A surface is a map of control heights of each facet, over the ideally canted facet. The measured
# surface is the one that the photographs were made with.

# %%
fig, axes = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
for ax, kind in zip(axes, ("network", "refined", "measured"), strict=True):
    surfaces[kind].plot(ax=ax)

# %% [markdown]
# ## Are they right?
#
# The first figure is the mean absolute error of the control heights. It is known here only because
# the mirrors are known. The second is the accuracy of forecasts of the held-out photographs. It can
# be computed at every plant.

# %%
errors_mm, accuracies = {}, {}
for kind, surface in surfaces.items():
    errors_mm[kind] = 1e3 * np.abs(surface.z - surfaces["measured"].z).mean()
    table = heliotwin.to_frame(plant.compare(surface))
    accuracies[kind] = table[~table.identifier.isin(used)].accuracy.mean()
    print(f"{kind:>9}: error {errors_mm[kind]:.3f} mm, accuracy {accuracies[kind]:.3f}")
