"""Parallel work in processes of this machine or on a cluster, with the same results as in one process.

A piece of work is a function of a module and its arguments. Each is run with one thread of BLAS and torch and
seeds its own random numbers, so that results have the same bits wherever they were computed.

On this machine joblib's processes (loky) run them, on a cluster the tasks of Ray or Dask, which are repeated
where a process or a machine is lost.
"""

import os
import pickle
import secrets
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import cloudpickle

from ...envs.engine.catalogue import FOUND_IN, on_path
from .rollout import Progress
from .threads import one_thread

RETRIES = 10
"""Number of times that Ray repeats a piece of work whose process is lost; Dask has its own setting, three."""
CLUSTER_PROCESSES = 16
"""Assumed number of processes of a remote cluster, to split work for it."""
NO_HTTP_ROUTES: dict[str, Any] = {
    f"distributed.{role}.http.routes": [] for role in ("scheduler", "worker", "nanny")
}
"""Dask's web servers show the work without authentication: these settings switch them off."""
CLUSTERS = "ray, ray://HOST:PORT, ray://auto, dask, tcp://HOST:PORT or tls://HOST:PORT"

Function = Callable[[Any, Progress], Any]
"""Function of a module from a piece of work and a progress callback to a result."""


class ImportPaths(NamedTuple):
    """Paths on which a process finds the modules and files of its pieces of work."""

    folder: str
    paths: list[str]
    named_in: list[str]
    """Folders of modules that the user has named, searched for these only."""
    safe_path: str | None
    """PYTHONSAFEPATH in the user's environment; this process sets it for the processes that it starts."""


Outcome = tuple[int, Any, tuple[Exception, str] | None, list[tuple[str, type[Warning]]]]
"""Number of a piece of work, its result, its error with the traceback, and its warnings."""


class LostProcessError(ValueError):
    """Error for a process that ended before its part of the work was finished."""


class Elsewhere(Exception):  # noqa: N818  (the cause of an error, not an error)
    """Traceback of an error in another process, shown as the cause of that error in this process."""


def end_with_parent(parent: int) -> None:
    """Start a thread that ends this process soon after its parent process, even if that is killed."""

    def watch() -> None:
        if sys.platform == "win32":
            from _winapi import SYNCHRONIZE, OpenProcess
            from multiprocessing.connection import wait

            wait([OpenProcess(SYNCHRONIZE, False, parent)])
        else:
            while os.getppid() == parent:
                time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _run_piece(index: int, packed: bytes, packed_item: bytes, paths: ImportPaths) -> Outcome:
    """Unpickle a function and its argument, and call it with the parent's import paths; return its outcome."""
    with suppress(OSError):  # another machine may not have it
        os.chdir(paths.folder)
    if paths.safe_path is None:  # competing programs run in the user's environment
        os.environ.pop("PYTHONSAFEPATH", None)
    # Engines search the working directory, too, unless this command does not.
    unwanted = {"", paths.folder} - set(paths.paths)
    sys.path[:] = [path for path in sys.path if path not in unwanted]
    sys.path.extend(path for path in paths.paths if path not in sys.path and Path(path).is_dir())
    with warnings.catch_warnings(record=True) as noted, one_thread():
        try:
            function = pickle.loads(packed)  # only now: its modules may lie on those paths
            with on_path(paths.named_in):
                item = pickle.loads(packed_item)
            result, failed = function(item, lambda measurements: None), None
        except Exception as error:
            result, failed = None, (_sendable(error), traceback.format_exc())
    return index, result, failed, [(str(warning.message), warning.category) for warning in noted]


