"""What all tests share: property tests draw the same examples every time, unless told otherwise."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import settings

from reachd.interfaces import ArmState, Touch, Twist
from reachd.strategies.parameters import SETS
from tactile_core.bus.runtime import RUNTIME_VARIABLE
from tactile_core.geometry import Side
from tactile_core.types import Instant

# A red `make test` must be red again when it is looked into. `make test-random` draws new examples
# and prints how to get a failing one again.
settings.register_profile("same", derandomize=True, deadline=None, database=None)
settings.register_profile("random", deadline=None, database=None, print_blob=True)
settings.load_profile("same")

T0 = Instant(5_000_000_000)


@pytest.fixture(scope="session", autouse=True)
def own_runtime_folder() -> Iterator[None]:
    """Locks and sockets of this process's rigs, apart from those of other tests and of users.

    In the system's folder of temporary files, because the path of a socket must be short.
    """
    with (
        tempfile.TemporaryDirectory(prefix="tactile-test-") as folder,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv(RUNTIME_VARIABLE, folder)
        yield


@pytest.fixture
def fresh_seed(request: pytest.FixtureRequest) -> int:
    """A seed: the same in ``make test``, another each time in ``make test-random``."""
    if request.config.getoption("--hypothesis-profile") != "random":
        return 0
    seed = random.SystemRandom().randrange(1 << 30)
    print("seed", seed)
    return seed


Edit = Callable[[str, int, Any], Iterable[tuple[str, int, Any]]]


def _when(row: tuple[Any, ...]) -> tuple[int, int]:
    return row[0], row[1]


@pytest.fixture(scope="session")
def make_touch() -> Callable[..., Touch]:
    """Valid touch without contact at ``at``, with values replaced as given."""

    def make(at: Instant = T0, **values: Any) -> Touch:
        calm = Touch(at, at, True, 0.0, Side.NONE, 0.0, 0.0, 0.0, 0.0)
        return replace(calm, **values)

    return make


@pytest.fixture(scope="session")
def make_arm() -> Callable[..., ArmState]:
    """Arm at rest in front of the cupboard at ``at``, with the hardware set's limits."""

    def make(at: Instant = T0, **values: Any) -> ArmState:
        limits = SETS["hardware"].safety.arm_limits
        calm = ArmState(
            captured=at,
            received=at,
            x=-0.2,
            y=0.0,
            heading=0.0,
            twist=Twist(0.0, 0.0, 0.0),
            fx=0.0,
            fy=0.0,
            mz=0.0,
            mode="ready",
            v_max=limits.v_max,
            omega_max=limits.omega_max,
            f_max=limits.f_max,
            m_max=limits.m_max,
        )
        return replace(calm, **values)

    return make
