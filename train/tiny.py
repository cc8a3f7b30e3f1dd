"""Pretrain the tiny base in three stages: words, pictures, then both.

    words      instruction and memories -> six bins; train/words.py
    pictures   frame -> what is in the scene, through heads that are thrown away
    both       the whole prompt -> six bins, scene, explanation; a part of it as text

In: a dataset of `python -m data --config configs/data-pretrain.yaml`. Out: a model folder as the
Hugging Face tools read it, in fp16. Trained once and committed as models/tiny.

    python -m train.tiny --config configs/tiny.yaml

With `start` a run goes on from an earlier base, on more sentences: its tokenizer, words and eyes
are taken over, and stage two is left out. What a stage made is kept beside the model, so a run that
was stopped goes on behind its last whole stage.
"""

import hashlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from ridetune.config import Share, save_config
from ridetune.contract import Contract, load_tokenizer
from ridetune.matrix import Ranges
from ridetune.prompt import ACTION_TOKENS, PromptBuilder
from ridetune.qwen import encode_frames, load_model
from ridetune.sample import Sample, read_samples
from ridetune.scene import SCENE_QUESTIONS, scene_answers
from ridetune.stage import Stopwatch, hash_file, new_folder, run_stage, write_manifest

from .base import TinyShape, build_model, build_tokenizer, save_tokenizer, vision_spec
from .collate import collate, tokenize
from .objective import batch_loss
from .pixels import Augment, patches_of
from .processes import in_processes, is_first, own_share, wait_for_all
from .reword import Rewording
from .rows import read_feedback, read_phrases, read_pixels
from .schedule import Steps, endless_batches, train_steps
from .score import score_phrases
from .teacher import Teacher
from .words import Lessons, WordsPlan, WordsTask, drop_words, learn_words, teach, text_length

EMBEDDING_SCALE = 0.04


@dataclass(frozen=True)
class TinyConfig:
    """What to pretrain, on what, for how long. start: an earlier base to go on from, or None."""

    start: Path | None
    data: Path
    out: Path
    ranges: Path
    seed: int
    device: str
    processes: int  # share each batch
    threads: int  # of each process
    shape: TinyShape
    words: WordsPlan
    pictures: Steps
    both: Steps
    word_dropout: float  # share of instruction tokens replaced by [UNK]
    as_text_share: float  # share of samples that answer the paper's way in the last stage
    text_weight: float  # weight of the text loss beside the action loss
    words_in_both: float  # text-only batches in the last stage, as a share of all
    words_kept: Share  # weight of what stage one left, in the average with the last stage
    start_kept: Share  # then the weight of the base that the run went on from, if from any


def pretrain(config: TinyConfig) -> None:
    """Run the three stages in all processes and write the model folder."""
    in_processes(config.processes, _pretrain, config)


def _pretrain(config: TinyConfig) -> None:
    watch = Stopwatch()
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    contract = Contract(vision_spec(config.shape), Ranges.load(config.ranges))
    phrases = read_phrases(config.data / "phrases.jsonl")
    held_out = read_phrases(config.data / "phrases-test.jsonl")
    teacher = Teacher.load()
    if config.start is None:
        tokenizer = build_tokenizer(teacher.word_pieces, _corpus(phrases), config.shape.vocabulary)
        model: Any = build_model(config.shape, tokenizer)
    else:
        tokenizer, model = load_tokenizer(config.start), load_model(config.start).train()
    prompts = contract.prompts(tokenizer)
    pieces, vectors = teacher.words_of(tokenizer, config.shape.hidden)
    if config.start is None:
        start_embeddings(model, prompts, pieces, vectors)
    model.to(torch.device(config.device))

    stages = Stages(config)

    def lessons_of() -> Lessons:
        kind_of = read_feedback(config.data / "feedback-train.json")
        rewording = Rewording(pieces, vectors)
        return teach(teacher, rewording, phrases, held_out, kind_of, config.words, config.seed)

    lessons: Lessons = stages.once("lessons", lessons_of)
    task = WordsTask(model, contract, prompts, lessons, config.word_dropout)
    language, visual = model.model.language_model, model.model.visual
    begun = _copy(language) if config.start is not None else None

    def words() -> Any:
        learn_words(task, held_out, config.words, config.seed)
        return _copy(language)

    spoken: dict[str, Tensor] = stages.once("words", words)
    language.load_state_dict(spoken)
    samples = read_samples(config.data / "train.parquet")
    pixels = read_pixels(samples, contract.vision)

    def pictures() -> Any:
        learn_pictures(model, contract, samples, pixels, config)
        return visual.state_dict()

    if config.start is None:
        visual.load_state_dict(stages.once("pictures", pictures))
    learn_both(model, contract, prompts, samples, pixels, task, held_out, config)
    keep(language, spoken, config.words_kept)
    if begun is not None:
        keep(language, begun, config.start_kept)
    if not is_first():
        return

    with new_folder(config.out) as folder:
        model.half()
        for part in (model.config, model.config.text_config, model.config.vision_config):
            part.dtype = torch.float16
        model.save_pretrained(folder)
        save_tokenizer(tokenizer, contract.vision, folder)
        contract.save(folder)
        save_config(config, folder / "pretraining.yaml")
        write_manifest(folder, seconds=watch.seconds, facts={"parameters": model.num_parameters()})
    print(f"tiny base: {model.num_parameters()} parameters in {config.out}, {watch.seconds:.0f} s")


