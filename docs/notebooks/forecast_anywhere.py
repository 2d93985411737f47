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
# # A forecast anywhere
#
# A surface is worth its forecasts. This notebook computes the flux of heliostats on a target, on a
# plane that was never photographed, and over a day.

# %%
from datetime import UTC, datetime, timedelta

import matplotlib.pyplot as plt
import numpy as np

import heliotwin

plant = heliotwin.make_demo("out/demo/plant")
surfaces = [plant.predict(name) for name in plant.heliostats]

# %% [markdown]
# ## At a sun
#
# The sun is azimuth from north over east and elevation, in degrees. The map is in W/m2, for
# a direct normal irradiance of 1000 W/m2.

# %%
flux = plant.forecast(surfaces[0], on="calibration_target", sun=(200.0, 45.0))
print(f"peak {flux.peak_w_m2:.0f} W/m2, power {flux.power_w:.0f} W")
flux.plot()

# %% [markdown]
# ## On any plane, at a time
#
# A plane has a centre in metres east, north and up of the tower base, and a normal on its lit side.
# The sun may be a time with a zone.

# %%
board = heliotwin.plane((0, 4, 28), normal=(0, 1, -0.5), width_m=6, height_m=6)
noon = datetime(2026, 6, 21, 11, 36, tzinfo=UTC)
maps = [plant.forecast(surface, on=board, sun=noon, resolution=(128, 128)) for surface in surfaces]

fig, axes = plt.subplots(1, len(maps), figsize=(12, 3.2), layout="constrained")
for ax, surface, one in zip(axes, surfaces, maps, strict=True):
    one.plot(ax=ax)
    ax.set_title(surface.heliostat)

# %% [markdown]
# Fluxes add. This sum does not include that mirrors shade and block each other;
# `POST /v1/jobs/forecasts` of the service does.

# %%
total = np.sum([one.flux for one in maps], axis=0)
print(f"peak of all {total.max() / 1e3:.1f} kW/m2")

# %% [markdown]
# ## Over a day
#
# The ideal mirror is what a plant without twins forecasts. Peaks differ by what the mirror's errors
# do, and powers hardly.

# %%
times = [noon + timedelta(hours=hours) for hours in range(-4, 5, 2)]
twin, ideal = surfaces[0], plant.surface("AB12", "ideal")
peaks = {
    kind: [
        plant.forecast(mirror, on=board, sun=at, resolution=(64, 64)).peak_w_m2 / 1e3
        for at in times
    ]
    for kind, mirror in (("twin", twin), ("ideal mirror", ideal))
}
fig, ax = plt.subplots(figsize=(7, 3.2), layout="constrained")
for kind, values in peaks.items():
    ax.plot([at.hour + at.minute / 60 for at in times], values, marker="o", label=kind)
ax.set_xlabel("hour of the day [UTC]")
ax.set_ylabel("peak [kW/m2]")
ax.legend()

# %% [markdown]
# ## What is refused
#
# A sun below the horizon, a vector in place of angles or a time without a zone would be quiet
# nonsense. The errors name the argument and the remedy.

# %%
refused = []
for sun in ((200.0, -5.0), (0.1, -0.7, 0.7), datetime(2026, 6, 21, 11, 36)):
    try:
        plant.forecast(twin, on=board, sun=sun)
    except heliotwin.InvalidInputError as error:
        refused.append(str(error))
print("\n".join(refused))
