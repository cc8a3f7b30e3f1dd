"""Published Qwen2.5-VL and Qwen3-VL folders take the new tokens and can be fine-tuned."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from peft import PeftModel
from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers
from torch import Tensor
from transformers import (
    Qwen2_5_VLConfig,
    Qwen2_5_VLForConditionalGeneration,
    Qwen3VLConfig,
    Qwen3VLForConditionalGeneration,
)

from ridetune.config import load_config
from ridetune.contract import Contract, load_tokenizer
from ridetune.matrix import Ranges
from ridetune.prompt import ACTION_TOKENS, CHAT_TOKENS, IMAGE, QUERY_TOKENS, PromptBuilder
from ridetune.qwen import load_model
from ridetune.torch_engine import TorchEngine
from ridetune.vision import VisionSpec, read_patches
from tests.small_base import RANGES, small_data, small_samples
from train.adopt import AdoptConfig, adopt
from train.sft import TrainConfig, finetune

NEW_TOKENS = [*QUERY_TOKENS, *ACTION_TOKENS]
SPARE = 4  # embedding rows that no token takes
PATCH = {"qwen2_5_vl": 14, "qwen3_vl": 16}
HIDDEN = 32
MEAN = (0.48145466, 0.4578275, 0.40821073)


def byte_level_tokenizer() -> Tokenizer:
    """A byte-level BPE without merges, with the chat tokens of Qwen."""
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {letter: number for number, letter in enumerate(alphabet)}
    tokenizer = Tokenizer(models.BPE(vocabulary, []))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.add_special_tokens([AddedToken(t, special=True) for t in CHAT_TOKENS])
    return tokenizer


def random_model(family: str, tokenizer: Tokenizer, num_rows: int, *, tied: bool) -> Any:
    """One random layer of the family, the vision tower cut to one block too."""
    text = {
        "vocab_size": num_rows,
        "hidden_size": HIDDEN,
        "intermediate_size": 48,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "num_key_value_heads": 1,
        "max_position_embeddings": 1024,
        "rope_parameters": {
            "rope_type": "default",
            "rope_theta": 1e4,
            "mrope_section": [2, 3, 3],
            "mrope_interleaved": family == "qwen3_vl",
        },
        "tie_word_embeddings": tied,
    }
    vision = {"hidden_size": 32, "depth": 1, "num_heads": 2, "intermediate_size": 48}
    vision["out_hidden_size"] = HIDDEN
    shared = {"image_token_id": tokenizer.token_to_id(IMAGE), "tie_word_embeddings": tied}
    if family == "qwen3_vl":
        own = {"num_position_embeddings": 16, "deepstack_visual_indexes": [0]}
        deep = Qwen3VLConfig(
            text_config={**text, "head_dim": 16}, vision_config={**vision, **own}, **shared
        )
        return Qwen3VLForConditionalGeneration(deep)
    windows = {"patch_size": 14, "window_size": 56, "fullatt_block_indexes": [0]}
    flat = Qwen2_5_VLConfig(text_config=text, vision_config={**vision, **windows}, **shared)
    return Qwen2_5_VLForConditionalGeneration(flat)


@pytest.fixture(scope="module")
def publish(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Writes a random model as the published folders are laid out."""

    def write(family: str, *, tied: bool = True, spare: int = len(NEW_TOKENS) + SPARE) -> Path:
        folder = tmp_path_factory.mktemp("published") / family
        tokenizer = byte_level_tokenizer()
        torch.manual_seed(0)
        num_rows = tokenizer.get_vocab_size() + spare
        model = random_model(family, tokenizer, num_rows, tied=tied)
        model.save_pretrained(folder, max_shard_size="40KB")
        tokenizer.save(str(folder / "tokenizer.json"))
        (folder / "tokenizer_config.json").write_text("{}")
        processor = {
            "patch_size": PATCH[family],
            "merge_size": 2,
            "temporal_patch_size": 2,
            "image_mean": MEAN,
            "image_std": [0.5, 0.5, 0.5],
        }
        (folder / "preprocessor_config.json").write_text(json.dumps(processor))
        return folder

    return write


