"""`make bench`: every bench_*.py beside this file, each as a process of its own, one after the other.

A name on the command line runs the files whose names contain it: `python tests/benchmarks clips`.
"""

import subprocess
import sys
from pathlib import Path


def main() -> int:
    here = Path(__file__).parent
    wanted = sys.argv[1:] or [""]
    files = [file for file in sorted(here.glob("bench_*.py")) if any(word in file.name for word in wanted)]
    failed: list[str] = []
    for file in files:
        print(f"\n=== {file.stem.removeprefix('bench_')} ===", flush=True)
        if subprocess.run([sys.executable, str(file)], check=False).returncode:
            failed.append(file.name)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return len(failed)


if __name__ == "__main__":
    sys.exit(main())
