"""Weather variants of a photograph, and the sheet that shows them."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from data.contact_sheet import CAPTION_PX, contact_sheet, main
from data.variants import VARIANTS, Variant, vary_weather
from ridetune.camera.weather import Image
from ridetune.vision import decode_frame

REAL = Path(__file__).parents[1] / "../shared/real/images"
SIZES = ((65, 64), (91, 333), (240, 426), (360, 200))  # height, width


def _frame(height: int = 216, width: int = 384) -> Image:
    """Clear day: blue sky, a hedge, dry grass, and a grey road with lines and bright stripes."""
    frame = np.empty((height, width, 3), np.uint8)
    half = height // 2
    frame[:half] = (110, 160, 220)
    frame[half:] = (170, 150, 95)
    frame[half - height // 10 : half + 2] = (60, 80, 45)
    centre = width // 2
    road = np.array([(centre, half), (0, height), (width, height)], np.int32)
    cv2.fillPoly(frame, [road], (105, 105, 108))
    for v in np.linspace(half + height // 16, height - 1, 12).astype(int):
        reach = int((v - half) / half * centre * 0.8)
        cv2.line(frame, (centre - reach, v), (centre + reach, v), (180, 180, 182), 1)
    for u in (0, width - 1):
        cv2.line(frame, (centre, half), (u, height), (240, 240, 240), 2)
    return frame


def _vary(frame: Image, variant: Variant, seed: int = 0) -> Image:
    return vary_weather(frame, variant, np.random.default_rng(seed))


@pytest.mark.parametrize("variant", VARIANTS)
def test_variant_is_the_same_for_a_seed_and_another_for_another_seed(variant: Variant) -> None:
    frame = _frame()
    first = _vary(frame, variant)
    assert np.array_equal(first, _vary(frame, variant))
    assert not np.array_equal(first, _vary(frame, variant, 1))


@pytest.mark.parametrize("variant", VARIANTS)
def test_variant_leaves_its_input_alone(variant: Variant) -> None:
    frame = _frame()
    frame.flags.writeable = False
    made = _vary(frame, variant)
    assert np.array_equal(frame, _frame())
    assert not np.shares_memory(made, frame)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_variant_keeps_shape_and_type_at_any_size(
    variant: Variant, height: int, width: int
) -> None:
    made = _vary(_frame(height, width), variant)
    assert made.shape == (height, width, 3) and made.dtype == np.uint8


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("level", [0, 128, 255])
def test_variant_survives_a_plain_frame(variant: Variant, level: int) -> None:
    assert _vary(np.full((90, 160, 3), level, np.uint8), variant).shape == (90, 160, 3)


@pytest.mark.parametrize("seed", range(4))
def test_night_is_much_darker(seed: int) -> None:
    frame = _frame()
    night = _vary(frame, "night", seed)
    assert night.mean() < 0.35 * frame.mean()
    assert night[:60].mean() < 35  # the sky


def test_a_small_red_light_stays_bright_at_night() -> None:
    frame = _frame()
    frame[96:101, 100:105] = (255, 30, 20)
    night = _vary(frame, "night")
    assert night[98, 102, 0] > 180 and night[98, 102, 0] > 2 * night[98, 102, 1]


@pytest.mark.parametrize("seed", range(4))
def test_fog_takes_more_contrast_from_far_rows_than_from_near_ones(seed: int) -> None:
    frame = _frame()
    fog = _vary(frame, "fog", seed)

    def left_of_contrast(rows: slice) -> float:
        return float(fog[rows].std(axis=1).mean() / frame[rows].std(axis=1).mean())

    far, near = left_of_contrast(slice(112, 122)), left_of_contrast(slice(170, 216))
    assert far < 0.8 * near < 0.8


@pytest.mark.parametrize("seed", range(4))
def test_low_sun_is_warmer(seed: int) -> None:
    frame = _frame().astype(np.int16)
    sun = _vary(_frame(), "low_sun", seed).astype(np.int16)
    assert (sun[..., 0] - sun[..., 2]).mean() > (frame[..., 0] - frame[..., 2]).mean() + 25


def test_low_sun_without_a_free_sky_has_no_disc() -> None:
    wall = np.full((180, 320, 3), 90, np.uint8)
    wall[::4] = 20
    assert _vary(wall, "low_sun").max() < 250


@pytest.mark.parametrize("variant", ["rain", "snow"])
def test_rain_and_snow_are_grey_and_unlike_the_clear_frame(variant: Variant) -> None:
    frame = _frame()
    made = _vary(frame, variant)
    assert np.abs(made.astype(np.int16) - frame).mean() > 20
    sky = made[:60].reshape(-1, 3).mean(axis=0)
    assert np.ptp(sky) < 40 < np.ptp(frame[0, 0])


def test_snow_makes_the_verges_whiter_than_rain() -> None:
    verge = (slice(140, 180), slice(0, 40))
    snow, rain = (_vary(_frame(), variant)[verge].mean() for variant in ("snow", "rain"))
    assert snow > rain + 40


def test_unusable_frames_and_variants_are_refused() -> None:
    rng = np.random.default_rng(0)
    for bad in (np.zeros((63, 200, 3), np.uint8), np.zeros((90, 90), np.uint8)):
        with pytest.raises(ValueError, match="64 px or more"):
            vary_weather(bad, "rain", rng)
    with pytest.raises(ValueError, match="choose one of rain, fog"):
        vary_weather(_frame(), "hail", rng)  # type: ignore[arg-type]


def test_real_frames_change_as_their_variant_says() -> None:
    paths = sorted((REAL / "sunny").glob("*.jpg"))[::6]
    if not paths:
        pytest.skip(f"no real frames in {REAL}")
    for path in paths:
        frame = decode_frame(path.read_bytes())
        made = {variant: _vary(frame, variant) for variant in VARIANTS}
        level = {variant: picture.mean() for variant, picture in made.items()}
        assert level["night"] < 0.45 * frame.mean(), path
        assert level["snow"] > level["rain"] > level["night"], path
        detail = [np.abs(np.diff(p.astype(np.int16), axis=1)).mean() for p in (made["fog"], frame)]
        assert detail[0] < 0.7 * detail[1], path
        warmth = [p[..., 0].mean() - p[..., 2].mean() for p in (made["low_sun"], frame)]
        assert warmth[0] > warmth[1] + 25, path


def test_contact_sheet_holds_every_tile_whole() -> None:
    white = np.full((50, 100, 3), 255, np.uint8)
    sheet = contact_sheet([[white] * 3] * 2, ("a", "b", "c"), ("one", "two"), tile=(64, 48))
    assert sheet.shape == (CAPTION_PX + 2 * (CAPTION_PX + 48), 3 * 64, 3)
    top = 2 * CAPTION_PX
    assert (sheet[top + 8 : top + 40] == 255).all()  # 64 x 32 in the middle of 64 x 48
    assert (sheet[top : top + 8] < 50).all()


def test_contact_sheet_refuses_counts_that_do_not_match() -> None:
    tile = np.zeros((64, 64, 3), np.uint8)
    with pytest.raises(ValueError, match="'one' has 1 pictures for 2 columns"):
        contact_sheet([[tile]], ("a", "b"), ("one",))
    with pytest.raises(ValueError, match="a name for each row"):
        contact_sheet([[tile]], ("a",), ())


def _folder(root: Path) -> Path:
    for name in ("sunny/1.jpg", "sunny/2.png", "rain/3.jpg"):
        path = root / "pictures" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(path.suffix, _frame()[..., ::-1])[1].tobytes())
    (root / "pictures/sunny/4.jpg").write_bytes(b"no picture")
    return root / "pictures"


def test_command_shows_clear_pictures_and_lists_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sheet.jpg"
    assert main([str(_folder(tmp_path)), str(out), "3"]) == 0
    assert decode_frame(out.read_bytes()).shape == (CAPTION_PX + 2 * (CAPTION_PX + 180), 1920, 3)
    printed = capsys.readouterr().out
    assert "left out rain/3.jpg: its condition is rain, not clear" in printed
    assert "left out sunny/4.jpg" in printed
    assert "2 pictures in 5 variants, 2 left out" in printed


@pytest.mark.parametrize(
    ("folder", "out", "message"),
    [
        ("pictures", "none/sheet.jpg", "cannot write .*: there is no folder .*none"),
        ("pictures", "sheet.gif", "name a file that ends in .jpg"),
        ("pictures", "taken.jpg", "taken.jpg is a folder"),
        ("pictures/rain", "sheet.jpg", r"no picture known to be clear \(1 left out\)"),
        ("empty", "sheet.jpg", "holds no .jpg"),
        ("nowhere", "sheet.jpg", "is no folder"),
    ],
)
def test_command_says_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], folder: str, out: str, message: str
) -> None:
    _folder(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "taken.jpg").mkdir()
    with pytest.raises(SystemExit) as stopped:
        main([str(tmp_path / folder), str(tmp_path / out)])
    assert stopped.value.code == 2
    said = " ".join(capsys.readouterr().err.split())
    assert re.search(message, said), said
    assert not (tmp_path / "sheet.jpg").exists()