def adopt_config(base: Path, out: Path) -> AdoptConfig:
    return AdoptConfig(base=base, out=out, ranges=RANGES, rows=2, columns=3)


@pytest.fixture(scope="module", params=["qwen2_5_vl", "qwen3_vl"])
def adopted(request: pytest.FixtureRequest, publish: Callable[..., Path]) -> Path:
    base = publish(request.param)
    out = base.with_name("adopted")
    adopt(adopt_config(base, out))
    return out


def prompts_of(folder: Path) -> PromptBuilder:
    return Contract.load(folder).prompts(load_tokenizer(folder))


def test_new_tokens_take_the_spare_rows_and_move_no_other_token(adopted: Path) -> None:
    before, after = byte_level_tokenizer().get_vocab(), load_tokenizer(adopted).get_vocab()
    assert {token: after[token] for token in before} == before
    assert after.keys() - before.keys() == set(NEW_TOKENS)
    model: Any = load_model(adopted)
    assert max(after.values()) == model.get_input_embeddings().weight.shape[0] - 1 - SPARE


def test_contract_holds_the_published_image_cut(adopted: Path) -> None:
    family = json.loads((adopted / "config.json").read_text())["model_type"]
    contract = Contract.load(adopted)
    assert contract.vision == VisionSpec(2, 3, PATCH[family], 2, 2, MEAN, (0.5, 0.5, 0.5))
    assert contract.ranges == Ranges.load(RANGES)


def test_weights_are_linked_shards_and_equal_the_published_ones(adopted: Path) -> None:
    shards = list(adopted.glob("*.safetensors"))
    assert len(shards) > 1
    assert all(shard.is_symlink() for shard in shards)
    assert (adopted / "model.safetensors.index.json").is_file()
    ours = load_model(adopted).state_dict()
    theirs = load_model(shards[0].resolve().parent).state_dict()
    assert all(torch.equal(ours[name], weight) for name, weight in theirs.items())


def test_adopted_model_decides(adopted: Path) -> None:
    contract, prompts, sample = Contract.load(adopted), prompts_of(adopted), small_samples()[0]
    engine = TorchEngine(load_model(adopted), prompts, contract.vision)
    patches = read_patches(sample.observation.frame, contract.vision)
    prefix = prompts.prefix()
    assert prefix.count(prompts.ids.image) == contract.vision.num_tokens == 6
    assert prompts.ids.unknown is None  # a byte-level vocabulary knows every script
    suffix = prompts.suffix("fahr bitte 慢一点", sample.memories)
    logits = engine.decide(engine.prefill(patches), suffix).logits
    assert logits.shape == (6, 256)
    assert np.isfinite(logits).all()
    assert logits.std() > 0


def two_steps(base: Path, folder: Path, *, train_tokens: bool) -> Path:
    config = load_config(
        TrainConfig,
        RANGES.with_name("train.yaml"),
        [
            f"base={base}",
            f"data={small_data()}",
            f"adapter={folder / 'adapter'}",
            f"out={folder / 'merged'}",
            "threads=1",
            "plan={steps: 2, batch: 4, learning_rate: 1.0e-2, weight_decay: 0.0}",
            f"lora={{rank: 2, alpha: 4, dropout: 0.0, train_tokens: {str(train_tokens).lower()}}}",
            "as_text_share=0.0",
            "watch_samples=2",
        ],
    )
    finetune(config)
    return config.out


def changed_rows(before: Tensor, after: Tensor) -> set[int]:
    differs = (before.half() != after.half()).any(dim=1)
    return set(torch.nonzero(differs)[:, 0].tolist())


