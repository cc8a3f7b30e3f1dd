"""The torch engine: the reference that exported graphs are held to, and the one for a GPU.

TorchEngine(load_model(folder), prompts, contract.vision)
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from transformers import DynamicCache

from ridetune.engines import CachedEngine, Prefix
from ridetune.prompt import PromptBuilder
from ridetune.qwen import VisionFeatures, action_logits, encode_frames, run_tokens
from ridetune.vision import VisionSpec


class TorchEngine(CachedEngine):
    """Runs a Qwen-VL model of transformers, on the device and in the dtype it was loaded with."""

    def __init__(self, model: Any, prompts: PromptBuilder, vision: VisionSpec) -> None:
        super().__init__(prompts.ids)
        self.model = model
        self.vision = vision
        ids = prompts.prefix()
        self._prefix_ids = torch.tensor([ids], device=model.device)
        self._prefix_positions = torch.from_numpy(prompts.positions(ids))[:, None].to(model.device)
        self._next_position = prompts.next_position(ids)

    @torch.inference_mode()
    def see(self, patches: NDArray[np.float32]) -> VisionFeatures:
        """Patches [num_patches, 3 * t * p * p] -> visual tokens."""
        frame = torch.from_numpy(patches)[None].to(self.model.device, self.model.dtype)
        return encode_frames(self.model, frame, self.vision)

    @torch.inference_mode()
    def read(self, visual: VisionFeatures) -> Prefix:
        """Visual tokens -> the prefilled prefix."""
        cache = DynamicCache()
        ids = self._prefix_ids
        run_tokens(self.model, ids, self._prefix_positions, visual, self.ids, cache=cache)
        return Prefix(_layers(cache), ids.shape[1], self._next_position)

    def prefill(self, patches: NDArray[np.float32]) -> Prefix:
        """Read system message and image; patches [num_patches, 3 * t * p * p]."""
        return self.read(self.see(patches))

    @torch.inference_mode()
    def advance(
        self, prefix: Prefix, ids: Sequence[int], *, num_hidden: int
    ) -> tuple[NDArray[np.float32], Prefix]:
        """Run text tokens after a prefix; see CachedEngine.advance."""
        device = self.model.device
        cache = DynamicCache(prefix.cache)  # appends by concatenation: the prefix stays as it is
        start, length = prefix.next_position, len(ids)
        positions = torch.arange(start, start + length, device=device).expand(3, 1, -1)
        hidden = run_tokens(
            self.model, torch.tensor([ids], device=device), positions, None, self.ids, cache=cache
        )
        after = Prefix(_layers(cache), prefix.num_tokens + length, start + length)
        return hidden[0, -num_hidden:].float().cpu().numpy(), after

    @torch.inference_mode()
    def action_logits(self, hidden: NDArray[np.float32]) -> NDArray[np.float32]:
        """Hidden states [tokens, hidden] -> logits of the 256 action tokens [tokens, 256]."""
        at_device = torch.from_numpy(hidden).to(self.model.device, self.model.dtype)
        logits = action_logits(self.model, at_device, self.ids).float().cpu().numpy()
        return np.asarray(logits, np.float32)

    @torch.inference_mode()
    def next_token(self, hidden: NDArray[np.float32]) -> int:
        """Hidden state of one token [1, hidden] -> the likeliest token of the vocabulary."""
        at_device = torch.from_numpy(hidden).to(self.model.device, self.model.dtype)
        return int(self.model.get_output_embeddings()(at_device)[0].argmax())


def _layers(cache: Any) -> tuple[tuple[torch.Tensor, torch.Tensor], ...]:
    """Keys and values [1, kv_heads, tokens, head_dim] of each layer."""
    return tuple((layer.keys, layer.values) for layer in cache.layers)
