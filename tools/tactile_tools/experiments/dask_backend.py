"""Run trials on a Dask cluster of one or more machines."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from types import TracebackType
from typing import Any, Self

from tactile_tools.experiments.backends import BackendError, batches
from tactile_tools.experiments.rows import Row
from tactile_tools.experiments.spec import TrialSpec

BATCH = 5
"""Trials in a task: a scene's five strategies. If its worker is lost, the task runs again."""

AHEAD = 2
"""Tasks submitted per thread of the cluster: no thread waits, and few tasks are lost at an end."""

CONNECT_S = 10.0
"""Seconds to wait for the scheduler."""


class DaskCluster:
    """Workers of the scheduler at ``address``, however many come and go."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._client: Any = None

    def __enter__(self) -> Self:
        """Connect; BackendError."""
        try:
            from distributed import Client
        except ImportError as error:
            raise BackendError(
                "--dask needs Dask: pip install 'tactile-reach[dask]', here and on the workers"
            ) from error
        try:
            self._client = Client(self._address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise BackendError(
                f"no Dask scheduler at {self._address} ({error}): start `dask scheduler` there, or "
                "leave --dask out"
            ) from error
        try:
            self._check()
        except BackendError:
            self._client.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Disconnect; the scheduler drops tasks that nobody waits for."""
        if self._client is not None:
            self._client.close()

    @property
    def workers(self) -> int:
        """Number of threads of the cluster now."""
        return max(1, sum(int(n) for n in self._client.nthreads().values()))

    def run(self, specs: Sequence[TrialSpec]) -> Iterator[Row]:
        """Rows of ``specs`` as they are finished, in any order; BackendError."""
        from distributed import as_completed

        waiting = deque(batches(specs, BATCH))
        asked: dict[Any, list[TrialSpec]] = {}
        suspects: deque[TrialSpec] = deque()
        done = as_completed([], loop=self._client.loop)
        try:
            while waiting or asked or suspects:
                while waiting and len(asked) < AHEAD * self.workers:
                    batch = waiting.popleft()
                    future = self._submit(batch)
                    asked[future] = batch
                    done.add(future)
                if asked:
                    future = next(done)
                    yield from self._rows_of(future, asked.pop(future), suspects)
                else:
                    yield self._run_alone(suspects.popleft())
        except OSError as error:
            raise self._scheduler_gone(error) from error

    def _submit(self, batch: Sequence[TrialSpec]) -> Any:
        from tactile_tools.experiments.trial import run_batch

        # Not pure: a trial requested again, or by another run, must run again.
        return self._client.submit(run_batch, list(batch), pure=False)

    def _rows_of(
        self, future: Any, batch: list[TrialSpec], suspects: deque[TrialSpec]
    ) -> Iterator[Row]:
        """Rows of a task that ended; if its workers died, its trials become suspects."""
        if self._died(future):
            suspects.extend(batch)
        else:
            yield from future.result()

    def _run_alone(self, spec: TrialSpec) -> Row:
        """Row of a suspect, run while nothing else runs that could kill its worker."""
        from distributed import wait

        from tactile_tools.experiments.trial import lost_row

        future = self._submit([spec])
        with self._client.as_current():
            wait(future)
        if self._died(future):
            return lost_row(spec, "the Dask workers that ran it died, one after another")
        row: Row = future.result()[0]
        return row

    def _died(self, future: Any) -> bool:
        """Whether a task ended because its workers died, of it or of its neighbours.

        BackendError if it ended otherwise, but without its rows.
        """
        from distributed.scheduler import KilledWorker

        if future.status == "finished":
            return False
        if future.status in ("lost", "cancelled"):
            raise self._scheduler_gone(future.status)
        error = future.exception()
        if isinstance(error, KilledWorker):
            return True
        raise BackendError(
            f"a worker of {self._address} cannot run trials: {type(error).__name__}: {error}"
        )

    def _check(self) -> None:
        """Check that every worker has this version of the software; BackendError."""
        try:
            found: dict[str, str] = self._client.run(version, "tactile-reach", on_error="return")
        except OSError as error:
            raise self._scheduler_gone(error) from error
        if not found:
            raise BackendError(
                f"the scheduler at {self._address} has no workers: start `dask worker "
                f"{self._address}`"
            )
        here = version("tactile-reach")
        for worker, there in found.items():
            if there != here:
                what = f"has version {there}" if isinstance(there, str) else f"has none ({there!r})"
                raise BackendError(
                    f"the worker {worker} {what} of tactile-reach, this machine {here}: install "
                    "the same everywhere"
                )

    def _scheduler_gone(self, why: object) -> BackendError:
        return BackendError(
            f"the Dask scheduler at {self._address} is gone ({why}); finished trials are kept, "
            "and the same command runs the rest"
        )
