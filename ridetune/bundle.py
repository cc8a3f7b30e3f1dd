"""The bundle: everything that the car needs, in one folder, held together by hashes.

    vision.onnx     patches [num_patches, 3 * t * p * p] -> wide visual tokens [tokens, (1 + n) * H]
    decoder.onnx    wide embeddings, rotary, past keys and values -> hidden states, keys and values
    embedding.npy   token embeddings [vocabulary, H]; head.npy beside it where the head is not tied
    tokenizer.json
    bundle.json     contract, shapes, hashes, parity with torch, latency profile of the benchmark

H is the hidden size, n the number of DeepStack layers. `python -m quantize.export` writes it.
"""

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from ridetune.contract import Contract, load_tokenizer
from ridetune.prompt import PromptBuilder
from ridetune.stage import hash_file

LOG = logging.getLogger(__name__)

BUNDLE_FILE = "bundle.json"
VISION_FILE = "vision.onnx"
DECODER_FILE = "decoder.onnx"
EMBEDDING_FILE = "embedding.npy"
HEAD_FILE = "head.npy"
TOKENIZER_FILE = "tokenizer.json"
REQUIRED_FILES = (VISION_FILE, DECODER_FILE, EMBEDDING_FILE, TOKENIZER_FILE)
_AGAIN = "export again with `python -m quantize.export`"


class _Facts(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class ModelShape(_Facts):
    """Sizes of the language model that an engine allocates by."""

    family: str
    hidden: int
    layers: int
    kv_heads: int
    head_dim: int
    vocabulary: int
    num_deepstack: int


class Rotary(_Facts):
    """mRoPE: angle of channel j = frequencies[j] * position[axes[j]]; axes time, height, width."""

    frequencies: tuple[float, ...]
    axes: tuple[int, ...]


class Quantization(_Facts):
    """How the linear layers are packed; accuracy_level as in MatMulNBits (4: int8 activations)."""

    bits: int
    group_size: int
    accuracy_level: int


class Source(_Facts):
    """The model folder that was exported, and the SHA-256 of its manifest where it has one."""

    folder: str
    manifest_sha256: str | None


class BundleFacts(_Facts):
    """The content of bundle.json; files: SHA-256 by name, parity: figures of the export's gate."""

    format: Literal[1] = 1
    contract: dict[str, Any]
    model: ModelShape
    rotary: Rotary
    quantization: Quantization | None
    source: Source
    files: dict[str, str]
    verified_with: dict[str, str]
    parity: dict[str, float]
    profile: dict[str, Any] | None = None


@dataclass(frozen=True)
class Bundle:
    """A checked bundle folder."""

    folder: Path
    facts: BundleFacts
    contract: Contract

    def prompts(self) -> PromptBuilder:
        """The prompt builder of the bundle's tokenizer and camera grid."""
        return self.contract.prompts(load_tokenizer(self.folder))


def load_bundle(folder: Path) -> Bundle:
    """Read and verify a bundle; ValueError with the remedy where it is not whole or not ours."""
    facts = read_facts(folder)
    where = folder / BUNDLE_FILE
    try:
        contract = Contract.parse(facts.contract, where=str(where))
    except (KeyError, TypeError) as error:
        raise ValueError(f"the contract in {where} is incomplete ({error}); {_AGAIN}") from error
    for name in sorted({*REQUIRED_FILES, *facts.files}):
        _check_file(folder, name, facts.files.get(name))
    LOG.info("event=bundle_verified folder=%s files=%d", folder, len(facts.files))
    return Bundle(folder, facts, contract)


def read_facts(folder: Path) -> BundleFacts:
    """bundle.json of a folder, its files not checked."""
    path = folder / BUNDLE_FILE
    if not folder.is_dir():
        raise ValueError(f"no bundle at {folder}; `python -m quantize.export` writes one")
    if not path.is_file():
        raise ValueError(f"{folder} holds no {BUNDLE_FILE}, it is not a bundle; {_AGAIN}")
    try:
        return BundleFacts.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        at = f" at {key}" if key else ""
        raise ValueError(f"{path} is malformed{at}: {first['msg']}; {_AGAIN}") from error


def write_facts(folder: Path, facts: BundleFacts) -> None:
    """Write bundle.json so that it is either the old one or the new one, whole."""
    partial = folder / f".{BUNDLE_FILE}.partial"
    plain = facts.model_dump(mode="json")
    if facts.profile is None:
        del plain["profile"]
    try:
        partial.write_text(json.dumps(plain, indent=2) + "\n")
        partial.replace(folder / BUNDLE_FILE)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def add_profile(folder: Path, profile: Mapping[str, Any]) -> None:
    """Put the latency profile of the benchmark into bundle.json, in place of an older one."""
    facts = read_facts(folder)
    write_facts(folder, facts.model_copy(update={"profile": dict(profile)}))


def _check_file(folder: Path, name: str, expected: str | None) -> None:
    path = folder / name
    if not path.is_file():
        raise ValueError(f"bundle file {name} is missing in {folder}; {_AGAIN}")
    if expected is None:
        raise ValueError(f"{folder / BUNDLE_FILE} holds no hash of {name}; {_AGAIN}")
    if hash_file(path) != expected:
        raise ValueError(f"bundle file {name} in {folder} was changed after export; {_AGAIN}")
