"""The ONNX Runtime engine: what drives the car, without torch.

    engine = OrtEngine(load_bundle(folder), threads=1)

The decoder graph knows no token ids: rows of the embedding table are gathered here, and the hidden
states are multiplied by those rows of the head that are needed, 256 for a decision. Nothing in
the engine changes after it is made, so it can be shared between threads.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from ridetune.bundle import (
    DECODER_FILE,
    EMBEDDING_FILE,
    HEAD_FILE,
    VISION_FILE,
    Bundle,
    Rotary,
)
from ridetune.engines import CachedEngine, Prefix
from ridetune.prompt import PromptBuilder

Array = NDArray[np.float32]


@dataclass(frozen=True)
class _Angles:
    """Rotary inputs of some tokens: cosines and sines [tokens, head_dim / 2]."""

    cos: Array
    sin: Array


class OrtEngine(CachedEngine):
    """Runs a bundle on CPU threads of ONNX Runtime."""

    def __init__(self, bundle: Bundle, *, threads: int = 1) -> None:
        prompts = bundle.prompts()
        super().__init__(prompts.ids)
        self.shape = bundle.facts.model
        self._vision = _open(bundle.folder / VISION_FILE, threads)
        self._decoder = _open(bundle.folder / DECODER_FILE, threads)
        inputs = [each.name for each in self._decoder.get_inputs()]
        self._past_names = [name for name in inputs if name.startswith("past_")]
        self._outputs = [output.name for output in self._decoder.get_outputs()]
        self._embedding = np.load(bundle.folder / EMBEDDING_FILE)
        self._head = _load_head(bundle.folder, self._embedding)
        self._action_head = np.ascontiguousarray(self._head[list(self.ids.actions)].T)
        self._frequencies = np.asarray(bundle.facts.rotary.frequencies, np.float32)
        self._prepare_prefix(prompts, bundle.facts.rotary)

    def _prepare_prefix(self, prompts: PromptBuilder, rotary: Rotary) -> None:
        """Read what stands before the image once and for all; lay out what is read per frame."""
        ids = prompts.prefix()
        first = ids.index(self.ids.image)
        angles = _angles(prompts.positions(ids), rotary)
        before = _Angles(angles.cos[:first], angles.sin[:first])
        wide = self._widen(ids[:first])
        _, self._before_image = self._run(wide, before, self._empty_cache(), num_hidden=1)
        self._frame = self._widen(ids[first:])
        self._frame_angles = _Angles(angles.cos[first:], angles.sin[first:])
        self._prefix_length, self._next_position = len(ids), prompts.next_position(ids)

    def see(self, patches: Array) -> Array:
        """Patches [num_patches, 3 * t * p * p] -> wide visual tokens [tokens, (1 + n) * hidden]."""
        (visual,) = self._vision.run(None, {"patches": patches})
        return np.asarray(visual, np.float32)

    def read(self, visual: Array) -> Prefix:
        """Wide visual tokens -> the prefilled prefix."""
        wide = self._frame.copy()
        wide[0, : len(visual)] = visual
        _, cache = self._run(wide, self._frame_angles, self._before_image, num_hidden=1)
        return Prefix(cache, self._prefix_length, self._next_position)

    def prefill(self, patches: Array) -> Prefix:
        """The prefix of a frame; patches [num_patches, 3 * t * p * p]."""
        return self.read(self.see(patches))

    def advance(
        self, prefix: Prefix, ids: Sequence[int], *, num_hidden: int
    ) -> tuple[Array, Prefix]:
        """Run text tokens after a prefix; see CachedEngine.advance."""
        start, length = prefix.next_position, len(ids)
        # Text stands at the same place on all three axes.
        turned = np.arange(start, start + length, dtype=np.float32)[:, None] * self._frequencies
        angles = _Angles(np.cos(turned), np.sin(turned))
        hidden, cache = self._run(self._widen(ids), angles, prefix.cache, num_hidden=num_hidden)
        return hidden, Prefix(cache, prefix.num_tokens + length, start + length)

    def action_logits(self, hidden: Array) -> Array:
        """Hidden states [tokens, hidden] -> logits of the 256 action tokens [tokens, 256]."""
        return hidden @ self._action_head

    def next_token(self, hidden: Array) -> int:
        """Hidden state of one token [1, hidden] -> the likeliest token of the vocabulary."""
        return int((self._head @ hidden[0]).argmax())

    def _widen(self, ids: Sequence[int]) -> Array:
        """Embeddings [1, tokens, (1 + n) * hidden] with nothing in the DeepStack part."""
        size = self.shape.hidden
        wide = np.zeros((1, len(ids), (1 + self.shape.num_deepstack) * size), np.float32)
        wide[0, :, :size] = self._embedding[ids]
        return wide

    def _empty_cache(self) -> list[Any]:
        nothing = np.zeros((1, self.shape.kv_heads, 0, self.shape.head_dim), np.float32)
        return [_value(nothing)] * (2 * self.shape.layers)

    def _run(
        self, wide: Array, angles: _Angles, cache: Sequence[Any], *, num_hidden: int
    ) -> tuple[Array, list[Any]]:
        """One pass; the cache is a list of OrtValues, key and value of each layer in turn."""
        length = wide.shape[1]
        wanted = np.arange(length - num_hidden, length)
        feeds = {
            "wide": _value(wide),
            "cos": _value(angles.cos),
            "sin": _value(angles.sin),
            "wanted": _value(wanted),
            **dict(zip(self._past_names, cache, strict=True)),
        }
        hidden, *longer = self._decoder.run_with_ort_values(self._outputs, feeds)
        return hidden.numpy()[0], longer


def _open(path: Path, threads: int) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.log_severity_level = 3  # warnings speak to those who write graphs
    # A car's computer has other work while no frame is being read.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _load_head(folder: Path, embedding: NDArray[Any]) -> Array:
    """The output rows [vocabulary, hidden] in float32: numpy multiplies nothing else quickly."""
    path = folder / HEAD_FILE
    table = np.load(path) if path.is_file() else embedding
    return np.asarray(table, np.float32)


def _angles(positions: NDArray[np.int64], rotary: Rotary) -> _Angles:
    """Positions [3, tokens] -> cosines and sines [tokens, head_dim / 2]."""
    frequencies = np.asarray(rotary.frequencies, np.float32)
    turned = positions[list(rotary.axes)].T.astype(np.float32) * frequencies
    return _Angles(np.cos(turned), np.sin(turned))


def _value(array: NDArray[Any]) -> Any:
    return ort.OrtValue.ortvalue_from_numpy(array)
