"""The image path: equal to the Qwen-VL image processor, and clear about unusable frames."""

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

from ridetune.camera.render import render
from ridetune.camera.scene import sample_scene
from ridetune.vision import (
    MAX_BYTES,
    FrameError,
    VisionSpec,
    decode_frame,
    fit_frame,
    patchify,
    read_patches,
)

REAL = Path(__file__).parents[1] / "../shared/real/images"
HALF = (0.5, 0.5, 0.5)
QWEN3_TINY = VisionSpec(4, 7, 16, 2, 2, HALF, HALF)
QWEN3_WIDE = VisionSpec(9, 16, 16, 2, 2, HALF, HALF)
QWEN25 = VisionSpec(
    8, 14, 14, 2, 2, (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
)
Pixels = NDArray[np.uint8]


def _encode(pixels: Pixels, kind: str = "PNG", **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


def _frame(seed: int = 0, width: int = 448, height: int = 256) -> Pixels:
    scene = sample_scene(np.random.default_rng(seed))
    return np.asarray(render(scene, width, height), np.uint8)


def _by_hugging_face(pixels: Pixels, spec: VisionSpec) -> NDArray[np.float32]:
    area = spec.height_px * spec.width_px
    processor = Qwen2VLImageProcessorPil(
        size={"shortest_edge": area, "longest_edge": area},
        patch_size=spec.patch_size,
        merge_size=spec.merge_size,
        temporal_patch_size=spec.temporal_patch_size,
        image_mean=list(spec.mean),
        image_std=list(spec.std),
    )
    out = processor(images=[Image.fromarray(pixels)], return_tensors="np")
    assert tuple(out["image_grid_thw"][0]) == spec.grid_thw
    return np.asarray(out["pixel_values"], np.float32)


def _crop_to(pixels: Pixels, spec: VisionSpec) -> Pixels:
    """Centre crop to exactly the grid's shape, so that both sides resize the same pixels."""
    scale = min(pixels.shape[0] // spec.height_px, pixels.shape[1] // spec.width_px) or 1
    height, width = scale * spec.height_px, scale * spec.width_px
    top, left = (pixels.shape[0] - height) // 2, (pixels.shape[1] - width) // 2
    return pixels[top : top + height, left : left + width]


@pytest.mark.parametrize("spec", [QWEN3_TINY, QWEN3_WIDE, QWEN25], ids=["tiny", "wide", "2.5"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_patches_of_synthetic_frames_equal_those_of_hugging_face(
    spec: VisionSpec, seed: int
) -> None:
    pixels = _frame(seed, 2 * spec.width_px, 2 * spec.height_px)
    ours = read_patches(_encode(pixels), spec)
    assert ours.dtype == np.float32
    assert np.abs(ours - _by_hugging_face(pixels, spec)).max() <= 1e-5


@pytest.mark.skipif(not REAL.is_dir(), reason="the real camera images are not in this checkout")
@pytest.mark.parametrize("condition", ["sunny", "rain", "snow", "night", "overcast"])
def test_patches_of_real_frames_equal_those_of_hugging_face(condition: str) -> None:
    path = sorted((REAL / condition).iterdir())[0]
    pixels = _crop_to(decode_frame(path.read_bytes()), QWEN3_TINY)
    ours = read_patches(_encode(pixels, compress_level=1), QWEN3_TINY)
    assert np.abs(ours - _by_hugging_face(pixels, QWEN3_TINY)).max() <= 1e-5


def test_decoded_pixels_of_a_jpeg_equal_those_of_opencv() -> None:
    jpeg = _encode(_frame(), "JPEG", quality=88)
    decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert decoded is not None
    expected = decoded.astype(np.int16)
    assert np.abs(decode_frame(jpeg).astype(np.int16) - expected).max() <= 1


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_large_jpeg_is_decoded_small_and_looks_the_same(orientation: int) -> None:
    turned = orientation == 6
    exif = Image.Exif()
    exif[274] = orientation
    size = (900, 1600) if turned else (1600, 900)
    jpeg = _encode(_frame(1, *size), "JPEG", quality=90, exif=exif)
    small = decode_frame(jpeg, (448, 256))
    assert small.shape == (450, 800, 3)
    assert decode_frame(jpeg).shape == (900, 1600, 3)
    whole = fit_frame(decode_frame(jpeg), QWEN3_TINY).astype(np.int16)
    assert np.abs(fit_frame(small, QWEN3_TINY) - whole).mean() < 1.0  # of 255 levels


def test_a_jpeg_is_never_decoded_smaller_than_asked() -> None:
    jpeg = _encode(_frame(1, 890, 600), "JPEG")
    assert decode_frame(jpeg, (448, 256)).shape == (600, 890, 3)
    assert decode_frame(jpeg, (445, 256)).shape == (300, 445, 3)


def test_a_patch_holds_channel_time_row_column_and_blocks_stay_together() -> None:
    spec = VisionSpec(1, 2, 2, 2, 2, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    pixels = np.zeros((4, 8, 3), np.uint8)
    pixels[:, :, 0] = np.arange(32).reshape(4, 8)
    patches = np.rint(patchify(pixels, spec) * 255)
    assert patches.shape == (8, 3 * 2 * 2 * 2)
    assert patches[0, :8].tolist() == [0, 1, 8, 9] * 2  # red, two times, a 2x2 patch
    assert patches[:, 0].tolist() == [0, 2, 16, 18, 4, 6, 20, 22]  # four patches a token
    assert not patches[:, 8:].any()


def test_a_frame_of_another_shape_is_cropped_in_its_middle() -> None:
    pixels = np.zeros((256, 1000, 3), np.uint8)
    pixels[:, 276:724] = 200  # the middle 448 of 1000 columns has the grid's shape
    assert fit_frame(pixels, QWEN3_TINY)[:, 2:-2].min() == 200
    tall = np.zeros((1000, 448, 3), np.uint8)
    tall[372:628] = 200
    assert fit_frame(tall, QWEN3_TINY)[2:-2].min() == 200


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "1"])
def test_other_colour_modes_become_rgb(mode: str) -> None:
    buffer = io.BytesIO()
    Image.fromarray(_frame()).convert(mode).save(buffer, "PNG")
    assert decode_frame(buffer.getvalue()).shape == (256, 448, 3)


def test_rotation_of_a_phone_camera_is_applied() -> None:
    exif = Image.Exif()
    exif[274] = 6
    assert decode_frame(_encode(_frame(), "JPEG", exif=exif)).shape == (448, 256, 3)


def _png_header(width: int, height: int) -> bytes:
    def chunk(name: bytes, body: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(name + body))
        return struct.pack(">I", len(body)) + name + body + check

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(b"\0" * 1000)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + head + body


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (b"", "is empty"),
        (b"hello, I am a text", "not a readable JPEG or PNG"),
        (b"GIF89a" + b"\0" * 100, "not a readable JPEG or PNG"),
        (b"\xff\xd8\xff", "not a readable JPEG or PNG"),
        (b"\0" * (MAX_BYTES + 1), f"has {MAX_BYTES + 1} bytes, the limit is {MAX_BYTES}"),
        (_png_header(8000, 8000), "announces 8000x8000 pixels"),
        (_png_header(60_000, 60_000), "announces too many pixels|announces 60000x60000"),
        (_png_header(448, 256), "damaged"),
        (_encode(np.zeros((31, 200, 3), np.uint8)), "200x31 pixels, each side needs at least 32"),
        (_encode(np.zeros((1, 1, 3), np.uint8)), "1x1 pixels"),
    ],
    ids=["empty", "text", "gif", "stub", "large", "big", "bomb", "no-rows", "flat", "dot"],
)
def test_an_unusable_frame_is_refused_with_its_reason(frame: bytes, message: str) -> None:
    with pytest.raises(FrameError, match=message):
        decode_frame(frame)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 0.995])
@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_a_truncated_frame_is_refused_and_never_painted_grey(kind: str, share: float) -> None:
    whole = _encode(_frame(), kind)
    with pytest.raises(FrameError, match=r"damaged|not a readable"):
        decode_frame(whole[: int(share * len(whole))])


def test_a_frame_error_is_a_value_error() -> None:
    assert issubclass(FrameError, ValueError)


def test_opencv_and_the_header_agree_on_the_size() -> None:
    pixels = _frame(3, 321, 123)
    assert decode_frame(_encode(pixels)).shape == (123, 321, 3)
    done, coded = cv2.imencode(".jpg", pixels)
    assert done and decode_frame(coded.tobytes()).shape == (123, 321, 3)
