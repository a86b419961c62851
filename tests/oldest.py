"""Print the oldest versions that setup.cfg admits, as constraints for pip: `make oldest` tests with them.

python tests/oldest.py save        # of install_requires and of the extra `save`
"""

import configparser
import re
import sys
from pathlib import Path

SETUP = Path(__file__).resolve().parents[1] / "setup.cfg"


def lower_bounds(extras: list[str], path: Path = SETUP) -> dict[str, str]:
    """Return the lower bound of each requirement of the package and of some of its extras."""
    config = configparser.ConfigParser()
    config.read(path)
    texts = [config["options"]["install_requires"], *(config["options.extras_require"][name] for name in extras)]
    bounds = {}
    for line in "\n".join(texts).splitlines():
        requirement = line.partition("#")[0].strip()
        if not requirement:
            continue
        name = re.match(r"[A-Za-z0-9_.-]+", requirement)
        bound = re.search(r">=\s*([0-9][0-9a-z.]*)", requirement)
        if name is None or bound is None:
            raise SystemExit(f"{requirement!r} in {path.name} has no lower bound: give it one, and test it.")
        bounds[name.group()] = bound.group(1)
    return bounds


if __name__ == "__main__":
    print("\n".join(f"{name}=={version}" for name, version in lower_bounds(sys.argv[1:]).items()))
