"""Message compression: fewer bytes per message, each message coded independently.

``LinkCodec(registry)`` is the message codec of a sender and a receiver; ``docs/reference/message-coding.md`` has the
format.
"""

from __future__ import annotations

from gr_ros2.compression.dictionary import Dictionary, shipped
from gr_ros2.compression.link_codec import CODECS, MAX_MESSAGE, LinkCodec

__all__ = ["CODECS", "MAX_MESSAGE", "Dictionary", "LinkCodec", "shipped"]
