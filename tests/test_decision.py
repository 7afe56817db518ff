"""Which flow is kept, that with or that without what a search found, and which parts of it."""

from __future__ import annotations

import numpy as np
import pytest

from hugin_abflow import decision
from hugin_abflow.decision import Candidate
from hugin_abflow.search import SearchParameters

HEIGHT, WIDTH = 43, 71
HOW = SearchParameters()


def textured() -> np.ndarray:
    return np.ones((2, HEIGHT, WIDTH), bool)


def untextured() -> np.ndarray:
    return ~textured()


# Rows and columns, by how many px what was found leads farther to the right there, and what it leaves
# unexplained.
Part = tuple[tuple[slice, slice], float, float]


def candidates(*parts: Part) -> tuple[Candidate, Candidate]:
    """Flow without and with a search, alike but for parts; .1 is left unexplained elsewhere and without."""
    flows, misfit = np.zeros((2, HEIGHT, WIDTH, 2), np.float32), np.full((2, HEIGHT, WIDTH), 0.1, np.float32)
    plain = Candidate(flows.copy(), misfit.copy())
    for place, far, left in parts:
        flows[(slice(None), *place, 0)] = np.array([far, -far])[:, None, None]
        misfit[(slice(None), *place)] = left
    return plain, Candidate(flows, misfit)


LARGE, SMALL = (slice(5, 38), slice(10, 50)), (slice(10, 20), slice(60, 66))


def decided(*parts: Part, level: int = 1) -> decision.Decision:
    return decision.decide(*candidates(*parts), level, 1, textured, None, False, HOW)


def test_a_large_part_that_explains_much_is_kept() -> None:
    assert decided((LARGE, 6, 0.02)) == decision.Decision(True)
    assert not decided((LARGE, 6, 0.08)).found
    assert not decided((LARGE, 1.2, 0.02)).found  # the same as without a search
    assert decided((LARGE, 6, 0.08), level=2).found  # it gains a little
    assert decided((LARGE, 1.2, 0.02), level=2).found  # twice as much on the level on which it is decided


def test_what_is_refused_is_told_if_it_explains_something() -> None:
    """Somebody who walked may be told from it."""
    kept = decided((SMALL, 6, 0.02))
    assert not kept.found
    (refused,) = kept.refused
    assert refused.level == 1 and refused.flows[0, 15, 62, 0] == 6
    assert not decided((SMALL, 6, 0.2)).refused


