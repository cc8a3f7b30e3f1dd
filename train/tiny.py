"""Pretrain the tiny base in three stages: words, pictures, then both.

    words      instruction and memories -> six bins, and MiniLM's vector of the instruction
    pictures   frame -> what is in the scene, through heads that are thrown away
    both       the whole prompt -> six bins, scene, explanation; a part of it as text

In: a dataset of `python -m data --config configs/data-pretrain.yaml`. Out: a model folder as the
Hugging Face tools read it, in fp16. Trained once and committed as models/tiny.

    python -m train.tiny --config configs/tiny.yaml
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from ridetune.config import save_config
from ridetune.contract import Contract
from ridetune.matrix import Ranges
from ridetune.prompt import ACTION_TOKENS, PromptBuilder
from ridetune.qwen import encode_frames
from ridetune.sample import Sample, read_samples
from ridetune.scene import SCENE_QUESTIONS, scene_answers
from ridetune.stage import Stopwatch, new_folder, run_stage, write_manifest

from .base import TinyShape, build_model, build_tokenizer, save_tokenizer, vision_spec
from .collate import Batch, Example, collate, tokenize, without_answer
from .objective import batch_loss
from .pixels import Augment, patches_of
from .rows import read_phrases, read_pixels
from .schedule import Steps, train_steps
from .score import score_phrases
from .teacher import Teacher

EMBEDDING_SCALE = 0.04


@dataclass(frozen=True)
class TinyConfig:
    """What to pretrain, on what, for how long."""

    data: Path
    out: Path
    ranges: Path
    seed: int
    device: str
    threads: int
    shape: TinyShape
    words: Steps
    pictures: Steps
    both: Steps
    word_dropout: float  # share of instruction tokens replaced by [UNK]
    distillation: float  # weight of the distance to the teacher's vector
    as_text_share: float  # share of samples that answer the paper's way
    text_weight: float  # weight of the text loss beside the action loss
    phrases_in_both: float  # text-only batches in the last stage, as a share of all


def pretrain(config: TinyConfig) -> None:
    """Run the three stages and write the model folder."""
    watch = Stopwatch()
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    contract = Contract(vision_spec(config.shape), Ranges.load(config.ranges))
    phrases = read_phrases(config.data / "phrases.jsonl")
    held_out = read_phrases(config.data / "phrases-test.jsonl")
    teacher = Teacher.load()
    tokenizer = build_tokenizer(teacher.word_pieces, _corpus(phrases), config.shape.vocabulary)
    prompts = contract.prompts(tokenizer)
    model = build_model(config.shape, tokenizer)
    start_embeddings(model, prompts, teacher)
    model.to(torch.device(config.device))

    learn_words(model, contract, prompts, phrases, held_out, teacher, config)
    samples = read_samples(config.data / "train.parquet")
    pixels = read_pixels(samples, contract.vision)
    learn_pictures(model, contract, samples, pixels, config)
    learn_both(model, contract, prompts, samples, pixels, phrases, held_out, config)

    with new_folder(config.out) as folder:
        model.half().save_pretrained(folder)
        save_tokenizer(tokenizer, contract.vision, folder)
        contract.save(folder)
        save_config(config, folder / "pretraining.yaml")
        write_manifest(folder, seconds=watch.seconds, facts={"parameters": model.num_parameters()})
    print(f"tiny base: {model.num_parameters()} parameters in {config.out}, {watch.seconds:.0f} s")


def start_embeddings(model: Any, prompts: PromptBuilder, teacher: Teacher) -> None:
    """Word embeddings from the teacher; neighbouring action tokens start near each other."""
    table = model.get_input_embeddings().weight
    vocabulary = prompts.tokenizer.get_vocab()
    pieces = [p for p in vocabulary if p in teacher.word_pieces]
    with torch.no_grad():
        table.normal_(0, EMBEDDING_SCALE)
        vectors = torch.from_numpy(teacher.word_vectors(pieces, table.shape[1]))
        table[[vocabulary[p] for p in pieces]] = vectors * EMBEDDING_SCALE
        level = torch.linspace(0, 1, len(ACTION_TOKENS))[:, None]
        waves = level * torch.randn(1, table.shape[1]) * 6 + torch.rand(1, table.shape[1]) * 6.3
        table[list(prompts.ids.actions)] = torch.cos(waves) * EMBEDDING_SCALE


def learn_words(
    model: Any,
    contract: Contract,
    prompts: PromptBuilder,
    phrases: list[Sample],
    held_out: list[Sample],
    teacher: Teacher,
    config: TinyConfig,
) -> None:
    """Stage one: no image, no answer text; the last query also predicts the teacher's vector.

    Rows with memories are three times as long, so only every second of them takes part.
    """
    phrases = [sample for i, sample in enumerate(phrases) if not sample.memories or i % 2]
    target, has_target = (t.to(model.device) for t in teacher_targets(phrases, teacher))
    torch.manual_seed(config.seed)
    head = nn.Linear(config.shape.hidden, target.shape[1]).to(model.device)

    def loss_of(chosen: list[int], rng: np.random.Generator) -> Tensor:
        batch = collate([words_only(phrases[i], prompts) for i in chosen])
        batch = drop_words(batch, prompts, config.word_dropout, rng).to(model.device)
        loss, hidden = batch_loss(model, batch, None, prompts.ids, text_weight=0.0)
        last = hidden[batch.query_rows, batch.queries[:, -1]]
        distances = (head(last) - target[chosen]).square().mean(dim=1) * has_target[chosen]
        return torch.as_tensor(loss.actions + config.distillation * distances.mean())

    def watch() -> str:
        return score_phrases(model, contract, prompts, held_out)

    lengths = [text_length(sample) for sample in phrases]
    parts = [model.model.language_model, head]
    train_steps("words", parts, lengths, loss_of, config.words, config.seed, watch=watch)


def teacher_targets(phrases: list[Sample], teacher: Teacher) -> tuple[Tensor, Tensor]:
    """MiniLM's vector of each written sentence [phrase, 384], and whether there is one [phrase].

    A sentence and its variations share one vector; what the grammar grew has none.
    """
    wordings: dict[str, str] = {}
    for sample in phrases:
        if not sample.phrase_id.startswith("grammar/"):
            wordings.setdefault(sample.phrase_id, sample.instruction)
    vectors = teacher.encode(list(wordings.values()), "teacher")
    vectors = (vectors - vectors.mean(0)) / vectors.std()
    row_of = {phrase_id: row for row, phrase_id in enumerate(wordings)}
    rows = np.array([row_of.get(sample.phrase_id, -1) for sample in phrases])
    return torch.from_numpy(vectors[rows]), torch.from_numpy(rows >= 0).float()


def learn_pictures(
    model: Any,
    contract: Contract,
    samples: list[Sample],
    pixels: NDArray[np.uint8],
    config: TinyConfig,
) -> None:
    """Stage two: the vision tower alone, with one throw-away head per question and depth."""
    answers = torch.tensor([scene_answers(sample.scene) for sample in samples]).to(model.device)
    sizes = [len(options) for options in SCENE_QUESTIONS.values()]
    width = contract.vision.num_tokens * config.shape.hidden
    torch.manual_seed(config.seed)
    last = nn.Linear(width, sum(sizes)).to(model.device)
    middle = nn.Linear(width, sum(sizes)).to(model.device)
    augment = Augment()

    def loss_of(chosen: list[int], rng: np.random.Generator) -> Tensor:
        patches = patches_of(pixels[chosen], contract.vision, augment, rng).to(model.device)
        features = encode_frames(model, patches, contract.vision)
        logits = last(features.tokens.flatten(1)) + middle(features.deepstack[0].flatten(1))
        losses = [
            F.cross_entropy(part, answers[chosen, question])
            for question, part in enumerate(logits.split(sizes, dim=1))
        ]
        return torch.stack(losses).sum()

    parts = [model.model.visual, last, middle]
    train_steps("pictures", parts, [1] * len(samples), loss_of, config.pictures, config.seed)


def learn_both(
    model: Any,
    contract: Contract,
    prompts: PromptBuilder,
    samples: list[Sample],
    pixels: NDArray[np.uint8],
    phrases: list[Sample],
    held_out: list[Sample],
    config: TinyConfig,
) -> None:
    """Stage three: everything together, with text-only batches mixed in to keep the words."""
    augment = Augment()

    def loss_of(chosen: list[int], rng: np.random.Generator) -> Tensor:
        if rng.random() < config.phrases_in_both:
            picked = rng.integers(len(phrases), size=2 * len(chosen))
            batch = collate([words_only(phrases[i], prompts) for i in picked])
            features = None
        else:
            patches = patches_of(pixels[chosen], contract.vision, augment, rng).to(model.device)
            features = encode_frames(model, patches, contract.vision)
            as_text = rng.random(len(chosen)) < config.as_text_share
            rows = [
                tokenize(samples[i], prompts, as_text=bool(text))
                for i, text in zip(chosen, as_text, strict=True)
            ]
            batch = collate(rows)
        batch = drop_words(batch, prompts, config.word_dropout, rng).to(model.device)
        loss, _ = batch_loss(model, batch, features, prompts.ids, text_weight=config.text_weight)
        return loss.total

    def watch() -> str:
        return score_phrases(model, contract, prompts, held_out)

    lengths = [text_length(sample) for sample in samples]
    train_steps("both", [model], lengths, loss_of, config.both, config.seed, watch=watch)


def words_only(sample: Sample, prompts: PromptBuilder) -> Example:
    """Memories and instruction up to the queries, without image and answer text."""
    return without_answer(tokenize(sample, prompts, image=False))


def text_length(sample: Sample) -> int:
    """Characters of the prompt's own part: good enough to batch by."""
    past = sum(len(m.instruction) + len(m.scene) + len(m.feedback) + 60 for m in sample.memories)
    return len(sample.instruction) + past


def drop_words(
    batch: Batch, prompts: PromptBuilder, share: float, rng: np.random.Generator
) -> Batch:
    """Replace a share of the ordinary words before the answer by [UNK]: no word is decisive."""
    unknown, first_special = prompts.ids.unknown, prompts.tokenizer.token_to_id("<|endoftext|>")
    assert unknown is not None and first_special is not None, "the tiny tokenizer has both"
    ids = batch.ids.clone()
    drawn = torch.from_numpy(rng.random(ids.shape)) < share
    prompt_end = torch.zeros(ids.shape[0], dtype=torch.long)
    prompt_end[batch.query_rows] = batch.queries[:, 0]
    before = torch.arange(ids.shape[1])[None, :] < prompt_end[:, None]
    ids[drawn & before & (ids > unknown) & (ids < first_special)] = unknown
    return replace(batch, ids=ids)


def _corpus(phrases: list[Sample]) -> list[str]:
    texts = []
    for sample in phrases:
        texts += [sample.instruction, sample.scene, sample.explanation]
        texts += [memory.feedback for memory in sample.memories]
    return texts


if __name__ == "__main__":
    sys.exit(run_stage(TinyConfig, "configs/tiny.yaml", pretrain, __doc__))
