"""Both engines answer alike on prompts with an image, and never change a prefix."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from quantize.export import load
from ridetune.bundle import load_bundle
from ridetune.engines import CachedEngine, Engine
from ridetune.ort_engine import OrtEngine
from ridetune.qwen import action_logits, encode_frames, run_tokens
from ridetune.torch_engine import TorchEngine
from ridetune.vision import read_patches
from tests.tiny_bundle import awq_bundle, awq_model, sample

BINS = (3, 60, 120, 180, 240, 255)


@dataclass(frozen=True)
class Setup:
    """Both engines on the same 4-bit weights, and one prompt."""

    ort: OrtEngine
    torch: TorchEngine
    patches: NDArray[np.float32]
    suffix: list[int]

    @property
    def both(self) -> tuple[CachedEngine, CachedEngine]:
        return self.ort, self.torch


@pytest.fixture(scope="module")
def setup() -> Setup:
    torch.set_num_threads(1)
    bundle = load_bundle(awq_bundle())
    prompts, spec = bundle.prompts(), bundle.contract.vision
    drive = sample(1)
    return Setup(
        OrtEngine(bundle),
        TorchEngine(load(awq_model()).model, prompts, spec),
        read_patches(drive.observation.frame, spec),
        prompts.suffix(drive.instruction, drive.memories),
    )


def test_engines_fit_the_protocol(setup: Setup) -> None:
    engines: list[Engine] = [*setup.both]
    assert len(engines) == 2


def test_split_prefill_equals_one_pass_through_the_whole_prompt(setup: Setup) -> None:
    reference, bundle = setup.torch, load_bundle(awq_bundle())
    prompts = bundle.prompts()
    ids = [*prompts.prefix(), *setup.suffix, *prompts.ids.queries]
    with torch.inference_mode():
        frame = torch.from_numpy(setup.patches)[None]
        features = encode_frames(reference.model, frame, bundle.contract.vision)
        positions = torch.from_numpy(prompts.positions(ids))[:, None]
        model, tokens = reference.model, torch.tensor([ids])
        hidden = run_tokens(model, tokens, positions, features, prompts.ids)
        truth = action_logits(reference.model, hidden[0, -6:], prompts.ids).numpy()
    assert np.abs(truth).max() > 1
    for engine in setup.both:
        decided = engine.decide(engine.prefill(setup.patches), setup.suffix)
        np.testing.assert_allclose(decided.logits, truth, atol=1e-4 * np.abs(truth).max())
        assert decided.after.num_tokens == len(ids)
        assert decided.after.next_position == prompts.next_position(ids)


def test_decisions_depend_on_the_image(setup: Setup) -> None:
    for engine in setup.both:
        seen = engine.decide(engine.prefill(setup.patches), setup.suffix)
        other = engine.decide(engine.prefill(-setup.patches), setup.suffix)
        assert np.abs(seen.logits - other.logits).max() > 0.01


def test_one_prefix_serves_many_decisions_unchanged(setup: Setup) -> None:
    for engine in setup.both:
        prefix = engine.prefill(setup.patches)
        first = engine.decide(prefix, setup.suffix)
        other = engine.decide(prefix, setup.suffix[:3])
        list(engine.explain(first, BINS, 4))
        engine.prefill(-setup.patches)
        again = engine.decide(prefix, setup.suffix)
        np.testing.assert_array_equal(first.logits, again.logits)
        assert other.logits.shape == (6, 256)


def test_explanations_of_both_engines_are_equal(setup: Setup) -> None:
    written = []
    for engine in setup.both:
        decided = engine.decide(engine.prefill(setup.patches), setup.suffix)
        written.append(list(engine.explain(decided, BINS, 12)))
    assert written[0] == written[1]
    assert written[0]


def test_explanation_depends_on_the_chosen_bins(setup: Setup) -> None:
    engine = setup.ort
    decided = engine.decide(engine.prefill(setup.patches), setup.suffix)
    texts = {tuple(engine.explain(decided, [b] * 6, 6)) for b in range(0, 256, 32)}
    assert len(texts) > 1


def test_matrices_written_by_both_engines_are_equal(setup: Setup) -> None:
    written = [
        engine.write_matrix(engine.prefill(setup.patches), setup.suffix, 12)
        for engine in setup.both
    ]
    assert written[0] == written[1]
    assert 0 < len(written[0]) <= 12


def script(engine: OrtEngine, says: list[int], monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Make an engine say the given tokens; the returned list grows with every pass."""
    passes: list[int] = []

    def next_token(hidden: NDArray[np.float32]) -> int:
        passes.append(len(hidden))
        return says[len(passes) - 1]

    monkeypatch.setattr(engine, "next_token", next_token)
    return passes


def test_text_ends_before_the_end_token(setup: Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    passes = script(setup.ort, [5, 6, setup.ort.ids.end, 7], monkeypatch)
    prefix = setup.ort.prefill(setup.patches)
    assert setup.ort.write_matrix(prefix, setup.suffix, 10) == [5, 6]
    assert passes == [1, 1, 1]


def test_text_stops_at_the_token_limit_without_a_wasted_pass(
    setup: Setup, monkeypatch: pytest.MonkeyPatch
) -> None:
    passes = script(setup.ort, [5, 6, 7], monkeypatch)
    prefix = setup.ort.prefill(setup.patches)
    assert setup.ort.write_matrix(prefix, setup.suffix, 2) == [5, 6]
    assert passes == [1, 1]
