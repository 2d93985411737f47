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
# # A hidden effect found
#
# If photographs and forecasts differ by more than noise, the plant's model lacks something: haze,
# facets that sag, a camera with another response. A study finds out what, and how much it gains.
#
# Here the plant declares a wrong camera: light is counts to the power of 1.5. Its photographs have
# sRGB, which is near 2.2. The library does not know this.

# %%
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import heliotwin

heliotwin.make_demo("out/demo/plant")
folder = Path("out/demo/wrong-camera")
folder.mkdir(parents=True, exist_ok=True)
for path in Path("out/demo/plant").resolve().iterdir():
    if not (folder / path.name).exists():
        (folder / path.name).symlink_to(path)
declared = {"declared": {"cameras": [{"transfer": {"gamma": 1.5}}]}}
(folder / "twin.json").write_text(json.dumps(declared))
plant = heliotwin.open_plant(folder)

# %% [markdown]
# ## The symptom
#
# Two mirrors are enough here, and quick. They are measured, so their surfaces are not to blame.
# Still the forecasts are worse than the noise of the photographs.

# %%
surfaces = [plant.surface(name) for name in ("AB12", "AK08")]


def accuracies(plant):
    """Accuracies of the forecasts of all photographs."""
    return np.array([one.accuracy for surface in surfaces for one in plant.compare(surface)])


before = accuracies(plant)
print(f"mean accuracy {before.mean():.3f}")

# %% [markdown]
# ## The study
#
# It fits each candidate to one half of the photographs, and judges it by the other half. Leave out
# `candidates` to try the whole catalogue; this takes a few minutes.

# %%
candidates = ["camera_response", "slope_error"]
study = plant.study(surfaces, candidates=candidates)
print(study.conclusion)
print(study.parameters)

# %% [markdown]
# Each candidate alone says which effects look alike.

# %%
gains = {one["name"]: one["accuracy_gain"]["mean"] for one in study.report["candidates"]}
fig, ax = plt.subplots(figsize=(7, 2.4), layout="constrained")
ax.barh(list(gains), list(gains.values()))
ax.set_xlabel("gain in accuracy, alone [1]")

# %% [markdown]
# ## The remedy
#
# The effect that was found joins the plant's model, and forecasts improve.

# %%
better = plant.with_effects(study)
after = accuracies(better)
print(f"mean accuracy {before.mean():.3f} before, {after.mean():.3f} after")
