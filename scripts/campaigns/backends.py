"""Where a campaign runs: this machine's cores, or an engine that is there already, through joblib.

What the workers of an engine need: torch_dpc with its extras `scripts` and `campaign`. The scripts themselves are sent.
"""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import joblib
from joblib.externals.loky.process_executor import BrokenProcessPool

from scripts.campaigns.config import RunConfig
from scripts.campaigns.runs import run_chunk

BACKENDS = ("local", "dask", "ray")
SCRIPTS = Path(__file__).resolve().parents[1]


class Lost(RuntimeError):
    """Workers died, and the engine has given their chunks up."""


class Backend:
    """One of joblib's backends.

    Args:
        name: joblib's name of it.
        lost: what it raises when workers die.
        streams: whether it hands out results as they finish; if not, they come in rounds of one chunk a worker.
        options: of joblib's `parallel_config`.
    """

    def __init__(self, name: str, lost: tuple[type[BaseException], ...], *, streams: bool = True, **options: Any):
        self.name, self.lost, self.streams, self.options = name, lost, streams, options

    def run(self, chunks: list[list[RunConfig]]) -> Iterator[list[dict[str, Any]]]:
        """Yield the rows of each chunk as it finishes.

        Raises:
            Lost: workers died; chunks that have not been yielded are to be run again.
        """
        with joblib.parallel_config(backend=self.name, **self.options):
            size = len(chunks) if self.streams else joblib.effective_n_jobs()
            kind = "generator_unordered" if self.streams else "list"
            try:
                for i in range(0, len(chunks), size):
                    parallel = joblib.Parallel(return_as=kind, batch_size=1)
                    yield from parallel(joblib.delayed(run_chunk)(chunk) for chunk in chunks[i : i + size])
            except self.lost as error:
                raise Lost(type(error).__name__) from error


@contextmanager
def open_backend(name: str, scheduler: str | None, workers: int) -> Iterator[Backend]:
    """Open the cores of this machine, or connect to an engine.

    Raises:
        ImportError: the engine's package is missing.
    """
    if name == "local":
        yield Backend("loky", (BrokenProcessPool,), n_jobs=workers, inner_max_num_threads=1)
    elif name == "dask":
        try:
            from distributed import Client, KilledWorker
        except ImportError as error:
            raise ImportError("--backend dask needs it: pip install '.[campaign]'") from error
        with Client(scheduler, set_as_default=False) as client, _packed() as file:
            client.upload_file(str(file), load=False)
            yield Backend("dask", (KilledWorker,), client=client, n_jobs=-1)
    else:
        try:
            import ray
            from ray.util.joblib import register_ray
        except ImportError as error:
            raise ImportError("--backend ray needs it: pip install ray") from error
        ray.init(address=scheduler, runtime_env={"py_modules": [str(SCRIPTS)]}, log_to_driver=False)
        register_ray()
        try:
            yield Backend("ray", (ray.exceptions.RayError,), streams=False, n_jobs=-1)
        finally:
            ray.shutdown()


@contextmanager
def _packed() -> Iterator[Path]:
    """Pack the scripts into one file that a worker can import from."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "torch_dpc_scripts.zip"
        with zipfile.ZipFile(path, "w") as archive:
            for script in sorted(SCRIPTS.rglob("*.py")):
                archive.write(script, script.relative_to(SCRIPTS.parent))
        yield path
