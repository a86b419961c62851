"""Campaigns: what a row depends on, and that kills neither lose nor repeat one."""

import os
import signal
import subprocess
import sys
import time

import pytest

for package in ("matplotlib", "tqdm", "joblib", "pyarrow"):
    pytest.importorskip(package, reason=f"campaigns need {package}: pip install '.[scripts,campaign]'")


import pyarrow.parquet as pq

from scripts import campaign
from scripts.campaigns import config
from scripts.campaigns.backends import Backend, Lost, open_backend
from scripts.campaigns.runs import run_chunk
from scripts.campaigns.store import Store
from scripts.experiments.case import run_seed
from scripts.experiments.masses import Masses
from scripts.shared.command import ROOT

SMALL = """
plants = ["masses"]
seeds = [3, 5, 8, 9]
attacks = ["none", "random", "algorithm1"]
rho = [0.05, 0.1]
steps = 30
[weights.paper]
[weights.strict]
lambda_s = 1e7
"""
ROWS = 4 * 5 * 2


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


def serial(configs):
    """The rows of configurations, one chunk after the other in this process."""
    return {row["id"]: row for chunk in campaign.chunks(configs) for row in run_chunk(chunk)}


def stored(store):
    """All rows in the parts, repeated ones included."""
    return [row for part in store.parts() for row in pq.read_table(part).to_pylist()]


def as_stored(row):
    return {k: list(v) if isinstance(v, tuple) else v for k, v in row.items()}


def is_complete(store, configs):
    """Every row once, and equal to the last bit to what one process finds."""
    rows, expected = stored(store), serial(configs)
    assert len(rows) == len(configs)
    assert {row["id"]: row for row in rows} == {i: as_stored(row) for i, row in expected.items()}
    return True


# --- rows -----------------------------------------------------------------------------------------------------------


def test_rows_are_the_product_and_no_attack_comes_once(small):
    configs = config.load(small)
    assert len(configs) == len({c.id for c in configs}) == ROWS
    assert sum(c.attack == "none" for c in configs) == 4 * 2
    assert {c.lambda_s for c in configs if c.weights == "strict"} == {1e7}
    assert len(config.load(ROOT / "scripts" / "campaigns" / "example.toml")) == 1000


def test_the_id_is_that_of_the_run(small):
    one = config.RunConfig("masses", "a", 0, "random", 0.1)
    assert one.id == config.RunConfig("masses", "b", 0, "random", 0.1).id
    others = [
        ("masses", "a", 1, "random", 0.1),
        ("masses", "a", 0, "random", 0.2),
        ("quadrotor", "a", 0, "random", 0.1),
    ]
    assert len({one.id, *(config.RunConfig(*other).id for other in others)}) == 4
    assert config.RunConfig("masses", "a", 0, "random", 0.1, R=(1.0, 2.0)).id != one.id


def test_a_row_is_the_run_of_figure_3():
    (run,) = [r for r in run_seed(Masses(), 3, [0.1]) if r["attack"] == "algorithm1"]
    (row,) = run_chunk([config.RunConfig("masses", "paper", 3, "algorithm1", 0.1)])
    assert row["error"] == pytest.approx(run["error"].mean(), rel=1e-12)
    assert row["largest"] == pytest.approx(run["error"].max(), rel=1e-12)
    assert (row["unsolved"], row["steps"], row["lambda_g"]) == (0, 200, 100.0)


def test_a_row_depends_neither_on_its_neighbours_nor_on_the_order(small):
    configs = [c for c in config.load(small) if c.seed == 5]
    together = {row["id"]: row for row in run_chunk(configs)}
    backwards = {row["id"]: row for row in run_chunk(configs[::-1])}
    alone = {c.id: run_chunk([c])[0] for c in configs}
    assert together == backwards == alone


def test_every_attack_of_the_list_runs():
    attacks = [a for a in config.ATTACKS if a != "none"]
    rows = run_chunk([config.RunConfig("masses_moving", "paper", 0, a, 0.1, steps=10) for a in attacks])
    assert all(row["perturbation"] > 0 and row["unsolved"] == 0 for row in rows)
    assert len({row["error"] for row in rows}) == len(attacks)


