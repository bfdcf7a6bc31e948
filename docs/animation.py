"""Joins videos side by side as a GIF, such as that of README.md: an untrained policy beside one taught by 500 labels.

mapt train --steps 1 --output untrained
accord demo --labels 500 --models MAPT --seeds 0 --steps 400000 --no-baseline --video --output taught
python docs/animation.py untrained/seed-0/final.mp4 taught/runs/*/final.mp4 --output docs/images/taught.gif
"""

import argparse
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import av
import imageio.v3 as iio
import numpy as np
from av.video.reformatter import Interpolation
from numpy.typing import NDArray

#: every second frame of a video of 20 per second, as fast as browsers play GIFs
EVERY, DURATION_MS = 2, 100
SIZE = (320, 240)


def frames(video: Path, start: int, count: int) -> Iterator[NDArray[np.uint8]]:
    """`count` frames from `start` on, of which every `EVERY`th counts: uint8 (H, W, 3)."""
    width, height = SIZE
    with av.open(str(video)) as container:
        for frame in islice(container.decode(video=0), start, start + EVERY * count, EVERY):
            picture = frame.to_ndarray(format="rgb24", width=width, height=height, interpolation=Interpolation.AREA)
            yield picture.astype(np.uint8, copy=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("videos", type=Path, nargs="+", help="from left to right")
    parser.add_argument("--output", type=Path, required=True, help="the GIF")
    parser.add_argument("--start", type=int, default=100, help="first frame of each video")
    parser.add_argument("--frames", type=int, default=40, help="frames of the GIF")
    options = parser.parse_args()
    each = (frames(video, options.start, options.frames) for video in options.videos)
    joined = [np.concatenate(together, axis=1) for together in zip(*each, strict=True)]
    iio.imwrite(options.output, joined, extension=".gif", duration=DURATION_MS, loop=0)


if __name__ == "__main__":
    main()
