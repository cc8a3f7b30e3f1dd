"""Score the served bundle beside its controls and beside torch, and write it down.

bundle + test split -> served decisions, controls, torch before and after AWQ, text decoding,
memory, scene descriptions -> evaluation.json, and one JSON line last

python -m evaluate --config configs/evaluate.yaml
"""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from ridetune.alignment import command_alignment
from ridetune.awq_checkpoint import load_quantized
from ridetune.bundle import Bundle, load_bundle
from ridetune.contract import load_tokenizer
from ridetune.control.vehicle import Vehicle
from ridetune.gate import Outcome, SafetyGate
from ridetune.matrix import ControllerMatrix, Ranges
from ridetune.ort_engine import OrtEngine
from ridetune.policy import Policy
from ridetune.qwen import load_model
from ridetune.sample import Sample, read_samples, some_of
from ridetune.scene import SCENE_QUESTIONS, scene_answers
from ridetune.sim.check import load_gate
from ridetune.stage import peak_rss_mb
from ridetune.torch_engine import TorchEngine

from .alignment import agreement, memory_shift, past_drive, score
from .decisions import propose, random_matrices, shuffle_frames, shuffle_instructions
from .writing import MatrixWriter


@dataclass(frozen=True)
class EvaluateConfig:
    """What to score; counts are numbers of samples."""

    bundle: Path
    data: Path
    merged: Path
    quantized: Path
    vehicle: Path
    envelope: Path
    out: Path
    seed: int
    threads: int
    torch_samples: int
    text_samples: int
    scene_samples: int
    memory_samples: int


def evaluate(config: EvaluateConfig) -> None:
    """Run every score and print one table and one JSON line."""
    torch.set_num_threads(config.threads)
    rng = np.random.default_rng(config.seed)
    bundle = load_bundle(config.bundle)
    engine = OrtEngine(bundle, threads=config.threads)
    tokenizer = load_tokenizer(config.bundle)
    policy = Policy(engine, bundle.contract, tokenizer)
    samples = read_samples(config.data / "test.parquet")
    served = propose(policy, samples, "served")
    result: dict[str, Any] = {"served": score(served, samples, policy.contract.codec)}
    result["controls"] = score_controls(policy, samples, rng)
    result["torch"] = compare_torch(config, bundle, samples, served)
    writer = MatrixWriter(engine, bundle.contract, tokenizer)
    subset = some_of(samples, config.text_samples)
    result["text"] = score_text(writer, subset, served, samples, bundle.contract.ranges)
    result["memory"] = score_memory(policy, samples, config, rng)
    result["scene"] = score_scenes(policy, some_of(samples, config.scene_samples))
    gate = load_gate(bundle.contract, Vehicle.load(config.vehicle), config.envelope)
    result["gate"] = gate_outcomes(served, samples, gate)
    result["peak_rss_mb"] = round(peak_rss_mb())
    config.out.parent.mkdir(parents=True, exist_ok=True)
    config.out.write_text(json.dumps(result, indent=2) + "\n")
    print_table(result)
    print(json.dumps(result))


def score_controls(
    policy: Policy, samples: list[Sample], rng: np.random.Generator
) -> dict[str, Any]:
    """What knows nothing, or half: the bar that the served scores must clear."""
    codec = policy.contract.codec
    frames = propose(policy, shuffle_frames(samples, rng), "shuffled frames")
    words = propose(policy, shuffle_instructions(samples, rng), "shuffled words")
    controls = {
        "constant": [codec.ranges.default] * len(samples),
        "random": random_matrices(len(samples), codec, rng),
        "shuffled_frames": frames,
        "shuffled_instructions": words,
        "oracle": [sample.matrix for sample in samples],
    }
    return {name: score(matrices, samples, codec) for name, matrices in controls.items()}


