"""The controller matrix and the ranges file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from ridetune.matrix import PARAMETERS, STYLES, ControllerMatrix, Ranges, ki_limit

SHIPPED = Path(__file__).parents[1] / "configs/ranges.yaml"
Change = Callable[[dict[str, Any]], object]


def _raw() -> dict[str, Any]:
    raw: dict[str, Any] = yaml.safe_load(SHIPPED.read_text())
    return raw


def test_values_and_rows_keep_the_order_of_the_paper() -> None:
    matrix = ControllerMatrix.of([1, 2, 3, 4, 5, 6])
    assert matrix.rows == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert matrix.values == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    assert (matrix.kp, matrix.ws) == (1, 6)


@pytest.mark.parametrize("count", [0, 5, 7])
def test_another_number_of_values_is_refused(count: int) -> None:
    with pytest.raises(ValueError, match=f"has 6 values .* got {count}"):
        ControllerMatrix.of([0.0] * count)


def test_ki_limit_is_an_eighth_of_kp_squared() -> None:
    assert ki_limit(0.4) == pytest.approx(0.02)


def test_envelope_spans_all_styles(ranges: Ranges) -> None:
    assert ranges.lowest == (0.08, 0.0, 0.0, 0.02, 0.0, 0.07)
    assert ranges.highest == (1.2, 0.1, 0.5, 1.5, 20.0, 6.0)


def test_shipped_default_is_inside_the_envelope_and_stable(ranges: Ranges) -> None:
    assert ranges.default.ki <= ki_limit(ranges.default.kp)
    for value, low, high in zip(ranges.default.values, ranges.lowest, ranges.highest, strict=True):
        assert low <= value <= high


def test_ranges_survive_the_round_trip(ranges: Ranges) -> None:
    assert Ranges.parse(ranges.as_dict(), where="test") == ranges


def test_every_style_lists_every_parameter(ranges: Ranges) -> None:
    assert set(ranges.styles) == set(STYLES)
    assert all(len(of_style) == len(PARAMETERS) for of_style in ranges.styles.values())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda raw: raw.pop("default"), "'default' is missing"),
        (lambda raw: raw["styles"].pop("moderate"), "'moderate' is missing"),
        (lambda raw: raw["styles"]["moderate"].pop("W_l"), "'W_l' is missing"),
        (
            lambda raw: raw["styles"]["moderate"].update(W_l=[1, 2, 3]),
            r"styles.moderate.W_l needs 4 numbers, got \[1, 2, 3\]",
        ),
        (
            lambda raw: raw["styles"]["moderate"].update(W_l=[0.1, "a", 1, 2]),
            "styles.moderate.W_l needs 4 numbers",
        ),
        (
            lambda raw: raw["styles"]["aggressive"].update(K_p=[0.5, 0.4, 0.6, 0.7]),
            "styles.aggressive.K_p must rise",
        ),
        (
            lambda raw: raw["styles"]["aggressive"].update(K_p=[0.1, 0.2, 0.3, float("nan")]),
            "styles.aggressive.K_p must rise",
        ),
        (
            lambda raw: raw["styles"]["aggressive"].update(K_d=[-1, 0, 0.1, 0.3]),
            "styles.aggressive.K_d must not be negative",
        ),
        (lambda raw: raw["default"][0].__setitem__(1, 0.05), "K_i <= K_p"),
        (lambda raw: raw["default"][0].__setitem__(0, 7.0), "default K_p = 7.0 is outside"),
        (lambda raw: raw["default"][1].pop(), "has 6 values"),
        (lambda raw: raw.update(default=5), "wrong form"),
        (lambda raw: raw.update(styles=[]), "wrong form"),
        (lambda raw: raw.update(slew=0), "slew"),
        (lambda raw: raw.update(slew=float("nan")), "slew"),
        (
            lambda raw: [raw["styles"][s].update(W_h=[1, 1, 1, 1]) for s in STYLES],
            "W_h has no room",
        ),
    ],
)
def test_a_wrong_entry_is_named(change: Change, message: str) -> None:
    raw = _raw()
    change(raw)
    with pytest.raises(ValueError, match=message) as caught:
        Ranges.parse(raw, where="my-car.yaml")
    if "6 values" not in message:
        assert "my-car.yaml" in str(caught.value)


def test_a_missing_file_and_a_file_that_is_no_mapping_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no ranges file at .*absent\.yaml"):
        Ranges.load(tmp_path / "absent.yaml")
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(ValueError, match="expected a mapping"):
        Ranges.load(tmp_path / "list.yaml")
    (tmp_path / "broken.yaml").write_text("a: [1\n")
    with pytest.raises(ValueError, match="not valid YAML"):
        Ranges.load(tmp_path / "broken.yaml")
