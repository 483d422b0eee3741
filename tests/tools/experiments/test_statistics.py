"""Statistics against values computed by hand, and published examples."""

from __future__ import annotations

import math

import pytest

from tactile_tools.experiments.statistics import (
    Rate,
    all_pairs,
    contrast,
    holm,
    mean_interval,
    paired_rates,
    signed_rank,
    stars,
)


def test_wilson_interval_of_15_in_148_matches_newcombe() -> None:
    # Newcombe 1998 (one sample), table I: 15 of 148 by the score method.
    low, high = Rate(15, 148).interval
    assert (round(low, 4), round(high, 4)) == (0.0624, 0.1605)


def test_wilson_interval_matches_hand_calculation() -> None:
    # 0 of 10: centre z²/(2(n + z²)), and as much on either side.
    z2 = 1.959964**2
    assert Rate(0, 10).interval == pytest.approx((0.0, z2 / (10 + z2)), abs=1e-6)
    assert math.isnan(Rate(0, 0).value)
    assert all(math.isnan(v) for v in Rate(0, 0).interval)


def test_difference_of_independent_rates_matches_newcombe() -> None:
    # Newcombe 1998 (two samples), table II, (a) 56/70 − 48/80, method 10.
    found = contrast(Rate(56, 70), Rate(48, 80))
    assert found.difference == pytest.approx(0.2)
    assert [round(v, 4) for v in found.interval] == [0.0524, 0.3339]


def test_fisher_exact_p_matches_hand_calculation() -> None:
    # The lady tasting tea: 3 of 4 against 1 of 4, two-sided (16 + 16 + 1 + 1) / 70.
    assert contrast(Rate(3, 4), Rate(1, 4)).p == pytest.approx(34 / 70)


def test_mcnemar_matches_hand_calculation() -> None:
    a = [True] * 8 + [False] * 2 + [True] * 5
    b = [False] * 8 + [True] * 2 + [True] * 5
    found = paired_rates(a, b)
    # 8 to 2 with a fair coin: 2 × (1 + 10 + 45) / 1024.
    assert found.p == pytest.approx(112 / 1024)
    assert (found.only_a, found.only_b, found.scenes) == (8, 2, 15)
    assert found.difference == pytest.approx(6 / 15)
    # Agresti and Min: 8.5 and 2.5 discordant of 17.
    spread = 1.959964 * math.sqrt(11 - 36 / 17) / 17
    assert found.interval == pytest.approx((6 / 17 - spread, 6 / 17 + spread), abs=1e-6)


def test_pairs_that_never_differ_give_no_evidence() -> None:
    assert paired_rates([True, False], [True, False]).p == 1.0
    assert signed_rank([1.0, 2.0], [1.0, 2.0]) == (1.0, 0.0)
    assert math.isnan(paired_rates([], []).p)


def test_signed_ranks_match_hand_calculation() -> None:
    # Differences 1, 2, 3, 4, −5: of the 32 signs, W ≤ 5 has 10, so p = 20/32; effect (10 − 5)/15.
    p, effect = signed_rank([1, 2, 3, 4, 0], [0, 0, 0, 0, 5])
    assert p == pytest.approx(20 / 32)
    assert effect == pytest.approx(5 / 15)


def test_signed_ranks_with_ties_match_hand_calculation() -> None:
    # Six pairs of one sign: 2 of 64 orders are as extreme; one tied pair is dropped.
    p, effect = signed_rank([1, 2, 3, 4, 5, 6, 7], [0, 0, 0, 0, 0, 0, 7])
    assert p == pytest.approx(2 / 64)
    assert effect == 1.0


def test_holm_correction_matches_hand_calculation() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.9]) == [1.0, 1.0]
    adjusted = holm([0.02, math.nan, 0.01])
    assert (adjusted[0], adjusted[2]) == (0.02, 0.02)
    assert math.isnan(adjusted[1])


def test_all_pairs_uses_common_scenes() -> None:
    values = {
        "a": {1: 0.0, 2: 0.0, 3: 0.0},
        "b": {2: 1.0, 3: 2.0, 4: 3.0},
        "c": {9: 1.0},
    }
    ab, ac, bc = all_pairs(values)
    assert (ab.a, ab.b, ab.scenes) == ("a", "b", 2)
    assert ab.mean_difference == -1.5
    assert ab.effect == -1.0
    assert ac.scenes == bc.scenes == 0
    assert math.isnan(ac.adjusted)
    assert ab.adjusted == ab.p  # the only test there is


def test_interval_of_a_mean_matches_hand_calculation() -> None:
    # 1, 2, 3: s = 1, t(2) = 4.3027.
    half = 4.302653 / math.sqrt(3)
    assert mean_interval([1.0, 2.0, 3.0]) == pytest.approx((2 - half, 2 + half), abs=1e-6)
    assert all(math.isnan(v) for v in mean_interval([1.0]))


@pytest.mark.parametrize(
    ("p", "mark"),
    [(9e-5, "****"), (1e-4, "***"), (0.009, "**"), (0.049, "*"), (0.05, "ns"), (math.nan, "")],
)
def test_significance_stars_are_those_of_the_paper(p: float, mark: str) -> None:
    assert stars(p) == mark
