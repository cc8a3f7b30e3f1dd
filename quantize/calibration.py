"""What the language model sees on the calibration samples.

    calibration.parquet -> Sample -> prompt with image -> mean |x| and some x of every linear layer

A prompt holds prefix, suffix, six queries and the six action tokens of the label. One prompt runs
at a time, so no padding enters the statistics. One pass serves all layers: the means are exact,
the tokens kept for the search are a random subset, which keeps memory flat for a large model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ridetune.contract import Contract, load_tokenizer
from ridetune.prompt import PromptBuilder, TokenIds
from ridetune.qwen import core, encode_frames, run_tokens
from ridetune.sample import Sample, read_samples
from ridetune.vision import VisionSpec, read_patches

CALIBRATION_FILE = "calibration.parquet"
# Inputs worth recording: q, k, v share one, gate and up share one.
RECORDED = ("self_attn.q_proj", "self_attn.o_proj", "mlp.gate_proj", "mlp.down_proj")


@dataclass(frozen=True)
class CalibrationPrompt:
    """One sample as tensors: ids [1, token], positions [3, 1, token], patches [1, patch, values].

    text_at is the index of the first token after the image, queries_at that of the first query.
    """

    ids: Tensor
    positions: Tensor
    patches: Tensor
    text_at: int
    queries_at: int


@dataclass(frozen=True)
class Reader:
    """What is needed beside the weights to run a prompt."""

    prompts: PromptBuilder
    vision: VisionSpec

    @staticmethod
    def load(folder: Path) -> "Reader":
        """The prompt builder and the image cut of a model folder."""
        contract = Contract.load(folder)
        return Reader(contract.prompts(load_tokenizer(folder)), contract.vision)

    @property
    def ids(self) -> TokenIds:
        """The ids of the action tokens and their like."""
        return self.prompts.ids


@dataclass(frozen=True)
class Activations:
    """Input of a linear layer: mean |x| over all tokens [in], and a part of the tokens [n, in]."""

    mean_abs: Tensor
    tokens: Tensor


def read_calibration(data: Path) -> list[Sample]:
    """The calibration split of a dataset folder; ValueError if there is none."""
    return read_samples(data / CALIBRATION_FILE)


def hold_apart(samples: Sequence[Sample], num_scenes: int) -> tuple[list[Sample], list[Sample]]:
    """Samples for the calibration, and those of the last `num_scenes` scenes for the check."""
    scenes = list(dict.fromkeys(sample.scene_id for sample in samples))
    if not 0 < num_scenes < len(scenes):
        raise ValueError(
            f"check_scenes is {num_scenes}, but there are {len(scenes)} calibration scenes; "
            "leave at least one for each purpose"
        )
    apart = set(scenes[-num_scenes:])
    return (
        [sample for sample in samples if sample.scene_id not in apart],
        [sample for sample in samples if sample.scene_id in apart],
    )


def write_prompt(sample: Sample, reader: Reader) -> CalibrationPrompt:
    """One sample as the model reads it in a drive, its label's action tokens behind the queries."""
    prompts = reader.prompts
    prefix = prompts.prefix()
    suffix = prompts.suffix(sample.instruction, sample.memories)
    actions = [prompts.ids.actions[b] for b in prompts.codec.encode(sample.matrix)]
    ids = [*prefix, *suffix, *prompts.ids.queries, *actions]
    patches = read_patches(sample.observation.frame, reader.vision)
    return CalibrationPrompt(
        ids=torch.tensor([ids]),
        positions=torch.from_numpy(prompts.positions(ids))[:, None],
        patches=torch.from_numpy(patches)[None],
        text_at=len(prefix),
        queries_at=len(prefix) + len(suffix),
    )


@torch.inference_mode()
def run_prompt(model: Any, prompt: CalibrationPrompt, reader: Reader) -> Tensor:
    """Last hidden states [token, hidden] of one prompt on the model's device."""
    device, dtype = model.device, model.dtype
    features = encode_frames(model, prompt.patches.to(device, dtype), reader.vision)
    hidden = run_tokens(
        model, prompt.ids.to(device), prompt.positions.to(device), features, reader.ids
    )
    return hidden[0]


def record_activations(
    model: Any, prompts: Sequence[CalibrationPrompt], reader: Reader, *, tokens: int, seed: int
) -> list[dict[str, Activations]]:
    """Per layer, the input of each linear in RECORDED over all prompts; about `tokens` kept."""
    layers = core(model).language_model.layers
    recorders = [{name: _Recorder() for name in RECORDED} for _ in layers]
    hooks = [
        layer.get_submodule(name).register_forward_pre_hook(recorder.see)
        for layer, by_name in zip(layers, recorders, strict=True)
        for name, recorder in by_name.items()
    ]
    generator = torch.Generator().manual_seed(seed)
    share = -(-tokens // len(prompts))
    try:
        for prompt in tqdm(prompts, desc="calibration", unit="prompt"):
            kept = torch.randperm(prompt.ids.shape[1], generator=generator)[:share]
            for recorder in (r for by_name in recorders for r in by_name.values()):
                recorder.kept = kept
            run_prompt(model, prompt, reader)
    finally:
        for hook in hooks:
            hook.remove()
    return [{name: r.activations() for name, r in by_name.items()} for by_name in recorders]


class _Recorder:
    """Sums |x| of one linear layer's input and keeps the tokens that `kept` names."""

    def __init__(self) -> None:
        self.kept = torch.empty(0, dtype=torch.long)
        self._sum: Tensor | None = None
        self._count = 0
        self._tokens: list[Tensor] = []

    def see(self, _: Any, inputs: tuple[Tensor, ...]) -> None:
        """The hook: inputs[0] is [1, token, in]."""
        x = inputs[0][0]
        total = x.abs().sum(0, dtype=torch.float32)
        self._sum = total if self._sum is None else self._sum + total
        self._count += x.shape[0]
        self._tokens.append(x[self.kept.to(x.device)].cpu())

    def activations(self) -> Activations:
        """What was seen so far."""
        assert self._sum is not None, "no prompt was run"
        return Activations((self._sum / self._count).cpu(), torch.cat(self._tokens))
