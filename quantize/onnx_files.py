"""Writes the two graphs as ONNX files and sets the accuracy level of their int4 products."""

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import nn

from ridetune.bundle import DECODER_FILE, VISION_FILE, ModelShape
from ridetune.gemm import PackedLinear
from ridetune.stage import Stopwatch
from ridetune.vision import VisionSpec

from .graphs import DecoderGraph, VisionGraph

LOG = logging.getLogger(__name__)
_OPSET = 20
_INLINE_BYTES = 1_500_000_000  # a protobuf file ends at 2 GiB
_TALKATIVE = ("torch.onnx", "torch.export", "onnxscript", "onnx_ir")


@dataclass(frozen=True)
class LoadedModel:
    """The torch model in float32 and, where it is quantized, its packed layers by module name."""

    model: Any
    packed: Mapping[str, PackedLinear]
    shape: ModelShape


def write_graphs(loaded: LoadedModel, spec: VisionSpec, folder: Path) -> None:
    """vision.onnx and decoder.onnx, the latter at accuracy level 0."""
    shape = loaded.shape
    values = 3 * spec.temporal_patch_size * spec.patch_size**2
    patches = torch.zeros(spec.num_tokens * spec.merge_size**2, values)
    vision = VisionGraph(loaded.model, spec)
    write_graph(vision, (patches,), folder / VISION_FILE, ["patches"], ["visual"], None)

    tokens, past, wanted = (torch.export.Dim(name) for name in ("tokens", "past", "wanted"))
    num = 2 * shape.layers
    cache = [torch.zeros(1, shape.kv_heads, 5, shape.head_dim) for _ in range(num)]
    wide = torch.zeros(1, 7, (1 + shape.num_deepstack) * shape.hidden)
    angles = torch.zeros(7, shape.head_dim // 2)
    names = [f"{kind}.{layer}" for layer in range(shape.layers) for kind in ("key", "value")]
    write_graph(
        DecoderGraph(loaded.model, shape, loaded.packed),
        (wide, angles, angles.clone(), torch.arange(3), cache),
        folder / DECODER_FILE,
        ["wide", "cos", "sin", "wanted", *(f"past_{name}" for name in names)],
        ["hidden", *names],
        ({1: tokens}, {0: tokens}, {0: tokens}, {0: wanted}, [{2: past}] * num),
    )


def write_graph(
    module: nn.Module,
    inputs: tuple[Any, ...],
    path: Path,
    input_names: Sequence[str],
    output_names: Sequence[str],
    dynamic_shapes: Any,
) -> None:
    """Export one module; weights above the protobuf limit go to a file beside the graph."""
    clock = Stopwatch()
    weights = [*module.parameters(), *module.buffers()]
    size = sum(each.numel() * each.element_size() for each in weights)
    LOG.info("event=exporting graph=%s weights_mb=%.1f", path.name, size / 1e6)
    with quiet(), torch.no_grad():
        program = torch.onnx.export(
            module.eval(),
            inputs,
            dynamo=True,
            verbose=False,
            opset_version=_OPSET,
            input_names=input_names,
            output_names=output_names,
            dynamic_shapes=dynamic_shapes,
        )
        assert program is not None
        program.save(path, external_data=size > _INLINE_BYTES)
    LOG.info("event=exported graph=%s seconds=%.1f", path.name, clock.seconds)


def set_accuracy_level(path: Path, level: int) -> None:
    """Change the accuracy level of every MatMulNBits in a graph file."""
    graph = onnx.load(path, load_external_data=False)
    for node in graph.graph.node:
        for attribute in node.attribute:
            if node.op_type == "MatMulNBits" and attribute.name == "accuracy_level":
                attribute.i = level
    onnx.save(graph, path)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep the exporter's progress talk and its deprecation warnings off the terminal."""
    loggers = [logging.getLogger(name) for name in _TALKATIVE]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
