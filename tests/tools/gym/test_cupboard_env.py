"""The cupboard as a Gymnasium environment: Gymnasium's own checker, and what users rely on."""

from __future__ import annotations

import subprocess
import sys
import warnings
from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="needs pip install -e '.[gym]'")

from gymnasium.utils.env_checker import check_env  # noqa: E402

ID = "tactile_tools.gym:Cupboard-v0"


def make(**options: Any) -> Any:
    return gymnasium.make(ID, **({"scene": "hardware"} | options))


def episode(env: Any, seed: int, steps: int = 40) -> list[Any]:
    """Everything that random actions, drawn from ``seed``, bring."""
    observation, info = env.reset(seed=seed)
    found: list[Any] = [observation, info]
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        found.append(env.step(rng.uniform(-1, 1, 3).astype(np.float32)))
        if found[-1][2] or found[-1][3]:
            break
    return found


def same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    return bool(a == b)


def test_gymnasiums_checker_finds_nothing() -> None:
    env = make()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize(("depth", "steps"), [("contacts", 40), ("taxels", 5)])
def test_same_seed_gives_the_same_bits(depth: str, steps: int) -> None:
    first, second = make(depth=depth), make(depth=depth)
    assert same(episode(first, 5, steps), episode(second, 5, steps))
    # An episode does not depend on earlier ones.
    assert not same(episode(first, 6, steps), episode(second, 5, steps))
    assert same(episode(first, 5, steps), episode(second, 5, steps))


def test_taxels_are_in_the_observation_space() -> None:
    env = make(depth="taxels")
    for observation, *_ in episode(env, 3, 10)[2:]:
        assert observation in env.observation_space
        assert observation["touch"][0] == 1.0


def test_scene_can_be_chosen() -> None:
    env = make()
    _, info = env.reset(seed=1, options={"scene_seed": 17})
    assert info["scene_seed"] == 17
    _, other = env.reset(seed=1)
    assert other["scene_seed"] != 17


def test_straight_ahead_touches_and_the_gate_limits_it() -> None:
    """Full speed into the clutter: patches are seen, the gate acts, its limits hold."""
    env = make(scene="authors_sim", depth="contacts")
    observation, info = env.reset(seed=0, options={"scene_seed": 35})
    touched, rewards = [], 0.0
    for _ in range(200):
        ahead, left, _ = observation["goal"]
        action = np.array([ahead, left, 0.0], np.float32) / max(abs(ahead), abs(left))
        observation, reward, terminated, truncated, info = env.step(action)
        rewards += float(reward)
        speed = np.hypot(observation["arm"][4], observation["arm"][5])
        assert speed < 0.06
        if observation["patches"][0, 0] == 1.0:
            touched.append(observation)
        if terminated or truncated:
            break
    assert touched
    for seen in touched:
        forces = seen["patches"][:, 5]
        assert list(forces) == sorted(forces, reverse=True)
        assert seen["touch"][0] == 1.0
        assert seen["touch"][2] == pytest.approx(float(forces.sum()), rel=1e-4)
    assert info["interventions"]
    assert rewards != 0.0


def test_empty_cupboard_is_reached(tmp_path: Any) -> None:
    from sim_device.world.scenes import Pose, Scene

    path = tmp_path / "empty.json"
    scene = Scene("test", "authors_sim", 1, 0.375, 0.55, Pose(-0.2, 0.0, 0.0), (0.1, 0.0), ())
    path.write_text(scene.to_json())
    env = make(scene=str(path))
    env.reset(seed=0)
    rewards = 0.0
    for _ in range(300):
        observation, reward, terminated, truncated, info = env.step(np.array([1, 0, 0], np.float32))
        rewards += float(reward)
        assert not truncated
        if terminated:
            break
    assert info["reached"]
    assert 1.9 < rewards < 2.1  # the whole distance, and the goal
    assert observation["patches"].sum() == 0.0


def test_time_limit_truncates() -> None:
    env = make(overrides={"time_limit": 0.5})
    env.reset(seed=0)
    for step in range(5):
        _, _, terminated, truncated, _ = env.step(np.zeros(3, np.float32))
        assert not terminated
        assert truncated == (step == 4)


def test_vectorised_environments_give_the_same_results() -> None:
    """Vectorised over processes, it gives the same as one by one."""
    vector = gymnasium.make_vec(
        ID,
        num_envs=2,
        vectorization_mode="async",
        scene="hardware",
        vector_kwargs={"shared_memory": True},
    )
    observation, _ = vector.reset(seed=[3, 4])
    action = np.array([[1, 0, 0], [0.5, 0.5, 0]], np.float32)
    stepped = vector.step(action)
    for index, seed in enumerate((3, 4)):
        env = make()
        alone, _ = env.reset(seed=seed)
        assert same(alone, {key: value[index] for key, value in observation.items()})
        alone_stepped = env.step(action[index])
        assert same(alone_stepped[0], {key: value[index] for key, value in stepped[0].items()})
    vector.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"scene": "kitchen"}, "kitchen"),
        ({"parameters": "fast"}, "fast"),
        ({"overrides": {"speed": 3}}, "speed"),
    ],
)
def test_unknown_scene_or_parameter_is_named(options: dict[str, Any], said: str) -> None:
    env = make(**options)
    with pytest.raises(ValueError, match=said):
        env.reset(seed=0)


def test_step_before_reset_is_refused() -> None:
    from tactile_tools.gym import CupboardEnv

    with pytest.raises(RuntimeError, match="reset"):
        CupboardEnv("hardware").step(np.zeros(3, np.float32))
    with pytest.raises(ValueError, match="unknown depth"):
        CupboardEnv("hardware", "deep")  # type: ignore[arg-type]


def test_without_gymnasium_the_extra_is_named() -> None:
    code = (
        "import sys\nsys.modules['gymnasium'] = None\n"
        "try:\n import tactile_tools.gym\nexcept ImportError as e:\n print(e)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "tactile-reach[gym]" in done.stdout
