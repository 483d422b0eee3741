"""What all tests share: property tests draw the same examples every time, unless told otherwise."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from mcap.reader import make_reader
from mcap.writer import Writer

from tactile_core.bus.messages import codec

# A red `make test` must be red again when it is looked into. `make test-random` draws new examples
# and prints how to get a failing one again.
settings.register_profile("same", derandomize=True, deadline=None, database=None)
settings.register_profile("random", deadline=None, database=None, print_blob=True)
settings.load_profile("same")


@pytest.fixture
def fresh_seed(request: pytest.FixtureRequest) -> int:
    """A seed: the same in ``make test``, another each time in ``make test-random``."""
    if request.config.getoption("--hypothesis-profile") != "random":
        return 0
    seed = random.SystemRandom().randrange(1 << 30)
    print("seed", seed)
    return seed


Edit = Callable[[str, int, Any], Iterable[tuple[str, int, Any]]]


@pytest.fixture(scope="session")
def rewrite() -> Callable[[Path, Path, Edit], Path]:
    """``rewrite(log, out, edit)``: what ``edit(topic, log ns, message)`` yields of each message."""

    def write(source: Path, out: Path, edit: Edit) -> Path:
        with source.open("rb") as reading, out.open("wb") as writing:
            writer = Writer(writing)
            writer.start("ros2", "test")
            schemas: dict[str, int] = {}
            channels: dict[str, int] = {}
            rows = []
            for schema, channel, message in make_reader(reading).iter_messages():
                assert schema is not None
                decoded = codec().decode(schema.name, message.data)
                for topic, log_ns, changed in edit(channel.topic, message.log_time, decoded):
                    data = codec().encode(schema.name, changed)
                    rows.append((log_ns, len(rows), topic, schema, data))
            for number, (log_ns, _, topic, schema, data) in enumerate(sorted(rows, key=_when)):
                if schema.name not in schemas:
                    schemas[schema.name] = writer.register_schema(
                        schema.name, schema.encoding, schema.data
                    )
                if topic not in channels:
                    channels[topic] = writer.register_channel(topic, "cdr", schemas[schema.name])
                writer.add_message(channels[topic], log_ns, data, log_ns, number)
            writer.finish()
        return out

    return write


def _when(row: tuple[Any, ...]) -> tuple[int, int]:
    return row[0], row[1]
