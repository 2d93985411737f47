"""What is known of photographs of the Solar Tower Juelich, which PAINT publishes: marks on targets, sides of crops.

Targets are told apart by their names. Where two share an edge (the tower's upper and lower), T bars stand at the ends
of that edge and L brackets only at the corners of the pair, so the pair's marks together serve either target. A target
that is alone has four brackets.
"""

from model.imaging.rectify import BRACKETS, Layout, MarkPlace

CENTERED_WINDOW = 6.1
"""Side [m] of what PAINT's ``flux-centered`` images show about the centre of mass."""

_UPPER: Layout = (
    MarkPlace("L", 0, 0, 0),
    MarkPlace("L", 1, 1, 0),
    MarkPlace("T", 3, 0, 1),
    MarkPlace("T", 1, 1, 1),
    MarkPlace("T", 0, 0.5, 0),
    MarkPlace("L", 3, 0, 2),
    MarkPlace("L", 2, 1, 2),
    MarkPlace("T", 2, 0.5, 2),
)
# The lower one has the same marks, one side further up; its own corners come first.
_LOWER: Layout = tuple(
    MarkPlace(place.kind, place.quarter, place.x, place.y - 1)
    for place in (*_UPPER[2:4], *_UPPER[5:7], *_UPPER[:2], _UPPER[4], _UPPER[7])
)


def mark_layouts(target_name: str) -> tuple[Layout, ...]:
    """The layouts of marks to try for a target, in order; one of a pair is named ``..._upper`` or ``..._lower``."""
    name = target_name.lower()
    if name.endswith("upper"):
        return _UPPER, BRACKETS
    if name.endswith("lower"):
        return _LOWER, BRACKETS
    return (BRACKETS,)
