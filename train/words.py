"""Stage one of the tiny base: what a sentence asks for, before it has seen a picture.

    written and grown sentences   their own labels
    reworded sentences            the teacher's shares of the styles, as a mixture of labels
    a part of the batches         with text: mostly the matrix, the paper's way, or the explanation

Beside the six bins, throw-away heads on the queries predict the teacher's vector of the sentence
and what kind of feedback the memories hold.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ridetune.codec import NUM_BINS, MatrixCodec
from ridetune.contract import Contract
from ridetune.matrix import NUM_PARAMETERS, STYLES
from ridetune.prompt import PromptBuilder
from ridetune.qwen import action_logits, run_tokens
from ridetune.sample import FEEDBACK_KINDS, Sample

from .collate import Batch, Example, collate, tokenize, without_answer
from .objective import batch_loss, soft_bins
from .reword import Rewording
from .schedule import Steps, train_steps
from .score import score_phrases
from .teacher import Teacher

REWORDED = "reworded"
MATRIX_AS_TEXT = 0.75  # of what is written in the batches with text; the rest is explanations


@dataclass(frozen=True)
class WordsPlan:
    """How the words are learned, and from how many reworded sentences."""

    steps: int
    batch: int
    learning_rate: float
    teacher: Steps
    rewordings: int
    distillation: float  # weight of the distance to the teacher's vector
    feedback: float  # weight of telling what kind of feedback the memories hold
    text_share: float  # share of batches that also learn to write


@dataclass(frozen=True)
class Lessons:
    """Samples with what the teacher says of them.

    vectors [sample, 384] and whether there is one, has_vector [sample]; opinions [sample, 3] are
    shares of the styles, used instead of the label where has_opinion [sample]. feedback [sample]
    is the kind that the memories hold, in FEEDBACK_KINDS; -1 without memories.
    """

    samples: list[Sample]
    vectors: Tensor
    has_vector: Tensor
    opinions: Tensor
    has_opinion: Tensor
    feedback: Tensor


class WordsTask:
    """The losses of sentences without images, for the first stage and to keep it in the last."""

    def __init__(
        self,
        model: Any,
        contract: Contract,
        prompts: PromptBuilder,
        lessons: Lessons,
        word_dropout: float,
    ) -> None:
        self.model, self.contract, self.prompts, self.lessons = model, contract, prompts, lessons
        self._word_dropout = word_dropout
        self._of_style = bins_by_style(lessons.samples, contract.codec)
        self.lengths = [text_length(sample) for sample in lessons.samples]

    def actions(self, chosen: list[int], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Loss of the six bins, and the last hidden states of the queries [sample, 6, hidden]."""
        lessons, device = self.lessons, self.model.device
        examples = [words_only(lessons.samples[i], self.prompts) for i in chosen]
        batch = drop_words(collate(examples), self.prompts, self._word_dropout, rng).to(device)
        hidden = run_tokens(self.model, batch.ids, batch.positions, None, self.prompts.ids)
        at_queries = hidden[batch.query_rows[:, None], batch.queries]
        mixed = torch.einsum("ns,spb->npb", lessons.opinions[chosen], self._of_style).to(device)
        unsure = lessons.has_opinion[chosen].to(device)[:, None, None]
        targets = torch.where(unsure, mixed, soft_bins(batch.bins))
        logits = action_logits(self.model, at_queries, self.prompts.ids).float()
        return F.cross_entropy(logits.flatten(0, 1), targets.flatten(0, 1)), at_queries

    def text(self, chosen: list[int], rng: np.random.Generator) -> Tensor:
        """Loss of the matrix as text, or of bins and explanation; opinions are no labels here."""
        rows = [i for i in chosen if not self.lessons.has_opinion[i]] or [0]
        samples = [self.lessons.samples[i] for i in rows]
        as_text = rng.random(len(samples)) < MATRIX_AS_TEXT
        examples = [
            tokenize(sample, self.prompts, image=False, as_text=bool(text))
            for sample, text in zip(samples, as_text, strict=True)
        ]
        batch = collate(examples).to(self.model.device)
        ids = self.prompts.ids
        loss, _ = batch_loss(self.model, batch, None, ids, text_weight=1.0, fixed_vocabulary=True)
        return loss.total


