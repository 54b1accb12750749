"""Images are reached through sockets, too."""

from fixtures.quick_close import quick_close

__all__ = ["quick_close"]
