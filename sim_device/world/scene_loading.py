"""Scenes by the names a user gives."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from sim_device.world.recorded_scenes import RECORDED, load_recorded
from sim_device.world.scene_generation import GENERATORS, generate
from sim_device.world.scenes import Scene, SceneError

FILE_PREFIX: Final = "recorded:"

RECORDED_SCENES: Final = "scenes_1_60.json.gz"
RECORDED_OUTCOMES: Final = "outcomes_1_60.csv"
"""Files of the sixty scenes recorded in the authors' simulator, and of the outcomes in them.

They are not part of this repository: nobody has published them under a licence."""

FOLDER_VARIABLE: Final = "TACTILE_SCENES_DIR"
"""Environment variable that names their folder."""

_BESIDE_CHECKOUT = Path(__file__).resolve().parents[3] / "shared" / "data" / "authors_scenes"

MAX_SCENE_BYTES: Final = 1 << 20
"""Largest scene file: a scene of 200 objects, the maximum, takes 50 kB of JSON."""


def load_scene(name: str, seed: int) -> Scene:
    """Scene ``seed`` of ``name``.

    ``name``: a generator, ``authors_sim_recorded`` or ``recorded:FILE.json.gz`` (``seed`` is the
    scene's number there), or ``FILE.json``, which is one scene whatever the seed. SceneError or
    ValueError lists what is available; RuntimeError if a generator cannot place its objects.
    """
    if name in GENERATORS:
        return generate(name, seed)
    if name == RECORDED:
        return _recorded(find_recorded(RECORDED_SCENES), seed)
    if name.startswith(FILE_PREFIX):
        return _recorded(Path(name.removeprefix(FILE_PREFIX)), seed)
    path = Path(name)
    if path.suffix == ".json":
        return _from_file(path)
    known = ", ".join([*sorted(GENERATORS), RECORDED, f"{FILE_PREFIX}FILE.json.gz"])
    raise SceneError(f"no scenes are called {name!r}; allowed: {known}, FILE.json")


def find_recorded(name: str) -> Path:
    """Path of ``name``, a file of the recorded scenes; SceneError says where to put it.

    Searched in the folder that `FOLDER_VARIABLE` names; if it is not set, in the user's data
    folder, then beside the checkout.
    """
    configured = os.environ.get(FOLDER_VARIABLE)
    data = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    home = data / "tactile-reach" / "authors_scenes"
    folders = [Path(configured)] if configured else [home, _BESIDE_CHECKOUT]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise SceneError(
        f"{name} is not in {folders[0]}: the scenes recorded in the authors' simulator are not "
        f"part of this repository; put {RECORDED_SCENES} and {RECORDED_OUTCOMES} there, or name "
        f"their folder with {FOLDER_VARIABLE}"
    )


def _recorded(path: Path, seed: int) -> Scene:
    scenes = {scene.seed: scene for scene in load_recorded(path)}
    if seed not in scenes:
        there = f"{min(scenes)} to {max(scenes)}" if scenes else "none"
        raise SceneError(f"no recorded scene {seed}: {path.name} has {there}; choose with --seed")
    return scenes[seed]


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