def test_fine_tuning_trains_the_new_rows_and_no_others(adopted: Path, tmp_path: Path) -> None:
    ids = prompts_of(adopted).ids
    merged = two_steps(adopted, tmp_path, train_tokens=True)
    base, tuned = load_model(adopted).state_dict(), load_model(merged).state_dict()
    table = "model.language_model.embed_tokens.weight"
    assert changed_rows(base[table], tuned[table]) == {*ids.actions, *ids.queries}
    others = {n for n in base if not torch.equal(base[n].half(), tuned[n].half())}
    layers = {name for name in others if "language_model.layers.0" in name}
    assert others - layers == {table, "lm_head.weight"}
    assert len(layers) == 7
    assert Contract.load(merged) == Contract.load(adopted)


def test_fine_tuning_leaves_the_embeddings_alone_unless_asked(
    adopted: Path, tmp_path: Path
) -> None:
    merged = two_steps(adopted, tmp_path, train_tokens=False)
    base, tuned = load_model(adopted).state_dict(), load_model(merged).state_dict()
    table = "model.language_model.embed_tokens.weight"
    assert changed_rows(base[table], tuned[table]) == set()


@pytest.mark.parametrize("family", ["qwen2_5_vl", "qwen3_vl"])
def test_head_of_its_own_learns_the_action_rows_too(
    family: str, publish: Callable[..., Path], tmp_path: Path
) -> None:
    base = publish(family, tied=False)
    adopt(adopt_config(base, tmp_path / "adopted"))
    merged = two_steps(tmp_path / "adopted", tmp_path, train_tokens=True)
    ids = prompts_of(merged).ids
    before, after = load_model(base).state_dict(), load_model(merged).state_dict()
    table, head = "model.language_model.embed_tokens.weight", "lm_head.weight"
    assert not torch.equal(after[table], after[head])
    assert set(ids.queries) <= changed_rows(before[table], after[table])
    assert changed_rows(before[table], after[table]) <= {*ids.actions, *ids.queries}
    assert set(ids.actions) <= changed_rows(before[head], after[head])
    assert changed_rows(before[head], after[head]) <= {*ids.actions, *ids.queries}

    kept: Any = PeftModel.from_pretrained(load_model(base), tmp_path / "adapter")
    again = kept.merge_and_unload().half().float().state_dict()
    assert torch.equal(again[table], after[table])
    assert torch.equal(again[head], after[head])


def test_table_without_room_is_refused(publish: Callable[..., Path], tmp_path: Path) -> None:
    base = publish("qwen3_vl", spare=len(NEW_TOKENS) - 1)
    with pytest.raises(ValueError, match=r"has 524 rows, the tokens need 525; resize it first"):
        adopt(adopt_config(base, tmp_path / "adopted"))
    assert not list(tmp_path.iterdir())


def test_table_with_just_enough_room_is_taken(publish: Callable[..., Path], tmp_path: Path) -> None:
    adopt(adopt_config(publish("qwen3_vl", spare=len(NEW_TOKENS)), tmp_path / "adopted"))
    assert Contract.load(tmp_path / "adopted").vision.num_tokens == 6


def test_other_families_are_refused(tmp_path: Path) -> None:
    base = tmp_path / "llava"
    base.mkdir()
    (base / "config.json").write_text(json.dumps({"model_type": "llava"}))
    with pytest.raises(ValueError, match=r"is a 'llava' model; .* qwen2_5_vl and qwen3_vl"):
        adopt(adopt_config(base, tmp_path / "adopted"))


def test_missing_files_are_named(publish: Callable[..., Path], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no config\.json in .*point `base` at"):
        adopt(adopt_config(tmp_path / "nowhere", tmp_path / "adopted"))
    base = publish("qwen3_vl")
    (base / "preprocessor_config.json").unlink()
    with pytest.raises(ValueError, match=r"no preprocessor_config\.json in"):
        adopt(adopt_config(base, tmp_path / "adopted"))


def test_published_model_is_never_replaced(publish: Callable[..., Path]) -> None:
    base = publish("qwen3_vl")
    before = sorted(path.name for path in base.iterdir())
    for out in (base, base.parent):
        with pytest.raises(ValueError, match="would replace the published model"):
            adopt(adopt_config(base, out))
    assert sorted(path.name for path in base.iterdir()) == before
