"""Peak memory and speed of 50,000 pairs on disk: writing, sequential and random reading, training.

Training runs one epoch of MAPT `small`'s Markov path, then the first hundred steps of the whole network. A tenth of the
pairs is exported to Parquet and loaded again. Each pass runs in its own process, so that its peak resident memory is
measured separately. Random reading of a memory map of the same files is measured for comparison.

    python tests/benchmarks/bench_datasets.py [pairs] [pass,pass]
"""

import itertools
import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mapt.preferences.dataset import PreferenceDataset, SegmentArrays, in_batches
from mapt.preferences.formats.records import SegmentRecords
from mapt.preferences.formats.tables import LabelRow, PreferenceTables, QueryRow, SegmentRow, TableWriter
from mapt.preferences.storage import SegmentFolder, SegmentWriter
from mapt.preferences.storage_layout import SegmentLayout
from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.trainer import train_reward_model

N_PAIRS = 50_000
LAYOUT = SegmentLayout(n_steps=100, n_agents=6, observation_dim=24, action_dim=1)
#: Segments written or read at once; a training step of 64 pairs reads 128.
WRITTEN, READ = 256, 128


def noise(rng: np.random.Generator, n_segments: int) -> SegmentArrays:
    shape = (n_segments, LAYOUT.n_steps, LAYOUT.n_agents)
    return SegmentArrays(
        rng.standard_normal((*shape, LAYOUT.observation_dim), dtype=np.float32),
        rng.standard_normal((*shape, LAYOUT.action_dim), dtype=np.float32),
        np.ones(shape[:2], dtype=np.bool_),
    )


def write(path: Path, n_pairs: int) -> None:
    rng, left = np.random.default_rng(0), 2 * n_pairs
    with SegmentWriter.create(path / "segments", LAYOUT) as writer:
        while left:
            writer.append(noise(rng, min(WRITTEN, left)))
            left -= min(WRITTEN, left)


def read_in_order(path: Path, n_pairs: int) -> None:
    for _ in in_batches(SegmentFolder.open(path / "segments"), READ):
        pass


def dataset(path: Path, n_pairs: int) -> PreferenceDataset:
    rng = np.random.default_rng(1)
    pairs = rng.permutation(2 * n_pairs).reshape(-1, 2)
    return PreferenceDataset(SegmentFolder.open(path / "segments"), pairs, rng.integers(0, 2, n_pairs))


def read_at_random(path: Path, n_pairs: int) -> None:
    """One epoch: every pair once, in random order."""
    data = dataset(path, n_pairs)
    for index in np.array_split(np.random.default_rng(2).permutation(n_pairs), 2 * n_pairs // READ):
        data.segments.take(data.pairs[index].reshape(-1))


def map_at_random(path: Path, n_pairs: int) -> None:
    """As `read_at_random`, from memory maps, for comparison."""
    rows = (2 * n_pairs, LAYOUT.n_steps, LAYOUT.n_agents)
    observations = np.memmap(path / "segments/observations.bin", "<f4", "r", shape=(*rows, LAYOUT.observation_dim))
    actions = np.memmap(path / "segments/actions.bin", "<f4", "r", shape=(*rows, LAYOUT.action_dim))
    data = dataset(path, n_pairs)
    for index in np.array_split(np.random.default_rng(2).permutation(n_pairs), 2 * n_pairs // READ):
        chosen = data.pairs[index].reshape(-1)
        SegmentArrays(observations[chosen], actions[chosen], data.segments.mask(chosen))  # type: ignore[attr-defined]


def train(path: Path, n_pairs: int) -> None:
    """One epoch of the Markov path, and the first steps of the whole network."""
    steps = itertools.count()
    settings = TrainConfig(batch_pairs=READ // 2, markov_epochs=1, max_epochs=1, visits=n_pairs, device="cpu")
    in_markov_epoch = math.ceil((n_pairs - round(n_pairs * settings.hold_out_fraction)) / settings.batch_pairs)
    network = RewardConfig.preset(
        "small",
        observation_dim=LAYOUT.observation_dim,
        action_dim=LAYOUT.action_dim,
        n_agents=LAYOUT.n_agents,
        segment_steps=LAYOUT.n_steps,
    )
    train_reward_model(
        dataset(path, n_pairs), network, settings, stop=lambda: next(steps) >= in_markov_epoch + WHOLE_STEPS
    )


def export(path: Path, n_pairs: int) -> None:
    """Export to Parquet tables."""
    folder, n_segments = SegmentFolder.open(path / "segments"), 2 * n_pairs
    with TableWriter(path / "export", LAYOUT) as tables:
        for first in range(0, n_segments, tables.rows_per_group):
            index = np.arange(first, min(first + tables.rows_per_group, n_segments))
            tables.add_segments([SegmentRow(f"s{i}") for i in index], SegmentRecords(folder.take(index)))
        tables.add_queries(QueryRow(f"q{i}", f"s{2 * i}", f"s{2 * i + 1}") for i in range(n_pairs))
        tables.add_labels(LabelRow(f"q{i}", "teacher", "label", float(i % 2)) for i in range(n_pairs))


def load(path: Path, n_pairs: int) -> None:
    """Load the tables into a `SegmentFolder`."""
    assert len(PreferenceTables.open(path / "export").load(path / "loaded")) == n_pairs


#: Training steps of the whole network; its memory is constant after the first.
WHOLE_STEPS = 100
#: Passes that run on a tenth of the pairs.
SHORT = ("export", "load")
PASSES: dict[str, Callable[[Path, int], None]] = {
    each.__name__: each for each in (write, read_in_order, read_at_random, map_at_random, train, export, load)
}


def run(name: str, path: Path, n_pairs: int) -> None:
    """Run one pass in this process and print its row."""
    before = peak_bytes()
    started = time.perf_counter()
    PASSES[name](path, n_pairs)
    seconds = time.perf_counter() - started
    rate = 2 * n_pairs / seconds
    print(
        f"{name:16} {seconds:8.1f} s {rate:10,.0f} segments/s   peak {peak_bytes() / 1e6:7,.0f} MB"
        f" ({(peak_bytes() - before) / 1e6:,.0f} MB more than before the pass)",
        flush=True,
    )


def peak_bytes() -> int:
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def main() -> None:
    n_pairs = int(sys.argv[1]) if len(sys.argv) > 1 else N_PAIRS
    size = 2 * n_pairs * LAYOUT.segment_bytes
    print(
        f"{n_pairs:,} pairs of T={LAYOUT.n_steps}, N={LAYOUT.n_agents}, C={LAYOUT.observation_dim}: {size / 1e9:.1f} GB"
    )
    with tempfile.TemporaryDirectory(prefix="bench-datasets-") as folder:
        chosen = ["write", *sys.argv[2].split(",")] if len(sys.argv) > 2 else list(PASSES)
        for name in chosen:
            n_used = n_pairs // 10 if name in SHORT else n_pairs
            subprocess.run([sys.executable, __file__, "--pass", name, folder, str(n_used)], check=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--pass"]:
        run(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]))
    else:
        main()
