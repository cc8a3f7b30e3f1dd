"""The straight line: stages meet on disk, and the library loads on a car without torch."""

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ridetune.config import load_config
from ridetune.matrix import Ranges

ROOT = Path(__file__).parents[1]
STAGES = ("data", "train", "quantize", "serve", "evaluate")
# What the car needs; the other modules of ridetune may import torch.
LIGHT = (
    "alignment",
    "bundle",
    "codec",
    "config",
    "contract",
    "engines",
    "envelope",
    "gate",
    "matrix",
    "memory",
    "memory_entry",
    "memory_file",
    "memory_seal",
    "policy",
    "prompt",
    "sample",
    "stage",
    "vision",
)
# Every shipped YAML with the dataclass that it fills.
CONFIGS = {
    "adopt.yaml": ("train.adopt", "AdoptConfig"),
    "ask.yaml": ("data.ask.config", "AskConfig"),
    "benchmark.yaml": ("quantize.benchmark", "BenchmarkConfig"),
    "closed_loop.yaml": ("evaluate.closed_loop", "ClosedLoopConfig"),
    "data.yaml": ("data.build", "DataConfig"),
    "data-pretrain.yaml": ("data.build", "DataConfig"),
    "data-export.yaml": ("data.export", "DataExportConfig"),
    "demo.yaml": ("serve.demo", "DemoConfig"),
    "driving_score.yaml": ("evaluate.driving_score", "DrivingScoreConfig"),
    "envelope.yaml": ("evaluate.envelope.build", "EnvelopeConfig"),
    "evaluate.yaml": ("evaluate.report", "EvaluateConfig"),
    "export.yaml": ("quantize.export", "ExportConfig"),
    "page.yaml": ("evaluate.page", "PageConfig"),
    "propose.yaml": ("data.propose", "ProposeConfig"),
    "quantize.yaml": ("quantize.build", "QuantizeConfig"),
    "review.yaml": ("data.review.__main__", "ReviewConfig"),
    "serve.yaml": ("serve.app", "ServeConfig"),
    "sweep.yaml": ("evaluate.sweep", "SweepConfig"),
    "tiny.yaml": ("train.tiny", "TinyConfig"),
    "train.yaml": ("train.sft", "TrainConfig"),
    "vehicle.yaml": ("ridetune.control.vehicle", "Vehicle"),
    "verified.yaml": ("ridetune.envelope", "Envelope"),
}


def _imported(path: Path) -> Iterator[str]:
    """The packages that a file imports anywhere in it; relative imports stay inside."""
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module


def _sources(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_imports_no_other_stage(stage: str) -> None:
    others = set(STAGES) - {stage}
    crossing = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in _sources(stage)
        for name in _imported(path)
        if name.split(".")[0] in others
    ]
    assert not crossing


def test_the_library_imports_no_stage() -> None:
    assert _sources("ridetune")
    crossing = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in _sources("ridetune")
        for name in _imported(path)
        if name.split(".")[0] in STAGES
    ]
    assert not crossing


@pytest.mark.parametrize("folder", ["ridetune", *STAGES])
def test_relative_imports_stay_inside_their_folder(folder: str) -> None:
    for path in _sources(folder):
        depth = len(path.relative_to(ROOT).parts) - 1
        levels = [n.level for n in ast.walk(ast.parse(path.read_text())) if hasattr(n, "level")]
        assert max(levels, default=0) <= depth, path


def test_the_library_loads_without_torch_and_transformers() -> None:
    modules = [f"ridetune.{name}" for name in LIGHT if (ROOT / f"ridetune/{name}.py").is_file()]
    code = (
        "import importlib, sys\n"
        "for heavy in ('torch', 'transformers', 'datasets', 'peft', 'onnx'):\n"
        "    sys.modules[heavy] = None\n"
        f"for name in {['ridetune', *modules]}:\n"
        "    importlib.import_module(name)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_every_shipped_config_is_in_the_table() -> None:
    shipped = {path.name for path in (ROOT / "configs").glob("*.yaml")} - {"ranges.yaml"}
    assert shipped == set(CONFIGS), "add the YAML with its dataclass to CONFIGS in this file"


@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_a_shipped_config_fills_its_dataclass(name: str) -> None:
    module, kind = CONFIGS[name]
    load_config(getattr(importlib.import_module(module), kind), ROOT / "configs" / name)


def test_the_shipped_ranges_load() -> None:
    Ranges.load(ROOT / "configs/ranges.yaml")
