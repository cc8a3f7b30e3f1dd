"""The architecture and the tokenizer of the tiny base: a Qwen3-VL small enough for a CPU.

Qwen3-VL rather than Qwen2.5-VL: its query/key norms keep a small model stable at high learning
rates and under int4, its 32 px visual tokens fit small camera grids without windows of 112 px,
and it exercises DeepStack, the part that exporters get wrong.
"""

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tokenizers import AddedToken, Tokenizer, decoders, models, normalizers, pre_tokenizers
from transformers import PreTrainedTokenizerFast, Qwen3VLConfig, Qwen3VLForConditionalGeneration

from ridetune.prompt import ACTION_TOKENS, CHAT_TOKENS, END, IMAGE, QUERY_TOKENS
from ridetune.vision import VisionSpec

UNKNOWN = "[UNK]"
PIXEL_MEAN = PIXEL_STD = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class TinyShape:
    """Sizes of the tiny model; widths are multiples of the AWQ group (128)."""

    vocabulary: int
    hidden: int
    layers: int
    heads: int
    kv_heads: int
    head_dim: int
    mlp: int
    vision_hidden: int
    vision_layers: int
    vision_heads: int
    vision_mlp: int
    deepstack_at: int
    rows: int
    columns: int


def vision_spec(shape: TinyShape) -> VisionSpec:
    """The image cut of Qwen3-VL on the tiny camera grid."""
    return VisionSpec(
        rows=shape.rows,
        columns=shape.columns,
        patch_size=16,
        merge_size=2,
        temporal_patch_size=2,
        mean=PIXEL_MEAN,
        std=PIXEL_STD,
    )


def build_tokenizer(word_pieces: dict[str, int], corpus: Iterable[str], size: int) -> Tokenizer:
    """A WordPiece tokenizer on a part of a larger vocabulary: first what the corpus needs.

    word_pieces: piece -> id of the teacher's vocabulary, in which lower ids are more frequent.
    Characters stay in, so that any Latin text can be spelled; digits stand alone, so that
    fixed-width numbers keep a fixed number of tokens.
    """
    whole = _word_piece(word_pieces)
    counts: Counter[str] = Counter()
    for text in corpus:
        counts.update(whole.encode(text, add_special_tokens=False).tokens)
    characters = [p for p in word_pieces if len(p.removeprefix("##")) == 1 and p.isascii()]
    reserved = len(ACTION_TOKENS) + len(QUERY_TOKENS) + len(CHAT_TOKENS) + 1
    frequent = [p for p, i in sorted(word_pieces.items(), key=lambda x: x[1]) if i > 1995]
    wanted = [*characters, *(piece for piece, _ in counts.most_common()), *frequent]
    kept = [p for p in dict.fromkeys(wanted) if p != UNKNOWN][: size - reserved]
    tokenizer = _word_piece({piece: i for i, piece in enumerate([UNKNOWN, *kept])})
    special = [*CHAT_TOKENS, *QUERY_TOKENS, *ACTION_TOKENS]
    tokenizer.add_special_tokens([AddedToken(t, special=True, normalized=False) for t in special])
    return tokenizer


def _word_piece(vocabulary: dict[str, int]) -> Tokenizer:
    tokenizer = Tokenizer(
        models.WordPiece(vocabulary, unk_token=UNKNOWN, max_input_chars_per_word=60)
    )
    tokenizer.normalizer = normalizers.BertNormalizer(lowercase=True)
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [pre_tokenizers.BertPreTokenizer(), pre_tokenizers.Digits(individual_digits=True)]
    )
    tokenizer.decoder = decoders.WordPiece(prefix="##", cleanup=True)
    return tokenizer


def build_model(shape: TinyShape, tokenizer: Tokenizer) -> Qwen3VLForConditionalGeneration:
    """The randomly initialised tiny model."""
    rope = {"rope_type": "default", "rope_theta": 10_000.0, "mrope_interleaved": True}
    third = shape.head_dim // 2 // 3
    config = Qwen3VLConfig(
        text_config=dict(
            vocab_size=tokenizer.get_vocab_size(),
            hidden_size=shape.hidden,
            intermediate_size=shape.mlp,
            num_hidden_layers=shape.layers,
            num_attention_heads=shape.heads,
            num_key_value_heads=shape.kv_heads,
            head_dim=shape.head_dim,
            max_position_embeddings=2048,
            rope_parameters={
                **rope,
                "mrope_section": [shape.head_dim // 2 - 2 * third, third, third],
            },
            tie_word_embeddings=True,
        ),
        vision_config=dict(
            hidden_size=shape.vision_hidden,
            depth=shape.vision_layers,
            num_heads=shape.vision_heads,
            intermediate_size=shape.vision_mlp,
            out_hidden_size=shape.hidden,
            num_position_embeddings=64,
            deepstack_visual_indexes=[shape.deepstack_at],
        ),
        image_token_id=tokenizer.token_to_id(IMAGE),
        video_token_id=tokenizer.token_to_id("<|video_pad|>"),
        vision_start_token_id=tokenizer.token_to_id("<|vision_start|>"),
        vision_end_token_id=tokenizer.token_to_id("<|vision_end|>"),
        tie_word_embeddings=True,
    )
    return Qwen3VLForConditionalGeneration(config)


def save_tokenizer(tokenizer: Tokenizer, spec: VisionSpec, folder: Path) -> None:
    """Tokenizer and image processor files as other Qwen-VL tools expect them."""
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, eos_token=END, pad_token=CHAT_TOKENS[0], unk_token=UNKNOWN
    )
    fast.save_pretrained(folder)
    pixels = spec.height_px * spec.width_px
    processor: dict[str, Any] = {
        "image_processor_type": "Qwen2VLImageProcessor",
        "patch_size": spec.patch_size,
        "merge_size": spec.merge_size,
        "temporal_patch_size": spec.temporal_patch_size,
        "image_mean": list(spec.mean),
        "image_std": list(spec.std),
        "size": {"shortest_edge": pixels, "longest_edge": pixels},
    }
    (folder / "preprocessor_config.json").write_text(json.dumps(processor, indent=2) + "\n")
