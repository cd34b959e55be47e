"""Trailers: what they refuse, and that AES-CCM and HKDF are the ones of the RFCs."""

from __future__ import annotations

import hmac
from hashlib import sha256

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError, WireError
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, Keys, SealMode, Trailer, subkey
from gr_ros2.wire.v1 import Header, write_header

KEY, OTHER = bytes(range(32)), bytes(32)
MODES: list[SealMode] = ["none", "authenticate", "encrypt"]


def trailers(mode: SealMode, boot: int = 7) -> tuple[Trailer, Trailer]:
    keys = Keys((KEY,) if mode != "none" else (), mode)
    return keys.own(3, boot), keys.candidates(3, boot, encrypt=keys.encrypts)[0]


@pytest.mark.parametrize("mode", MODES)
@given(body=st.binary(max_size=40), number=st.integers(0, 1 << 47), repair_id=st.integers(0, 127), plain=st.booleans())
def test_what_is_closed_opens(mode: SealMode, body: bytes, number: int, repair_id: int, plain: bool) -> None:
    ours, theirs = trailers(mode)
    clear = write_header(Header(3, mode != "none", 3, number & 65535)) + bytes((0, repair_id))
    data = ours.close(clear, body, number, repair_id, plain=plain)
    assert len(data) == len(clear) + len(body) + ours.size
    assert theirs.open(clear, data[len(clear) :], number, repair_id, plain=plain) == body
    assert (body in data) or (mode == "encrypt" and not plain)


@pytest.mark.parametrize("mode", MODES)
@given(body=st.binary(max_size=20), flip=st.integers(0, 10_000), number=st.integers(0, 1 << 40))
def test_any_change_is_refused(mode: SealMode, body: bytes, flip: int, number: int) -> None:
    ours, theirs = trailers(mode)
    clear = write_header(Header(0, mode != "none", 3, number & 65535))
    data = bytearray(ours.close(clear, body, number, NOT_A_REPAIR))
    data[flip // 8 % len(data)] ^= 1 << flip % 8
    with pytest.raises(WireError):
        theirs.open(bytes(data[:4]), bytes(data[4:]), number, NOT_A_REPAIR)


@pytest.mark.parametrize("mode", MODES)
def test_another_start_number_repair_id_source_or_key_is_refused(mode: SealMode) -> None:
    ours, theirs = trailers(mode)
    clear = write_header(Header(0, mode != "none", 3, 5))
    rest = ours.close(clear, b"body", 5, NOT_A_REPAIR)[4:]
    later = trailers(mode, boot=8)[1]
    wrong = [(later, 5, NOT_A_REPAIR), (theirs, 5 + 65536, NOT_A_REPAIR)]
    if mode != "none":
        keys = Keys((OTHER,), mode)
        wrong += [(theirs, 5, 1), (keys.own(3, 7), 5, NOT_A_REPAIR), (Keys((KEY,), mode).own(4, 7), 5, NOT_A_REPAIR)]
    for trailer, number, repair_id in wrong:
        with pytest.raises(WireError):
            trailer.open(clear, rest, number, repair_id)


def test_what_goes_over_one_radio_alone_opens_nowhere_else() -> None:
    keys = Keys((bytes(32), bytes(range(32))), "encrypt")
    clear = write_header(Header(0, True, 1, 5))
    for closing, opening in ((keys, keys.bound()), (keys.bound(), keys)):
        data = closing.own(1, 2).close(clear, b"body", 5, NOT_A_REPAIR)
        for trailer in opening.candidates(1, 2, encrypt=True):
            with pytest.raises(WireError):
                trailer.open(data[: len(clear)], data[len(clear) :], 5, NOT_A_REPAIR)
        assert closing.candidates(1, 2, encrypt=True)[0].open(clear, data[len(clear) :], 5, NOT_A_REPAIR) == b"body"


def test_a_relay_may_change_the_hop_count_and_nothing_else() -> None:
    ours, theirs = trailers("encrypt")
    clear = write_header(Header(0, True, 3, 5, dst_id=9, hop=3))
    rest = ours.close(clear, b"body", 5, NOT_A_REPAIR)[6:]
    assert theirs.open(clear[:5] + b"\2", rest, 5, NOT_A_REPAIR) == b"body"
    with pytest.raises(WireError):
        theirs.open(clear[:4] + b"\x08" + clear[5:], rest, 5, NOT_A_REPAIR)


def test_subkeys_are_those_of_rfc_5869() -> None:
    extracted = hmac.digest(b"gr-ros2 version 1", KEY, sha256)
    info = bytes((3, 0, 0, 0, 0, 0, 0, 0, 7))
    assert subkey(KEY, 3, 7) == hmac.digest(extracted, info + b"\1", sha256)[:16]


def test_keys_and_mode_go_together() -> None:
    for keys, mode in (((), "encrypt"), ((KEY,), "none"), ((b"short",), "encrypt")):
        with pytest.raises(ConfigError):
            Keys(keys, mode)  # type: ignore[arg-type]
    assert [Keys((KEY, OTHER), "authenticate").trailer_len, Keys().trailer_len] == [8, 4]
    assert len(Keys((KEY, OTHER), "encrypt").candidates(1, 2, encrypt=True)) == 2
