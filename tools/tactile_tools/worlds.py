"""Scenes by the names a user gives."""

from __future__ import annotations

from pathlib import Path

from sim_device.world.generate import generate
from sim_device.world.recorded import load_recorded
from sim_device.world.scenes import Scene, SceneError

RECORDED = "recorded:"


def load_scene(source: str, seed: int) -> Scene:
    """Scene ``seed`` of a generator or of ``recorded:FILE.json.gz``, or the one in ``FILE.json``.

    ValueError that says what there is.
    """
    if source.startswith(RECORDED):
        path = Path(source.removeprefix(RECORDED))
        scenes = {scene.seed: scene for scene in load_recorded(path)}
        if seed not in scenes:
            raise SceneError(
                f"{path} has no scene {seed}; it has {min(scenes)} to {max(scenes)}: set --seed"
            )
        return scenes[seed]
    if source.endswith(".json"):
        try:
            return Scene.from_json(Path(source).read_text(encoding="utf-8"))
        except OSError as error:
            raise SceneError(f"cannot read the scene {source}: {error.strerror}") from error
        except (SceneError, UnicodeDecodeError) as error:
            raise SceneError(f"{source} is no scene: {error}") from error
    return generate(source, seed)
