"""The cupboard as a Gymnasium environment: ``gymnasium.make("tactile_tools.gym:Cupboard-v0")``."""

from __future__ import annotations

try:
    import gymnasium
except ImportError as error:
    raise ImportError("tactile_tools.gym needs `pip install 'tactile-reach[gym]'`") from error

from tactile_tools.gym.env import CupboardEnv

__all__ = ["ENVIRONMENT", "CupboardEnv"]

ENVIRONMENT = "Cupboard-v0"

if ENVIRONMENT not in gymnasium.registry:  # imported under another name
    gymnasium.register(id=ENVIRONMENT, entry_point="tactile_tools.gym.env:CupboardEnv")
