"""Run ``simdevice`` as ``python -m sim_device``."""

from __future__ import annotations

import sys

from sim_device.cli import main

sys.exit(main())
