"""``python -m sim_device`` is ``simdevice``."""

from __future__ import annotations

import sys

from sim_device.cli import main

sys.exit(main())
