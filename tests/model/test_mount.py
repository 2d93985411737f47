from dataclasses import replace

import numpy as np
import pytest

from model.actuator import LinearActuator
from model.errors import InvalidInputError, UnreachableError
from model.frames import sun_direction
from model.mount import Mount, rotation

RNG = np.random.default_rng(1)
MOUNTS = {
    "juelich": Mount.juelich(),
    "azimuth_elevation": Mount.azimuth_elevation(mirror_offset=(0.0, 0.1, 0.2)),
    "tilted": Mount.juelich().tilted(rotation([0.0, 1.0, 0.0], 0.03)),
}


def actuator(clockwise: bool) -> LinearActuator:
    return LinearActuator(154166.6667, 0.0774, 0.3353, 0.3381, 0.039, clockwise, 68745)


def random_normals(count: int) -> np.ndarray:
    normals = RNG.normal(size=(count, 3)) + [0, -1, 1.5]
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


@pytest.mark.parametrize("name", MOUNTS)
def test_angles_from_normal_invert_the_attitude(name):
    normals = random_normals(200)
    attitude = MOUNTS[name].attitude(MOUNTS[name].angles_from_normal(normals))
    np.testing.assert_allclose(attitude[..., 2], normals, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(attitude), 1)


@pytest.mark.parametrize("name", MOUNTS)
def test_alignment_reflects_the_sun_onto_the_aim(name):
    mount, position, aim = MOUNTS[name], np.array([20.0, 70.0, 1.8]), np.array([1.0, 0.0, 40.0])
    sun = sun_direction(150.0, 40.0)
    attitude = mount.attitude(mount.align(position, sun, aim))
    normal, center = attitude[:, 2], mount.mirror_center(position, attitude)
    out = 2 * (normal @ sun) * normal - sun
    toward = (aim - center) / np.linalg.norm(aim - center)
    assert np.arccos(min(1.0, out @ toward)) < 1e-7


def test_a_stack_turns_each_mirror_by_its_own_mount():
    suns, aims = (
        sun_direction([150.0, 200.0, 170.0], 40.0),
        np.array([[1.0, 0, 40], [0, 0, 38], [-1, 0, 39]]),
    )
    positions, mounts = RNG.uniform(20, 80, (3, 3)), list(MOUNTS.values())
    stack = Mount.stack(mounts)
    angles = stack.align(positions, suns, aims)
    for index, mount in enumerate(mounts):
        alone = mount.align(positions[index], suns[index], aims[index])
        np.testing.assert_allclose(angles[index], alone, atol=1e-12)
        attitude = mount.attitude(alone)
        np.testing.assert_allclose(stack.attitude(angles)[index], attitude, atol=1e-12)
        np.testing.assert_allclose(
            stack.mirror_center(positions, stack.attitude(angles))[index],
            mount.mirror_center(positions[index], attitude),
            atol=1e-9,
        )


def test_the_mount_rolls_the_mirror():
    """Same normal, different roll: some degrees at noon, many at low sun (DESIGN.md,
    section 4.3).
    """
    normal = random_normals(1)[0]
    frames = [
        m.attitude(m.angles_from_normal(normal))
        for m in (MOUNTS["juelich"], Mount.azimuth_elevation())
    ]
    roll = np.degrees(np.arccos(np.clip(frames[0][:, 0] @ frames[1][:, 0], -1, 1)))
    assert roll > 5


def test_upright_mirror_faces_south():
    np.testing.assert_allclose(Mount.juelich().attitude([0, 0])[:, 2], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(
        Mount.juelich().attitude([-np.pi / 2, 0])[:, 2], [0, 0, 1], atol=1e-12
    )


@pytest.mark.parametrize("clockwise", [True, False])
def test_actuators_invert(clockwise):
    steps = np.linspace(0, 60000, 50)
    angles = actuator(clockwise).angle(steps)
    np.testing.assert_allclose(actuator(clockwise).steps(angles), steps, atol=1e-5)
    assert (np.diff(angles) < 0).all() == clockwise


def test_motors_and_angles_invert_through_the_mount():
    mount = Mount.juelich((actuator(False), actuator(True)))
    steps = np.array([[20000.0, 40000.0], [30000.0, 50000.0]])
    np.testing.assert_allclose(
        mount.motors_from_angles(mount.angles_from_motors(steps)), steps, atol=1e-5
    )


def test_triangle_that_does_not_close_is_named():
    with pytest.raises(UnreachableError, match="motor position"):
        actuator(False).angle(1e6)


def test_motor_positions_need_actuators():
    with pytest.raises(InvalidInputError, match="no actuators"):
        Mount.juelich().angles_from_motors([1, 2])


def test_aim_straight_away_from_the_sun_is_refused():
    sun = sun_direction(180.0, 45.0)
    with pytest.raises(UnreachableError, match="away from the sun"):
        Mount.juelich(mirror_offset=(0, 0, 0)).align(np.zeros(3), sun, -sun * 100)


def test_a_pylon_leans_towards_where_its_mirror_faces():
    """The normal's elevation sinks by lean * cos(elevation), its azimuth stays, and angles lead
    back to it.
    """
    straight, leaning = Mount.juelich(), replace(Mount.juelich(), lean=0.012)
    angles = np.radians([[-20.0, 30.0], [-60.0, -15.0], [-5.0, 0.0], [-90.0, 0.0]])
    before, after = (mount.attitude(angles)[..., 2] for mount in (straight, leaning))
    elevation, lower = np.arcsin(before[:, 2]), np.arcsin(after[:, 2])
    np.testing.assert_allclose(elevation - lower, 0.012 * np.cos(elevation), atol=1e-12)
    east, north = after[:3, :2].T
    np.testing.assert_allclose(np.arctan2(east, north), np.arctan2(*before[:3, :2].T), atol=1e-12)
    np.testing.assert_allclose(leaning.angles_from_normal(after[:3]), angles[:3], atol=1e-12)
    np.testing.assert_allclose(
        Mount.stack([straight, leaning]).attitude(angles[:2])[1], leaning.attitude(angles[1])
    )
