"""The AWQ stage on tiny random models with planted outlier channels."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import torch
from PIL import Image
from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

from quantize.awq import (
    JOBS,
    LINEARS,
    check_layer,
    fold,
    round_groups,
    round_layer,
    search_clip,
    search_scales,
)
from quantize.build import QuantizeConfig, quantize
from quantize.calibration import (
    Activations,
    Reader,
    hold_apart,
    read_calibration,
    record_activations,
    run_prompt,
    write_prompt,
)
from quantize.divergence import is_above
from ridetune.awq_checkpoint import load_packed, load_quantized
from ridetune.codec import MatrixCodec
from ridetune.config import load_config
from ridetune.contract import Contract
from ridetune.gemm import unpack
from ridetune.matrix import Ranges
from ridetune.qwen import core, load_model
from ridetune.sample import Observation, Sample
from train.base import TinyShape, build_model, build_tokenizer, save_tokenizer, vision_spec

ROOT = Path(__file__).parents[1]
NUM_SCENES = 12
SHAPE = TinyShape(
    vocabulary=420,
    hidden=128,
    layers=2,
    heads=4,
    kv_heads=2,
    head_dim=32,
    mlp=256,
    vision_hidden=64,
    vision_layers=2,
    vision_heads=2,
    vision_mlp=128,
    deepstack_at=0,
    rows=2,
    columns=4,
)


def _tokenizer() -> Any:
    letters = "abcdefghijklmnopqrstuvwxyz0123456789.,:'-|"
    pieces = ["[UNK]", *letters, *(f"##{letter}" for letter in letters), "drive", "faster"]
    return build_tokenizer({p: i for i, p in enumerate(pieces)}, ["drive faster"], SHAPE.vocabulary)


def _qwen25(tokenizer: Any) -> Any:
    """The older architecture: biases in q, k, v; a mean vision width of its own; no DeepStack."""
    text = dict(
        vocab_size=tokenizer.get_vocab_size(),
        hidden_size=SHAPE.hidden,
        intermediate_size=SHAPE.mlp,
        num_hidden_layers=SHAPE.layers,
        num_attention_heads=SHAPE.heads,
        num_key_value_heads=SHAPE.kv_heads,
        rope_parameters={
            "rope_type": "default",
            "rope_theta": 10_000.0,
            "mrope_section": [4, 6, 6],
        },
        tie_word_embeddings=False,
    )
    vision = dict(
        hidden_size=64,
        depth=2,
        num_heads=2,
        intermediate_size=128,
        out_hidden_size=SHAPE.hidden,
        patch_size=16,
        window_size=64,
        fullatt_block_indexes=[1],
    )
    ids = {
        f"{name}_token_id": tokenizer.token_to_id(f"<|{name}_pad|>") for name in ("image", "video")
    }
    return Qwen2_5_VLForConditionalGeneration(
        Qwen2_5_VLConfig(text_config=text, vision_config=vision, tie_word_embeddings=False, **ids)
    )


def _plant_outliers(model: Any) -> None:
    """A few channels carry large activations, as in every trained language model."""
    with torch.no_grad():
        for layer in core(model).language_model.layers:
            for norm in (layer.input_layernorm, layer.post_attention_layernorm):
                norm.weight[torch.randperm(SHAPE.hidden)[:4]] *= 20
            layer.mlp.up_proj.weight[torch.randperm(SHAPE.mlp)[:6]] *= 20
            for name in LINEARS:
                layer.get_submodule(name).weight *= 3
                if layer.get_submodule(name).bias is not None:
                    layer.get_submodule(name).bias.normal_()


def _save(model: Any, tokenizer: Any, ranges: Ranges, folder: Path) -> Path:
    _plant_outliers(model)
    model.save_pretrained(folder)
    save_tokenizer(tokenizer, vision_spec(SHAPE), folder)
    Contract(vision_spec(SHAPE), ranges).save(folder)
    return folder


@pytest.fixture(scope="module", params=["Qwen3-VL", "Qwen2.5-VL"])
def source(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, ranges: Ranges
) -> Path:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    tokenizer = _tokenizer()
    model = _qwen25(tokenizer) if request.param == "Qwen2.5-VL" else build_model(SHAPE, tokenizer)
    return _save(model, tokenizer, ranges, tmp_path_factory.mktemp("source"))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory, ranges: Ranges) -> Path:
    folder = tmp_path_factory.mktemp("data")
    rng = np.random.default_rng(1)
    codec = MatrixCodec(ranges)
    rows = []
    for number in range(NUM_SCENES):
        sample = Sample(
            observation=Observation(_png(rng)),
            instruction="drive faster please" if number % 2 else "i am not in a hurry",
            memories=(),
            matrix=codec.decode(list(rng.integers(20, 230, 6))),
            scene="sunny straight road",
            explanation="",
            style="moderate",
            level="I",
            intent="",
            condition="sunny",
            split="calibration",
            scene_id=f"scene-{number}",
            phrase_id="",
        )
        rows.append(sample.as_row())
    parquet.write_table(pa.Table.from_pylist(rows), folder / "calibration.parquet")
    return folder


def _png(rng: np.random.Generator) -> bytes:
    """A frame of coarse random blocks."""
    blocks = Image.fromarray(rng.integers(0, 256, (4, 8, 3), np.uint8))
    file = io.BytesIO()
    blocks.resize((128, 64)).save(file, "PNG")
    return file.getvalue()


def _config(source: Path, dataset: Path, out: Path, *overrides: str) -> QuantizeConfig:
    paths = (f"model={source}", f"data={dataset}", f"out={out}")
    small = ("check_scenes=4", "tokens=512", "threads=1")
    return load_config(QuantizeConfig, ROOT / "configs/quantize.yaml", [*paths, *small, *overrides])


@pytest.fixture(scope="module")
def quantized(source: Path, dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "awq"
    quantize(_config(source, dataset, out))
    return out


def test_awq_loses_clearly_less_than_rounding_where_channels_stand_out(quantized: Path) -> None:
    report = json.loads((quantized / "report.json").read_text())
    for key in ("actions_nats", "next_token_nats"):
        assert report["kl"]["awq"][key] < 0.75 * report["kl"]["round_to_nearest"][key]
    assert report["finite"] == {"float32": True, "float16": True}
    assert not any(report["awq_worse_than_rounding_beyond_noise"].values())
    assert len(report["jobs"]) == SHAPE.layers * len(JOBS)
    assert all(job["error_scaled"] <= job["error_rounded"] for job in report["jobs"])


def test_checkpoint_packs_the_language_layers_and_nothing_else(
    source: Path, quantized: Path
) -> None:
    checkpoint = load_packed(quantized)
    expected = {
        f"model.language_model.layers.{n}.{name}" for n in range(SHAPE.layers) for name in LINEARS
    }
    assert set(checkpoint.linears) == expected
    original = load_model(source).state_dict()
    for key, tensor in checkpoint.tensors.items():
        assert tensor.dtype == torch.float16
        if "layernorm" not in key:
            assert torch.equal(tensor, original[key].half()), key
    settings = json.loads((quantized / "config.json").read_text())["quantization_config"]
    assert settings["modules_to_not_convert"] == ["visual", "model.visual", "lm_head"]
    for name in ("tokenizer.json", "preprocessor_config.json", "ridetune.json", "manifest.json"):
        assert (quantized / name).is_file()


def test_loaded_model_holds_exactly_the_dequantized_weights(quantized: Path) -> None:
    model: Any = load_quantized(quantized)
    for name, packed in load_packed(quantized).linears.items():
        weight = model.get_submodule(name).weight
        assert torch.equal(weight, torch.from_numpy(unpack(packed).dequantize()))


def test_folding_leaves_the_unrounded_model_as_it_was(source: Path, dataset: Path) -> None:
    reader = Reader.load(source)
    prompts = [write_prompt(sample, reader) for sample in read_calibration(dataset)[:3]]
    model: Any = load_model(source, dtype=torch.float64)
    before = run_prompt(model, prompts[0], reader)
    seen = record_activations(model, prompts, reader, tokens=64, seed=0)
    for layer, inputs in zip(core(model).language_model.layers, seen, strict=True):
        _, _, searches = round_layer(layer, inputs, group_size=128, num_exponents=4, clip=False)
        assert any(search.exponent is not None for search in searches.values())
        layer.load_state_dict(fold(layer, searches), strict=False)
    after = run_prompt(model, prompts[0], reader)
    assert torch.allclose(before, after, atol=1e-4 * float(before.abs().max()))


def test_recorded_mean_is_over_all_tokens_and_kept_tokens_are_a_part(
    source: Path, dataset: Path
) -> None:
    reader = Reader.load(source)
    prompts = [write_prompt(sample, reader) for sample in read_calibration(dataset)[:2]]
    model: Any = load_model(source)
    whole = record_activations(model, prompts, reader, tokens=10_000, seed=0)[0]
    part = record_activations(model, prompts, reader, tokens=20, seed=0)[0]
    for name, inputs in whole.items():
        assert inputs.tokens.shape[0] == sum(p.ids.shape[1] for p in prompts)
        assert part[name].tokens.shape[0] == 20
        assert torch.allclose(inputs.mean_abs, inputs.tokens.abs().mean(0), atol=1e-5, rtol=1e-4)
        assert torch.allclose(inputs.mean_abs, part[name].mean_abs)


def test_rounding_error_is_at_most_half_a_step_and_zero_stays_zero() -> None:
    torch.manual_seed(1)
    weight = torch.randn(16, 256)
    weight[3, :128] = weight[3, :128].abs() + 5  # a group without zero inside its range
    weight[4] = 0
    weight[:, 7] = 0
    grouped = round_groups(weight, 128)
    change = (grouped.dequantize() - weight).view(16, 2, 128).abs()
    # The zero point is rounded too, so the ends of the range may miss by up to a step.
    assert bool((change <= 1.01 * grouped.scales).all())
    assert float((change / grouped.scales).mean()) < 0.3
    assert not grouped.dequantize()[4].any()
    assert not grouped.dequantize()[:, 7].any()
    assert torch.equal(grouped.dequantize(), torch.from_numpy(grouped.as_levels().dequantize()))


def test_search_scales_up_the_channel_with_large_activations() -> None:
    torch.manual_seed(2)
    tokens = torch.randn(256, 128)
    tokens[:, 5] *= 50
    seen = Activations(tokens.abs().mean(0), tokens)
    search = search_scales([torch.randn(64, 128)], seen, group_size=128, num_exponents=20)
    assert search.error_scaled < 0.5 * search.error_rounded
    assert int(search.scales.argmax()) == 5


def test_clip_cuts_a_lone_outlier_weight_that_carries_no_activation() -> None:
    torch.manual_seed(3)
    weight = torch.randn(8, 128)
    weight[:, 9] = 12
    tokens = torch.randn(256, 128)
    tokens[:, 9] = 0
    assert bool((search_clip(weight, tokens, 128) < 0.8).all())


def test_scenes_of_the_check_are_not_calibrated_on(dataset: Path) -> None:
    samples = read_calibration(dataset)
    fit, check = hold_apart([*samples, *samples], 4)
    assert {s.scene_id for s in fit}.isdisjoint({s.scene_id for s in check})
    assert len(fit) == 2 * (NUM_SCENES - 4)
    with pytest.raises(ValueError, match="12 calibration scenes"):
        hold_apart(samples, NUM_SCENES)


@pytest.mark.parametrize("left", [0.0, 1.0])
def test_a_difference_within_noise_is_not_called_worse(left: float) -> None:
    right = np.random.default_rng(0).normal(size=50)
    assert is_above(right + left, right) == bool(left)
    assert not is_above(right[::-1], right)


def test_an_adapter_and_a_quantized_model_are_refused(
    source: Path, quantized: Path, dataset: Path, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="already quantized"):
        quantize(_config(quantized, dataset, tmp_path / "out"))
    (tmp_path / "adapter_config.json").write_text("{}")
    with pytest.raises(ValueError, match="merge it"):
        quantize(_config(tmp_path, dataset, tmp_path / "out"))
    with pytest.raises(ValueError, match="another `out` folder"):
        quantize(_config(source, dataset, source))
    with pytest.raises(ValueError, match="no quantized model"):
        load_quantized(source)
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / ".out.partial").exists()


def test_widths_that_do_not_divide_into_groups_are_refused(source: Path) -> None:
    layer = core(load_model(source)).language_model.layers[0]
    with pytest.raises(ValueError, match="smaller group_size"):
        check_layer(layer, 96)
