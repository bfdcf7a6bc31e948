"""How a clip looks, how fast it plays and how it is encoded."""

from dataclasses import dataclass
from typing import Literal

Quality = Literal["fast", "pretty"]
Camera = Literal["follow"]


@dataclass(frozen=True, slots=True)
class CodecSettings:
    """H.264 settings, named as libx264 names them."""

    #: speed against size; `veryfast` costs half the time of `medium` for 5% more bytes
    preset: str = "veryfast"
    #: constant rate factor: lower is better and larger
    crf: int = 23
    #: frames from one key frame to the next; a seek decodes at most so many frames
    keyframe_interval_frames: int = 5


@dataclass(frozen=True, slots=True)
class RenderSettings:
    """One look for all clips of an experiment.

    Raises:
        ValueError: if the size is not positive and even (4:2:0 chroma needs even sizes), or the rate is not
            positive.
    """

    #: pixels; multiples of 16 fill whole macroblocks
    width: int = 448
    #: pixels
    height: int = 336
    #: frames a second; one frame is one control step, so 20 is real time for a task of 0.05 s steps
    frame_rate_hz: float = 20.0
    #: "fast" draws without anti-aliasing, shadow map or reflection; "pretty" with the first two, at 2 to 3 times
    #: the cost
    quality: Quality = "fast"
    #: "follow" is a side view at a fixed height and distance that goes along with the body
    camera: Camera = "follow"
    codec: CodecSettings = CodecSettings()

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0 or self.width % 2 or self.height % 2:
            raise ValueError(f"A clip of {self.width}x{self.height} cannot be encoded: both must be positive and even.")
        if not self.frame_rate_hz > 0:
            raise ValueError(f"A clip cannot play at {self.frame_rate_hz} frames a second.")
