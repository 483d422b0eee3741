"""Generated scenes have the statistics of the simulator, and of the bench, that they imitate."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest

from sim_device.world.scene_generation import authors_sim, gap, generate, hardware
from sim_device.world.scenes import Scene, Shape

SEEDS = range(1, 25)


@pytest.fixture(scope="module")
def squeezed() -> list[Scene]:
    return [authors_sim(seed) for seed in SEEDS]


def test_fill_matches_the_authors_simulator(squeezed: list[Scene]) -> None:
    fill = [scene.fill for scene in squeezed]
    # 0.37 over 88 scenes, from 0.26 to 0.53; the standard error over 24 is 0.014.
    assert np.mean(fill) == pytest.approx(0.37, abs=0.04)
    assert min(fill) > 0.2
    assert max(fill) < 0.6


def test_object_kinds_match_the_authors_simulator(squeezed: list[Scene]) -> None:
    for scene in squeezed:
        assert 20 <= len(scene.objects) <= 30
        for item in scene.objects:
            assert 0.25 <= item.mass <= 0.75
            assert 0.06 <= item.height <= 0.08
            low, high = (0.06, 0.10) if item.shape is Shape.DISC else (0.03, 0.05)
            assert low <= item.size_x <= high
            assert low <= item.size_y <= high
    discs = [item.shape is Shape.DISC for scene in squeezed for item in scene.objects]
    assert np.mean(discs) == pytest.approx(0.41, abs=0.07)  # as in the recorded scenes


def test_some_objects_overlap_front_edge_and_back_wall(squeezed: list[Scene]) -> None:
    front = [[o.x - o.half_extent[0] for o in scene.objects] for scene in squeezed]
    back = [[o.x + o.half_extent[0] - scene.depth for o in scene.objects] for scene in squeezed]
    assert np.mean([sum(e < 0 for e in row) for row in front]) == pytest.approx(3.1, abs=1.5)
    assert np.mean([sum(e > 0 for e in row) for row in back]) == pytest.approx(3.2, abs=1.5)
    assert min(min(row) for row in front) > -0.0105
    assert max(max(row) for row in back) < 0.0105


def test_objects_accumulate_at_the_edges(squeezed: list[Scene]) -> None:
    x = [10 * o.x for scene in squeezed for o in scene.objects]
    y = [10 * o.y for scene in squeezed for o in scene.objects]
    # Counts of the authors' simulator over 88 scenes (2,221 objects).
    of_x = np.array([409, 312, 212, 174, 157, 213, 308, 436]) / 2221
    of_y = np.array([434, 284, 194, 182, 189, 239, 285, 414]) / 2221
    share_x = np.histogram(x, np.linspace(-0.2, 3.9, 9))[0] / len(x)
    share_y = np.histogram(y, np.linspace(-2.75, 2.75, 9))[0] / len(y)
    # Three standard errors of a share of 0.2 among 600 objects.
    assert np.abs(share_x - of_x).max() < 0.05
    assert np.abs(share_y - of_y).max() < 0.05


def test_overlaps_stay_within_those_of_the_simulator(squeezed: list[Scene]) -> None:
    for scene in squeezed:
        discs = [o for o in scene.objects if o.shape is Shape.DISC]
        for a, b in combinations(discs, 2):
            assert math.hypot(a.x - b.x, a.y - b.y) > a.radius + b.radius - 0.0006
        for item in scene.objects:
            assert abs(item.y) + item.half_extent[1] < scene.width / 2 + 0.0006


@pytest.mark.parametrize("name", ["authors_sim", "hardware"])
def test_same_seed_gives_identical_scenes(name: str) -> None:
    assert generate(name, 7).to_json() == generate(name, 7).to_json()
    assert generate(name, 7) != generate(name, 8)


def test_start_and_goal_match_the_authors_simulator(squeezed: list[Scene]) -> None:
    for scene in squeezed:
        assert (scene.start.x, scene.start.heading) == (-0.2, 0.0)
        assert abs(scene.start.y) <= 0.15
        assert scene.goal[0] == pytest.approx(0.358)
        assert abs(scene.goal[1]) <= 0.15
    assert np.std([scene.goal[1] for scene in squeezed]) > 0.05


@pytest.mark.parametrize("seed", range(12))
def test_grid_scene_matches_the_bench(seed: int) -> None:
    scene = hardware(seed)
    assert (scene.depth, scene.width) == (0.38, 0.53)
    assert 15 <= len(scene.objects) <= 22
    cells = set()
    for item in scene.objects:
        assert 0.043 <= item.size_x <= 0.088
        assert 0.043 <= item.size_y <= 0.088
        assert 0.143 <= item.mass <= 0.570
        hx, hy = item.half_extent
        assert item.x - hx > 0
        assert item.x + hx < scene.depth
        assert abs(item.y) + hy < scene.width / 2
        cells.add((int(item.x // (0.38 / 5)), int((item.y + 0.265) // (0.53 / 7))))
    assert len(cells) == len(scene.objects)
    assert all(gap(a, b) > 0 for a, b in combinations(scene.objects, 2))


def test_unknown_generator_lists_available_ones() -> None:
    with pytest.raises(ValueError, match=r"kitchen.*authors_sim, hardware"):
        generate("kitchen", 1)
    with pytest.raises(ValueError, match="-1"):
        generate("hardware", -1)
