"""What an answer makes of a proposal: the model's words, and a matrix drawn by the rules."""

from dataclasses import replace
from typing import get_args

import numpy as np

from ridetune.camera.scene import Lead
from ridetune.matrix import Ranges
from ridetune.scene import scene_answers

from ..annotate import Rules
from ..proposals import Proposal
from ..sources.seen import Facts
from .answers import Answer


class Labeller:
    """Puts a model's answer in the place of the rules' words, with a matrix that fits it."""

    def __init__(self, ranges: Ranges, *, annotator: str, seed: int) -> None:
        self._rules = Rules(ranges)
        self._annotator = annotator
        self._seed = seed

    def label(self, proposal: Proposal, answer: Answer) -> Proposal:
        """The proposal as the model has it; the same for the same proposal, answer and seed."""
        rng = np.random.default_rng([self._seed, int(proposal.proposal_id, 16)])
        speed = proposal.sample.observation.speed_mps
        matrix = self._rules.label(answer.style, facts_of(answer), speed, rng)
        sample = replace(
            proposal.sample,
            scene=answer.scene,
            condition=answer.condition,
            style=answer.style,
            explanation=answer.explanation,
            matrix=matrix,
        )
        return replace(
            proposal, sample=sample, annotator=self._annotator, confidence=answer.confidence
        )


def facts_of(answer: Answer) -> Facts:
    """What of an answer asks for care, read from the words of its scene."""
    lead: tuple[Lead, ...] = get_args(Lead)
    said = scene_answers(answer.scene)[2]
    return Facts(
        condition=answer.condition,
        dark="dark" in answer.scene or "night" in answer.scene,
        low_sun="low sun" in answer.scene,
        lead=lead[said] if said >= 0 else None,
        traffic="dense" if "dense traffic" in answer.scene else None,
    )
