from unittest.mock import Mock

import numpy as np

from model.images import normalized
from model.observation import Observation
from model.plant import Heliostat, TargetPlane
from model.plant_model import JUELICH_MODEL
from service.twin.surfaces.present_shape import list_outliers, reject_outliers


def test_outlier_contradicts_the_others():
    assert list_outliers([0.12, 0.30, 0.10, 0.13, 0.11, 0.45, 0.12]) == [1, 5]


def test_nearly_consistent_images_are_not_separated_by_noise():
    misfits = 0.01 + 0.001 * np.random.default_rng(1).standard_normal(20)
    assert list_outliers([*misfits, 0.04, misfits[0]]) == []


def test_what_comes_last_may_be_a_mirror_that_has_changed():
    before = [0.10, 0.12, 0.11, 0.10, 0.13, 0.12, 0.11]
    assert list_outliers([*before, 0.4, 0.38]) == []
    assert list_outliers([*before, 0.4, 0.38, 0.12]) == [7, 8]


def test_a_photograph_that_contradicts_the_others_is_left_out_with_its_reason():
    """A stand-in for the network explains all images but the third, on which half of the spot lies
    in a shadow.
    """
    spot = normalized(
        np.exp(-np.add.outer(np.linspace(-2, 2, 64) ** 2, np.linspace(-2, 2, 64) ** 2))
    )
    shaded = normalized(spot * (np.arange(64) < 32))
    plane = TargetPlane(
        "tower", np.zeros(3), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), 5.4, 6.4
    )
    suns = [np.array([np.sin(a), 0.0, np.cos(a)]) for a in np.linspace(-0.5, 0.5, 7)]
    images = [shaded if name == 2 else spot for name in range(7)]
    observed = [
        Observation(image, sun, plane, np.zeros(3), str(name))
        for name, (image, sun) in enumerate(zip(images, suns, strict=True))
    ]
    glance = Mock(
        **{"predict.return_value": Mock(z=None), "render.return_value": np.array([spot] * 7)}
    )
    heliostat = Heliostat.juelich("AB12", (0.0, 100.0, 0.0))
    kept, apart = reject_outliers(glance, heliostat, observed, JUELICH_MODEL)
    assert [o.identifier for o in kept] == ["0", "1", "3", "4", "5", "6"]
    assert set(apart) == {"2"}
    assert apart["2"].startswith("contradicts the others: it differs by 1.00 ")
    assert reject_outliers(glance, heliostat, observed[:5], JUELICH_MODEL) == (observed[:5], {})
