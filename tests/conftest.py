"""Before anything imports NumPy: one thread for its linear algebra.

The problems are small: where other processes use the machine, threads that wait for each other cost 500 times more.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
