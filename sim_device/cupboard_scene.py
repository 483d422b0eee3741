"""Scenes as a user names them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sim_device.world.generate import GENERATORS, generate
from sim_device.world.recorded import load_recorded
from sim_device.world.scenes import Scene, SceneError

RECORDED_PREFIX = "recorded:"

MAX_SCENE_BYTES = 1 << 20
"""A scene of 200 objects, the most there may be, takes 50 kB of JSON."""


@dataclass(frozen=True, slots=True)
class SceneSource:
    """Scenes as a user names them: a generator, a JSON file, or ``recorded:N``.

    ``recorded``: file of the recorded scenes. SceneError from `load` for all that cannot be.
    """

    name: str
    recorded: Path

    def load(self, seed: int) -> Scene:
        """Scene for ``seed``; a file and ``recorded:N`` have but the one."""
        if self.name in GENERATORS:
            try:
                return generate(self.name, seed)
            except RuntimeError as error:
                raise SceneError(f"{self.name}: {error}; take another seed") from error
        if self.name.startswith(RECORDED_PREFIX):
            return self._recorded(self.name.removeprefix(RECORDED_PREFIX))
        path = Path(self.name)
        if path.suffix == ".json":
            return _from_file(path)
        known = ", ".join(sorted(GENERATORS))
        raise SceneError(
            f"scene {self.name!r} given; allowed: {known}, FILE.json, or {RECORDED_PREFIX}N"
        )

    def reseeded(self, seed: int) -> Scene:
        """Scene for another seed; of the recorded ones, that of this seed. SceneError: no such."""
        if self.name in GENERATORS:
            return self.load(seed)
        if self.name.startswith(RECORDED_PREFIX):
            return self._recorded(str(seed))
        raise SceneError(f"{self.name} is one scene; only generators and recorded:N have seeds")

    def _recorded(self, text: str) -> Scene:
        scenes = {scene.seed: scene for scene in load_recorded(self.recorded)}
        if not text.isdecimal() or int(text) not in scenes:
            seeds = f"{min(scenes)} to {max(scenes)}" if scenes else "none"
            raise SceneError(f"recorded scene {text!r} given; {self.recorded.name} has {seeds}")
        return scenes[int(text)]


def _from_file(path: Path) -> Scene:
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_SCENE_BYTES + 1)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror})") from error
    if len(data) > MAX_SCENE_BYTES:
        raise SceneError(f"{path}: longer than {MAX_SCENE_BYTES} bytes, so no scene")
    try:
        return Scene.from_json(data.decode("utf-8"))
    except UnicodeDecodeError:
        raise SceneError(f"{path}: not UTF-8 text, so no scene") from None
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None