def test_what_shows_nothing_does_not_tell() -> None:
    """A sign's letters, which are explained by far better, are a third of what is mostly a white board."""
    letters = np.zeros((2, HEIGHT, WIDTH), bool)
    letters[:, ::3] = True
    plain, found = candidates((LARGE, 6, 0.1))
    found.misfit[np.where(letters, found.flows[..., 0] != 0, False)] = 0.02
    assert decision.decide(plain, found, 1, 1, lambda: letters, None, False, HOW).found
    assert not decision.decide(plain, found, 1, 1, textured, None, False, HOW).found
    # where nothing shows anything, or only a small thing, all counts
    assert not decision.decide(plain, found, 1, 1, untextured, None, False, HOW).found
    letters[:, :, : WIDTH // 3] = False
    letters[:, :, 2 * WIDTH // 3 :] = False
    assert letters.mean() > HOW.tells
    assert decision.decide(plain, found, 1, 1, lambda: letters, None, False, HOW).found
    letters[:, 1::2] = False
    letters[:, :21] = False
    assert letters.mean() < HOW.tells
    assert not decision.decide(plain, found, 1, 1, lambda: letters, None, False, HOW).found


def bearings(places: np.ndarray) -> np.ndarray:
    lon, lat = (places[:, 0] - WIDTH) / 300, (HEIGHT - places[:, 1]) / 300
    return np.stack([np.cos(lat) * np.sin(lon), np.cos(lat) * np.cos(lon), np.sin(lat)], 1)


def test_small_parts_are_kept_if_they_move_as_what_stands_still() -> None:
    """A camera that moved to the left: all goes to the right, what is near farther."""
    for far, found in ((6, True), (-6, False)):
        plain, searched = candidates((SMALL, far, 0.02))
        for one in (plain, searched):
            one.flows[..., 0] += np.array([3, -3])[:, None, None]
        assert decision.decide(plain, searched, 1, 1, textured, bearings, False, HOW).found == found
        assert not decision.decide(plain, searched, 1, 1, untextured, bearings, False, HOW).found  # unknown


@pytest.mark.parametrize("far", [6, -6])
def test_what_may_move_either_way_has_to_lead_back(far: int) -> None:
    """Layers that are turned against each other: what is known goes to the right above, to the left below."""
    place = np.s_[28:34, 20:50]
    plain, searched = candidates((place, far, 0.02))
    right = np.where(np.arange(HEIGHT) < HEIGHT // 2, 3, -3)[:, None]
    for one in (plain, searched):
        one.flows[..., 0] += np.stack([right, -right])
    assert decision.decide(plain, searched, 1, 1, textured, bearings, False, HOW).found
    searched.flows[(1, *place)] = plain.flows[(1, *place)] + np.array([0.5 * far, 0], np.float32)
    assert not decision.decide(plain, searched, 1, 1, textured, bearings, False, HOW).found


@pytest.mark.parametrize("wraps", [False, True])
def test_what_does_not_lead_back_explains_nothing(wraps: bool) -> None:
    """It fits by chance, and counts for no more than flow without a search."""
    plain, found = candidates((LARGE, 6, 0.02), (SMALL, 6, 0.3))
    columns = np.arange(WIDTH)
    believed = decision.trusted_misfit(plain, found, 2, wraps)
    for way, there in enumerate(((columns >= 10) & (columns < 44), (columns >= 16) & (columns < 50))):
        expected = np.full((HEIGHT, WIDTH), 0.1, np.float32)
        expected[LARGE[0], there], expected[SMALL] = 0.02, 0.3  # which is no better
        assert np.array_equal(believed[way], expected)
    assert np.array_equal(decision.trusted_misfit(plain, found, 6.1, wraps), found.misfit)


def test_a_large_part_has_to_lead_back_unless_it_moves_as_what_stands_still() -> None:
    plain, found = candidates((LARGE, 6, 0.02))
    found.flows[1] *= -1
    assert not decision.decide(plain, found, 1, 1, textured, None, False, HOW).found
    plain, found = candidates((LARGE, 6, 0.02))
    assert decision.decide(plain, found, 1, 1, textured, None, False, HOW).found


@pytest.mark.parametrize("wraps", [False, True])
def test_what_leads_over_the_border_leads_back_only_where_columns_wrap(wraps: bool) -> None:
    plain, found = candidates()
    found.flows[0, :, WIDTH - 4 :, 0], found.flows[1, :, 2:6, 0] = 6, -6
    found.misfit[0, :, WIDTH - 4 :] = 0.02
    believed = decision.trusted_misfit(plain, found, 2, wraps)[0, :, WIDTH - 4 :]
    assert np.all(believed == np.float32(0.02 if wraps else 0.1))


@pytest.mark.parametrize("way", [0, 1])
def test_return_is_read_at_the_pixel_that_flow_leads_to(way: int) -> None:
    plain, found = candidates()
    found.flows[way, 20, 30] = (2.6, -4.4)
    found.misfit[way, 20, 30] = 0.02
    assert decision.trusted_misfit(plain, found, 2, False)[way, 20, 30] == np.float32(0.1)
    found.flows[1 - way, 16, 33] = (-2.6, 4.4)
    assert decision.trusted_misfit(plain, found, 2, False)[way, 20, 30] == np.float32(0.02)


@pytest.mark.parametrize("wraps", [False, True])
def test_a_part_that_explains_less_is_dropped(wraps: bool) -> None:
    """As one: also where it happens to fit, and what only one image shows of it; the rest is not."""
    beside = slice(10, 20), slice(66, WIDTH)
    around = slice(12, 20), slice(0, 4)
    plain, found = candidates((LARGE, 6, 0.02), (SMALL, -3, 0.3), (beside, -3, 0.05), (around, 0.7, 0.05))
    for one in (plain, found):
        one.misfit[:, 11, 61:64] = -1
    expected = np.zeros((2, HEIGHT, WIDTH), bool)
    for place in (SMALL, beside, *((around,) if wraps else ())):
        expected[(slice(None), *place)] = True
    assert np.array_equal(decision.worse(plain, found, wraps), expected)


def test_each_way_has_its_own_parts() -> None:
    plain, found = candidates((SMALL, -3, 0.3))
    found.flows[1] = 0
    worse = decision.worse(plain, found, False)
    assert worse[0].sum() == 60 and not worse[1].any()


def test_what_no_image_shares_with_the_other_is_left() -> None:
    plain, found = candidates((SMALL, -3, 0.3))
    for one in (plain, found):
        one.misfit[:] = -1
    assert not decision.worse(plain, found, False).any()
