"""From a camera frame and the passenger's words to a decision that the car may run.

    frame -> image path -> prefill            `Policy.prepare`, before the passenger has spoken
    words -> prompt -> one decision pass -> codec -> gate      `Policy.decide`
    after the matrix: scene and explanation                    `Policy.explain`

The engine runs the model, the contract says what it was trained with. The same frame, words,
memories and last safe matrix give the same decision.
"""

import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from tokenizers import Tokenizer

from ridetune.contract import Contract
from ridetune.engines import ActionPass, Engine, Prefix
from ridetune.gate import SafetyGate, Verdict
from ridetune.matrix import ControllerMatrix
from ridetune.sample import Condition, Memory
from ridetune.vision import read_patches

MAX_EXPLANATION_TOKENS = 96
MAX_MATRIX_TOKENS = 80  # of a matrix written as text

_ANSWER = re.compile(r"\s*scene\s*:\s*(?P<scene>.*?)\s*(?:\.(?!\d)\s*(?P<explanation>.*))?", re.S)
# What the decoder of a word-piece vocabulary leaves between the pieces of one word.
_GAPS = (
    (re.compile(r"(?<=\d) (?=\d)"), ""),
    (re.compile(r"(?<=\d)\. (?=\d)"), "."),
    (re.compile(r" (?=[:;%)])"), ""),
    (re.compile(r" ?(['/-]) ?(?=\w)"), r"\1"),
    (re.compile(r"\( "), "("),
)


@dataclass(frozen=True)
class PreparedFrame:
    """A frame that the model has read; captured_s is on the policy's monotonic clock [s]."""

    prefix: Prefix = field(repr=False)
    captured_s: float
    timings_ms: dict[str, float]


@dataclass(frozen=True)
class Decision:
    """A proposal, what the gate says of it, and what it took.

    confidence: per parameter, in [0, 1]. timings_ms: image and prefill (of the frame, whenever
    they ran), prompt, decide, gate, and total: the wall time of the `decide` call, which includes
    image and prefill only if the call was given a frame that was not prepared.
    frame_age_ms: from the capture of the frame to the verdict.
    """

    proposal: ControllerMatrix
    verdict: Verdict
    confidence: tuple[float, ...]
    timings_ms: dict[str, float]
    frame_age_ms: float
    action_pass: ActionPass = field(repr=False)


@dataclass(frozen=True)
class Explanation:
    """What the model saw and why it chose the proposal; empty where it did not say."""

    scene: str
    explanation: str
    ms: float


class Policy:
    """One model behind one gate; `clock` is monotonic [s].

    gate: one of the bundle's ranges alone if not given; a car's has envelope and check as well.
    """

    def __init__(
        self,
        engine: Engine,
        contract: Contract,
        tokenizer: Tokenizer,
        *,
        gate: SafetyGate | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.contract = contract
        self._engine = engine
        self._tokenizer = tokenizer
        self._codec = contract.codec
        self._prompts = contract.prompts(tokenizer)
        self._gate = SafetyGate(contract.ranges, self._codec) if gate is None else gate
        self._clock = clock

    def prepare(self, frame: bytes, *, captured_s: float | None = None) -> PreparedFrame:
        """Read an encoded JPEG or PNG frame; FrameError if it is unusable.

        captured_s: when the frame was taken, on the policy's clock; now if not given.
        """
        watch = _Laps(self._clock)
        patches = read_patches(frame, self.contract.vision)
        watch.lap("image")
        prefix = self._engine.prefill(patches)
        watch.lap("prefill")
        captured = watch.start if captured_s is None else captured_s
        return PreparedFrame(prefix, captured, watch.laps_ms)

    def decide(
        self,
        frame: PreparedFrame | bytes,
        instruction: str,
        memories: Sequence[Memory] = (),
        *,
        last_safe: ControllerMatrix,
        condition: Condition | None = None,
        captured_s: float | None = None,
    ) -> Decision:
        """One decision; FrameError or InstructionError if the input is unusable.

        condition: of the road, from the car's own sensors, for the gate; None if not known.
        captured_s: as in `prepare`, for a frame given as bytes. A memory whose matrix lies
        outside the vehicle's ranges is a ValueError.
        """
        watch = _Laps(self._clock)
        if isinstance(frame, bytes):
            frame = self.prepare(frame, captured_s=captured_s)
            watch.skip()
        suffix = self._prompts.suffix(instruction, memories)
        watch.lap("prompt")
        action_pass = self._engine.decide(frame.prefix, suffix)
        proposal, confidence = self._codec.expect(action_pass.logits)
        watch.lap("decide")
        verdict = self._gate.judge(proposal, last_safe, condition)
        watch.lap("gate")
        return Decision(
            proposal=proposal,
            verdict=verdict,
            confidence=confidence,
            timings_ms={**frame.timings_ms, **watch.laps_ms, "total": watch.total_ms},
            frame_age_ms=1e3 * (watch.last - frame.captured_s),
            action_pass=action_pass,
        )

    def explain(
        self, decision: Decision, *, max_tokens: int = MAX_EXPLANATION_TOKENS
    ) -> Explanation:
        """Scene and explanation of a decision's proposal; run it after the matrix is out.

        A proposal without bins (a model that answers NaN) has no explanation.
        """
        watch = _Laps(self._clock)
        try:
            bins = self._codec.encode(decision.proposal)
        except ValueError:
            return Explanation("", "", watch.total_ms)
        ids = _until(self._engine.explain(decision.action_pass, bins, max_tokens), self._end)
        scene, explanation = parse_answer(read_text(self._tokenizer, ids))
        watch.lap("explain")
        return Explanation(scene, explanation, watch.total_ms)

    @property
    def _end(self) -> int:
        return self._prompts.ids.end


def read_text(tokenizer: Tokenizer, ids: Sequence[int]) -> str:
    """Token ids as text without special tokens; closes the gaps of a word-piece vocabulary."""
    text = str(tokenizer.decode(list(ids), skip_special_tokens=True))
    if type(tokenizer.decoder).__name__ == "WordPiece":
        for gap, closed in _GAPS:
            text = gap.sub(closed, text)
    return text.strip()


def parse_answer(text: str) -> tuple[str, str]:
    """`scene: <scene>. <explanation>` -> (scene, explanation).

    Tolerant: a missing part is empty, and a text without the word "scene" is all explanation.
    """
    found = _ANSWER.fullmatch(text)
    if found is None:
        return "", text.strip()
    return found["scene"].strip(), (found["explanation"] or "").strip()


def _until(ids: Iterable[int], end: int) -> list[int]:
    kept = []
    for token in ids:
        if token == end:
            break
        kept.append(token)
    return kept


class _Laps:
    """Times the stages of one call [ms]; `last` is when the latest one ended [s]."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.start = self.last = clock()
        self.laps_ms: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        now = self._clock()
        self.laps_ms[stage] = 1e3 * (now - self.last)
        self.last = now

    def skip(self) -> None:
        self.last = self._clock()

    @property
    def total_ms(self) -> float:
        return 1e3 * (self.last - self.start)
