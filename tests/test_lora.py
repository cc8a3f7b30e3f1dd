"""Fine-tuning changes the adapter alone, resumes to the very same weights, and merges exactly."""

import errno
import json
import runpy
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as parquet
import pytest
import torch
from peft import PeftModel
from safetensors.torch import load_file, save_file
from torch import Tensor

import train.sft
from ridetune.config import load_config
from ridetune.contract import Contract, load_tokenizer
from ridetune.qwen import load_model
from ridetune.sample import read_samples
from tests.small_base import RANGES, small_base, small_data, small_prompts, small_samples
from train.lora import (
    MERGE_TOLERANCE,
    AdapterCheckpoint,
    LoraShape,
    add_adapter,
    check_merge,
    merge,
)
from train.objective import batch_loss
from train.score import query_logits
from train.sft import TrainConfig, encode_all, finetune, fingerprint

YAML = RANGES.with_name("train.yaml")


def overrides(folder: Path, *changes: str) -> list[str]:
    return [
        f"base={small_base()}",
        f"data={small_data()}",
        f"adapter={folder / 'adapter'}",
        f"out={folder / 'merged'}",
        "threads=1",
        "plan={steps: 8, batch: 4, learning_rate: 1.0e-2, weight_decay: 0.0}",
        "lora={rank: 4, alpha: 8, dropout: 0.1}",
        "checkpoint_every=4",
        "watch_samples=4",
        *changes,
    ]


def train_config(folder: Path, *changes: str) -> TrainConfig:
    return load_config(TrainConfig, YAML, overrides(folder, *changes))


class Losses(list[float]):
    """The loss of every training step; `fail_at` raises at that step instead."""

    fail_at: int | None = None


@pytest.fixture
def losses(monkeypatch: pytest.MonkeyPatch) -> Losses:
    found, real = Losses(), batch_loss

    def watched(*args: Any, **kwargs: Any) -> Any:
        if len(found) + 1 == found.fail_at:
            raise KeyboardInterrupt
        loss, hidden = real(*args, **kwargs)
        found.append(loss.total.item())
        return loss, hidden

    monkeypatch.setattr(train.sft, "batch_loss", watched)
    return found


def adapter_weights(folder: Path) -> dict[str, Tensor]:
    weights: dict[str, Tensor] = load_file(folder / "adapter/adapter_model.safetensors")
    return weights


