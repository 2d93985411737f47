import numpy as np
import pytest

from model.prior import FacetKind, generic_prior
from tests.conftest import flat_heliostat
from training.prior import generic_kind


@pytest.mark.full
def test_kind_of_facets_is_distinguished_from_mirrors():
    prior, kind = generic_prior(flat_heliostat().facet_frames[2]), FacetKind()
    rng = np.random.default_rng(0)
    found = generic_kind(
        np.stack([prior.surface(rng.normal(size=len(prior.basis))) for _ in range(40)])
    )
    for name in ("canting", "bending", "reach", "grain", "alike"):
        assert getattr(found, name) == pytest.approx(getattr(kind, name), rel=0.15), name
