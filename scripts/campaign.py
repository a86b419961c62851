"""A campaign: plants x seeds x rho x attacks x weights in closed loop, on this machine's cores or on a cluster.

    python -m scripts.campaign scripts/campaigns/example.toml           # 1,000 runs, about a minute on two cores
    python -m scripts.campaign FILE --backend dask --scheduler tcp://HOST:8786
    python -m scripts.campaign FILE --backend ray --scheduler auto

Rows are written as they finish; a killed campaign goes on where it stopped, and the rows of a worker that is killed are
run again by another. A row depends on its own line of the configuration alone. Leaves, in results/:

    campaign_{name}/        the parts, one Parquet file a finished chunk
    campaign_{name}.parquet all rows, in the order of the configuration
    campaign_{name}.png     error against rho, for each plant, attack and set of weights
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from scripts.campaigns.backends import BACKENDS, Lost, open_backend
from scripts.campaigns.config import RunConfig, load
from scripts.campaigns.plot import plot
from scripts.campaigns.store import Store
from scripts.shared.command import RESULTS, cores, versions

CHUNK = 25  # rows at most: what one kill can cost a worker
PATIENCE = 3  # times in a row that workers may be lost without a finished chunk in between


def chunks(configs: Sequence[RunConfig], size: int = CHUNK) -> list[list[RunConfig]]:
    """Return groups of rows that share a recording."""
    groups: dict[tuple[str, int], list[RunConfig]] = {}
    for config in configs:
        groups.setdefault((config.plant, config.seed), []).append(config)
    return [group[i : i + size] for group in groups.values() for i in range(0, len(group), size)]


def run_campaign(configs: Sequence[RunConfig], store: Store, backend: Any) -> int:
    """Run what is missing, and return how often workers were lost."""
    losses, in_a_row = 0, 0
    missing = store.missing(configs)
    with tqdm(total=len(configs), initial=len(configs) - len(missing), desc="Campaign", unit="run") as bar:
        while missing:
            try:
                for rows in backend.run(chunks(missing)):
                    store.add(rows)
                    bar.update(len(rows))
                    in_a_row = 0
            except Lost as error:
                losses, in_a_row = losses + 1, in_a_row + 1
                if in_a_row > PATIENCE:
                    raise
                tqdm.write(f"a worker was lost ({error}); going on with what is missing")
            missing = store.missing(configs)
    return losses


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("config", type=Path, help="a TOML file; see scripts/campaigns/example.toml")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the results (default results/)")
    parser.add_argument("--workers", type=int, default=cores(), help="processes of this machine (default: one a core)")
    parser.add_argument(
        "--backend", choices=BACKENDS, default="local", help="where the runs take place (default local)"
    )
    parser.add_argument("--scheduler", help="address of the engine; for ray also `auto`")
    args = parser.parse_args(argv)
    if (args.scheduler is None) != (args.backend == "local"):
        parser.error("--scheduler goes with --backend dask or ray, and they need it")
    configs, name = load(args.config), f"campaign_{args.config.stem}"
    store, began = Store(args.out / name), time.perf_counter()

    with open_backend(args.backend, args.scheduler, args.workers) as backend:
        run_campaign(configs, store, backend)
    note = versions(1, args.workers).split(";")[0]  # the seeds are in the rows
    table = store.merge(configs, args.out / f"{name}.parquet", note)
    plot(args.out / f"{name}.png", table)
    print(f"{len(table)} runs: {args.out / f'{name}.parquet'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
