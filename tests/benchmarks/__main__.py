"""`make bench`: run every bench_*.py in this folder in turn, each in its own process.

    python tests/benchmarks [--json FILE] [NAME ...]
    python tests/benchmarks --compare BEFORE.json AFTER.json

A NAME selects the files whose names contain it. `--json` records every figure that is printed. `--compare` prints the
ratios after/before of two such files and marks those that differ by more than 10%. Whether more is better depends on
the figure: rates should not fall, times should not rise.
"""

import argparse
import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

#: a number that is not part of a name such as HalfCheetah-6x1
_NUMBER = re.compile(r"(?<![\w.,|-])-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?(?![\d.,]|\w*[x|_-]\d)")
_MARKED_DIFFERENCE = 0.1

#: the numbers of each line, keyed by the file and the line with `#` for its numbers
Figures = dict[str, list[float]]


def figures_of(name: str, output: str) -> Figures:
    """The numbers in each line of a benchmark's output. Lines that differ only in numbers are counted."""
    seen: Counter[str] = Counter()
    figures: Figures = {}
    for line in output.splitlines():
        numbers = [float(number.replace(",", "")) for number in _NUMBER.findall(line)]
        if not numbers:
            continue
        text = " ".join(_NUMBER.sub("#", line).split())
        seen[text] += 1
        figures[f"{name}: {text}" + (f" ({seen[text]})" if seen[text] > 1 else "")] = numbers
    return figures


def run(file: Path) -> tuple[int, str]:
    """Run one file, print its output as it comes, and return its exit status and output."""
    lines: list[str] = []
    with subprocess.Popen([sys.executable, "-u", str(file)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            lines.append(line)
    return process.returncode, "".join(lines)


def compare(before: Figures, after: Figures) -> None:
    """Print the ratios after/before of all lines that both runs have."""
    for line, numbers in before.items():
        others = after.get(line)
        if others is None or len(others) != len(numbers):
            print(f"{line}\n    only in one of the runs")
            continue
        ratios = [new / old if old else float(new == old) for old, new in zip(numbers, others, strict=True)]
        marked = " <-- differs by more than 10%" * any(abs(ratio - 1) > _MARKED_DIFFERENCE for ratio in ratios)
        print(f"{line}\n    " + "  ".join(f"{ratio:.2f}" for ratio in ratios) + marked)


def main() -> int:
    parser = argparse.ArgumentParser(description="Run the benchmarks, or compare two recorded runs.")
    parser.add_argument("names", nargs="*", help="run the files whose names contain one of these")
    parser.add_argument("--json", type=Path, help="record all figures in this file")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"), help="compare two recorded runs")
    options = parser.parse_args()
    if options.compare:
        before, after = (json.loads(file.read_text()) for file in options.compare)
        compare(before, after)
        return 0
    files = sorted(Path(__file__).parent.glob("bench_*.py"))
    figures: Figures = {}
    failed: list[str] = []
    for file in files:
        if not any(name in file.name for name in options.names or [""]):
            continue
        name = file.stem.removeprefix("bench_")
        print(f"\n=== {name} ===", flush=True)
        status, output = run(file)
        figures |= figures_of(name, output)
        if options.json:
            options.json.write_text(json.dumps(figures, indent=1))
        if status:
            failed.append(file.name)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return len(failed)


if __name__ == "__main__":
    sys.exit(main())
