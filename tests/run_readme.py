"""Run the Python blocks of README.md with the interpreter at hand, as `make package` does in a clean environment.

    python tests/run_readme.py README.md
"""

import re
import sys
from pathlib import Path

if __name__ == "__main__":
    import torch_dpc

    print(f"torch_dpc {torch_dpc.__version__} from {Path(torch_dpc.__file__).parent}")
    for block in re.findall(r"^```python\n(.*?)^```", Path(sys.argv[1]).read_text(), flags=re.M | re.S):
        exec(compile(block, sys.argv[1], "exec"), {"__name__": "__main__"})
