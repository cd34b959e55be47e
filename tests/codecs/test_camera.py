"""Cameras: every encoding, every output, sizes that follow the budget, chains of frames, and bad images."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from shutil import which
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.codecs import CODECS, CodedTopic, h264, video
from gr_ros2.codecs.base import KEY_TIMES
from gr_ros2.codecs.camera import ENCODINGS, scaled_camera_info
from gr_ros2.codecs.messages import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, PACKET, VIDEO, read, write
from gr_ros2.compression.zstd_frames import read_varint
from gr_ros2.core.errors import ConfigError, DamagedError, MissingFrameError
from gr_ros2.wire import varint
from tests.codecs.scenes import Array, camera_info, compressed, header, image, picture, view

WIDTH, HEIGHT, BUDGET = 160, 120, 2000


def through(message: bytes, type_name: str = IMAGE, budget: int = BUDGET, **options: str) -> tuple[Any, str]:
    """The message that comes out, and what was said."""
    topic = CodedTopic(type_name, {"camera": options})
    coded = topic.encoder().encode(message, budget)
    return read(next(iter(topic.codecs.values())).output, topic.decoder().decode(coded.data)), coded.said


def psnr(one: Array, other: Array) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


def in_encoding(pixels: Array, encoding: str) -> Array:
    """RGB pixels as bytes of an encoding, shape (height, bytes of a row)."""
    kind, _ = ENCODINGS[encoding]
    if kind.startswith("bayer"):
        made = np.empty(pixels.shape[:2], np.uint8)
        for place, letter in enumerate(encoding.removeprefix("bayer_")[:4]):
            row, column = divmod(place, 2)
            made[row::2, column::2] = pixels[row::2, column::2, "rgb".index(letter)]
        return made
    return video.to_rows(picture(pixels, kind), pixels.shape[1] * ENCODINGS[encoding][1]).copy()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_comes_out_as_it_came_in(encoding: str) -> None:
    smooth = np.kron(view(1, WIDTH // 8, HEIGHT // 8), np.ones((8, 8, 1), np.uint8))
    rows = in_encoding(smooth, encoding)
    message = image(rows.reshape(HEIGHT, WIDTH, -1), encoding, 3, padding=5)
    out, said = through(message, size="full")
    assert (out.width, out.height, out.encoding, out.step) == (WIDTH, HEIGHT, encoding, rows.shape[1])
    assert out.header == header(3)
    assert psnr(out.data.reshape(HEIGHT, -1), rows) > 26
    assert ("without alpha" in said) == (encoding in ("rgba8", "bgra8"))


@pytest.mark.parametrize("encoding", ["rgb8", "bayer_rggb8"])
def test_odd_sizes_stay(encoding: str) -> None:
    pixels = view(0, 161, 121)
    rows = in_encoding(pixels, encoding)
    out, _ = through(image(rows.reshape(121, 161, -1), encoding), size="full")
    assert (out.width, out.height, len(out.data)) == (161, 121, rows.size)
    assert psnr(out.data.reshape(rows.shape), rows) > 18


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(ENCODINGS)), st.integers(1, 70), st.integers(1, 70), st.integers(30, 4000))
def test_images_of_any_size_come_out_in_it(encoding: str, width: int, height: int, budget: int) -> None:
    """FFmpeg's converter would end the process for a Bayer image with an odd side."""
    width += width % 2 if ENCODINGS[encoding][1] == 2 else 0
    pixels = np.random.default_rng(1).integers(0, 256, (height, width, ENCODINGS[encoding][1]), np.uint8)
    message = image(pixels, encoding)
    topic = CodedTopic(IMAGE, {"camera": {"size": "full"}})
    out = read(IMAGE, topic.decoder().decode(topic.encoder().encode(message, budget).data))
    assert (out.width, out.height, out.encoding, len(out.data)) == (width, height, encoding, pixels.size)


@pytest.mark.parametrize("encoding", ["rgb16", "16UC3", "yuv420", "", "bayer_rggb16"])
def test_an_unknown_encoding_passes_exactly_and_is_named(encoding: str) -> None:
    message = image(view(0, 16, 8), encoding)
    topic = CodedTopic(IMAGE)
    coded = topic.encoder().encode(message)
    assert topic.decoder().decode(coded.data) == message
    assert f"encoding {encoding!r}" in coded.said