# --- kills ----------------------------------------------------------------------------------------------------------


class Killer(Store):
    """A store that kills a worker when the first chunk has come in."""

    def __init__(self, folder, kill):
        super().__init__(folder)
        self.kill = kill

    def add(self, rows):
        super().add(rows)
        if self.kill is not None:
            kill, self.kill = self.kill, None
            kill()


def test_a_killed_local_worker_loses_nothing(small, tmp_path, monkeypatch):
    psutil = pytest.importorskip("psutil", reason="needs psutil to find the workers: pip install '.[campaign]'")
    monkeypatch.setattr(campaign, "chunks", lambda configs: [[c] for c in configs])  # many chunks: the kill hits one
    configs = config.load(small)

    def kill():
        children = psutil.Process().children()
        next(c for c in children if "popen_loky_posix" in " ".join(c.cmdline())).kill()

    with open_backend("local", None, 2) as backend:
        losses = campaign.run_campaign(configs, store := Killer(tmp_path / "parts", kill), backend)
    assert losses >= 1 and is_complete(store, configs)


def test_a_campaign_whose_workers_always_die_gives_up(small, tmp_path):
    class Doomed(Backend):
        def run(self, chunks):
            raise Lost("always")

    with pytest.raises(Lost):
        campaign.run_campaign(config.load(small), Store(tmp_path / "parts"), Doomed("loky", ()))


@pytest.mark.slow
def test_a_killed_campaign_goes_on_where_it_stopped(tmp_path):
    path = tmp_path / "long.toml"
    path.write_text(SMALL.replace("steps = 30", "steps = 200").replace("[3, 5, 8, 9]", "{first = 0, count = 12}"))
    configs, store = config.load(path), Store(tmp_path / "campaign_long")
    command = [sys.executable, "-m", "scripts.campaign", path, "--out", tmp_path, "--workers", "1"]
    first = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL, start_new_session=True)
    began = time.monotonic()
    while not store.parts() and time.monotonic() - began < 120:
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    before = {part: (part.stat().st_mtime_ns, part.read_bytes()) for part in store.parts()}
    assert 0 < len(before) < 12
    (store.folder / "half.123.tmp").write_bytes(b"PAR1")  # what a kill in the middle of writing leaves
    subprocess.run(command, cwd=ROOT, stderr=subprocess.DEVNULL, check=True)
    assert all((part.stat().st_mtime_ns, part.read_bytes()) == old for part, old in before.items())
    assert not list(store.folder.glob("*.tmp")) and is_complete(store, configs)
    table = pq.read_table(tmp_path / "campaign_long.parquet")
    assert table["id"].to_pylist() == [c.id for c in configs]
    assert (tmp_path / "campaign_long.png").stat().st_size > 10_000


def test_a_changed_weight_runs_its_own_rows_only(small, tmp_path):
    store = Store(tmp_path / "parts")
    with open_backend("local", None, 1) as backend:
        campaign.run_campaign(config.load(small), store, backend)
        small.write_text(SMALL.replace("1e7", "1e5").replace("[weights.paper]", "[weights.renamed]"))
        configs = config.load(small)
        assert {c.weights for c in store.missing(configs)} == {"strict"}
        campaign.run_campaign(configs, store, backend)
    table = store.merge(configs, tmp_path / "all.parquet", "")
    assert table["id"].to_pylist() == [c.id for c in configs]
    assert set(table["weights"].to_pylist()) == {"renamed", "strict"}


# --- damage ---------------------------------------------------------------------------------------------------------


def finished_campaign(small, folder):
    configs, store = config.load(small), Store(folder)
    with open_backend("local", None, 1) as backend:
        campaign.run_campaign(configs, store, backend)
    return configs, store


