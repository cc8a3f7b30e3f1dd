"""Ask a policy about samples: the matrices that it proposes, and controls that know nothing."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from tqdm import tqdm

from ridetune.codec import NUM_BINS, MatrixCodec
from ridetune.matrix import NUM_PARAMETERS, ControllerMatrix
from ridetune.policy import Policy
from ridetune.sample import Memory, Sample

# Prefilled frames in memory at once; samples of one frame stand together.
FRAMES_KEPT = 64


def propose(
    policy: Policy,
    samples: Sequence[Sample],
    about: str,
    memories: Sequence[tuple[Memory, ...]] | None = None,
) -> list[ControllerMatrix]:
    """The proposal for each sample; a frame that several samples share is read once."""
    default = policy.contract.ranges.default
    prepare = lru_cache(maxsize=FRAMES_KEPT)(policy.prepare)
    found = []
    for i, sample in enumerate(tqdm(samples, desc=about, unit="decision")):
        frame = prepare(sample.observation.frame)
        past = memories[i] if memories is not None else sample.memories
        decision = policy.decide(frame, sample.instruction, past, last_safe=default)
        found.append(decision.proposal)
    return found


def shuffle_frames(samples: Sequence[Sample], rng: np.random.Generator) -> list[Sample]:
    """The same samples, each looking at the frame of some other sample."""
    order = rng.permutation(len(samples))
    return [
        replace(sample, observation=samples[i].observation)
        for sample, i in zip(samples, order, strict=True)
    ]


def shuffle_instructions(samples: Sequence[Sample], rng: np.random.Generator) -> list[Sample]:
    """The same samples; every scene's instructions are swapped with some other sentence's."""
    sentences = sorted({sample.instruction for sample in samples})
    other = dict(zip(sentences, rng.permutation(np.array(sentences, object)), strict=True))
    return [replace(sample, instruction=other[sample.instruction]) for sample in samples]


def random_matrices(
    count: int, codec: MatrixCodec, rng: np.random.Generator
) -> list[ControllerMatrix]:
    """Six uniform bins each."""
    return [codec.decode(rng.integers(0, NUM_BINS, NUM_PARAMETERS).tolist()) for _ in range(count)]
