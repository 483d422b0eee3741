"""Python interface to the skin for your own programs.

    import tactile_reach as tr

    with tr.connect() as bus:
        for f in bus.board("left").features():
            print(f.normal_force)

`connect` joins the daemons of this machine. `Bus.board` gives access to one board: newest values,
streams, tare, recording. `Bus.reach` gives goals; `read_log` reads a log into arrays. Errors are
`TactileError`, whose text is one sentence that names the remedy.
"""

from __future__ import annotations

from tactile_reach.client import (
    Board,
    Bus,
    NotThereError,
    Reach,
    RefusedError,
    SilentError,
    Stream,
    TactileError,
    connect,
)
from tactile_reach.log import Log, Table, read_log
from tactile_reach.values import (
    Ambient,
    Arm,
    ArrayLayout,
    Features,
    Field,
    Forces,
    Geometry,
    Patch,
    ReachState,
)

__all__ = [
    "Ambient",
    "Arm",
    "ArrayLayout",
    "Board",
    "Bus",
    "Features",
    "Field",
    "Forces",
    "Geometry",
    "Log",
    "NotThereError",
    "Patch",
    "Reach",
    "ReachState",
    "RefusedError",
    "SilentError",
    "Stream",
    "Table",
    "TactileError",
    "connect",
    "read_log",
]
