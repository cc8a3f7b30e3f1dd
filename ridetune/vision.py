"""The one image path: encoded bytes -> patches, for training and for serving.

    bytes -> checked size -> RGB, a large JPEG at 1/2, 1/4 or 1/8 -> centre crop to the grid's shape
          -> bicubic resize -> (x / 255 - mean) / std -> patches [num_patches, 3 * t * p * p]

The resize, the normalisation and the order of the patches are those of the Hugging Face Qwen-VL
image processor; a golden test holds them to it. The crop and the fixed grid are ours: one camera,
one grid, so that the exported graphs can bake the positions in. A JPEG stays at least OVERSAMPLED
times larger than the grid while it is decoded, for the sake of the resize.
"""

import io
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

# A 20 KB file can announce gigapixels: refuse by the header, before decoding.
MAX_BYTES = 16 * 1024 * 1024
MAX_PIXELS = 4096 * 4096
MIN_SIDE = 32
OVERSAMPLED = 2

_TURNED = (5, 6, 7, 8)  # EXIF orientations that swap width and height
_DAMAGED = "the image is damaged and cannot be decoded; send a complete JPEG or PNG"


class FrameError(ValueError):
    """The frame cannot be used; the message says why and what to send instead."""


@dataclass(frozen=True)
class VisionSpec:
    """How a model family cuts an image; `rows` x `columns` visual tokens per frame."""

    rows: int
    columns: int
    patch_size: int
    merge_size: int
    temporal_patch_size: int
    mean: tuple[float, float, float]
    std: tuple[float, float, float]

    @property
    def num_tokens(self) -> int:
        """Visual tokens that the language model sees."""
        return self.rows * self.columns

    @property
    def height_px(self) -> int:
        """Height of the resized frame in pixels."""
        return self.rows * self.merge_size * self.patch_size

    @property
    def width_px(self) -> int:
        """Width of the resized frame in pixels."""
        return self.columns * self.merge_size * self.patch_size

    @property
    def grid_thw(self) -> tuple[int, int, int]:
        """Patches in time, height and width, as the Hugging Face models want it."""
        return (1, self.rows * self.merge_size, self.columns * self.merge_size)


def read_patches(frame: bytes, spec: VisionSpec) -> NDArray[np.float32]:
    """Encoded bytes -> patches; FrameError if the frame is unusable."""
    return patchify(read_fitted(frame, spec), spec)


def read_fitted(frame: bytes, spec: VisionSpec) -> NDArray[np.uint8]:
    """Encoded bytes -> RGB pixels [height_px, width_px, 3]; FrameError if the frame is unusable."""
    enough = (OVERSAMPLED * spec.width_px, OVERSAMPLED * spec.height_px)
    return fit_frame(decode_frame(frame, enough), spec)


def decode_frame(frame: bytes, enough: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """RGB pixels [height, width, 3] of a JPEG or PNG; FrameError if unusable.

    enough: width and height [px] that will do; a larger JPEG is then decoded at 1/2, 1/4 or 1/8 of
    its size, by its low frequencies alone, but never smaller than that.
    """
    if not frame:
        raise FrameError("the image is empty; send the bytes of a JPEG or PNG camera frame")
    if len(frame) > MAX_BYTES:
        raise FrameError(
            f"the image has {len(frame)} bytes, the limit is {MAX_BYTES}; send a smaller frame"
        )
    with _open(frame) as image:
        _check_size(*image.size)
        if image.format == "JPEG":
            return _decode_jpeg(image, enough)
    pixels = cv2.imdecode(np.frombuffer(frame, np.uint8), cv2.IMREAD_COLOR_RGB)
    if pixels is None:
        raise FrameError(_DAMAGED)
    return np.asarray(pixels, np.uint8)


def _open(frame: bytes) -> Image.Image:
    """The image with its header read and no pixel decoded."""
    try:
        return Image.open(io.BytesIO(frame), formats=("JPEG", "PNG"))
    except Image.DecompressionBombError as error:
        raise FrameError(
            f"the image announces too many pixels, the limit is {MAX_PIXELS}; send a smaller frame"
        ) from error
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise FrameError("the image is not a readable JPEG or PNG; send one of these") from error


def _check_size(width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise FrameError(
            f"the image announces {width}x{height} pixels, the limit is {MAX_PIXELS}; "
            "send a smaller frame"
        )
    if min(width, height) < MIN_SIDE:
        raise FrameError(
            f"the image has {width}x{height} pixels, each side needs at least {MIN_SIDE}; "
            "send a camera frame"
        )


def _decode_jpeg(image: Image.Image, enough: tuple[int, int] | None) -> NDArray[np.uint8]:
    try:
        if enough is not None:
            turned = image.getexif().get(ExifTags.Base.Orientation, 1) in _TURNED
            image.draft("RGB", enough[::-1] if turned else enough)
        return np.array(ImageOps.exif_transpose(image).convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise FrameError(_DAMAGED) from error


def fit_frame(pixels: NDArray[np.uint8], spec: VisionSpec) -> NDArray[np.uint8]:
    """Centre crop to the grid's shape and resize to [height_px, width_px, 3]."""
    height, width = pixels.shape[:2]
    shape = spec.width_px / spec.height_px
    crop_width = min(width, round(height * shape))
    crop_height = min(height, round(width / shape))
    left, top = (width - crop_width) // 2, (height - crop_height) // 2
    box = (left, top, left + crop_width, top + crop_height)
    image = Image.fromarray(pixels)
    resized = image.resize((spec.width_px, spec.height_px), Image.Resampling.BICUBIC, box=box)
    return np.asarray(resized, np.uint8)


def patchify(fitted: NDArray[np.uint8], spec: VisionSpec) -> NDArray[np.float32]:
    """Normalised patches [num_patches, 3 * t * p * p], merge blocks together, row by row.

    A patch holds channel, time, row, column; a still image fills every time slot alike.
    """
    m, p = spec.merge_size, spec.patch_size
    blocks = fitted.reshape(spec.rows, m, p, spec.columns, m, p, 3)
    ordered = blocks.transpose(0, 3, 1, 4, 6, 2, 5)  # [row, column, m, m, channel, p, p]
    flat = ordered.reshape(-1, 3, 1, p * p)
    mean, std = (np.asarray(x, np.float32)[:, None, None] * 255 for x in (spec.mean, spec.std))
    normal = (flat.astype(np.float32) - mean) / std
    return np.repeat(normal, spec.temporal_patch_size, axis=2).reshape(len(flat), -1)
