"""Sensor of the synthetic front camera: optics, exposure, colours, noise and JPEG.

In: the finished picture and a random stream. Out: the picture as a camera would store it.
"""

from functools import lru_cache

import cv2
import numpy as np

from .weather import Image, crop


@lru_cache(maxsize=4)
def _sensor_noise(width: int, height: int) -> Image:
    """Gaussian noise, mean 128 and deviation 32, [height + 64, width + 64, 3]."""
    noise = np.random.default_rng(2).normal(128, 32, (height + 64, width + 64, 3))
    noise = 0.6 * noise + 0.4 * noise.mean(axis=2, keepdims=True)
    return np.asarray(np.clip(noise, 0, 255), np.uint8)


@lru_cache(maxsize=16)
def _vignette(width: int, height: int, level: int) -> Image:
    """Brightness factor times 255 that falls to the corners, level 0..3, [height, width, 3]."""
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    fall = 1 - (0.1 + 0.15 * level) * ((x**2 + y**2) / 2) ** 1.3
    return np.repeat((255 * fall).astype(np.uint8)[..., None], 3, axis=2)


def expose(image: Image, rng: np.random.Generator, *, dark: bool) -> Image:
    """Camera: optics, exposure, white balance, contrast, saturation, noise and JPEG."""
    height, width = image.shape[:2]
    u = rng.random(12)
    if u[0] < 0.5:
        image = np.asarray(
            cv2.GaussianBlur(image, (3, 3) if width < 600 else (5, 5), 0.4 + 0.7 * u[1]), np.uint8
        )
    if u[2] < 0.5:
        image = np.asarray(
            cv2.multiply(image, _vignette(width, height, int(8 * u[2])), scale=1 / 255), np.uint8
        )
    s = 0.65 + 0.7 * u[3]
    grey = (1 - s) * np.array([0.299, 0.587, 0.114])
    mix = np.eye(3, dtype=np.float32) * s + grey[None]
    balance = np.array([1 + 0.14 * (u[4] - 0.5), 1 + 0.03 * (u[5] - 0.5), 1 + 0.14 * (u[6] - 0.5)])
    image = np.asarray(cv2.transform(image, mix * balance[:, None]), np.uint8)
    ramp = np.linspace(0, 1, 256) ** (0.85 + 0.35 * u[7]) * (0.85 + 0.3 * u[8])
    ramp = np.clip(ramp, 0, 1) * (1 - 0.08 * u[9]) + (0.0 if dark else 0.05 * u[9])
    image = np.asarray(cv2.LUT(image, (255 * ramp).astype(np.uint8)), np.uint8)
    strength = (0.05 + 0.2 * u[10] ** 2) * (1.3 if dark else 1.0)
    noise = crop(_sensor_noise(width, height), height, width, rng)
    image = np.asarray(cv2.addWeighted(image, 1.0, noise, strength, -128 * strength), np.uint8)
    if u[11] < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, 30 + int(190 * u[11])]
        coded = cv2.imencode(".jpg", image, quality)[1]
        image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
    return image
