import numpy as np

from service.twin.consensus import contradicting


def test_what_stands_out_contradicts_the_others():
    assert contradicting([0.12, 0.30, 0.10, 0.13, 0.11, 0.45, 0.12]) == [1, 5]


def test_images_that_all_but_agree_are_not_told_apart_by_their_noise():
    misfits = 0.01 + 0.001 * np.random.default_rng(1).standard_normal(20)
    assert contradicting([*misfits, 0.04, misfits[0]]) == []


def test_what_comes_last_may_be_a_mirror_that_has_changed():
    before = [0.10, 0.12, 0.11, 0.10, 0.13, 0.12, 0.11]
    assert contradicting([*before, 0.4, 0.38]) == []
    assert contradicting([*before, 0.4, 0.38, 0.12]) == [7, 8]
