"""Before anything imports NumPy: one thread for its linear algebra.

The problems are small: where other processes use the machine, threads that wait for each other cost 500 times more.
"""

import os

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def pytest_collection_modifyitems(items):
    """Refuse a case named by an address: parallel test processes need one list of names."""
    named = [item.nodeid for item in items if " at 0x" in item.nodeid]
    if named:
        raise pytest.UsageError(f"give this case a name with `ids=`: {named[0]}")
