"""The export carries the integers over exactly, is held to torch with images, and is atomic."""

import errno
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import numpy_helper

import quantize.export as stage
from quantize.export import ExportConfig, export, load, parity_prompts
from quantize.onnx_files import set_accuracy_level
from quantize.parity import (
    answers,
    check_decisions,
    check_exact,
    compare_decisions,
    compare_exact,
)
from ridetune.awq_checkpoint import load_packed
from ridetune.bundle import BUNDLE_FILE, DECODER_FILE, Bundle, load_bundle, read_facts
from ridetune.config import load_config
from ridetune.gemm import GroupedLevels, unpack
from ridetune.ort_engine import OrtEngine
from ridetune.torch_engine import TorchEngine
from tests.tiny_bundle import (
    GATE,
    ROOT,
    awq_bundle,
    awq_model,
    copy_of_bundle,
    export_config,
    plain_bundle,
    plain_model,
)


def test_shipped_config_loads() -> None:
    assert load_config(ExportConfig, Path("configs/export.yaml")).accuracy_level in (0, 4)


@pytest.mark.parametrize("folder", [plain_bundle, awq_bundle])
def test_graphs_equal_torch_on_image_prompts(folder: Callable[[], Path]) -> None:
    parity = read_facts(folder()).parity
    assert parity["prompts"] == 2
    assert parity["hidden_difference"] < 1e-4 * parity["hidden_largest"]
    assert parity["logits_difference"] < 1e-4 * parity["logits_largest"]
    assert parity["bins_max"] < 0.1


def test_bundle_names_its_source_and_shapes() -> None:
    facts = load_bundle(awq_bundle()).facts
    assert facts.source.folder == awq_model().name
    assert facts.quantization is not None
    assert facts.quantization.group_size == 128
    assert facts.model.num_deepstack == 1
    assert {"config.yaml", "manifest.json"} < set(facts.files)
    assert read_facts(plain_bundle()).quantization is None


def test_integers_of_the_checkpoint_are_carried_over_exactly() -> None:
    linears = load_packed(awq_model()).linears
    graph = onnx.load(awq_bundle() / DECODER_FILE).graph
    tensors = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    nodes = [node for node in graph.node if node.op_type == "MatMulNBits"]
    found = [_unpack_node([tensors[name] for name in node.input[1:]]) for node in nodes]
    assert len(found) == len(linears) == 14
    for packed in linears.values():
        truth = unpack(packed)
        assert any(
            truth.levels.shape == other.levels.shape
            and np.array_equal(truth.levels, other.levels)
            and np.array_equal(truth.zeros, other.zeros)
            and np.array_equal(truth.scales, other.scales)
            for other in found
        )


def _unpack_node(inputs: list[NDArray[np.uint8]]) -> GroupedLevels:
    levels, scales, zeros = inputs
    split = np.stack([levels & 15, levels >> 4], axis=-1).reshape(levels.shape[0], -1)
    halves = np.stack([zeros & 15, zeros >> 4], axis=-1).reshape(zeros.shape[0], -1)
    return GroupedLevels(split, halves[:, : scales.shape[1]], scales.astype(np.float16))


def test_int8_activations_move_little_of_the_probability(tmp_path: Path) -> None:
    bundle = load_bundle(copy_of_bundle(tmp_path))
    prompts = parity_prompts(export_config(awq_model(), "unused"), bundle.contract)
    exact = answers(OrtEngine(bundle), prompts, name="level 0")
    set_accuracy_level(bundle.folder / DECODER_FILE, 4)
    deployed = answers(OrtEngine(bundle), prompts, name="level 4")
    one, other = (shares(np.stack([a.logits for a in some])) for some in (exact, deployed))
    moved = np.abs(one - other).sum(axis=-1) / 2  # [prompt, parameter]
    assert 0 < moved.min() <= moved.max() < 0.05
    figures = compare_decisions(exact, deployed, bundle.contract.codec)
    assert 0 < figures["bins_mean"] < figures["bins_max"]


