"""Make a published Qwen-VL folder ready for `python -m train`: new tokens, contract.

The 256 action and 6 query tokens take ids that the published embedding tables leave unused
(Qwen2.5-VL and Qwen3-VL pad them), so no weight is copied or changed: the new folder links to the
published safetensors. Fine-tuning then trains the new rows too (`lora.train_tokens=true`).

    python -m train.adopt --config configs/adopt.yaml base=/models/Qwen3-VL-4B-Instruct
"""

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tokenizers import AddedToken

from ridetune.contract import TOKENIZER_FILE, Contract, load_tokenizer
from ridetune.matrix import Ranges
from ridetune.prompt import ACTION_TOKENS, QUERY_TOKENS
from ridetune.stage import new_folder, run_stage
from ridetune.vision import VisionSpec

FAMILIES = ("qwen2_5_vl", "qwen3_vl")


@dataclass(frozen=True)
class AdoptConfig:
    """The published folder, the new one, the camera grid in visual tokens, the ranges."""

    base: Path
    out: Path
    ranges: Path
    rows: int
    columns: int


def adopt(config: AdoptConfig) -> None:
    """Write the new folder; ValueError where the base is unknown or has no room for the tokens."""
    described = _read(config.base / "config.json")
    if described.get("model_type") not in FAMILIES:
        raise ValueError(
            f"{config.base} is a {described.get('model_type')!r} model; "
            f"this project knows {' and '.join(FAMILIES)}"
        )
    tokenizer = load_tokenizer(config.base)
    new = [*QUERY_TOKENS, *ACTION_TOKENS]
    tokenizer.add_special_tokens([AddedToken(t, special=True, normalized=False) for t in new])
    room = described.get("text_config", described)["vocab_size"]
    needed = max(tokenizer.get_vocab().values()) + 1
    if needed > room:
        raise ValueError(
            f"the embedding table of {config.base} has {room} rows, the tokens need {needed}; "
            "resize it first (transformers: model.resize_token_embeddings)"
        )
    if config.base.resolve().is_relative_to(config.out.resolve()):
        raise ValueError(f"{config.out} would replace the published model; name a new `out` folder")
    spec = read_vision_spec(config.base, config.rows, config.columns)
    with new_folder(config.out) as folder:
        for path in sorted(config.base.glob("*.json")):
            shutil.copy(path, folder / path.name)
        for path in sorted(config.base.glob("*.safetensors")):
            (folder / path.name).symlink_to(path.resolve())
        tokenizer.save(str(folder / TOKENIZER_FILE))
        Contract(spec, Ranges.load(config.ranges)).save(folder)
    print(f"adopted {config.base} in {config.out}: {spec.num_tokens} visual tokens per frame")


def read_vision_spec(base: Path, rows: int, columns: int) -> VisionSpec:
    """The image cut that a published image processor describes, on our camera grid."""
    raw = _read(base / "preprocessor_config.json")
    return VisionSpec(
        rows=rows,
        columns=columns,
        patch_size=raw["patch_size"],
        merge_size=raw["merge_size"],
        temporal_patch_size=raw["temporal_patch_size"],
        mean=tuple(raw["image_mean"]),
        std=tuple(raw["image_std"]),
    )


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ValueError(f"no {path.name} in {path.parent}; point `base` at a published model")
    raw: dict[str, Any] = json.loads(path.read_text())
    return raw


if __name__ == "__main__":
    sys.exit(run_stage(AdoptConfig, "configs/adopt.yaml", adopt, __doc__))
