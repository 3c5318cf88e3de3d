"""What goes wrong with an image of one's own."""

from __future__ import annotations

from see2act.errors import UserError


class ImageError(UserError, ValueError):
    """An image, a calibration or bounds that nothing can be predicted from; the message is one line and says what to do."""
