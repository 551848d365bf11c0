"""`python -m benchmarks` lists the benchmarks; `python -m benchmarks NAME [its options]` runs one."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

# As the command line has it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def available() -> list[str]:
    """Names of the benchmarks in this folder: the modules that have a `main`."""
    modules = sorted(Path(__file__).parent.glob("[a-z]*.py"))
    return [path.stem for path in modules if "\ndef main(" in path.read_text()]


def main() -> None:
    """Run the one named, or list them."""
    names = available()
    if len(sys.argv) < 2 or sys.argv[1] not in names:
        print(f"usage: python -m benchmarks {{{'|'.join(names)}}} [options]", file=sys.stderr)
        raise SystemExit(2 if len(sys.argv) > 1 else 0)
    name = sys.argv[1]
    sys.argv = [f"python -m benchmarks {name}", *sys.argv[2:]]
    load = os.getloadavg()[0]
    print(f"{os.cpu_count()} processors, load {load:.1f} before the start (a busy machine reads slower)")
    importlib.import_module(f"benchmarks.{name}").main()


if __name__ == "__main__":
    main()
