"""The scores of proposals on the test split, with the counts that they rest on."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from ridetune.alignment import (
    command_alignment,
    conservativeness,
    scenario_alignment,
    style_of,
)
from ridetune.codec import NUM_BINS, MatrixCodec
from ridetune.matrix import ControllerMatrix
from ridetune.sample import ADVERSE, Memory, Sample

Pair = tuple[ControllerMatrix, ControllerMatrix]


def score(
    matrices: Sequence[ControllerMatrix], samples: Sequence[Sample], codec: MatrixCodec
) -> dict[str, Any]:
    """Command alignment [0, 100], style accuracy and scenario alignment [0, 1], and their parts."""
    ranges = codec.ranges
    aligned = [
        command_alignment(m, s.style, ranges) for m, s in zip(matrices, samples, strict=True)
    ]
    right = [style_of(m, ranges) == s.style for m, s in zip(matrices, samples, strict=True)]
    voices = [voice_of(s.phrase_id) for s in samples]
    pairs = clear_adverse_pairs(matrices, samples)
    by_condition = {c: scenario_alignment(pairs[c], codec) for c in ADVERSE if pairs[c]}
    return {
        "command_alignment": round(float(np.mean(aligned)), 2),
        "style_accuracy": round(float(np.mean(right)), 4),
        "style_accuracy_by_level": _means(right, [s.level for s in samples]),
        "style_accuracy_by_voice": _means(right, voices),
        "command_alignment_by_voice": _means(aligned, voices),
        "scenario_alignment": round(
            scenario_alignment([pair for c in ADVERSE for pair in pairs[c]], codec), 4
        ),
        "scenario_alignment_by_condition": {c: round(v, 4) for c, v in by_condition.items()},
        "decisions": len(matrices),
        "pairs": sum(len(p) for p in pairs.values()),
    }


def voice_of(phrase_id: str) -> str:
    """Who wrote a phrase of the bank: `moderate_families/II/...` is of the voice `families`."""
    return phrase_id.split("/")[-3].split("_", 1)[-1]


def _means(values: Sequence[float], groups: Sequence[str]) -> dict[str, float]:
    """The mean of the values in each group."""
    members: dict[str, list[float]] = {}
    for value, group in sorted(zip(values, groups, strict=True), key=lambda pair: pair[1]):
        members.setdefault(group, []).append(value)
    return {group: round(float(np.mean(own)), 4) for group, own in members.items()}


def clear_adverse_pairs(
    matrices: Sequence[ControllerMatrix], samples: Sequence[Sample]
) -> dict[str, list[Pair]]:
    """(sunny, adverse) matrices of the same scene and instruction, by adverse condition."""
    clear = {
        (s.scene_id, s.instruction): m
        for m, s in zip(matrices, samples, strict=True)
        if s.condition == "sunny"
    }
    pairs: dict[str, list[Pair]] = defaultdict(list)
    for matrix, sample in zip(matrices, samples, strict=True):
        if sample.condition != "sunny":
            pairs[sample.condition].append((clear[sample.scene_id, sample.instruction], matrix))
    return pairs


def agreement(
    ours: Sequence[ControllerMatrix], theirs: Sequence[ControllerMatrix], codec: MatrixCodec
) -> dict[str, float]:
    """How alike two runs decide: a decision is equal if its style and all values agree.

    Values agree within two bins of 256, the resolution at which the label itself is written
    being one bin.
    """
    far = [
        max(
            abs(codec.share(a, i) - codec.share(b, i)) * (NUM_BINS - 1)
            for i, (a, b) in enumerate(zip(x.values, y.values, strict=True))
        )
        for x, y in zip(ours, theirs, strict=True)
    ]
    same = [
        style_of(x, codec.ranges) == style_of(y, codec.ranges)
        for x, y in zip(ours, theirs, strict=True)
    ]
    equal = [s and f <= 2.0 for s, f in zip(same, far, strict=True)]
    return {
        "equal": round(float(np.mean(equal)), 4),
        "same_style": round(float(np.mean(same)), 4),
        "bins_p50": round(float(np.median(far)), 3),
        "bins_p99": round(float(np.quantile(far, 0.99)), 3),
        "decisions": len(far),
    }


def memory_shift(
    without: Sequence[ControllerMatrix], remembered: Sequence[ControllerMatrix], codec: MatrixCodec
) -> dict[str, float]:
    """Change of conservativeness that memories bring: its mean, and the share that rises."""
    changes = [
        conservativeness(after, codec) - conservativeness(before, codec)
        for before, after in zip(without, remembered, strict=True)
    ]
    return {
        "mean_shift": round(float(np.mean(changes)), 4),
        "share_more_conservative": round(float(np.mean(np.array(changes) > 0)), 4),
        "decisions": len(changes),
    }


def past_drive(sample: Sample, feedback: str) -> tuple[Memory, ...]:
    """A remembered drive like this sample, with a passenger's feedback."""
    return (Memory(sample.instruction, sample.scene, sample.matrix, feedback),)
