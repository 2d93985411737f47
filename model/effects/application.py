"""Apply effects to suns, mounts, optics and images."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

from torch import Tensor

from model.effects.base import Array, Effect, Stage
from model.effects.catalogue import in_light_order
from model.effects.scope import Since
from model.mount import Mount
from model.plant import Heliostat
from model.setup import Setup
from model.site import Site
from model.tracing.scene import Optics, Window


def effects_of_stage(effects: Iterable[Effect], *stages: Stage) -> list[Effect]:
    """Effects of some stages."""
    return [effect for effect in effects if not effect.stages.isdisjoint(stages)]


def apply_sun_effects(effects: Iterable[Effect], suns: Array, site: Site) -> Array:
    """True unit vectors (B, 3) towards the sun, from recorded ones (B, 3)."""
    for effect in effects:
        suns = effect.on_sun(suns, site)
    return suns


def apply_mount_effects(
    heliostats: Sequence[Heliostat], effects: Sequence[Effect]
) -> list[Heliostat]:
    """The heliostats with changed mounts; repeated heliostats stay the same object.

    A calibration includes the effects on the mounts in its photographs. So only effects that began
    later act on a calibrated mount.
    """
    changed: dict[int, Heliostat] = {}
    for heliostat in heliostats:
        if id(heliostat) not in changed:
            mount = heliostat.mount
            for effect in effects:
                if not mount.is_calibrated or _began_after_calibration(effect, mount):
                    mount = effect.on_mount(mount, heliostat.name)
            changed[id(heliostat)] = replace(heliostat, mount=mount)
    return [changed[id(heliostat)] for heliostat in heliostats]


def _began_after_calibration(effect: Effect, mount: Mount) -> bool:
    """Check if an effect began after the newest photograph that calibrated a mount."""
    newest = mount.calibrated_until
    return newest is not None and isinstance(effect.scope, Since) and effect.scope.since > newest


def apply_optics_effects(effects: Iterable[Effect], optics: Optics) -> Optics:
    """The declared optics with the effects."""
    for effect in in_light_order(effects):
        optics = effect.on_optics(optics)
    return optics


def apply_image_effects(
    effects: Iterable[Effect], flux: Tensor, window: Window, setups: Sequence[Setup], site: Site
) -> Tensor:
    """The camera's images of irradiance (B, rows, columns) of B setups over ``window``."""
    for effect in in_light_order(effects):
        flux = effect.on_images(flux, window, setups, site)
    return flux
