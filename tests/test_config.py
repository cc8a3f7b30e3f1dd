"""YAML and overrides -> a frozen dataclass, with errors that say what to do."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from ridetune.config import Count, Share, load_config, save_config


@dataclass(frozen=True)
class Optimizer:
    """A section."""

    learning_rate: float
    steps: int


@dataclass(frozen=True)
class Config:
    """A stage's config."""

    out: Path
    seed: int
    optimizer: Optimizer
    method: Literal["rtn", "awq"] = "awq"
    frames: Path | None = None
    warm_up: Optimizer | None = None
    phases: tuple[Optimizer, ...] = ()
    by_name: dict[str, Optimizer] = field(default_factory=dict)
    workers: Count = 1
    share: Share = 0.5


GOOD = "out: runs/x\nseed: 3\noptimizer: {learning_rate: 0.01, steps: 5}\n"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "stage.yaml"
    file.write_text(GOOD)
    return file


def test_yaml_becomes_the_dataclass(path: Path) -> None:
    assert load_config(Config, path) == Config(Path("runs/x"), 3, Optimizer(0.01, 5))


def test_overrides_reach_into_sections(path: Path) -> None:
    changed = ["seed=4", "optimizer.steps=9", "method=rtn", "out=a=b", "frames="]
    config = load_config(Config, path, changed)
    assert config == Config(Path("a=b"), 4, Optimizer(0.01, 9), "rtn", None)


def test_the_last_override_of_a_key_wins(path: Path) -> None:
    assert load_config(Config, path, ["seed=4", "seed=5"]).seed == 5


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sead=4", "unknown key 'sead'; did you mean 'seed'"),
        ("optimizer.step=4", "unknown key 'step'; did you mean 'steps'"),
        ("seed", "not of the form section.key=value"),
        ("seed.deep=4", "seed is a value, not a section"),
        ("seed=many", "seed: .* got 'many'"),
        ("seed=1.5", "seed: .* got 1.5"),
        ("method=gptq", "method: .* got 'gptq'"),
        ("optimizer.learning_rate=null", "optimizer.learning_rate: .* got None"),
        ("warm_up={step: 4}", "warm_up: unknown key 'step'; did you mean 'steps'"),
        ("phases=[{step: 4}]", "phases: unknown key 'step'; did you mean 'steps'"),
        ("by_name={first: {step: 4}}", "by_name: unknown key 'step'; did you mean 'steps'"),
        ("workers=-1", "workers: .* got -1"),
        ("share=1.5", "share: .* got 1.5"),
        ("out=[", "the value is not valid YAML"),
    ],
)
def test_a_wrong_override_says_what_is_wrong(path: Path, override: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_config(Config, path, [override])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must hold a mapping"),
        ("- 1\n", "must hold a mapping"),
        ("a: [1\n", "is not valid YAML"),
        (GOOD.replace("seed: 3\n", ""), "the key 'seed' is missing"),
        (GOOD.replace(", steps: 5", ""), "the key 'optimizer.steps' is missing"),
        (GOOD + "sede: 3\n", "unknown key 'sede'; did you mean 'seed'"),
        (GOOD + "1: 3\n", "unknown key 1; did you mean"),
    ],
)
def test_a_wrong_file_is_named_with_its_remedy(path: Path, text: str, message: str) -> None:
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        load_config(Config, path)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no config file at .*none\.yaml"):
        load_config(Config, tmp_path / "none.yaml")


def test_a_saved_config_loads_to_the_same_values(path: Path, tmp_path: Path) -> None:
    config = load_config(Config, path, ["frames=/a/b"])
    save_config(config, tmp_path / "saved.yaml")
    assert load_config(Config, tmp_path / "saved.yaml") == config
