"""What can go wrong when pictures are made.

RenderingError
├── ClipNotWritten
└── NothingDraws
"""


class RenderingError(Exception):
    """Pictures could not be made."""


class ClipNotWritten(RenderingError):
    """Frames are none or of another size, or the encoder or the disk refused. Nothing of the clip is left."""


class NothingDraws(RenderingError):
    """No OpenGL draws here without a display, or not this."""
