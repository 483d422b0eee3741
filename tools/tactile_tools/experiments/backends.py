"""Backends that run the trials: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Protocol, Self

from tactile_tools.experiments.rows import Row
from tactile_tools.experiments.spec import TrialSpec

Batch = Sequence[TrialSpec]
"""Trials that one worker runs one after another, of the same scene where possible."""

BATCH = 10
"""Trials in a batch: enough that a scene, which costs as much as a trial, is made only once."""

ATTEMPTS = 2
"""Workers that may die of one trial before it is given up: the first may have been bad luck."""

MAX_DEATHS_IN_A_ROW = 20
"""Workers that may die in succession, without a row in between, before the run is given up."""

_WORKER_ENVIRONMENT = {
    # Linear algebra uses one thread: the other workers use the other cores.
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # glibc's threshold otherwise rises with the first physics engine that is freed. After that
    # each engine comes from the heap, which fragments: 7 MB in 1,000 trials.
    "MALLOC_MMAP_THRESHOLD_": str(1 << 20),
}
"""Environment of the workers; it must be set when they start."""


class BackendError(Exception):
    """Trials cannot be run; the message says why and what to do."""


class Backend(Protocol):
    """Runs trials. A context manager; leaving it ends what still runs."""

    def __enter__(self) -> Self:
        """Start; BackendError."""
        ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End all that still runs."""
        ...

    @property
    def workers(self) -> int:
        """How many trials run at a time."""
        ...

    def run(self, specs: Sequence[TrialSpec]) -> Iterator[Row]:
        """Rows of ``specs`` as they are finished, in any order; BackendError."""
        ...


def batches(specs: Sequence[TrialSpec], size: int) -> list[list[TrialSpec]]:
    """``specs``, which are sorted by scene, in batches of one scene."""
    made: list[list[TrialSpec]] = []
    scene = None
    for spec in specs:
        here = (spec.source, spec.scene_seed)
        if not made or here != scene or len(made[-1]) == size:
            made.append([])
            scene = here
        made[-1].append(spec)
    return made


class _Worker:
    """A process, and the trials it has been given."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_serve, args=(theirs,), daemon=True)
        self.process.start()
        theirs.close()
        self.asked: deque[TrialSpec] = deque()

    def ask(self, batch: Batch) -> None:
        """Send it ``batch``. If it has died, that is noticed when its answer is awaited."""
        self.asked.extend(batch)
        try:
            self.pipe.send(list(batch))
        except OSError:
            return

    def end(self) -> None:
        """Kill it: it holds nothing worth keeping."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


class Processes:
    """Runs trials in ``jobs`` processes of this machine. One that dies costs only its trial."""

    def __init__(self, jobs: int) -> None:
        self.workers = jobs
        self._workers: list[_Worker] = []

    def __enter__(self) -> Self:
        """Start nothing yet: processes are started as they are needed."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.end()
        self._workers.clear()

    def run(self, specs: Sequence[TrialSpec]) -> Iterator[Row]:
        """Rows of ``specs`` as they are finished, in any order; BackendError."""
        # Small batches when there is little to do, so that no worker waits long for the last one.
        size = max(1, min(BATCH, len(specs) // (4 * self.workers)))
        waiting = deque(batches(specs, size))
        deaths: dict[TrialSpec, int] = {}
        while len(self._workers) < min(self.workers, len(waiting)):
            self._workers.append(_start_worker())
        idle = list(self._workers)
        deaths_in_a_row = 0
        while True:
            while idle and waiting:
                idle.pop().ask(waiting.popleft())
            busy = {worker.pipe: worker for worker in self._workers if worker.asked}
            if not busy:
                return
            for pipe in wait(list(busy)):
                assert isinstance(pipe, Connection)
                worker = busy[pipe]
                try:
                    row: Row = pipe.recv()
                except (EOFError, OSError):
                    deaths_in_a_row += 1
                    yield from self._handle_death(worker, waiting, deaths)
                    if deaths_in_a_row == MAX_DEATHS_IN_A_ROW:
                        raise BackendError(
                            f"{MAX_DEATHS_IN_A_ROW} worker processes in a row died "
                            f"({_cause_of_death(worker.process)}); is there enough memory? "
                            "Finished trials are kept, and the same command runs the rest"
                        ) from None
                    self._workers.remove(worker)
                    self._workers.append(_start_worker())
                    idle.append(self._workers[-1])
                    continue
                deaths_in_a_row = 0
                worker.asked.popleft()
                if not worker.asked:
                    idle.append(worker)
                yield row

    def _handle_death(
        self, worker: _Worker, waiting: deque[list[TrialSpec]], deaths: dict[TrialSpec, int]
    ) -> Iterator[Row]:
        """Requeue what a dead worker did not do; a trial that killed two workers is lost."""
        worker.end()
        killer = worker.asked[0]
        rest = list(worker.asked)[1:]
        deaths[killer] = deaths.get(killer, 0) + 1
        if rest:
            waiting.appendleft(rest)
        if deaths[killer] < ATTEMPTS:
            waiting.appendleft([killer])
            return
        from tactile_tools.experiments.trial import lost_row

        cause = _cause_of_death(worker.process)
        yield lost_row(killer, f"the process that ran it died ({cause}), {ATTEMPTS} times")


def _cause_of_death(process: BaseProcess) -> str:
    """How a process died."""
    code = process.exitcode or 0
    return signal.Signals(-code).name if code < 0 else f"exit code {code}"


def _start_worker() -> _Worker:
    """Start a worker with its own environment."""
    before = {name: os.environ.get(name) for name in _WORKER_ENVIRONMENT}
    os.environ.update(_WORKER_ENVIRONMENT)
    try:
        return _Worker()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(pipe: Connection) -> None:
    """Main loop of a worker: batches in, rows out one by one, until the other end is gone."""
    # Ctrl-C reaches the whole group; the parent decides when its workers end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from tactile_tools.experiments.trial import run_one

    try:
        while True:
            for spec in pipe.recv():
                pipe.send(run_one(spec))
    except (EOFError, OSError):
        return
