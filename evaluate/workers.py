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

from joblib import Parallel, delayed

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
        parallel = Parallel(
            n_jobs=workers,
            return_as="generator",
            batch_size=1,
            pre_dispatch=_AHEAD * workers,
        )
        results: Iterator[Result] = parallel(delayed(work)(task) for task in tasks)
        return results
    return map(work, tasks)


def _run_on_ray(
    work: Callable[[TaskType], Result],
    tasks: Iterable[TaskType],
    workers: int,
    address: str | None,
) -> Iterator[Result]:
    ray = _start_ray(workers, address)
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


def _start_ray(workers: int, address: str | None) -> Any:
    try:
        import ray
    except ImportError as error:
        raise ValueError(
            "Ray is not installed; pip install -c constraints.txt -e '.[scale]', or take "
            "backend=joblib, which is enough for one machine"
        ) from error
    # Workers elsewhere get the code of this checkout; they need Python and numba only.
    packages = [str(_ROOT / "ridetune"), str(_ROOT / "evaluate")]
    ray.init(
        address=address,
        num_cpus=None if address else workers,
        include_dashboard=None if address else False,
        log_to_driver=False,
        runtime_env={"py_modules": packages},
    )
    return ray
