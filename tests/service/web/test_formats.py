"""The Accept header, by RFC 9110, and arrays as JSON."""

import json
import math

import numpy as np
import pytest
from pydantic import BaseModel

from service.base.errors import NotAcceptableError
from service.web.responses.formats import ARRAYS, JSON, choose, json_answer
from service.web.responses.representations import NPZ, NPZ_VENDOR, PNG


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


# --- arrays
# --------------------------------------------------------------------------------------------------


class Named(BaseModel):
    name: str
    value: float | None = None


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8, np.int64])
def test_numbers_come_back_bit_by_bit(dtype: type):
    rng = np.random.default_rng(0)
    array = (
        rng.lognormal(0, 3, (7, 5, 3))
        if dtype in (np.float32, np.float64)
        else rng.integers(0, 99, (7, 5, 3))
    ).astype(dtype)
    for shown in (array, array.T, array[::2], array[0], array[0, 0, 0]):
        answer = json_answer(Named(name="ä"), array=shown, none=None)
        document = json.loads(answer.body)
        assert (document["name"], document["none"]) == ("ä", None)
        back = np.array(document["array"], dtype=dtype)
        assert back.shape == np.shape(shown)
        assert back.tobytes() == np.asarray(shown).tobytes()
    assert (answer.headers["Content-Type"], answer.headers["Vary"]) == (
        "application/json",
        "Accept",
    )


def test_what_is_not_finite_becomes_null():
    """NaN and Infinity are no JSON; a parser that is strict would refuse the whole answer."""
    array = np.array([1.5, math.nan, math.inf, -math.inf], dtype=np.float32)
    document = json.loads(
        json_answer(Named(name="a", value=math.nan), array=array).body, parse_constant=pytest.fail
    )
    assert document == {"name": "a", "value": None, "array": [1.5, None, None, None]}
