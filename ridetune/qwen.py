"""The torch side of a Qwen-VL model: load it, encode frames, run tokens through it.

Works on the Hugging Face classes of Qwen2.5-VL and Qwen3-VL; what differs between them (DeepStack)
is carried in VisionFeatures. Positions come from the prompt builder, one grid per camera.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from transformers import AutoModelForImageTextToText, PreTrainedModel

from ridetune.prompt import TokenIds
from ridetune.vision import VisionSpec


@dataclass(frozen=True)
class VisionFeatures:
    """Visual tokens [frame, token, hidden] and one such tensor per DeepStack layer."""

    tokens: Tensor
    deepstack: tuple[Tensor, ...]

    def select(self, frames: list[int]) -> "VisionFeatures":
        """The features of some frames, in that order."""
        return VisionFeatures(self.tokens[frames], tuple(d[frames] for d in self.deepstack))


def load_model(folder: Path, *, dtype: torch.dtype = torch.float32) -> PreTrainedModel:
    """Load a Qwen-VL model from a folder, safetensors only; ValueError if there is none."""
    if not (folder / "config.json").is_file():
        raise ValueError(
            f"no model at {folder}; run the stage that makes it, or set the path in the config"
        )
    model: PreTrainedModel = AutoModelForImageTextToText.from_pretrained(
        folder, dtype=dtype, use_safetensors=True, attn_implementation="sdpa", local_files_only=True
    )
    return model.eval()


def core(model: Any) -> Any:
    """The part with .visual and .language_model, also under a LoRA adapter."""
    return model.get_base_model().model if hasattr(model, "get_base_model") else model.model


def encode_frames(model: Any, patches: Tensor, spec: VisionSpec) -> VisionFeatures:
    """Patches [frame, patch, values] -> visual tokens."""
    visual = core(model).visual
    num_frames = patches.shape[0]
    grid = torch.tensor([spec.grid_thw] * num_frames, device=patches.device)
    out = visual(patches.flatten(0, 1), grid_thw=grid)

    def by_frame(flat: Tensor) -> Tensor:
        return flat.view(num_frames, spec.num_tokens, -1)

    deepstack = getattr(out, "deepstack_features", None) or []
    return VisionFeatures(by_frame(out.pooler_output), tuple(by_frame(d) for d in deepstack))


def run_tokens(
    model: Any,
    ids: Tensor,
    positions: Tensor,
    features: VisionFeatures | None,
    token_ids: TokenIds,
    *,
    cache: Any = None,
) -> Tensor:
    """Token ids [sample, token] -> last hidden states [sample, token, hidden].

    positions: [3, sample, token]. Rows may be padded on the right: attention is causal, so
    padding changes nothing before it. With a cache the tokens continue what it holds.
    """
    inner = core(model)
    embeds = inner.language_model.get_input_embeddings()(ids)
    extra: dict[str, Any] = {}
    is_image = ids == token_ids.image
    if features is not None:
        mask = is_image[..., None].expand_as(embeds)
        embeds = embeds.masked_scatter(mask, features.tokens.to(embeds.dtype))
        if features.deepstack:
            extra["visual_pos_masks"] = is_image
            extra["deepstack_visual_embeds"] = [d.flatten(0, 1) for d in features.deepstack]
    out = inner.language_model(
        inputs_embeds=embeds,
        position_ids=positions,
        past_key_values=cache,
        use_cache=cache is not None,
        **extra,
    )
    return torch.as_tensor(out.last_hidden_state)


def action_logits(model: Any, hidden: Tensor, token_ids: TokenIds) -> Tensor:
    """Hidden states [..., hidden] -> logits over the 256 action tokens [..., 256]."""
    rows = torch.tensor(token_ids.actions, device=hidden.device)
    return torch.as_tensor(hidden @ model.get_output_embeddings().weight[rows].T)