@pytest.mark.parametrize(("codec", "kind"), [("mjpeg", "yuvj420p"), ("mjpeg", "yuvj422p"), ("png", "rgb24")])
def test_compressed_images_come_out_as_jpeg(codec: str, kind: str) -> None:
    pixels = view(0, WIDTH, HEIGHT)
    label = f"rgb8; {codec.replace('mjpeg', 'jpeg')} compressed "
    message = compressed(video.packed(codec, picture(pixels, kind), 2), label, 2)
    out, _ = through(message, COMPRESSED_IMAGE, size="full")
    assert out.header == header(2)
    assert out.format == "rgb8; jpeg compressed "
    shown = video.still("mjpeg", bytes(out.data)).to_ndarray(format="rgb24")
    assert psnr(shown, pixels) > 22


def test_a_picture_with_alpha_says_that_it_loses_it() -> None:
    topic = CodedTopic(COMPRESSED_IMAGE)
    for kind, said in (("rgba", True), ("rgb24", False)):
        message = compressed(video.packed("png", picture(view(0, 64, 48), kind)), "png")
        assert ("without alpha" in topic.encoder().encode(message, BUDGET).said) == said


def test_pictures_that_are_neither_jpeg_nor_png_pass_exactly() -> None:
    deep = video.packed("png", video.from_rows(np.zeros((8, 16), np.uint8), 8, "gray16be"))
    for data, label in ((b"RIFF1234WEBP", "webp"), (deep, "png")):
        message = compressed(data, label)
        topic = CodedTopic(COMPRESSED_IMAGE)
        coded = topic.encoder().encode(message)
        assert topic.decoder().decode(coded.data) == message
        assert label in coded.said


@pytest.mark.parametrize(
    ("shape", "encoding", "said"),
    [
        ((6000, 6000), "mono8", "6000 × 6000 pixels"),
        ((4000, 4000), "16UC1", "4000 × 4000 pixels"),
        ((1, 1), "bayer_rggb8", "no Bayer pattern"),
        ((8, 8), "16UC3", "encoding '16UC3'"),
    ],
)
def test_the_reason_why_a_picture_passes_exactly_is_that_of_its_own_codec(
    shape: tuple[int, int], encoding: str, said: str
) -> None:
    size = {"16UC1": 2, "16UC3": 6}.get(encoding, 1)
    coded = CodedTopic(IMAGE).encoder().encode(image(np.zeros((*shape, size), np.uint8), encoding))
    assert coded.data[0] == CODECS["exact"].number
    assert said in coded.said


