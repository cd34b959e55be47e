"""What every codec of the table keeps (``codecs/base.py``), tried with the samples of each."""

from __future__ import annotations

import random
from contextlib import suppress

import pytest

from gr_ros2.codecs import CODECS, Coded, base
from gr_ros2.codecs.base import KEY_TIMES
from gr_ros2.codecs.messages import VIDEO, read
from gr_ros2.codecs.pack import Packer
from gr_ros2.core.errors import CodecError, DamagedError, MissingFrameError
from tests.codecs.samples import SAMPLES, Sample

MAX_SIZE = 4_000_000

samples = pytest.mark.parametrize("sample", SAMPLES.values(), ids=SAMPLES)


def coded(sample: Sample, key: bool = False) -> list[Coded]:
    encoder = sample.topic().encoder()
    found = []
    for message in sample.messages():
        found.append(encoder.encode(message, sample.budget, key))
        encoder.confirmed(found[-1].name)
    return found


def test_every_codec_has_samples() -> None:
    assert {sample.codec for sample in SAMPLES.values()} == set(CODECS)
    numbers = [row.number for row in CODECS.values()]
    assert len(set(numbers)) == len(numbers)


@samples
def test_messages_come_out_in_their_type_with_their_header(sample: Sample) -> None:
    topic = sample.topic()
    decoder = topic.decoder(MAX_SIZE)
    number = CODECS[sample.codec].number
    for message, frame in zip(sample.messages(), coded(sample), strict=True):
        out = decoder.decode(frame.data)
        assert frame.data[0] == number
        assert len(frame.data) <= len(message) + 8
        shown, given = read(topic.codecs[number].output, out), read(sample.type_name, message)
        if sample.exact:
            assert out == message
            assert not frame.said
        else:
            if topic.codecs[number].output == VIDEO:
                assert (shown.timestamp, shown.frame_id) == (given.header.stamp, given.header.frame_id)
            else:
                assert shown.header == given.header
            assert frame.said


@samples
def test_frames_are_within_their_budget(sample: Sample) -> None:
    if sample.budget is not None:
        for frame in coded(sample):
            times = KEY_TIMES if frame.before is None and sample.codec in ("camera", "depth") else 1
            assert len(frame.data) <= 1.1 * times * sample.budget
    assert coded(sample)


@samples
def test_equal_messages_give_equal_frames(sample: Sample) -> None:
    assert coded(sample) == coded(sample)


@samples
def test_a_key_frame_stands_alone(sample: Sample) -> None:
    for frame in coded(sample, key=True):
        assert frame.before is None
        assert sample.topic().decoder(MAX_SIZE).decode(frame.data)


@samples
def test_a_frame_without_the_one_that_it_needs_is_not_shown(sample: Sample) -> None:
    frames = coded(sample)
    for frame in frames:
        decoder = sample.topic().decoder(MAX_SIZE)
        if frame.before is not None:
            with pytest.raises(MissingFrameError):
                decoder.decode(frame.data)
        assert decoder.decode(frames[0].data)
    assert frames[0].before is None


@samples
def test_whatever_is_lost_doubled_or_late_what_is_shown_is_what_was_sent(sample: Sample) -> None:
    """With joiners, and with restarts of the sender, whose frames are of another chain."""
    rng = random.Random(4)
    sent: list[tuple[bytes, bytes]] = []
    for _ in range(3):
        perfect, encoder = sample.topic().decoder(MAX_SIZE), sample.topic().encoder()
        for number, message in enumerate(sample.messages() * 3):
            frame = encoder.encode(message, sample.budget, key=number % 7 == 6)
            sent.append((frame.data, perfect.decode(frame.data)))
            if number % 2:
                encoder.confirmed(frame.name)
    shown = missing = 0
    for _ in range(12):
        decoder = sample.topic().decoder(MAX_SIZE)
        loss = rng.choice((0.05, 0.3))
        frames = [frame for frame in sent[rng.randrange(len(sent)) :] if rng.random() > loss]
        for place in range(len(frames) - 1):
            if rng.random() < 0.1:
                frames[place], frames[place + 1] = frames[place + 1], frames[place]
            elif rng.random() < 0.1:
                frames[place + 1] = frames[place]
        for data, message in frames:
            try:
                assert decoder.decode(data) == message
                shown += 1
            except MissingFrameError:
                missing += 1
    assert shown
    assert missing or all(encoder.encode(message).before is None for message in sample.messages())


@samples
def test_messages_that_are_not_of_the_type_are_damaged_and_the_next_passes(sample: Sample) -> None:
    encoder = sample.topic().encoder()
    for message in sample.messages():
        for cut in (0, 3, len(message) // 2) if sample.codec not in ("exact", "growing") else ():
            with pytest.raises(DamagedError):
                encoder.encode(message[:cut], sample.budget)
        assert encoder.encode(message, sample.budget).data


@samples
def test_arbitrary_frames_end_in_a_message_or_an_error_and_a_key_frame_mends_all(sample: Sample) -> None:
    rng = random.Random(1)
    frames = [frame.data for frame in coded(sample)]
    key = coded(sample, key=True)[0].data
    clean = sample.topic().decoder(MAX_SIZE).decode(key)
    decoder = sample.topic().decoder(MAX_SIZE)
    for turn in range(150):
        data = bytearray(rng.choice(frames))
        for _ in range(rng.choice((1, 1, 3, 20))):
            data[rng.randrange(len(data))] = rng.randrange(256)
        data = data[: rng.randrange(len(data) + 1)] if turn % 3 == 0 else data
        with suppress(CodecError):
            assert len(decoder.decode(bytes(data))) <= MAX_SIZE
        if turn % 10 == 0:
            assert decoder.decode(key) == clean


@samples
def test_no_message_is_larger_than_allowed(sample: Sample) -> None:
    frame = coded(sample, key=True)[-1].data
    size = len(sample.topic().decoder(MAX_SIZE).decode(frame))
    assert len(sample.topic().decoder(size + 64).decode(frame)) == size
    with pytest.raises(DamagedError):
        sample.topic().decoder(size // 2).decode(frame)


@samples
def test_random_bytes_are_no_frame(sample: Sample) -> None:
    rng = random.Random(2)
    for size in range(60):
        decoder = sample.topic().decoder(MAX_SIZE)
        with suppress(CodecError):
            assert len(decoder.decode(bytes([CODECS[sample.codec].number]) + rng.randbytes(size))) <= MAX_SIZE
    with pytest.raises(DamagedError):
        sample.topic().decoder().decode(b"")
    with pytest.raises(DamagedError, match="no codec 200"):
        sample.topic().decoder().decode(b"\xc8")


@samples
def test_bytes_that_are_no_message_end_in_an_error_and_nothing_refers_to_them(sample: Sample) -> None:
    """Neither at the encoder, whose next message passes, nor where somebody sends a frame that changes them."""
    topic, message = sample.topic(), sample.messages()[-1]
    for bad in (b"", b"\0\1\0\0", b"\x37\xa4\x30\xec" + bytes(range(200))):
        encoder, decoder = topic.encoder(), topic.decoder()
        with suppress(CodecError):
            coded = encoder.encode(bad, sample.budget)
            encoder.confirmed(coded.name)
            decoder.decode(coded.data)
        whole = base.frame(0, Packer().pack(bad))
        for forged in (whole, base.frame(1, b"\x0a12345", whole.name)):
            with suppress(CodecError):
                decoder.decode(bytes([CODECS[sample.codec].number]) + forged.data)
        assert decoder.decode(encoder.encode(message, sample.budget).data)
