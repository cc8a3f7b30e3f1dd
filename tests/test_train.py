"""Where the loss is taken, what it cannot see, and in which order samples come."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ridetune.codec import NUM_BINS
from ridetune.contract import Contract
from ridetune.matrix import ControllerMatrix
from ridetune.policy import read_text
from ridetune.qwen import VisionFeatures, action_logits, load_model, run_tokens
from tests.small_base import (
    reworded,
    small_base,
    small_prompts,
    small_samples,
)
from train.collate import Example, answer_text, collate, tokenize, without_answer
from train.objective import batch_loss, soft_bins
from train.schedule import cosine, endless_batches
from train.score import query_logits
from train.sft import encode_all


@pytest.fixture(scope="module")
def contract() -> Contract:
    return Contract.load(small_base())


@pytest.fixture(scope="module")
def model() -> Any:
    return load_model(small_base())


@pytest.fixture(scope="module")
def features(model: Any, contract: Contract) -> VisionFeatures:
    return encode_all(model, list(small_samples()), contract)


@torch.no_grad()
def logits_of(model: Any, examples: Sequence[Example], features: VisionFeatures | None) -> Tensor:
    """Action logits [example, 6, 256] of whole prompts with their answers."""
    batch, ids = collate(examples), small_prompts().ids
    hidden = run_tokens(model, batch.ids, batch.positions, features, ids)
    at_queries = hidden[batch.query_rows[:, None], batch.queries]
    return action_logits(model, at_queries, ids)


def test_example_holds_queries_then_actions_then_words() -> None:
    prompts, sample = small_prompts(), small_samples()[0]
    example = tokenize(sample, prompts)
    assert example.first_query is not None
    assert example.first_target == example.first_query + 12
    head, answer = example.ids[: example.first_query], example.ids[example.first_query :]
    assert tuple(answer[:6]) == prompts.ids.queries
    assert tuple(prompts.ids.actions.index(token) for token in answer[6:12]) == example.bins
    assert example.bins == prompts.codec.encode(sample.matrix)
    assert answer[12:-1] == prompts.text(answer_text(sample))
    assert answer[-1] == prompts.ids.end
    assert head == [*prompts.prefix(), *prompts.suffix(sample.instruction, sample.memories)]


def test_text_targets_follow_the_positions_that_predict_them() -> None:
    prompts, samples = small_prompts(), small_samples()
    examples = [tokenize(samples[0], prompts), tokenize(samples[1], prompts, as_text=True)]
    batch = collate(examples)
    assert torch.equal(batch.ids[batch.text_rows, batch.text_at + 1], batch.text_ids)
    for row, example in enumerate(examples):
        targets = batch.text_ids[batch.text_rows == row].tolist()
        assert targets == example.ids[example.first_target :]
        assert targets[-1] == prompts.ids.end
    last_action = batch.ids[0, batch.text_at[0]]
    assert last_action == prompts.ids.actions[examples[0].bins[-1]]


def test_queries_of_a_batch_point_at_the_query_tokens_and_skip_text_samples() -> None:
    prompts, samples = small_prompts(), small_samples()
    as_text = (False, True, False)
    batch = collate(
        [tokenize(s, prompts, as_text=t) for s, t in zip(samples[:3], as_text, strict=True)]
    )
    assert batch.query_rows.tolist() == [0, 2]
    read = batch.ids[batch.query_rows[:, None], batch.queries]
    assert read.tolist() == [list(prompts.ids.queries)] * 2
    assert [tuple(b) for b in batch.bins.tolist()] == [
        prompts.codec.encode(samples[i].matrix) for i in (0, 2)
    ]


def test_text_sample_answers_with_the_matrix_as_the_parser_reads_it() -> None:
    prompts, sample = small_prompts(), small_samples()[0]
    example = tokenize(sample, prompts, as_text=True)
    said = read_text(prompts.tokenizer, example.ids[example.first_target :])
    found = prompts.codec.parse(said)
    assert found is not None
    np.testing.assert_allclose(found.values, sample.matrix.values, atol=1e-3)
    assert not set(prompts.ids.queries) & set(example.ids)


def test_answer_tokens_change_no_query_logits(model: Any, features: VisionFeatures) -> None:
    prompts, sample = small_prompts(), small_samples()[0]
    ours, theirs = (tokenize(s, prompts) for s in (sample, reworded(sample)))
    assert ours.bins != theirs.bins
    own = features.select([0])
    logits = logits_of(model, [ours], own)
    torch.testing.assert_close(logits_of(model, [theirs], own), logits, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        query_logits(model, prompts, [sample], own), logits, atol=1e-5, rtol=0
    )
    other = replace(sample, instruction="hurry up")
    assert (logits_of(model, [tokenize(other, prompts)], own) - logits).abs().max() > 0.01
    assert (logits_of(model, [ours], features.select([11])) - logits).abs().max() > 0.01


def test_padding_changes_nothing(model: Any, features: VisionFeatures) -> None:
    prompts = small_prompts()
    examples = sorted((tokenize(s, prompts) for s in small_samples()), key=lambda e: len(e.ids))
    pair = [examples[0], examples[-1]]
    assert len(pair[1].ids) - len(pair[0].ids) > 20
    own = features.select([0, 1])
    with torch.no_grad():
        both, _ = batch_loss(model, collate(pair), own, prompts.ids, text_weight=0.5)
        alone = [
            batch_loss(model, collate([e]), own.select([i]), prompts.ids, text_weight=0.5)[0]
            for i, e in enumerate(pair)
        ]
    weights = [len(e.ids) - e.first_target for e in pair]
    text = sum(w * part.text for w, part in zip(weights, alone, strict=True)) / sum(weights)
    actions = (alone[0].actions + alone[1].actions) / 2
    torch.testing.assert_close(both.text, torch.as_tensor(text), atol=1e-5, rtol=0)
    torch.testing.assert_close(both.actions, actions, atol=1e-5, rtol=0)
    torch.testing.assert_close(both.total, both.actions + 0.5 * both.text)


def test_action_loss_is_the_distance_of_the_query_logits_to_the_soft_label(
    model: Any, features: VisionFeatures
) -> None:
    prompts, sample = small_prompts(), small_samples()[3]
    own = features.select([3])
    with torch.no_grad():
        batch = collate([tokenize(sample, prompts)])
        loss, _ = batch_loss(model, batch, own, prompts.ids, text_weight=0.0)
    chances = torch.softmax(query_logits(model, prompts, [sample], own)[0], dim=-1)
    level = torch.arange(NUM_BINS)
    distances = []
    for parameter, label in enumerate(prompts.codec.encode(sample.matrix)):
        target = torch.exp(-((level - label) ** 2) / (2 * 6.0**2))
        distances.append(-(target / target.sum() * chances[parameter].log()).sum())
    torch.testing.assert_close(loss.total, torch.stack(distances).mean(), atol=1e-4, rtol=0)


def test_batch_of_text_samples_alone_has_no_action_loss(
    model: Any, features: VisionFeatures
) -> None:
    prompts = small_prompts()
    batch = collate([tokenize(small_samples()[0], prompts, as_text=True)])
    with torch.no_grad():
        loss, _ = batch_loss(model, batch, features.select([0]), prompts.ids, text_weight=1.0)
    assert loss.actions == 0
    assert loss.total == loss.text > 0


def test_suffix_stands_at_the_same_positions_with_and_without_the_image() -> None:
    prompts, sample = small_prompts(), small_samples()[0]
    seen, blind = tokenize(sample, prompts), tokenize(sample, prompts, image=False)
    num_prefix = len(prompts.prefix())
    assert seen.ids[num_prefix:] == blind.ids
    np.testing.assert_array_equal(seen.positions[:, num_prefix:], blind.positions)
    assert prompts.ids.image not in blind.ids


def test_example_without_answer_ends_with_the_last_query() -> None:
    prompts = small_prompts()
    example = without_answer(tokenize(small_samples()[0], prompts))
    assert tuple(example.ids[-6:]) == prompts.ids.queries
    assert example.positions.shape == (3, len(example.ids))
    assert len(collate([example]).text_ids) == 0


def test_each_sample_gets_the_visual_tokens_of_its_own_frame(
    model: Any, contract: Contract, features: VisionFeatures
) -> None:
    samples = small_samples()
    assert len({s.observation.frame for s in samples}) == 4
    for number in (0, 5, 11):
        alone = encode_all(model, [samples[number]], contract)
        torch.testing.assert_close(features.select([number]).tokens, alone.tokens)
        torch.testing.assert_close(features.deepstack[0][[number]], alone.deepstack[0])
    assert not torch.allclose(features.tokens[0], features.tokens[11])


def test_label_outside_the_envelope_names_the_sample() -> None:
    sample = small_samples()[0]
    wild = replace(sample, matrix=ControllerMatrix.of([99.0, *sample.matrix.values[1:]]))
    with pytest.raises(ValueError, match=rf"sample {sample.scene_id}.*K_p = 99.0"):
        tokenize(wild, small_prompts())


@pytest.mark.parametrize("label", [0, 1, 100, 255])
def test_soft_label_is_a_distribution_with_its_peak_at_the_label(label: int) -> None:
    target = soft_bins(torch.tensor([[label] * 6]))
    assert target.shape == (1, 6, NUM_BINS)
    torch.testing.assert_close(target.sum(-1), torch.ones(1, 6))
    assert target.argmax(-1).tolist() == [[label] * 6]
    near, far = (int(np.clip(label + step, 0, 255)) for step in (6, 12))
    if label < 200:
        falls = target[0, 0, label] / target[0, 0, near]
        assert falls == pytest.approx(np.exp(0.5), rel=1e-4)  # one standard deviation
        assert target[0, 0, far] < target[0, 0, near]


def test_every_epoch_takes_each_sample_once() -> None:
    lengths = [i % 7 for i in range(50)]
    batches = endless_batches(lengths, 8, seed=1)
    for _ in range(2):
        assert Counter(i for batch in islice(batches, 7) for i in batch) == Counter(range(50))
    first, again = (list(islice(endless_batches(lengths, 8, seed=1), 9)) for _ in range(2))
    assert first == again != list(islice(endless_batches(lengths, 8, seed=2), 9))
    spans = [max(lengths[i] for i in b) - min(lengths[i] for i in b) for b in first]
    assert np.mean(spans) < 3  # of 7: batches hold samples of about equal length


def test_learning_rate_rises_to_its_peak_and_falls_to_two_percent() -> None:
    shares = [cosine(step, 200) for step in range(200)]
    assert shares[0] == pytest.approx(1 / 6)
    assert max(shares) == shares[6] == 1.0
    assert all(a >= b for a, b in pairwise(shares[6:]))
    assert shares[-1] == pytest.approx(0.02, abs=1e-3)
    assert cosine(0, 1) == 1.0
