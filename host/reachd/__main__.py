"""``python -m reachd``."""

import sys

from reachd.cli import main

sys.exit(main())