def _sendable(error: Exception) -> Exception:
    """Return an error that can be pickled: the same one, or a RuntimeError with its text."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error.with_traceback(None)


def check_workers(workers: Any) -> "Workers":
    """Return the workers unchanged, for None those that use only this process; raise ValueError for other
    types.
    """
    if workers is not None and not isinstance(workers, Workers):
        raise ValueError(
            f"workers must be filtergym.evaluation.running.parallel.Workers, such as Workers(2), got {workers!r}"
        )
    return workers or Workers()


class Workers:
    """Processes that run pieces of work; ``with Workers(4) as workers`` ends them afterwards.

    Args:
        jobs: processes; 1: this one; -1: as many as there are cores.
        cluster: ``"ray"`` or ``"dask"``: a new one on this machine, closed to other users, with ``jobs`` processes,
            where that is more than one, or as many as there are cores. A running cluster: ``ray://HOST:PORT``;
            ``ray://auto``, that of this machine, started by any user; of Dask ``tls://HOST:PORT``, with the
            certificates of Dask's configuration, or ``tcp://HOST:PORT``, which is open to everybody who reaches the
            port. None: no cluster.

    Raises:
        ValueError: for invalid ``jobs`` or ``cluster``, or where the packages of a cluster are missing.
    """

    def __init__(self, jobs: int = 1, cluster: str | None = None) -> None:
        if jobs != -1 and jobs < 1:
            raise ValueError(f"jobs must be at least 1, or -1 for all cores, got {jobs}")
        self.engine: str = ""
        if cluster is not None:
            scheme, elsewhere, _ = cluster.partition("://")
            engines = (
                {"ray": "ray", "tcp": "dask", "tls": "dask"} if elsewhere else {"ray": "ray", "dask": "dask"}
            )
            if scheme not in engines:
                raise ValueError(f"cluster must be {CLUSTERS}, got {cluster!r}")
            self.engine = engines[scheme]
            if elsewhere and jobs != 1:
                raise ValueError("a cluster has as many processes as it has: leave out jobs")
        self.jobs = jobs
        self.cluster = cluster
        self.alone: bool = jobs == 1 and cluster is None
        """Whether this process does all of the work."""
        self._ended = ExitStack()
        self._dask: Any = None

    @property
    def width(self) -> int:
        """Number of pieces into which work is best divided: processes or cores, an assumed number for a remote
        cluster.
        """
        if self.alone:
            return 1
        if self.cluster is not None and "://" in self.cluster:
            return CLUSTER_PROCESSES
        return self._cores

    @property
    def _cores(self) -> int:
        if self.jobs not in (1, -1):
            return self.jobs
        import joblib

        return int(joblib.cpu_count())  # that this process may use

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.close()

    def run(
        self,
        function: Function,
        items: Sequence[Any],
        sizes: Sequence[int] | None = None,
        progress: Progress | None = None,
    ) -> Iterator[tuple[int, Any]]:
        """Call a function with each item, on all processes; yield number and result of each when it is finished.

        Args:
            function: function of a module, which workers import.
            items: its arguments.
            sizes: measurements of each piece, for the progress.
            progress: called with the number of measurements done; for work in other processes when a piece is done.

        Raises:
            ValueError: if a process is lost for good, or the cluster does not exist; and any error of the function.
        """
        tick = progress or (lambda measurements: None)
        if self.alone:
            for index, item in enumerate(items):
                with one_thread():
                    result = function(item, tick)
                yield index, result
            return
        paths = ImportPaths(os.getcwd(), list(sys.path), list(FOUND_IN), os.environ.get("PYTHONSAFEPATH"))
        packed = cloudpickle.dumps(function)
        calls = ((index, packed, cloudpickle.dumps(item), paths) for index, item in enumerate(items))
        spread = {"ray": self._over_ray, "dask": self._over_dask}.get(self.engine, self._over_processes)
        shown_warnings: set[tuple[str, type[Warning]]] = set()
        # New processes search no libraries in the working directory; :func:`_run_piece` sets their paths.
        with _environment(PYTHONSAFEPATH="1"):
            for number, result, failed, noted in spread(calls):
                for text, category in noted:
                    if (text, category) not in shown_warnings:
                        shown_warnings.add((text, category))
                        warnings.warn(text, category, stacklevel=2)
                if failed is not None:
                    raise failed[0] from Elsewhere(failed[1])
                if sizes is not None:
                    tick(sizes[number])
                yield number, result

    def results(
        self,
        function: Function,
        items: Sequence[Any],
        sizes: Sequence[int] | None = None,
        progress: Progress | None = None,
    ) -> list[Any]:
        """Call a function with each item on all processes; return the results in the order of the items."""
        found: list[Any] = [None] * len(items)
        for index, result in self.run(function, items, sizes, progress):
            found[index] = result
        return found

    def _over_processes(self, calls: Iterator[tuple[Any, ...]]) -> Iterator[Outcome]:
        import joblib
        from joblib.externals.loky.process_executor import TerminatedWorkerError
        from joblib.parallel import LokyBackend

        class Processes(LokyBackend):
            def configure(self, *given: Any, **options: Any) -> Any:
                own = {"initializer": end_with_parent, "initargs": (os.getpid(),)}
                return super().configure(*given, **own, **options)

        # Where an error or Ctrl-C ends the work early, the rest is cancelled.
        warnings.filterwarnings("ignore", message=".*tasks which were still being processed by the workers")
        try:
            with joblib.parallel_config(backend=Processes(), inner_max_num_threads=1):
                # Arrays are passed whole: those that joblib maps into memory could not be written to.
                pool = joblib.Parallel(
                    self.jobs, return_as="generator_unordered", batch_size=1, max_nbytes=None
                )
                yield from pool(joblib.delayed(_run_piece)(*call) for call in calls)
        except TerminatedWorkerError as error:
            raise LostProcessError(
                "a process that did part of the work was ended from outside, perhaps because memory ran out: take "
                "fewer jobs, or continue by the same command where it stores finished work"
            ) from error

    def _over_dask(self, calls: Iterator[tuple[Any, ...]]) -> Iterator[Outcome]:
        try:
            # Of the extra `cluster`, which no check of types installs, as ray below.
            import dask  # pyright: ignore[reportMissingImports]
            from distributed import (  # pyright: ignore[reportMissingImports]
                Client,
                KilledWorker,
                LocalCluster,
                Security,
                as_completed,
            )

            # Certificates that this process gives to its workers alone: other connections are rejected.
            begin = self._dask is None and self.cluster == "dask"
            security = Security.temporary() if begin else None
        except ImportError as error:
            raise _missing(error) from error
        if self._dask is None:
            where: Any = self.cluster
            try:
                if begin:
                    with dask.config.set(NO_HTTP_ROUTES):
                        where = LocalCluster(
                            n_workers=self._cores,
                            threads_per_worker=1,
                            processes=True,
                            dashboard_address=None,
                            protocol="tls://",
                            security=security,
                        )
                    self._ended.callback(where.close)
                self._dask = Client(where, timeout=30)
            except (OSError, ValueError) as error:
                raise ValueError(f"there is no cluster of Dask at {self.cluster}: {error}") from error
            self._ended.callback(self._dask.close)
        futures = [self._dask.submit(_run_piece, *call, pure=False) for call in calls]
        try:
            for future in as_completed(futures):
                yield future.result()
                future.release()  # a result is large, and is not needed any more
        except KilledWorker as error:
            raise ValueError(f"the cluster has lost a piece of work for good: {error}") from error
        finally:
            self._dask.cancel(futures)

    def _over_ray(self, calls: Iterator[tuple[Any, ...]]) -> Iterator[Outcome]:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no telemetry
        try:
            import ray  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise _missing(error) from error
        if not ray.is_initialized():
            try:
                self._begin_ray(ray)
            except (ConnectionError, OSError, ValueError, RuntimeError) as error:
                raise ValueError(f"there is no cluster of Ray at {self.cluster}: {error}") from error
            self._ended.callback(ray.shutdown)
        remote = ray.remote(num_cpus=1, max_retries=RETRIES)(_run_piece)
        pending: list[Any] = []
        try:
            yield from self._from_ray(ray, remote, calls, pending)
        finally:
            for reference in pending:  # where the work ends early
                ray.cancel(reference, force=True)

    @staticmethod
    def _from_ray(
        ray: Any, remote: Any, calls: Iterator[tuple[Any, ...]], pending: list[Any]
    ) -> Iterator[Outcome]:
        """Submit pieces of work to a Ray cluster and yield their outcomes; ``pending`` holds those submitted."""
        more = True
        while pending or more:
            # The cluster may grow meanwhile; two pieces for each core keep it busy.
            most = 2 * max(1, int(ray.cluster_resources().get("CPU", 1)))
            while more and len(pending) < most:
                call = next(calls, None)
                more = call is not None
                if call is not None:
                    pending.append(remote.remote(*call))
            if pending:
                ready, pending[:] = ray.wait(pending, num_returns=1)
                try:
                    yield from ray.get(ready)
                except ray.exceptions.RayError as error:
                    reason = str(error).strip().splitlines()[0]
                    raise ValueError(f"the cluster has lost a piece of work for good: {reason}") from error

    def _begin_ray(self, ray: Any) -> None:
        quiet = {"log_to_driver": False, "logging_level": "error"}
        if self.cluster != "ray":
            ray.init("auto" if self.cluster == "ray://auto" else self.cluster, **quiet)
            return
        # A new one, even if another runs. Since 2.59 Ray requires a token; without this one it would write one to a
        # file that other users may be able to read.
        if "RAY_AUTH_TOKEN_PATH" not in os.environ:
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        ray.init("local", num_cpus=self._cores, include_dashboard=False, **quiet)


@contextmanager
def _environment(**variables: str) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _missing(error: ImportError) -> ValueError:
    return ValueError(f"a cluster needs more packages: pip install 'filtergym[cluster]' ({error})")
