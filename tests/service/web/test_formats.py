"""The Accept header, by RFC 9110."""

import pytest

from service.base.faults import NotAcceptableError
from service.web.answers.formats import ARRAYS, JSON, choose
from service.web.answers.representations.npz import NPZ, NPZ_VENDOR
from service.web.answers.representations.png import PNG


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        (None, JSON),
        ("", JSON),
        ("*/*", JSON),
        ("application/*", JSON),
        ("image/*", PNG),
        ("image/png", PNG),
        ("IMAGE/PNG", PNG),
        ("application/x-npz", NPZ),
        ("application/vnd.numpy.npz", NPZ_VENDOR),
        ("text/html, application/json;q=0.5", JSON),
        ("application/json;q=0.5, image/png", PNG),
        ("application/json;q=0.5, image/png;q=0.4", JSON),
        ("*/*;q=0.1, image/png;q=0.2", PNG),
        ("application/json;q=0, */*", NPZ),
        ("text/html,application/xhtml+xml,image/png,*/*;q=0.8", PNG),
        ("image/png;level=1;q=1.0", PNG),
        (" application/json ; q=1 ", JSON),
    ],
)
def test_best_representation(accept: str | None, expected: str):
    assert choose(accept) == expected


@pytest.mark.parametrize(
    "accept", ["text/html", "image/jpeg", "*/*;q=0", "json", "image/png;q=nan", "a/b;q=2", "/", ";"]
)
def test_nothing_acceptable(accept: str):
    with pytest.raises(NotAcceptableError, match="image/png") as caught:
        choose(accept)
    assert caught.value.offered == ARRAYS