@pytest.mark.parametrize(("width", "height"), [(30_000, 1), (1, 30_000), (16_386, 64)])
def test_a_picture_of_a_side_that_no_encoder_takes_is_halved(width: int, height: int) -> None:
    out, _ = through(image(np.zeros((height, width, 1), np.uint8), "mono8"), size="full")
    assert (out.width, out.height) == (-(-width // 2), -(-height // 2))


def broken(**change: Any) -> Callable[[], bytes]:
    def make() -> bytes:
        good = read(IMAGE, image(view(0, 32, 16), "rgb8"))
        names = ("header", "height", "width", "encoding", "is_bigendian", "step", "data")
        return write(IMAGE, **{name: getattr(good, name) for name in names} | change)

    return make


BAD_IMAGES = {
    "no width": broken(width=0),
    "no height": broken(height=0),
    "no pixels": broken(width=0, height=0, step=0, data=np.zeros(0, np.uint8)),
    "wider than its rows": broken(width=33),
    "higher than its data": broken(height=17),
    "no data": broken(data=np.zeros(0, np.uint8)),
    "65,535 × 65,535": broken(width=65535, height=65535, step=3 * 65535),
}


@pytest.mark.parametrize("bad", BAD_IMAGES.values(), ids=BAD_IMAGES)
def test_an_image_that_contradicts_itself_has_one_reason_and_the_next_passes(bad: Callable[[], bytes]) -> None:
    topic = CodedTopic(IMAGE)
    encoder, decoder = topic.encoder(), topic.decoder()
    first = encoder.encode(image(view(0, 64, 64), "rgb8"), BUDGET)
    with pytest.raises(DamagedError, match="damaged image"):
        encoder.encode(bad(), BUDGET)
    second = encoder.encode(image(view(1, 64, 64), "rgb8", 1), BUDGET)
    assert second.before == first.name
    assert [decoder.decode(first.data) != b"", decoder.decode(second.data) != b""] == [True, True]


def test_a_jpeg_that_is_cut_short_has_one_reason_and_the_next_passes() -> None:
    good = [video.packed("mjpeg", picture(view(n, WIDTH, HEIGHT), "yuvj420p")) for n in range(2)]
    topic = CodedTopic(COMPRESSED_IMAGE)
    encoder = topic.encoder()
    for length in (2, 100, 700, len(good[0]) // 2):
        with pytest.raises(DamagedError):
            encoder.encode(compressed(good[0][:length], "jpeg"), BUDGET)
    assert encoder.encode(compressed(good[1], "jpeg"), BUDGET).data[0] == 1


def test_a_jpeg_is_whole_only_with_its_end() -> None:
    whole = video.packed("mjpeg", picture(np.full((64, 64, 3), 90, np.uint8), "yuvj420p"))
    for behind in (b"", b"\0" * 8):
        assert video.still("mjpeg", whole + behind).width == 64
    for size in range(2, len(whole) - 1):
        with pytest.raises(DamagedError):
            video.still("mjpeg", whole[:size])


def test_another_size_encoding_or_frame_is_a_key_frame() -> None:
    topic = CodedTopic(IMAGE, {"camera": {"size": "full"}})
    encoder, decoder = topic.encoder(), topic.decoder()
    small, large = view(0, 64, 48), view(0, 96, 48)
    messages = [
        *(image(small, "rgb8", n) for n in range(2)),
        *(image(small, "bgr8", n) for n in range(2)),
        *(image(large, "bgr8", n) for n in range(2)),
    ]
    frames = [encoder.encode(message, BUDGET) for message in messages]
    assert [frame.before is None for frame in frames] == [True, False] * 3
    shown = [read(IMAGE, decoder.decode(frame.data)) for frame in frames]
    assert [(out.width, out.encoding) for out in shown[::2]] == [(64, "rgb8"), (64, "bgr8"), (96, "bgr8")]


def test_key_frames_one_after_the_other_take_no_more_than_the_budget() -> None:
    """As of two cameras that publish as one topic."""
    encoder = CodedTopic(IMAGE, {"camera": {"size": "full"}}).encoder()
    frames = [
        encoder.encode(image(view(number, 160, 120), ("rgb8", "bgr8")[number % 2], number), 900) for number in range(6)
    ]
    assert {frame.before for frame in frames} == {None}
    assert len(frames[0].data) > 2 * 900
    assert all(len(frame.data) <= 1.1 * 900 for frame in frames[1:])


def test_the_size_follows_the_budget_and_stays_when_it_wavers() -> None:
    topic = CodedTopic(IMAGE)
    encoder = topic.encoder()
    message = image(view(0, 320, 240), "rgb8")
    blocks = 20 * 15

    def sizes(budgets: list[int]) -> list[int]:
        said = [encoder.encode(message, budget).said for budget in budgets]
        return [int(each.split(" of ")[1].split(" ")[0]) for each in said]

    assert set(sizes([3 * blocks + 1] * 3)) == {320}
    assert set(sizes([2 * blocks, 5 * blocks] * 10)) == {320}
    fallen = sizes([blocks] * 30)
    assert (fallen[0], fallen[-1], len(set(fallen))) == (320, 160, 2)
    assert sizes([8 * blocks] * 30)[-1] == 320


@pytest.mark.parametrize(
    ("size", "width"),
    [("full", 320), ("320x240", 320), ("319x240", 160), ("100x1000", 160), ("1x1", 160), ("auto", 160)],
)
def test_a_size_may_be_given(size: str, width: int) -> None:
    out, said = through(image(view(0, 320, 240), "rgb8"), budget=100, size=size)
    assert out.width == width
    assert (", of 320 × 240" in said) == (width < 320)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"size": "big"}, "size is 'big'"),
        ({"size": "0x3"}, "size is '0x3'"),
        ({"output_type": "mp4"}, "output_type is 'mp4'"),
    ],
)
def test_a_wrong_option_is_named(options: dict[str, str], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        CodedTopic(IMAGE, {"camera": options})


@pytest.mark.parametrize("drop", range(1, 6))
def test_nothing_is_shown_after_a_missing_frame_until_a_key_frame(drop: int) -> None:
    topic = CodedTopic(IMAGE)
    encoder, decoder = topic.encoder(), topic.decoder()
    frames = [encoder.encode(image(view(n, 64, 64), "rgb8", n), BUDGET, key=n == 6) for n in range(9)]
    for number, frame in enumerate(frames):
        if number == drop:
            continue
        if drop < number < 6:
            with pytest.raises(MissingFrameError):
                decoder.decode(frame.data)
        else:
            assert read(IMAGE, decoder.decode(frame.data)).header == header(number)


def test_a_frame_that_comes_twice_or_of_another_chain_is_not_shown() -> None:
    topic = CodedTopic(IMAGE)
    one, other = topic.encoder(), topic.encoder()
    mine = [one.encode(image(view(n, 64, 64), "rgb8"), BUDGET) for n in range(3)]
    theirs = [other.encode(image(view(n + 5, 64, 64), "rgb8"), BUDGET) for n in range(3)]
    decoder = topic.decoder()
    decoder.decode(mine[0].data)
    decoder.decode(mine[1].data)
    for frame in (mine[1], theirs[2]):
        with pytest.raises(MissingFrameError):
            decoder.decode(frame.data)
    # What was shown before is forgotten, too: the frame after it might build on what was refused.
    with pytest.raises(MissingFrameError):
        decoder.decode(mine[2].data)


def test_decoders_of_two_streams_do_not_meet() -> None:
    topic = CodedTopic(IMAGE)
    streams = [[topic.encoder(), topic.decoder()] for _ in range(2)]
    for number in range(4):
        for place, (encoder, decoder) in enumerate(streams):
            coded = encoder.encode(image(view(number + 9 * place, 64, 64), "rgb8", number + place), BUDGET)
            assert read(IMAGE, decoder.decode(coded.data)).header == header(number + place)


def claims(width: int, height: int, body: bytes) -> bytes:
    return b"\1\1" + varint(width) + varint(height) + varint(0) + varint(0) + body


def test_what_claims_to_be_large_is_refused_before_it_is_decoded() -> None:
    decoder = CodedTopic(IMAGE).decoder(1 << 20)
    with pytest.raises(DamagedError, match="65534 × 65534 pixels, at most"):
        decoder.decode(claims(65534, 65534, bytes(20)))
    large = h264.H264Encoder(2048, 2048).encode(video.from_luma(np.zeros((2048, 2048), np.uint8)), 9000)
    with pytest.raises(DamagedError):
        decoder.decode(claims(64, 64, large))
    with pytest.raises(DamagedError):
        h264.H264Decoder(2048, 1024).decode(large)


def test_compressed_video_is_what_ffmpeg_decodes_without_a_warning(tmp_path: Path) -> None:
    topic = CodedTopic(IMAGE, {"camera": {"output_type": "CompressedVideo"}})
    encoder, decoder = topic.encoder(), topic.decoder()
    stream = b""
    for number in range(12):
        out = read(
            VIDEO, decoder.decode(encoder.encode(image(view(number, 64, 48), "rgb8", number), 600, number == 6).data)
        )
        assert (out.format, out.frame_id, out.timestamp) == ("h264", "camera", header(number).stamp)
        stream += bytes(out.data)
    path = tmp_path / "stream.h264"
    path.write_bytes(stream)
    with av.open(str(path), format="h264") as file:
        assert sum(1 for _ in file.decode(video=0)) == 12
    if which("ffmpeg"):
        command = ["ffmpeg", "-v", "warning", "-i", str(path), "-f", "null", "-"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")


def test_packets_for_ffmpeg_name_key_frames() -> None:
    topic = CodedTopic(IMAGE, {"camera": {"output_type": "FFMPEGPacket", "size": "full"}})
    encoder, decoder = topic.encoder(), topic.decoder()
    found = [encoder.encode(image(view(n, 65, 48), "rgb8", n), BUDGET, key=n == 2) for n in range(4)]
    out = [read(PACKET, decoder.decode(frame.data)) for frame in found]
    assert [packet.flags for packet in out] == [1, 0, 1, 0]
    assert {(packet.width, packet.height, packet.encoding) for packet in out} == {(66, 48, "h264")}
    assert out[3].pts == 1_700_000_000_300_000_000
    with pytest.raises(MissingFrameError):
        topic.decoder().decode(found[1].data)


@pytest.mark.parametrize("budget", [130, 160, 200])
def test_a_key_frame_of_a_small_budget_is_no_grey_picture(budget: int) -> None:
    pixels = view(0, 640, 480)
    topic = CodedTopic(IMAGE)
    coded = topic.encoder().encode(image(pixels, "rgb8"), budget)
    out = read(IMAGE, topic.decoder().decode(coded.data))
    shown = out.data.reshape(out.height, out.width, 3)
    assert psnr(shown, pixels[2::4, 2::4]) > 18.5
    assert len(coded.data) <= KEY_TIMES * budget


@pytest.mark.parametrize("budget", [100, 160, 200, 330])
def test_a_budget_between_two_kilobits_is_used_and_held(budget: int) -> None:
    """x264's buffer is a whole number of kilobits."""
    encoder = CodedTopic(IMAGE, {"camera": {"size": "full"}}).encoder()
    frames = [encoder.encode(image(view(n, WIDTH, HEIGHT), "rgb8", n), budget) for n in range(60)]
    shares = [len(frame.data) / budget for frame in frames[1:]]
    assert np.median(shares) >= 0.8
    assert np.percentile(shares, 99) <= 1.15
    assert 0.65 <= len(frames[0].data) / budget / KEY_TIMES <= 1


def test_a_budget_that_grows_is_used_at_once() -> None:
    encoder = CodedTopic(IMAGE, {"camera": {"size": "full"}}).encoder()
    budgets = [200 + 50 * (n % 2) for n in range(60)]
    frames = [encoder.encode(image(view(n, WIDTH, HEIGHT), "rgb8", n), budget) for n, budget in enumerate(budgets)]
    assert np.median([len(frame.data) for frame in frames[1::2]]) >= 0.75 * 250


def test_budgets_hold_when_they_change_with_each_frame() -> None:
    rng = np.random.default_rng(5)
    topic = CodedTopic(IMAGE, {"camera": {"size": "full"}})
    encoder = topic.encoder()
    shares = []
    for number in range(150):
        budget = int(400 * 6 ** rng.random())
        coded = encoder.encode(image(view(number, WIDTH, HEIGHT), "rgb8"), budget)
        shares.append(len(coded.data) / budget / (KEY_TIMES if number == 0 else 1))
    assert np.percentile(shares, 99) <= 1.1


def test_a_camera_info_is_scaled_with_its_image() -> None:
    small = read(CAMERA_INFO, scaled_camera_info(camera_info(), 320, 120))
    whole = read(CAMERA_INFO, camera_info())
    point = np.array([0.3, -0.2, 2.0])
    before, after = (np.asarray(each.k).reshape(3, 3) @ point / point[2] for each in (whole, small))
    # A corner of the picture stays a corner: it lies half a pixel before the centre of the first one.
    assert (after[:2] + 0.5) * (2, 4) == pytest.approx(before[:2] + 0.5)
    assert np.asarray(small.p).reshape(3, 4)[0, 3] == pytest.approx(-6)
    assert (small.width, small.height, small.header) == (320, 120, whole.header)
    assert (small.roi.x_offset, small.roi.y_offset, small.roi.width, small.roi.height) == (50, 12, 150, 50)
    assert scaled_camera_info(camera_info(), 640, 480) == camera_info()
    with pytest.raises(DamagedError):
        scaled_camera_info(b"\0\1\0\0", 1, 1)


@settings(max_examples=80, deadline=None)
@given(st.binary(max_size=300), st.integers(2, 200), st.integers(2, 200))
def test_any_bytes_of_video_end_in_an_image_or_an_error(data: bytes, width: int, height: int) -> None:
    decoder = video.VideoDecoder(1 << 14)
    body = b"\1" + varint(width) + varint(height) + varint(0) + varint(0)
    for start in (b"\0\0\0\1\x67", b"\0\0\0\1\x65", b""):
        try:
            *_, shown, key = decoder.read(body + start + data)
        except DamagedError:
            continue
        assert key
        assert shown is None or shown.width * shown.height <= 1 << 14
    assert read_varint(varint(width))[0] == width


@pytest.mark.parametrize(("width", "height", "encoding"), [(3840, 2160, "rgb8"), (4200, 2400, "mono8")])
def test_a_picture_that_no_receiver_would_make_is_halved(width: int, height: int, encoding: str) -> None:
    """More bytes than a message may have, more pixels than a decoder takes."""
    pixels = np.zeros((height, width, 3)[: 3 if encoding == "rgb8" else 2], np.uint8)
    topic = CodedTopic(IMAGE, {"camera": {"size": "full"}})
    coded = topic.encoder().encode(image(pixels, encoding), 100_000)
    out = read(IMAGE, topic.decoder().decode(coded.data))
    assert (out.width, out.height) == (width // 2, height // 2)
