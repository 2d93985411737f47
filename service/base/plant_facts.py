"""What is known of a plant besides its targets, receivers, heliostats and optical model."""

from dataclasses import dataclass

from pydantic import Field

from model.plant import Tower
from service.base.fields import JsonObject, Model, Number


class TowerSize(Model):
    """The tower: an upright cylinder on the tower base, which casts a shadow."""

    radius_m: Number = Field(gt=0, lt=1e3, description="[m]")
    height_m: Number = Field(gt=0, lt=1e4, description="[m]")

    def tower(self) -> Tower:
        """As the model has it."""
        return Tower(self.radius_m, self.height_m)


@dataclass(frozen=True)
class PlantFacts:
    """Facts of a plant; each may be None.

    Attributes
    ----------
    tower : Tower or None
        It casts a shadow.
    time_zone : str or None
        Name in the IANA time zone database.
    heliostat_types : dict or None
        Of ``plant.yaml``: its ``types``, and the text of the ``files`` that they name.
    """

    tower: Tower | None = None
    time_zone: str | None = None
    heliostat_types: JsonObject | None = None

    def columns(self) -> dict[str, object]:
        """The facts by name, in the form of the store."""
        tower = self.tower and {"radius_m": self.tower.radius, "height_m": self.tower.height}
        return {**vars(self), "tower": tower}


NO_FACTS = PlantFacts()
"""Nothing is known."""
