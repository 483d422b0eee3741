"""Write a header with the field of the simulator's skin under known presses, for the C board.

    python tests/sensor_proto/c/field_table.py field_table.h truth.json

The header holds the field at each chip of finger number 0, 20 times a second for 16 s, repeated;
the other file holds the true forces at those instants.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from sim_device.board.catalogue import build_skin, identity
from sim_device.board.firmware import Registers
from sim_device.skin.elastomer import Contact
from sim_device.skin.environment import Environment

FRAME_MS = 50
FRAMES = 320
TEMPERATURE_C = 25.0
FORCES_N = (2.0, 4.0, 3.0)


def press(ms: float) -> float:
    """Force in N on the left side: 6 s at rest, three presses of 2 s with 0.5 s ramps, rest."""
    for number, force in enumerate(FORCES_N):
        t = ms / 1000 - 6.0 - 3.0 * number
        if 0 <= t <= 2.0:
            return force * min(1.0, t / 0.5, (2.0 - t) / 0.5)
    return 0.0


def write(header: Path, truth: Path, seed: int = 0) -> None:
    """Write both files for the finger number ``seed``."""
    skin = build_skin("finger", seed)
    around = Environment(temperature=lambda _: TEMPERATURE_C).at(0.0)
    left = skin.geometry.slices[0]
    middle = skin.geometry.arrays[0].position.mean(axis=0)
    inward = -skin.geometry.arrays[0].rotation[0][:, 2]
    field, forces = [], []
    for frame in range(FRAMES):
        force = press(frame * FRAME_MS)
        contacts = [Contact(middle, inward * force, 5e-3)] if force else []
        on_taxels = skin.taxel_force(contacts)
        moved = skin.elastomer.load(on_taxels, FRAME_MS / 1000)
        field.append(np.rint(1000 * skin.field_ut(moved, around)).astype(np.int64))
        forces.append(float(-on_taxels[left, 2].sum()))
    arrays = Registers(skin, 100.0).arrays()
    rows = ",\n".join(
        "{" + ",".join("{" + ",".join(map(str, chip)) + "}" for chip in now) + "}" for now in field
    )
    entries = ", ".join(
        f'{{"{a.name}", 1, {a.rows}, {a.columns}, {a.pitch_um}, {a.lsb_xy_nt}, {a.lsb_z_nt}}}'
        for a in arrays
    )
    unique = ", ".join(str(b) for b in identity("finger", seed).unique_id)
    header.write_text(
        f"""/* Written by field_table.py. */
#define REFERENCE_ARRAYS {len(arrays)}
#define REFERENCE_CHIPS {skin.geometry.taxels}
#define REFERENCE_ARRAY_CHIPS {max(a.taxels for a in arrays)}
#define REFERENCE_FRAME_MS {FRAME_MS}
#define REFERENCE_FRAMES {FRAMES}
#define REFERENCE_CC {round(100 * TEMPERATURE_C)}
#define REFERENCE_MODEL "finger"
#include <stdint.h>
#define REFERENCE_ENTRIES {entries}
static const uint8_t reference_id[8] = {{{unique}}};
static const int32_t reference_field_nt[{FRAMES}][{skin.geometry.taxels}][3] = {{
{rows}}};
""",
        encoding="ascii",
    )
    truth.write_text(json.dumps({"frame_ms": FRAME_MS, "left_n": forces}), encoding="ascii")


if __name__ == "__main__":
    write(Path(sys.argv[1]), Path(sys.argv[2]))
