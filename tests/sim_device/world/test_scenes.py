"""Scenes survive JSON bit for bit, and invalid ones are refused by name."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_device.world.scenes import MAX_OBJECTS, Pose, Scene, SceneError, SceneObject, Shape

length = st.floats(1e-3, 1.0)
coordinate = st.floats(-2.0, 2.0)


@st.composite
def objects(draw: st.DrawFn) -> SceneObject:
    shape = draw(st.sampled_from(Shape))
    size_x = draw(length)
    size_y = size_x if shape is Shape.DISC else draw(length)
    return SceneObject(
        shape, size_x, size_y, draw(length), draw(length), *(draw(coordinate) for _ in range(3))
    )


@settings(max_examples=50, deadline=None)
@given(
    st.builds(
        Scene,
        source=st.text(max_size=20),
        parameters=st.sampled_from(["hardware", "authors_sim"]),
        seed=st.integers(0, 2**63),
        depth=length,
        width=length,
        start=st.builds(Pose, coordinate, coordinate, coordinate),
        goal=st.tuples(coordinate, coordinate),
        objects=st.lists(objects(), max_size=5).map(tuple),
    )
)
def test_scene_round_trips_through_json_exactly(scene: Scene) -> None:
    again = Scene.from_json(scene.to_json())
    assert again == scene
    assert again.to_json() == scene.to_json()


def test_fill_is_footprint_area_over_cupboard_area(build: Any) -> None:
    scene = build.cupboard(
        build.box(0.1, 0.0, size=(0.04, 0.05)), build.disc(0.2, 0.1, radius=0.03)
    )
    assert scene.fill == pytest.approx((0.002 + math.pi * 0.0009) / (0.375 * 0.55))


def test_half_extent_of_a_rotated_box(build: Any) -> None:
    turned = build.box(0, 0, size=(0.04, 0.02), yaw=math.pi / 2)
    assert turned.half_extent == pytest.approx((0.01, 0.02))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": 0.0}, "mass"),
        ({"mass": math.nan}, "mass"),
        ({"size_x": -0.1}, "size"),
        ({"height": math.inf}, "size"),
        ({"yaw": math.nan}, "pose"),
        ({"shape": Shape.DISC, "size_x": 0.05}, "one diameter"),
    ],
)
def test_impossible_objects_are_refused(change: dict[str, Any], message: str) -> None:
    figures: dict[str, Any] = {
        "shape": Shape.BOX, "size_x": 0.04, "size_y": 0.04, "height": 0.07, "mass": 0.5,
        "x": 0.1, "y": 0.0, "yaw": 0.0,
    }  # fmt: skip
    with pytest.raises(SceneError, match=message):
        SceneObject(**{**figures, **change})


def test_scene_must_name_an_existing_parameter_set(build: Any) -> None:
    raw = json.loads(build.cupboard().to_json())
    raw["parameters"] = "kitchen"
    with pytest.raises(SceneError, match=r"kitchen.*authors_sim, hardware"):
        Scene.from_json(json.dumps(raw))


def test_too_many_objects_are_refused(build: Any) -> None:
    with pytest.raises(SceneError, match=str(MAX_OBJECTS)):
        build.cupboard(*[build.disc(0.1, 0.0)] * (MAX_OBJECTS + 1))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "no JSON"),
        ("[]", "format"),
        ('{"format": 99}', "99"),
        ('{"format": 1, "goal": [0, 0]}', "lacks 'source'"),
        ('{"format": 1, "goal": 3}', "damaged"),
    ],
)
def test_damaged_json_is_refused_with_a_reason(text: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        Scene.from_json(text)
