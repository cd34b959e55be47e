"""zstd data without the parts that a link does not need: magic, frame header, checksum and, for a single block, its
header.

Coded form: a varint of 2 * size + (1 where the rest is the content of one compressed block, 0 where it is blocks with
their headers), then the blocks.

Invariants: the size comes first and is checked against a bound before decompression, which never gives more bytes than
that, so that a small message cannot become a very large one; arbitrary bytes raise only CodecError.
"""

from __future__ import annotations

import sys
from typing import Any

from gr_ros2.core.errors import DamagedError
from gr_ros2.wire import varint

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

_MAGIC = b"\x28\xb5\x2f\xfd"
_DICTIONARY_MAGIC = b"\x37\xa4\x30\xec"
_SINGLE_SEGMENT_WITH_SIZE = b"\xa0"
"""Frame header descriptor: window = content, 4 bytes of content size, no dictionary id, no checksum (RFC 8878)."""
_COMPRESSED_BLOCK = 2
_EMPTY_BLOCK = bytes(3)
"""The header of a raw block of no bytes that is not the last."""
_MAX_BLOCK = 1 << 21
_LEVEL = 12


class Zstd:
    """One compressor and its decompressor.

    :param dictionary: a dictionary that both ends have, made by ``train``, or any bytes to refer to; b'' = none
    :param level: of zstd, 1 = fast to 22 = small; for sending only
    """

    def __init__(self, dictionary: bytes = b"", level: int = _LEVEL) -> None:
        raw = not dictionary.startswith(_DICTIONARY_MAGIC)
        self._dictionary = zstd.ZstdDict(dictionary, is_raw=raw) if dictionary else None
        options: dict[int, int] = {
            zstd.CompressionParameter.compression_level: level,
            zstd.CompressionParameter.content_size_flag: 0,
            zstd.CompressionParameter.dict_id_flag: 0,
        }
        self._compressor = zstd.ZstdCompressor(options=options, zstd_dict=self._dictionary)

    def compress(self, data: bytes, sized: bool = True, least: int = 0) -> bytes:
        """The coded form.

        :param sized: False: the varint is only the flag, for a size that both ends know
        :param least: fewest bytes of the coded form; a shorter one is padded with empty blocks at the start
        """
        frame: bytes = self._compressor.compress(data, self._compressor.FLUSH_FRAME)
        descriptor = frame[4]
        single_segment = descriptor & 0x20
        header = 5 + (0 if single_segment else 1) + (0, 1, 2, 4)[descriptor & 3]
        header += (1 if single_segment else 0, 2, 4, 8)[descriptor >> 6]
        block = int.from_bytes(frame[header : header + 3], "little")
        alone = block & 7 == _COMPRESSED_BLOCK << 1 | 1 and (block >> 3) == len(frame) - header - 3
        body = frame[header + 3 * alone :]
        if len(body) + 1 < least:
            alone, body = False, frame[header:]
            body = _EMPTY_BLOCK * -(-(least - 1 - len(body)) // len(_EMPTY_BLOCK)) + body
        return varint((len(data) if sized else 0) << 1 | alone) + body

    def decompress(self, coded: bytes, max_size: int, size: int | None = None) -> bytes:
        """The data.

        :param max_size: a larger size is refused
        :param size: size that both ends know, None where the coded form contains it
        :raises DamagedError: not such data, or more than ``max_size``
        """
        value, start = read_varint(coded)
        if size is None:
            size = value >> 1
        elif value > 1:
            raise DamagedError("damaged message: two sizes")
        if size > max_size:
            raise DamagedError(f"damaged message: claims {size} bytes, at most {max_size} are accepted")
        body = coded[start:]
        if value & 1:
            if len(body) >= _MAX_BLOCK:
                raise DamagedError("damaged message: a block longer than zstd allows")
            body = (len(body) << 3 | _COMPRESSED_BLOCK << 1 | 1).to_bytes(3, "little") + body
        frame = b"".join((_MAGIC, _SINGLE_SEGMENT_WITH_SIZE, size.to_bytes(4, "little"), body))
        decompressor: Any = zstd.ZstdDecompressor(zstd_dict=self._dictionary)
        try:
            data: bytes = decompressor.decompress(frame, size + 1)
        except (zstd.ZstdError, EOFError) as error:
            raise DamagedError(f"damaged message: {' '.join(str(error).split())}") from error
        if len(data) != size or not decompressor.eof or decompressor.unused_data:
            raise DamagedError(f"damaged message: {len(data)} bytes instead of {size}")
        return data


def train(samples: list[bytes], size: int) -> bytes:
    """A zstd dictionary of at most ``size`` bytes from sample messages.

    :raises ValueError: when the samples are too few or too similar for training
    """
    try:
        content: bytes = zstd.train_dict(samples, size).dict_content
    except zstd.ZstdError as error:
        raise ValueError(" ".join(str(error).split())) from error
    return content


def read_varint(data: bytes) -> tuple[int, int]:
    """(value, where the rest begins)

    :raises DamagedError: when it does not end within 5 bytes
    """
    value = 0
    for at, byte in enumerate(data[:5]):
        value |= (byte & 0x7F) << 7 * at
        if byte < 0x80:
            return value, at + 1
    raise DamagedError("damaged message: a number that does not end")