def assert_same(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> None:
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def logits_of(model: Any) -> Tensor:
    contract = Contract.load(small_base())
    samples = list(small_samples()[:4])
    with torch.no_grad():
        seen = encode_all(model, samples, contract)
        return query_logits(model, small_prompts(), samples, seen)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the adapter and the merged model of eight steps in one go."""
    folder = tmp_path_factory.mktemp("finished")
    finetune(train_config(folder))
    return folder


def test_thirty_steps_of_the_command_lower_the_loss_and_leave_the_base_alone(
    tmp_path: Path, losses: Losses, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, Tensor] = {}

    def watched(model: Any) -> Any:
        seen.update({k: v.clone() for k, v in model.state_dict().items()})
        return merge(model)

    monkeypatch.setattr(train.sft, "merge", watched)
    settings = overrides(tmp_path, "plan.steps=30", "plan.batch=6", "lora.dropout=0.0")
    monkeypatch.setattr(sys, "argv", ["train", "--config", str(YAML), *settings])
    with pytest.raises(SystemExit) as left:
        runpy.run_module("train", run_name="__main__")
    assert left.value.code == 0
    assert len(losses) == 30
    assert np.mean(losses[-6:]) < np.mean(losses[:6]) - 0.3

    base = load_model(small_base()).state_dict()
    plain = {
        name.removeprefix("base_model.model.").replace(".base_layer", ""): weight
        for name, weight in seen.items()
        if "lora_" not in name
    }
    assert_same(plain, dict(base))
    trained = [weight for name, weight in seen.items() if "lora_B" in name]
    assert len(trained) == 7  # four of attention and three of the MLP, in the one layer
    assert all(weight.abs().max() > 0 for weight in trained)


def test_merge_changes_the_linear_layers_of_the_language_model_alone(finished: Path) -> None:
    base = load_model(small_base()).half().state_dict()
    merged = load_model(finished / "merged", dtype=torch.float16).state_dict()
    assert base.keys() == merged.keys()
    changed = {name for name in base if not torch.equal(base[name], merged[name])}
    assert len(changed) == 7
    assert all("language_model.layers.0" in name and "_proj" in name for name in changed)


def test_merged_folder_answers_as_the_adapter_on_its_base(finished: Path) -> None:
    base: Any = load_model(small_base())
    plain = logits_of(base)
    adapted = logits_of(PeftModel.from_pretrained(base, finished / "adapter").eval())
    merged = logits_of(load_model(finished / "merged"))
    assert (adapted - merged).abs().max() < MERGE_TOLERANCE * adapted.std()
    assert (adapted - plain).abs().max() > 5 * MERGE_TOLERANCE * adapted.std()


def test_finished_run_leaves_a_whole_model_folder(finished: Path) -> None:
    merged = finished / "merged"
    assert Contract.load(merged) == Contract.load(small_base())
    assert load_tokenizer(merged).get_vocab() == small_prompts().tokenizer.get_vocab()
    manifest = json.loads((merged / "manifest.json").read_text())
    assert 0 <= manifest["merge_difference"] <= MERGE_TOLERANCE
    assert load_config(TrainConfig, merged / "config.yaml") == train_config(finished)
    assert sorted(path.name for path in finished.iterdir()) == ["adapter", "merged"]
    assert not (finished / "adapter/checkpoint.pt").exists()


def test_gate_passes_rounding_and_refuses_other_weights() -> None:
    logits = torch.randn(3, 6, 256, generator=torch.Generator().manual_seed(0))
    assert check_merge(logits, logits) == 0.0
    assert check_merge(logits, logits + 0.5 * MERGE_TOLERANCE) == pytest.approx(0.01, rel=0.05)
    one_off = logits.clone()
    one_off[1, 2, 3] += 0.1
    with pytest.raises(ValueError, match=r"merged weights disagree with the adapter.*0\.02"):
        check_merge(logits, one_off)


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_gate_refuses_values_that_are_not_finite(broken: float) -> None:
    logits = torch.randn(1, 6, 256, generator=torch.Generator().manual_seed(0))
    spoilt = logits.clone()
    spoilt[0, 0, 0] = broken
    for pair in ((logits, spoilt), (spoilt, logits), (spoilt, spoilt)):
        with pytest.raises(ValueError, match="merged weights disagree"):
            check_merge(*pair)


def test_resumed_run_ends_in_the_very_same_weights(
    finished: Path, tmp_path: Path, losses: Losses
) -> None:
    losses.fail_at = 7  # six steps are done, four of them are kept
    with pytest.raises(KeyboardInterrupt):
        finetune(train_config(tmp_path))
    assert [path.name for path in (tmp_path / "adapter").iterdir()] == ["checkpoint.pt"]
    lost = losses[4:6]

    losses.clear()
    losses.fail_at = None
    finetune(train_config(tmp_path))
    assert len(losses) == 4
    assert losses[:2] == lost
    assert_same(adapter_weights(tmp_path), adapter_weights(finished))


def no_space(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def unmerged(model: Any) -> Any:
    """The base without what the adapter learnt."""
    return model.unload()


@pytest.mark.parametrize(
    ("part", "fault", "error", "says"),
    [
        ("merge", unmerged, ValueError, "merged weights disagree with the adapter"),
        ("write_model", no_space, OSError, "No space left"),
    ],
)
def test_failed_merge_leaves_no_model_and_costs_no_training(
    part: str,
    fault: Callable[..., Any],
    error: type[Exception],
    says: str,
    finished: Path,
    tmp_path: Path,
    losses: Losses,
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train.sft, part, fault)
        with pytest.raises(error, match=says):
            finetune(train_config(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["adapter"]
    assert [path.name for path in (tmp_path / "adapter").iterdir()] == ["checkpoint.pt"]
    losses.clear()
    finetune(train_config(tmp_path))
    assert losses == []
    assert_same(adapter_weights(tmp_path), adapter_weights(finished))


def test_checkpoint_of_another_run_is_refused(tmp_path: Path, losses: Losses) -> None:
    losses.fail_at = 5
    with pytest.raises(KeyboardInterrupt):
        finetune(train_config(tmp_path))
    losses.clear()
    other = copy_of(small_data(), tmp_path / "data")
    rows = parquet.read_table(other / "train.parquet")
    parquet.write_table(rows.slice(0, 11), other / "train.parquet")
    for change in ("seed=12", f"data={other}"):
        with pytest.raises(
            ValueError, match=r"checkpoint.pt belongs to a run on other data.*delete"
        ):
            finetune(train_config(tmp_path, change))
    assert losses == []


def copy_of(folder: Path, place: Path) -> Path:
    return Path(shutil.copytree(folder, place))


def test_samples_without_any_text_train_too(tmp_path: Path, losses: Losses) -> None:
    changes = ("plan.steps=2", "as_text_share=0.0", "explained_share=0.0")
    finetune(train_config(tmp_path, *changes))
    assert len(losses) == 2
    assert np.isfinite(losses).all()


def test_fingerprint_follows_all_that_shapes_the_steps(tmp_path: Path) -> None:
    ours = fingerprint(train_config(tmp_path))
    assert fingerprint(train_config(tmp_path / "elsewhere", "watch_samples=5")) == ours
    for change in (
        "plan.steps=9",
        "lora.rank=8",
        "as_text_share=0.3",
        "text_weight=0.1",
        "explained_share=0.1",
    ):
        assert fingerprint(train_config(tmp_path, change)) != ours
    base = copy_of(small_base(), tmp_path / "base")
    assert fingerprint(train_config(tmp_path, f"base={base}")) == ours
    contract = base / "ridetune.json"
    text = contract.read_text()
    contract.write_text(text.replace('"rows": 1', '"rows": 2'))
    assert fingerprint(train_config(tmp_path, f"base={base}")) != ours
    contract.write_text(text)
    weights = load_file(base / "model.safetensors")
    weights[min(weights)].view(-1)[0] += 1
    save_file(weights, base / "model.safetensors")
    assert fingerprint(train_config(tmp_path, f"base={base}")) != ours


@pytest.fixture
def checkpoint(tmp_path: Path) -> tuple[AdapterCheckpoint, torch.optim.Optimizer]:
    model = add_adapter(load_model(small_base()), LoraShape(2, 4, 0.0), small_prompts().ids)
    trained = [p for p in model.parameters() if p.requires_grad]
    path = tmp_path / "adapter/checkpoint.pt"
    return AdapterCheckpoint(path, model, "ours", every=2), torch.optim.AdamW(trained)


def test_full_disk_leaves_the_earlier_checkpoint(
    checkpoint: tuple[AdapterCheckpoint, torch.optim.Optimizer], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, optimizer = checkpoint
    kept.save(optimizer, 2)
    before = kept.path.read_bytes()

    def half(state: object, file: Any) -> None:
        file.write(b"half of it")
        no_space()

    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", half)
        with pytest.raises(OSError, match="No space left"):
            kept.save(optimizer, 4)
    assert [path.name for path in kept.path.parent.iterdir()] == ["checkpoint.pt"]
    assert kept.path.read_bytes() == before
    assert kept.load(optimizer) == 2


def test_checkpoint_is_written_at_its_own_rhythm(
    checkpoint: tuple[AdapterCheckpoint, torch.optim.Optimizer],
) -> None:
    kept, optimizer = checkpoint
    assert kept.load(optimizer) == 0
    kept.save(optimizer, 1)
    assert not kept.path.exists()
    kept.save(optimizer, 2)
    kept.save(optimizer, 3)
    assert kept.load(optimizer) == 2


def test_missing_base_and_missing_data_name_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no model at .*set the path in the config"):
        finetune(train_config(tmp_path, f"base={tmp_path}"))
    with pytest.raises(ValueError, match=r"no dataset at .*run `make data`"):
        finetune(train_config(tmp_path, f"data={tmp_path}"))
    assert list(tmp_path.iterdir()) == []


def test_training_data_has_a_held_out_split() -> None:
    train_scenes = {sample.scene_id for sample in small_samples()}
    held_out = read_samples(small_data() / "test.parquet")
    assert len(small_samples()) == 12
    assert not train_scenes & {sample.scene_id for sample in held_out}
