"""What all tests share: property tests draw the same examples every time, unless told otherwise."""

from __future__ import annotations

from hypothesis import settings

# A red `make test` must be red again when it is looked into. `make test-random` draws new examples
# and prints how to get a failing one again.
settings.register_profile("same", derandomize=True, deadline=None, database=None)
settings.register_profile("random", deadline=None, database=None, print_blob=True)
settings.load_profile("same")
