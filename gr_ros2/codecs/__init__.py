"""What a topic becomes on the air: pictures, depth, clouds and maps in far fewer bytes than their messages.

``CodedTopic(type_name, options)`` makes the encoder of a sender and the decoders of its receivers.
"""

from __future__ import annotations

from gr_ros2.codecs.base import MAX_SIZE, Codec, Coded, Decoder, Encoder
from gr_ros2.codecs.topic import CODECS, CodecRow, CodedTopic

__all__ = ["CODECS", "MAX_SIZE", "Codec", "CodecRow", "Coded", "CodedTopic", "Decoder", "Encoder"]
