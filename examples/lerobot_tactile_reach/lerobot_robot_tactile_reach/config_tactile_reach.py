"""Configuration of the wrapper."""

from dataclasses import dataclass, field

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("tactile_reach")
@dataclass(kw_only=True)
class TactileReachConfig(RobotConfig):
    """``boards``: taxels of each board by its name, 0 for sums alone. ``robot``: what is wrapped.

    ``connect``: zenoh endpoints of tactiled, empty for this machine's own. ``keys``: folder of keys
    of a rig with certificates. ``max_age_s``: age from which touch is not valid. ``wait_s``: how
    long to wait for each board when connecting.
    """

    boards: dict[str, int] = field(default_factory=dict)
    robot: RobotConfig | None = None
    connect: list[str] = field(default_factory=list)
    keys: str | None = None
    max_age_s: float = 0.2
    wait_s: float = 5.0

    def __post_init__(self) -> None:
        """Refuse a configuration without boards."""
        super().__post_init__()
        if not self.boards:
            raise ValueError("boards is empty: name at least one, such as {left: 5}")
