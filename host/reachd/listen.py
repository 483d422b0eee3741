"""Everything that is said on the bus about a trial, into the log as it came."""

from __future__ import annotations

import zenoh

from tactile_bus.instant import WallClock, monotonic_now
from tactile_bus.recorder import Recorder
from tactile_bus.streams import BusSample, Tap
from tactile_bus.topics import ARM_STATE, NAME, TF, WORLD, find_topic, service_key

MAX_NAMES = 16
"""Names of streams that are logged: a board's, an arm's and a world's, and some to spare; so that
a publisher that makes up names cannot fill the log with channels."""

ANSWER = 5.0
"""s for which an answer of the board may come."""


class Listener:
    """Logs all streams of ``board``, the state of ``arm``, frames, and every world's objects.

    ``refused``: samples of topics or names that are not logged.
    """

    def __init__(
        self, session: zenoh.Session, recorder: Recorder, wall: WallClock, board: str, arm: str
    ) -> None:
        self.refused = 0
        self._session = session
        self._geometry = service_key(board, "geometry")
        self._asked = False
        self._recorder = recorder
        self._wall = wall
        self._names: set[str] = set()
        keys = (
            f"tactile/{board}/*",
            ARM_STATE.key(arm),
            TF.template,
            WORLD.template.format(name="*"),
        )
        self._taps = [Tap(session, key, self._take) for key in keys]

    def ask_geometry(self) -> None:
        """Have the board's geometry published once more, for it was before this began to listen.

        To be called when features come, so that the board can be asked. Nobody waits for the
        answer; a second call does nothing.
        """
        if not self._asked:
            self._asked = True
            self._session.get(self._geometry, lambda _: None, timeout=ANSWER)

    def close(self) -> None:
        """Stop listening."""
        for tap in self._taps:
            tap.close()

    def _take(self, sample: BusSample) -> None:
        found = find_topic(sample.key)
        if found is None or not self._known(found[1]):
            self.refused += 1
            return
        topic, name = found
        now_ns = self._wall.wall_ns(monotonic_now())
        stamp_ns = now_ns if sample.wall_ns is None else sample.wall_ns
        self._recorder.write(topic, name, sample.data, now_ns, stamp_ns)

    def _known(self, name: str) -> bool:
        if name in self._names:
            return True
        if len(self._names) >= MAX_NAMES or not NAME.fullmatch(name):
            return False
        self._names.add(name)
        return True
