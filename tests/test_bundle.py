"""A bundle is whole, unchanged and of this code's contract, or it is refused with the remedy."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ridetune.bundle import (
    BUNDLE_FILE,
    REQUIRED_FILES,
    BundleFacts,
    add_profile,
    load_bundle,
    read_facts,
    write_facts,
)
from ridetune.contract import Contract
from ridetune.matrix import Ranges
from ridetune.stage import hash_files
from ridetune.vision import VisionSpec

SPEC = VisionSpec(2, 3, 16, 2, 2, (0.5, 0.5, 0.5), (0.5, 0.5, 0.5))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A bundle whose graphs are stand-ins: loading checks hashes and does not open them."""
    for name in REQUIRED_FILES:
        (tmp_path / name).write_text(f"content of {name}")
    facts = BundleFacts.model_validate(
        {
            "contract": Contract(SPEC, Ranges.load(Path("configs/ranges.yaml"))).as_dict(),
            "model": {
                "family": "qwen3_vl",
                "hidden": 8,
                "layers": 1,
                "kv_heads": 1,
                "head_dim": 8,
                "vocabulary": 10,
                "num_deepstack": 1,
            },
            "rotary": {"frequencies": [1.0, 0.1], "axes": [0, 1]},
            "quantization": {"bits": 4, "group_size": 128, "accuracy_level": 4},
            "source": {"folder": "awq", "manifest_sha256": None},
            "files": hash_files(tmp_path),
            "verified_with": {"onnxruntime": "1.32.0"},
            "parity": {"bins_p95": 0.1},
        }
    )
    write_facts(tmp_path, facts)
    return tmp_path


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / BUNDLE_FILE
    facts = json.loads(path.read_text())
    change(facts)
    path.write_text(json.dumps(facts))


def test_whole_bundle_loads_with_its_contract(folder: Path) -> None:
    bundle = load_bundle(folder)
    assert bundle.contract.vision == SPEC
    assert bundle.facts.profile is None
    assert "profile" not in json.loads((folder / BUNDLE_FILE).read_text())


def test_missing_folder_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no bundle at .*quantize\.export"):
        load_bundle(tmp_path / "nowhere")


def test_folder_without_bundle_json_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no bundle\.json.*export again"):
        load_bundle(tmp_path)


@pytest.mark.parametrize("name", REQUIRED_FILES)
def test_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(ValueError, match=f"bundle file {name} is missing.*export again"):
        load_bundle(folder)


@pytest.mark.parametrize("name", REQUIRED_FILES)
def test_changed_file_is_named(folder: Path, name: str) -> None:
    with (folder / name).open("ab") as file:
        file.write(b"\0")
    with pytest.raises(ValueError, match=f"{name} in .* was changed after export; export again"):
        load_bundle(folder)


def test_file_without_a_hash_is_refused(folder: Path) -> None:
    edit(folder, lambda facts: facts["files"].pop("decoder.onnx"))
    with pytest.raises(ValueError, match=r"no hash of decoder\.onnx"):
        load_bundle(folder)


def test_other_prompt_version_is_refused(folder: Path) -> None:
    edit(folder, lambda facts: facts["contract"].update(prompt_version=99))
    with pytest.raises(ValueError, match="prompt version 99"):
        load_bundle(folder)


def test_incomplete_contract_is_refused(folder: Path) -> None:
    edit(folder, lambda facts: facts["contract"].pop("vision"))
    with pytest.raises(ValueError, match=r"contract in .* is incomplete"):
        load_bundle(folder)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 2}', "\xff"])
def test_malformed_json_is_refused(folder: Path, text: str) -> None:
    (folder / BUNDLE_FILE).write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=r"bundle\.json is malformed.*export again"):
        load_bundle(folder)


def test_unknown_key_is_named(folder: Path) -> None:
    edit(folder, lambda facts: facts.update(colour="red"))
    with pytest.raises(ValueError, match="malformed at colour"):
        load_bundle(folder)


def test_profile_is_added_and_replaced(folder: Path) -> None:
    add_profile(folder, {"decide_ms": {"p50": 3.1}})
    add_profile(folder, {"decide_ms": {"p50": 2.9}})
    assert load_bundle(folder).facts.profile == {"decide_ms": {"p50": 2.9}}


def test_interrupted_profile_leaves_the_old_facts(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = read_facts(folder)

    def fail(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device", str(target))

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="No space left"):
        add_profile(folder, {"decide_ms": 1})
    assert read_facts(folder) == before
    assert not list(folder.glob(".*"))
