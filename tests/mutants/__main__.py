"""Run the tests of each mutant and count those that live: `make mutants` (about half an hour on a core).

Each mutant is a copy of the package with one wrong change. Its tests run in a fork of this process, which has torch in
memory already, one after another. A killed mutant made a test fail (or hang, or a crash); a survivor is a test that is
missing. Results are kept, one a line, in results/mutants.jsonl: an interrupted run goes on, and a mutant whose text has
changed runs again.
"""

import argparse
import hashlib
import json
import os
import resource
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import hypothesis  # noqa: F401  (in memory before the forks)
import numpy  # noqa: F401
import pytest
import scipy.optimize  # noqa: F401
import torch
from tqdm import tqdm

from . import attacks, control, data, kernels, problem, solve
from .mutant import Mutant

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 120  # of processor time: a mutant whose tests take longer hangs, and is killed
MUTANTS: list[Mutant] = [m for room in (control, attacks, kernels, solve, data, problem) for m in room.MUTANTS]


def key(mutant: Mutant) -> str:
    """Return what changes when the mutant, the file it is made of, or its tests do."""
    paths = [ROOT / mutant.file, *(ROOT / "tests" / path for path in mutant.tests.split(" -k ")[0].split())]
    text = repr(mutant) + "".join(path.read_text() for path in paths)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def made(mutant: Mutant | None, folder: Path) -> None:
    """Copy the package into a folder, with the mutant's change."""
    shutil.copytree(ROOT / "torch_dpc", folder / "torch_dpc", ignore=shutil.ignore_patterns("__pycache__"))
    if mutant is None:
        return
    path = folder / mutant.file
    text = path.read_text()
    if text.count(mutant.old) != 1:
        raise SystemExit(f"{mutant.name!r}: its text stands {text.count(mutant.old)} times in {mutant.file}.")
    path.write_text(text.replace(mutant.old, mutant.new))
    if path.suffix in (".c", ".h"):
        _compile(folder)


def _compile(folder: Path) -> None:
    """Build the mutated kernels without optimisation: seconds instead of minutes."""
    solve_room = folder / "torch_dpc" / "solve"
    target = solve_room / f"_kernels{sysconfig.get_config_var('EXT_SUFFIX')}"
    target.unlink(missing_ok=True)
    include = sysconfig.get_paths()["include"]
    command = [
        "gcc",
        "-O1",
        "-shared",
        "-fPIC",
        "-std=c11",
        "-pthread",
        "-D_GNU_SOURCE",
        f"-I{include}",
        f"-I{solve_room}",
        str(solve_room / "_kernels.c"),
        "-o",
        str(target),
        "-lm",
    ]
    subprocess.run(command, check=True, capture_output=True)


def outcome(mutant: Mutant | None, tests: str, with_kernels: bool) -> str:
    """Return "killed", "survived" or "no tests"."""
    with tempfile.TemporaryDirectory() as folder:
        made(mutant, Path(folder))
        child = os.fork()
        if child == 0:
            os._exit(_tested(folder, tests, with_kernels))
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return {0: "survived", 4: "no tests", 5: "no tests"}.get(code, "killed")


def _tested(folder: str, tests: str, with_kernels: bool) -> int:
    """Run the tests against the package in a folder, in this process, and return pytest's status."""
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    sys.path[:0] = [folder]
    os.environ["PYTHONPATH"] = os.pathsep.join([folder, str(ROOT)])
    os.environ["TORCH_DPC_NO_KERNELS"] = "0" if with_kernels else "1"
    os.chdir(ROOT)
    torch.set_num_threads(1)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    arguments = ["-q", "-x", "-p", "no:cacheprovider", "-m", "not slow"]
    paths = []
    words = tests.split(" -k ")
    if len(words) == 2:
        arguments += ["-k", words[1]]
    paths = [str(ROOT / "tests" / path) for path in words[0].split()]
    return int(pytest.main([*arguments, *paths]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "mutants.jsonl")
    parser.add_argument("--only", default="", help="a part of the name")
    parser.add_argument("--check", action="store_true", help="only look whether each text stands once in its file")
    parser.add_argument("--baseline", action="store_true", help="run the tests on the package as it is: all must pass")
    asked = parser.parse_args()
    chosen = [m for m in MUTANTS if asked.only in m.name]
    if asked.check:
        for m in chosen:
            if (n := (ROOT / m.file).read_text().count(m.old)) != 1:
                print(f"{m.name}: its text stands {n} times in {m.file}")
        print(f"{len(chosen)} mutants")
        return
    if asked.baseline:
        for tests, with_kernels in tqdm(sorted({(m.tests, m.kernels) for m in chosen}), unit="set"):
            if (found := outcome(None, tests, with_kernels)) != "survived":
                print(f"{tests} (kernels: {with_kernels}): {found} without a mutant")
        return
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    lines = asked.out.read_text().splitlines() if asked.out.exists() else []
    done = {row["key"]: row for row in map(json.loads, lines)}
    with asked.out.open("a") as file:
        for mutant in tqdm(chosen, unit="mutant"):
            if key(mutant) in done:
                continue
            row = {
                "key": key(mutant),
                "name": mutant.name,
                "file": mutant.file,
                "outcome": outcome(mutant, mutant.tests, mutant.kernels),
            }
            done[row["key"]] = row
            file.write(json.dumps(row) + "\n")
            file.flush()
    rows = [done[key(mutant)] for mutant in chosen]
    alive = [row for row in rows if row["outcome"] != "killed"]
    print(f"{len(rows) - len(alive)} of {len(rows)} killed ({100 * (1 - len(alive) / max(len(rows), 1)):.0f} %)")
    for row in alive:
        print(f"  {row['outcome']}: {row['name']} ({row['file']})")


if __name__ == "__main__":
    main()