def shares(logits: NDArray[np.float32]) -> NDArray[np.float64]:
    """Probabilities over the bins."""
    mass = np.exp(logits - logits.max(axis=-1, keepdims=True), dtype=float)
    whole: NDArray[np.float64] = mass / mass.sum(axis=-1, keepdims=True)
    return whole


class Flat(OrtEngine):
    """An engine that loses DeepStack, as some exporters do."""

    def see(self, patches: NDArray[np.float32]) -> NDArray[np.float32]:
        visual = super().see(patches)
        visual[:, self.shape.hidden :] = 0
        return visual


def test_gate_refuses_graphs_without_deepstack() -> None:
    bundle = load_bundle(awq_bundle())
    prompts = parity_prompts(export_config(awq_model(), "unused"), bundle.contract)
    reference = TorchEngine(load(awq_model()).model, bundle.prompts(), bundle.contract.vision)
    truth = answers(reference, prompts, name="torch")
    found = answers(Flat(bundle), prompts, name="flat")
    with pytest.raises(ValueError, match="differ from torch by"):
        check_exact(compare_exact(truth, found), GATE)


def test_gate_refuses_values_that_are_not_finite() -> None:
    figures = {"hidden_difference": float("nan"), "hidden_largest": 1.0}
    with pytest.raises(ValueError, match=r"gate\.tolerance"):
        check_exact({**figures, "logits_difference": 0.0, "logits_largest": 1.0}, GATE)


def test_gate_refuses_decisions_that_moved() -> None:
    with pytest.raises(ValueError, match="set accuracy_level to 0"):
        check_decisions({"bins_p95": 5.1}, GATE)


def test_failing_gate_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    config = export_config(awq_model(), "refused")
    _reuse_graphs(monkeypatch)
    monkeypatch.setattr(stage, "OrtEngine", Flat)
    with pytest.raises(ValueError, match="differ from torch by"):
        export(config)
    assert not config.out.exists()
    assert not list(ROOT.glob(".refused*"))


@pytest.mark.parametrize("failing", ["write_embedding", "write_facts"])
def test_full_disk_leaves_the_earlier_bundle(
    failing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    earlier = copy_of_bundle(tmp_path)
    before = (earlier / BUNDLE_FILE).read_bytes()
    config = ExportConfig(**{**vars(export_config(awq_model(), "unused")), "out": earlier})
    _reuse_graphs(monkeypatch)

    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(stage, failing, fail)
    with pytest.raises(OSError, match="No space left"):
        export(config)
    assert (earlier / BUNDLE_FILE).read_bytes() == before
    load_bundle(earlier)
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


def _reuse_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Copy the graphs of the finished bundle instead of exporting them again."""

    def copy(_: object, __: object, folder: Path) -> None:
        for path in awq_bundle().glob("*.onnx"):
            shutil.copy(path, folder)

    monkeypatch.setattr(stage, "write_graphs", copy)


def test_other_families_are_refused_before_their_weights_are_read(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "qwen2_5_vl"}))
    with pytest.raises(ValueError, match=r"export supports Qwen3-VL so far.*qwen2_5_vl"):
        load(tmp_path)


def test_missing_model_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no model at .*python -m quantize"):
        load(tmp_path)


def test_float16_embedding_is_half_the_size_and_near(tmp_path: Path) -> None:
    bundle = load_bundle(copy_of_bundle(tmp_path))
    prompts = parity_prompts(export_config(awq_model(), "unused"), bundle.contract)
    path = bundle.folder / "embedding.npy"
    whole, size = answers(OrtEngine(bundle), prompts, name="float32"), path.stat().st_size
    stage.write_embedding(load(plain_model()).model, bundle.folder, dtype="float16")
    half = answers(
        OrtEngine(Bundle(bundle.folder, bundle.facts, bundle.contract)), prompts, name="half"
    )
    assert path.stat().st_size < 0.6 * size
    np.testing.assert_allclose(half[0].logits, whole[0].logits, atol=0.05)
