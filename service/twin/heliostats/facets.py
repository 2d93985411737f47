"""Where the facets of a stored surface lie."""

import numpy as np

from service.drawing.facets import FacetPlaces
from service.sources.documents import read_heliostat
from service.sources.schema import STORED
from service.store.tables import HeliostatRow


def facet_places(
    heliostat: HeliostatRow, origin: tuple[float, float, float], count: int
) -> FacetPlaces:
    """Places of the ``count`` facets of a surface; ``origin`` is the tower base in WGS84.

    They are in rows if the heliostat has another number of facets since.
    """
    mirror = read_heliostat(heliostat.name, heliostat.properties, np.array(origin), STORED)
    if len(mirror.facets) != count:
        return FacetPlaces.in_rows(count, heliostat.size_m)
    return FacetPlaces.of(mirror)