def learn_words(task: WordsTask, held_out: list[Sample], plan: WordsPlan, seed: int) -> None:
    """Train the language model on sentences and memories, without images."""
    model, lessons = task.model, task.lessons
    torch.manual_seed(seed)
    width = model.config.text_config.hidden_size
    meaning = nn.Linear(width, lessons.vectors.shape[1]).to(model.device)
    kind = nn.Linear(width, len(FEEDBACK_KINDS)).to(model.device)

    def loss_of(chosen: list[int], rng: np.random.Generator) -> Tensor:
        if rng.random() < plan.text_share:
            return task.text(chosen, rng)
        loss, queries = task.actions(chosen, rng)
        far = meaning(queries[:, -1]) - lessons.vectors[chosen].to(model.device)
        known = lessons.has_vector[chosen].to(model.device)
        loss = loss + plan.distillation * (far.square().mean(dim=1) * known).mean()
        feedback = lessons.feedback[chosen].to(model.device)
        if bool((feedback >= 0).any()):
            told = F.cross_entropy(kind(queries.mean(dim=1)), feedback, ignore_index=-1)
            loss = loss + plan.feedback * told
        return torch.as_tensor(loss)

    def watch() -> str:
        return score_phrases(model, task.contract, task.prompts, held_out)

    steps = Steps(plan.steps, plan.batch, plan.learning_rate)
    parts = [model.model.language_model, meaning, kind]
    train_steps("words", parts, task.lengths, loss_of, steps, seed, watch=watch)


def teach(
    teacher: Teacher,
    rewording: Rewording,
    phrases: list[Sample],
    held_out: list[Sample],
    kind_of: Mapping[str, int],
    plan: WordsPlan,
    seed: int,
) -> Lessons:
    """Fine-tune the teacher on the phrases, let it judge reworded ones, gather all lessons.

    Rows with memories are three times as long, so only every second of them takes part. A written
    sentence and its variations share one vector; what the grammar grew has none. kind_of tells the
    kind of each sentence of feedback.
    """
    phrases = [sample for i, sample in enumerate(phrases) if not sample.memories or i % 2]
    plain = [sample for sample in phrases if not sample.memories]

    def watch() -> str:
        best = teacher.listen([s.instruction for s in held_out], "held out").styles.argmax(1)
        right = [STYLES[i] == s.style for i, s in zip(best.tolist(), held_out, strict=True)]
        return f"style={np.mean(right):.3f}"

    written = [sample for sample in plain if not sample.phrase_id.startswith("grammar/")]
    texts, styles = [s.instruction for s in written], [s.style for s in written]
    teacher.learn_styles(texts, styles, plan.teacher, seed, watch)

    wordings: dict[str, str] = {}
    for sample in written:
        wordings.setdefault(sample.phrase_id, sample.instruction)
    rng = np.random.default_rng([seed, 1])
    reworded = [
        replace(sample, instruction=rewording(sample.instruction, rng), phrase_id=REWORDED)
        for sample in (plain[int(i)] for i in rng.integers(len(plain), size=plan.rewordings))
    ]
    heard = teacher.listen([*wordings.values(), *(s.instruction for s in reworded)], "teacher")
    vectors = (heard.vectors - heard.vectors.mean(0)) / heard.vectors.std()
    row_of = {phrase_id: row for row, phrase_id in enumerate(wordings)}
    rows = [row_of.get(sample.phrase_id, -1) for sample in phrases]
    rows += range(len(wordings), len(vectors))
    own = torch.tensor(rows)
    return Lessons(
        samples=[*phrases, *reworded],
        vectors=vectors[own],
        has_vector=(own >= 0).float(),
        opinions=heard.styles[own],
        has_opinion=torch.arange(len(own)) >= len(phrases),
        feedback=torch.tensor(
            [kind_of[s.memories[0].feedback] if s.memories else -1 for s in (*phrases, *reworded)]
        ),
    )


def bins_by_style(samples: Sequence[Sample], codec: MatrixCodec) -> Tensor:
    """The soft labels of each style without memories, averaged: [3, 6, 256]."""
    counts = torch.zeros(len(STYLES), NUM_PARAMETERS, NUM_BINS)
    for sample in samples:
        if not sample.memories:
            bins = torch.tensor(codec.encode(sample.matrix))
            counts[STYLES.index(sample.style), torch.arange(NUM_PARAMETERS), bins] += 1
    counts /= counts.sum(dim=2, keepdim=True).clamp(min=1)
    return counts @ soft_bins(torch.arange(NUM_BINS))


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
