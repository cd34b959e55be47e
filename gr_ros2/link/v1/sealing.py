"""The trailers of version 1: a CRC-32, or the 8-byte tag of AES-CCM (RFC 3610, RFC 6655), which cannot be made without
the key.

A fleet shares keys. Each start of each robot seals with its own key. That key is derived from the fleet's key by HKDF
(RFC 5869), with the robot's id and the number of the start, its *boot number*, half of which is random. So two robots
that have one id by mistake do not share a key. The nonce consists of the full packet number (not only 16 bits of it)
and the packet's repair id. No pair of key and nonce is used twice as long as a number is sent once, and a repair id
once per number.

Invariants: ``open`` returns a body only if the trailer belongs to the packet's bytes, its sender's boot number and its
full packet number; otherwise it raises a named WireError. The hop count of a sealed packet is not covered, because
relays change it.
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct
from typing import Literal, Protocol

from gr_ros2.core.errors import ConfigError, CrcError, TagError
from gr_ros2.state.keys import KEY_LEN
from gr_ros2.wire.v1 import ADDRESSED, CRC_LEN, HEADER_LEN, TAG_LEN, crc, session_crc

SealMode = Literal["none", "authenticate", "encrypt"]

NOT_A_REPAIR = 255
"""Takes the place of the repair id in the nonce of a source packet."""

_SUBKEY_LEN = 16
_SALT = b"gr-ros2 version 1"
_BOUND = b"bound to one radio"
_HOP = HEADER_LEN + 1
_nonce = Struct(">IQB")
_info = Struct(">BQ")


class Trailer(Protocol):
    """Closes and opens the packets of one start of one robot.

    ``clear`` is what stands before the body: the header, and in a repair packet also window, repair id and mask.
    ``number`` is the full packet number. ``repair_id`` is that of a repair packet; for other packets it is
    ``NOT_A_REPAIR``. ``plain``: the body is not encrypted, whatever the mode (as in a hello).

    :ivar size: its bytes
    :ivar encrypts: whether bodies are encrypted
    """

    size: int
    encrypts: bool

    def close(self, clear: bytes, body: bytes, number: int, repair_id: int, *, plain: bool = False) -> bytes:
        """The whole packet."""

    def open(self, clear: bytes, rest: bytes, number: int, repair_id: int, *, plain: bool = False) -> bytes:
        """The body.

        :param rest: what follows ``clear`` in the packet
        :raises WireError: CrcError or TagError, where the trailer does not match
        """


class Checksum:
    """CRC-32 over boot number, turns and packet. It detects damage and packets of another start. Anybody can forge it.

    :param boot: boot number of the sender
    """

    size, encrypts = CRC_LEN, False

    def __init__(self, boot: int) -> None:
        self._boot = boot
        self._turns = 0
        self._session = session_crc(boot, 0)

    def close(self, clear: bytes, body: bytes, number: int, repair_id: int, *, plain: bool = False) -> bytes:  # noqa: ARG002
        data = clear + body
        if number >> 16 != self._turns:
            self._turn(number >> 16)
        return data + crc(data, self._session)

    def open(self, clear: bytes, rest: bytes, number: int, repair_id: int, *, plain: bool = False) -> bytes:  # noqa: ARG002
        body = rest[:-CRC_LEN]
        if number >> 16 != self._turns:
            self._turn(number >> 16)
        if crc(clear + body, self._session) != rest[-CRC_LEN:]:
            raise CrcError("CRC-32 does not match: damaged, or of another start of the sender")
        return body

    def _turn(self, turns: int) -> None:
        self._turns, self._session = turns, session_crc(self._boot, turns)


class Seal:
    """AES-128-CCM with a tag of 8 bytes.

    :param key: 32 bytes, the fleet's key
    :param src_id: id of the sender
    :param boot: boot number of the sender
    :param encrypt: whether bodies are encrypted; otherwise everybody can read them, but nobody can change them
    """

    size = TAG_LEN

    def __init__(self, key: bytes, src_id: int, boot: int, *, encrypt: bool) -> None:
        from cryptography.exceptions import InvalidTag  # here: 8 MB that a link without a key does not need
        from cryptography.hazmat.primitives.ciphers.aead import AESCCM

        self.encrypts = encrypt
        self._forged = InvalidTag
        self._cipher = AESCCM(subkey(key, src_id, boot), tag_length=TAG_LEN)

    def close(self, clear: bytes, body: bytes, number: int, repair_id: int, *, plain: bool = False) -> bytes:
        nonce = _nonce.pack(0, number, repair_id)
        named = without_hop(clear) if clear[0] & ADDRESSED else clear
        if self.encrypts and not plain:
            return clear + self._cipher.encrypt(nonce, body, named)
        return clear + body + self._cipher.encrypt(nonce, b"", named + body)

    def open(self, clear: bytes, rest: bytes, number: int, repair_id: int, *, plain: bool = False) -> bytes:
        nonce = _nonce.pack(0, number, repair_id)
        named = without_hop(clear) if clear[0] & ADDRESSED else clear
        try:
            if self.encrypts and not plain:
                return self._cipher.decrypt(nonce, rest, named)
            body = rest[:-TAG_LEN]
            self._cipher.decrypt(nonce, rest[-TAG_LEN:], named + body)
        except self._forged:
            raise TagError("the tag does not match: damaged, forged, or of another start of the sender") from None
        return body


def without_hop(clear: bytes) -> bytes:
    """The bytes of an addressed packet before its body, without the hop count."""
    return clear[:_HOP] + clear[_HOP + 1 :]


def subkey(key: bytes, src_id: int, boot: int) -> bytes:
    """The key of one start of one robot: HKDF-SHA256 with salt ``gr-ros2 version 1``, and src_id and boot as info."""
    from cryptography.hazmat.primitives.hashes import SHA256
    from cryptography.hazmat.primitives.kdf.hkdf import HKDF

    return HKDF(SHA256(), _SUBKEY_LEN, _SALT, _info.pack(src_id, boot)).derive(key)


class Keys:
    """The keys of a fleet, and how its packets are sealed.

    :param keys: 32 bytes each; the first is used, all are accepted; empty if nothing is sealed
    :param mode: ``none`` sends and accepts packets with a CRC; other modes accept only sealed packets, encrypted or not
    :raises ConfigError: a key of another length, or a mode that does not fit the keys
    """

    def __init__(self, keys: Sequence[bytes] = (), mode: SealMode = "none") -> None:
        if any(len(key) != KEY_LEN for key in keys):
            raise ConfigError(f"a key has {KEY_LEN} bytes; make one with gr-ros2 key new FILE")
        if (mode == "none") != (not keys):
            remedy = "set key to a file (gr-ros2 key new FILE)" if not keys else "leave key out, or change seal"
            raise ConfigError(f"seal = {mode!r} with {len(keys)} keys; {remedy}")
        self.mode = mode
        self._keys = tuple(keys)

    def bound(self) -> Keys:
        """Those of the endpoints that send over one radio alone: what these have sealed opens nowhere else, also
        without the byte before it."""
        from cryptography.hazmat.primitives.hashes import SHA256
        from cryptography.hazmat.primitives.kdf.hkdf import HKDF

        return Keys([HKDF(SHA256(), KEY_LEN, _SALT, _BOUND).derive(key) for key in self._keys], self.mode)

    @property
    def sealed(self) -> bool:
        """Whether packets carry a tag."""
        return bool(self._keys)

    @property
    def trailer_len(self) -> int:
        """Bytes of a trailer."""
        return TAG_LEN if self._keys else CRC_LEN

    @property
    def encrypts(self) -> bool:
        """Whether bodies are encrypted."""
        return self.mode == "encrypt"

    def own(self, src_id: int, boot: int) -> Trailer:
        """The trailer of this robot's packets."""
        if not self._keys:
            return Checksum(boot)
        return Seal(self._keys[0], src_id, boot, encrypt=self.encrypts)

    def candidates(self, src_id: int, boot: int, *, encrypt: bool) -> list[Trailer]:
        """The trailers that another robot's packets may have."""
        if not self._keys:
            return [Checksum(boot)]
        return [Seal(key, src_id, boot, encrypt=encrypt) for key in self._keys]
