"""Where tasks run: in this process, on this machine's cores (joblib), or on many machines (Ray).

    for result in run_tasks(work, tasks, backend="joblib", workers=4): ...

Results come in the order of the tasks, and only a few tasks are under way at a time, so that memory
does not grow with their number. `work` and what it takes must pickle and must not depend on where
it runs; then the results are the same bit for bit.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Literal, TypeVar

Backend = Literal["serial", "joblib", "ray"]
TaskType = TypeVar("TaskType")
Result = TypeVar("Result")

# Tasks under way per worker: one that runs, one that waits for it.
_AHEAD = 2
_ROOT = Path(__file__).parents[1]


def run_tasks(
    work: Callable[[TaskType], Result],
    tasks: Iterable[TaskType],
    *,
    backend: Backend,
    workers: int,
    address: str | None = None,
) -> Iterator[Result]:
    """The result of each task, in their order.

    address: of a running Ray cluster; None starts one on this machine. Raises ValueError where
    there are no workers or Ray is not installed.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    if backend == "ray":
        return _run_on_ray(work, tasks, workers, address)
    if backend == "joblib":
        return _run_on_cores(work, tasks, workers)
    return map(work, tasks)


def _run_on_cores(
    work: Callable[[TaskType], Result], tasks: Iterable[TaskType], workers: int
) -> Iterator[Result]:
    from joblib import Parallel, delayed

    failed: list[Exception] = []

    def guarded() -> Iterator[TaskType]:
        # joblib asks for tasks in a thread of its own, where an error would be lost.
        try:
            yield from tasks
        except Exception as error:  # noqa: BLE001
            failed.append(error)

    parallel = Parallel(
        n_jobs=workers, return_as="generator", batch_size=1, pre_dispatch=_AHEAD * workers
    )
    yield from parallel(delayed(work)(task) for task in guarded())
    if failed:
        raise failed[0]


def _run_on_ray(
    work: Callable[[TaskType], Result],
    tasks: Iterable[TaskType],
    workers: int,
    address: str | None,
) -> Iterator[Result]:
    # Workers elsewhere get the code of this checkout; they need the same packages as here.
    packages = {"ridetune", work.__module__.partition(".")[0]}
    ray = _start_ray(workers, address, sorted(packages))
    try:
        remote = ray.remote(work)
        waiting: deque[Any] = deque()
        for task in tasks:
            waiting.append(remote.remote(task))
            if len(waiting) >= _AHEAD * workers:
                yield ray.get(waiting.popleft())
        while waiting:
            yield ray.get(waiting.popleft())
    finally:
        ray.shutdown()


def _start_ray(workers: int, address: str | None, packages: list[str]) -> Any:
    try:
        import ray
    except ImportError as error:
        raise ValueError(
            "Ray is not installed; pip install -c constraints.txt -e '.[scale]', or take "
            "backend=joblib, which is enough for one machine"
        ) from error
    ray.init(
        address=address,
        num_cpus=None if address else workers,
        include_dashboard=None if address else False,
        log_to_driver=False,
        runtime_env={"py_modules": [str(_ROOT / package) for package in packages]},
    )
    return ray
