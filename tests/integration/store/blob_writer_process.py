"""A process that stores blobs until it is killed: python blob_writer_process.py URL."""

import itertools
import sys

from accord.store.blobs import open_blobs


def main() -> None:
    blobs = open_blobs(sys.argv[1])
    for number in itertools.count():
        blobs.put(f"folder-{number % 7}/{number}", bytes([number % 256]) * 300_000)
        print(number, flush=True)


if __name__ == "__main__":
    main()
