"""The committed tiny base: small enough, whole, and it understands what it is for."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from data.build import encode
from data.phrases import load_bank
from ridetune.alignment import conservativeness
from ridetune.camera.render import render
from ridetune.camera.scene import sample_scene, with_condition
from ridetune.contract import Contract, load_tokenizer
from ridetune.matrix import ControllerMatrix
from ridetune.policy import Policy
from ridetune.qwen import load_model
from ridetune.sample import ADVERSE, Condition, Memory
from ridetune.torch_engine import TorchEngine

BASE = Path(__file__).parents[1] / "models" / "tiny"
NUM_SCENES = 6
Ask = Callable[..., ControllerMatrix]


@pytest.fixture(scope="module")
def policy() -> Policy:
    torch.set_num_threads(1)
    contract, tokenizer = Contract.load(BASE), load_tokenizer(BASE)
    engine = TorchEngine(load_model(BASE), contract.prompts(tokenizer), contract.vision)
    return Policy(engine, contract, tokenizer)


def frames(condition: Condition) -> list[bytes]:
    """The same scenes in a condition, as JPEG."""
    rng = np.random.default_rng(77)
    scenes = [with_condition(sample_scene(rng), condition) for _ in range(NUM_SCENES)]
    return [encode(render(scene)) for scene in scenes]


def mean_conservativeness(
    policy: Policy, condition: Condition, said: str, memories: tuple[Memory, ...] = ()
) -> float:
    """Of the proposals for one sentence over all scenes in a condition."""
    default = policy.contract.ranges.default
    proposals = [
        policy.decide(frame, said, memories, last_safe=default).proposal
        for frame in frames(condition)
    ]
    return float(np.mean([conservativeness(m, policy.contract.codec) for m in proposals]))


def test_the_weights_are_safetensors_of_at_most_12_megabytes() -> None:
    weights = list(BASE.glob("*.safetensors"))
    assert weights
    assert sum(path.stat().st_size for path in weights) <= 12_000_000
    assert not [path for path in BASE.iterdir() if path.suffix in {".bin", ".pt", ".pkl"}]


def test_haste_drives_brisker_than_content_and_content_than_sickness(policy: Policy) -> None:
    late = mean_conservativeness(policy, "sunny", "I am going to be late for work.")
    same = mean_conservativeness(policy, "sunny", "Keep it like this.")
    sick = mean_conservativeness(policy, "sunny", "I feel a bit motion-sick.")
    assert late < same < sick


@pytest.mark.parametrize("condition", ADVERSE)
def test_bad_conditions_make_the_same_wish_more_conservative(
    policy: Policy, condition: Condition
) -> None:
    said = "Keep it like this."
    clear = mean_conservativeness(policy, "sunny", said)
    assert mean_conservativeness(policy, condition, said) > clear


def test_remembered_feedback_moves_the_matrix_against_the_complaint(policy: Policy) -> None:
    feedback = load_bank().feedback.sayings
    said, scene = (
        "Keep it like this.",
        "sunny straight road in the city, no vehicle ahead, light traffic",
    )

    def after(kind: str) -> float:
        sayings = feedback[kind][:4]  # type: ignore[index]
        drives = [(Memory(said, scene, policy.contract.ranges.default, f),) for f in sayings]
        return float(np.mean([mean_conservativeness(policy, "sunny", said, d) for d in drives]))

    assert after("too_aggressive") > after("just_right") > after("too_conservative")


def test_the_scene_description_names_the_condition(policy: Policy) -> None:
    default = policy.contract.ranges.default
    said = "Drive normally."
    named = {"sunny": "sunny", "snow": "snowy", "night": "night"}
    right = [
        word in policy.explain(policy.decide(frame, said, last_safe=default)).scene
        for condition, word in named.items()
        for frame in frames(condition)[:2]  # type: ignore[arg-type]
    ]
    assert sum(right) >= 5