class Stages:
    """What the stages of a run have made, kept in a folder of its own beside the model.

    The folder is named after the data and all that shapes the stages before the last; a change of
    the code is not noticed.
    """

    def __init__(self, config: TinyConfig) -> None:
        shaping = (config.seed, config.shape, config.words, config.pictures, config.word_dropout)
        about = hash_file(config.data / "manifest.json") + repr(shaping)
        if config.start is not None:
            about += hash_file(config.start / "model.safetensors")
        name = hashlib.sha256(about.encode()).hexdigest()[:12]
        self._folder = config.out.with_name(f"{config.out.name}-stages") / name
        self._folder.mkdir(parents=True, exist_ok=True)
        self._found = {path.stem for path in self._folder.glob("*.pt")}
        wait_for_all()  # so that all have found the same

    def once(self, stage: str, make: Callable[[], Any]) -> Any:
        """What the stage made, now or in an earlier run."""
        path = self._folder / f"{stage}.pt"
        if stage in self._found:
            return torch.load(path, weights_only=False)
        made = make()
        if is_first():
            torch.save(made, path.with_suffix(".new"))
            path.with_suffix(".new").rename(path)
        return made


def start_embeddings(
    model: Any, prompts: PromptBuilder, pieces: Sequence[str], vectors: NDArray[np.float32]
) -> None:
    """Word embeddings from vectors [piece, hidden]; neighbouring action tokens start near."""
    table = model.get_input_embeddings().weight
    vocabulary = prompts.tokenizer.get_vocab()
    with torch.no_grad():
        table.normal_(0, EMBEDDING_SCALE)
        rows = [vocabulary[p] for p in pieces]
        table[rows] = torch.from_numpy(vectors) * EMBEDDING_SCALE
        level = torch.linspace(0, 1, len(ACTION_TOKENS))[:, None]
        waves = level * torch.randn(1, table.shape[1]) * 6 + torch.rand(1, table.shape[1]) * 6.3
        table[list(prompts.ids.actions)] = torch.cos(waves) * EMBEDDING_SCALE


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
    task: WordsTask,
    held_out: list[Sample],
    config: TinyConfig,
) -> None:
    """Stage three: everything together, with text-only batches mixed in to keep the words."""
    augment = Augment()
    word_batches = endless_batches(task.lengths, 2 * config.both.batch, config.seed + 1)

    def loss_of(chosen: list[int], rng: np.random.Generator) -> Tensor:
        if rng.random() < config.words_in_both:
            words = own_share(next(word_batches))
            if rng.random() < config.words.text_share:
                return task.text(words, rng)
            return task.actions(words, rng)[0]
        patches = patches_of(pixels[chosen], contract.vision, augment, rng).to(model.device)
        features = encode_frames(model, patches, contract.vision)
        as_text = rng.random(len(chosen)) < config.as_text_share
        rows = [
            tokenize(samples[i], prompts, as_text=bool(text))
            for i, text in zip(chosen, as_text, strict=True)
        ]
        batch = drop_words(collate(rows), prompts, config.word_dropout, rng).to(model.device)
        weight = config.text_weight
        loss, _ = batch_loss(
            model, batch, features, prompts.ids, text_weight=weight, fixed_vocabulary=True
        )
        return loss.total

    def watch() -> str:
        return score_phrases(model, contract, prompts, held_out)

    lengths = [text_length(sample) for sample in samples]
    train_steps("both", [model], lengths, loss_of, config.both, config.seed, watch=watch)


def keep(language: nn.Module, earlier: dict[str, Tensor], share: float) -> None:
    """Average the language model with an earlier state of it; `share` is the latter's weight.

    Learning to look costs some understanding of words, and the average of both weights keeps most
    of either (WiSE-FT, Wortsman et al. 2022).
    """
    now = language.state_dict()
    mixed = {name: torch.lerp(now[name], earlier[name].to(now[name]), share) for name in now}
    language.load_state_dict(mixed)


def _copy(language: nn.Module) -> dict[str, Tensor]:
    return {name: weight.clone() for name, weight in language.state_dict().items()}


def _corpus(phrases: list[Sample]) -> list[str]:
    texts = []
    for sample in phrases:
        texts += [sample.instruction, sample.scene, sample.explanation]
        texts += [memory.feedback for memory in sample.memories]
    return texts


if __name__ == "__main__":
    sys.exit(run_stage(TinyConfig, "configs/tiny.yaml", pretrain, __doc__))
