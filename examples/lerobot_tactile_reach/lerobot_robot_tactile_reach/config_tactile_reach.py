"""Configuration of the wrapping robot."""

from dataclasses import dataclass, field

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("tactile_reach")
@dataclass(kw_only=True)
class TactileReachConfig(RobotConfig):
    """Configuration of `TactileReach`.

    ``boards``: number of taxels of each board by name, 0 for the sums alone. ``robot``: the wrapped
    robot, None for touch alone. ``connect``: zenoh endpoints of tactiled, empty for those of this
    machine. ``keys``: folder of keys of a rig with certificates. ``max_age_s``: age from which
    touch is not valid. ``wait_s``: how long to wait for each board when connecting.
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