def compare_torch(
    config: EvaluateConfig,
    bundle: Bundle,
    samples: list[Sample],
    served: list[ControllerMatrix],
) -> dict[str, Any]:
    """Scores of the merged and of the dequantized model in torch, and agreement with the served."""
    codec = bundle.contract.codec
    scenes = sorted({sample.scene_id for sample in samples})
    num_scenes = max(config.torch_samples * len(scenes) // len(samples), 1)
    kept = set(scenes[:num_scenes])
    chosen = [i for i, sample in enumerate(samples) if sample.scene_id in kept]
    subset = [samples[i] for i in chosen]
    ours = [served[i] for i in chosen]
    result: dict[str, Any] = {"served": score(ours, subset, codec)}
    tokenizer = load_tokenizer(config.bundle)
    for name, folder in (("merged", config.merged), ("quantized", config.quantized)):
        model = load_model(folder) if name == "merged" else load_quantized(folder)
        engine = TorchEngine(model, bundle.prompts(), bundle.contract.vision)
        theirs = propose(Policy(engine, bundle.contract, tokenizer), subset, f"torch {name}")
        result[name] = score(theirs, subset, codec)
        result[f"served_against_{name}"] = agreement(ours, theirs, codec)
    return result


def score_text(
    writer: MatrixWriter,
    subset: Sequence[Sample],
    served: Sequence[ControllerMatrix],
    samples: Sequence[Sample],
    ranges: Ranges,
) -> dict[str, Any]:
    """The paper's way on the same bundle: the matrix as text, token by token."""
    proposal_of = {id(sample): matrix for sample, matrix in zip(samples, served, strict=True)}
    text_scores, bin_scores, tokens = [], [], []
    for sample in subset:
        matrix, count = writer.write(sample.observation.frame, sample.instruction, sample.memories)
        tokens.append(count)
        text_scores.append(
            command_alignment(matrix, sample.style, ranges) if matrix is not None else None
        )
        bin_scores.append(command_alignment(proposal_of[id(sample)], sample.style, ranges))
    valid = [s for s in text_scores if s is not None]
    return {
        "command_alignment_text": round(float(np.mean([s or 0.0 for s in text_scores])), 2),
        "command_alignment_bins": round(float(np.mean(bin_scores)), 2),
        "well_formed": round(len(valid) / len(text_scores), 4),
        "tokens_mean": round(float(np.mean(tokens)), 1),
        "decisions": len(text_scores),
    }


def score_memory(
    policy: Policy, samples: list[Sample], config: EvaluateConfig, rng: np.random.Generator
) -> dict[str, Any]:
    """What remembered feedback in unseen wordings does to the matrix."""
    path = config.data / "feedback-test.json"
    sayings: dict[str, list[str]] = json.loads(path.read_text())
    sunny = [sample for sample in samples if sample.condition == "sunny"]
    subset = some_of(sunny, config.memory_samples)
    codec = policy.contract.codec
    neutral = _remembering(policy, subset, sayings["just_right"], rng)
    return {
        kind: memory_shift(neutral, _remembering(policy, subset, sayings[kind], rng), codec)
        for kind in ("too_aggressive", "too_conservative")
    } | {
        "against": "the same samples with just_right feedback",
        "sayings": sum(map(len, sayings.values())),
    }


def _remembering(
    policy: Policy, subset: Sequence[Sample], sayings: list[str], rng: np.random.Generator
) -> list[ControllerMatrix]:
    drives = [past_drive(sample, sayings[int(rng.integers(len(sayings)))]) for sample in subset]
    return propose(policy, subset, "memory", drives)


def score_scenes(policy: Policy, subset: Sequence[Sample]) -> dict[str, float]:
    """How often the description agrees with the scene, by question."""
    default = policy.contract.ranges.default
    right = []
    for sample in subset:
        decision = policy.decide(sample.observation.frame, sample.instruction, last_safe=default)
        said = scene_answers(policy.explain(decision).scene)
        right.append([a == b for a, b in zip(said, scene_answers(sample.scene), strict=True)])
    shares = np.mean(right, axis=0)
    return {name: round(float(s), 4) for name, s in zip(SCENE_QUESTIONS, shares, strict=True)}


def gate_outcomes(
    served: Sequence[ControllerMatrix], samples: Sequence[Sample], gate: SafetyGate
) -> dict[str, int]:
    """What the gate says of each proposal in its condition, from a last safe matrix beside it."""
    verdicts = Counter(
        gate.judge(matrix, matrix, sample.condition).outcome
        for matrix, sample in zip(served, samples, strict=True)
    )
    return {outcome: verdicts[outcome] for outcome in get_args(Outcome)}


def print_table(result: dict[str, Any]) -> None:
    """The scores for a person."""
    rows = {"served bundle": result["served"], **result["controls"]}
    print(f"{'':24}{'command':>10}{'style':>8}{'scenario':>10}")
    for name, scores in rows.items():
        print(
            f"{name.replace('_', ' '):24}{scores['command_alignment']:>10.1f}"
            f"{scores['style_accuracy']:>8.2f}{scores['scenario_alignment']:>10.2f}"
        )
