"""What can go wrong between simulator states and a clip.

AccordError
├── Unavailable
│   └── RenderingUnavailable     no OpenGL without a display on this machine
└── RenderFailed                 this clip was not made; another may be
    └── RenderTimedOut
"""

from accord.domain.errors import AccordError, Unavailable


class RenderingUnavailable(Unavailable):
    """No clip can be drawn on this machine. The message says what to install."""

    code = "rendering_unavailable"


class RenderFailed(AccordError):
    """A clip could not be drawn or encoded, or its process died. Nothing is left at the clip's path."""

    code = "render_failed"


class RenderTimedOut(RenderFailed):
    """A clip took longer than its limit: its process was killed and replaced."""

    code = "render_timed_out"

    def __init__(self, limit_seconds: float) -> None:
        super().__init__(f"The clip was not finished in {limit_seconds:g} seconds. Its process was replaced.")
        self.limit_seconds = limit_seconds