def test_a_damaged_part_is_set_aside_and_its_rows_are_run_again(small, tmp_path, caplog):
    configs, store = finished_campaign(small, tmp_path / "parts")
    part, rows = store.parts()[0], len(stored(store))
    whole = part.read_bytes()
    cuts = [whole[: len(whole) * k // 20] for k in range(20)]
    bits = [
        bytes([*whole[:i], whole[i] ^ 1 << (i % 8), *whole[i + 1 :]]) for i in range(0, len(whole), len(whole) // 50)
    ]
    for content in [*cuts, *bits, b"PAR1", whole + b"\0"]:
        part.write_bytes(content)
        missing = store.missing(configs)
        assert 0 < len(missing) < rows and not part.exists() and part.with_suffix(".damaged").exists()
        part.with_suffix(".damaged").unlink()
        part.write_bytes(whole)
    assert "is damaged: set aside" in caplog.text
    part.write_bytes(whole[:-1])
    with open_backend("local", None, 1) as backend:
        campaign.run_campaign(configs, store, backend)
    assert is_complete(store, configs)
    assert store.merge(configs, tmp_path / "all.parquet", "")["id"].to_pylist() == [c.id for c in configs]


# --- engines --------------------------------------------------------------------------------------------------------


@pytest.fixture
def cluster():
    distributed = pytest.importorskip("distributed", reason="needs Dask: pip install '.[campaign]'")
    with distributed.LocalCluster(
        n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        yield cluster


@pytest.mark.slow
def test_dask_gives_the_same_rows(small, tmp_path, cluster):
    campaign.main([str(small), "--out", str(tmp_path), "--backend", "dask", "--scheduler", cluster.scheduler_address])
    store = Store(tmp_path / "campaign_small")
    assert is_complete(store, config.load(small))


@pytest.mark.slow
def test_a_killed_dask_worker_loses_nothing(small, tmp_path, monkeypatch, cluster):
    from distributed import Client

    monkeypatch.setattr(campaign, "chunks", lambda configs: [[c] for c in configs])
    configs = config.load(small)

    def kill():
        with Client(cluster.scheduler_address, set_as_default=False) as client:
            os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)

    with open_backend("dask", cluster.scheduler_address, 0) as backend:
        campaign.run_campaign(configs, store := Killer(tmp_path / "parts", kill), backend)
    assert store.kill is None and is_complete(store, configs)


@pytest.mark.slow
def test_ray_gives_the_same_rows(small, tmp_path):
    ray = pytest.importorskip("ray", reason="needs Ray, which `make` leaves out: pip install ray")
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        address = ray.get_runtime_context().gcs_address
        command = [sys.executable, "-m", "scripts.campaign", small, "--out", tmp_path]
        command += ["--backend", "ray", "--scheduler", address]
        subprocess.run(command, cwd=ROOT, stderr=subprocess.DEVNULL, check=True)
    finally:
        ray.shutdown()
    assert is_complete(Store(tmp_path / "campaign_small"), config.load(small))


# --- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('plants = ["masses"]', 'plants = ["pendulum"]'), "`plants` must list some of `masses`"),
        (("seeds = [3, 5, 8, 9]", "seeds = 3"), "`seeds` must be a list"),
        (("seeds = [3, 5, 8, 9]", "seeds = [3, 3]"), "two rows are the same run"),
        (("rho = [0.05, 0.1]", "rho = [-0.1]"), "`rho` must list positive numbers"),
        (("steps = 30", "steps = 0"), "`steps` must be a positive integer"),
        (("steps = 30", "step = 30"), "unknown `step`"),
        (("lambda_s = 1e7", "lambda_x = 1e7"), r"\[weights.strict\] must hold"),
        (("lambda_s = 1e7", "Q = [1.0, 2.0]"), "the 4 diagonal entries of the masses"),
    ],
)
def test_bad_configurations_are_named(small, change, message):
    small.write_text(SMALL.replace(*change))
    with pytest.raises(ValueError, match=message):
        config.load(small)


def test_an_engine_needs_its_address(small):
    with pytest.raises(SystemExit):
        campaign.main([str(small), "--backend", "dask"])
