"""The gate against random and adversarial proposals: both kinds of error, counted.

proposals -> gate (envelope, check) -> what came out driven on many other cars, with other noise

    python -m evaluate.envelope.proof --config configs/envelope.yaml

With `proof.box=false` the boxes are as wide as the ranges and the check stands alone.
Both the proposal and what the gate made of it are driven.
False acceptance: what the gate let the car run breaks a limit in a drive.
Needless: the proposal breaks none and was limited or refused all the same.
Each proposal has its own seed, so a long proof may be run in parts:
`proof.first=2000 proof.proposals=2000` adds to the report of the first.
Simulation only: cars of the verified population, half of them at its corners.
"""

import json
import logging
import sys
import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from evaluate.significance import clopper_pearson
from ridetune.control.vehicle import Vehicle
from ridetune.envelope import Envelope
from ridetune.gate import SafetyGate, Verdict
from ridetune.matrix import NUM_PARAMETERS, ControllerMatrix, Ranges, ki_limit
from ridetune.sample import CONDITIONS, Condition
from ridetune.sim.check import OPEN_ROAD, SHORT_TURN, RolloutCheck, Trial, violation
from ridetune.sim.drive import Answer, Moment, drive_policy
from ridetune.sim.rollout import rollout
from ridetune.sim.scenarios import LANE_CHANGE, LEFT_TURN, SCENARIOS, Scenario
from ridetune.stage import run_stage

from .build import EnvelopeConfig
from .monte_carlo import MonteCarlo, draw_car, project

_log = logging.getLogger(__name__)
KINDS = ("uniform", "log_uniform", "corner", "climbed", "ki_rule", "step")
_CLIMB_STEPS = 4
_DRIVES: tuple[tuple[Scenario, int], ...] = ((LEFT_TURN, 8), (LANE_CHANGE, 2), (OPEN_ROAD, 2))
_OTHERS = tuple(s for s in SCENARIOS.values() if s not in (LEFT_TURN, LANE_CHANGE))
_KEPT_EXAMPLES = 20


class Adversary:
    """Makes proposals and drives what becomes of them."""

    def __init__(self, carlo: MonteCarlo, gate: SafetyGate, envelope: Envelope) -> None:
        self.carlo, self.gate, self.envelope = carlo, gate, envelope

    def propose(
        self, kind: str, condition: Condition | None, rng: np.random.Generator
    ) -> ControllerMatrix:
        """A proposal of a kind; `climbed` ones walk towards a violation that the gate lets pass."""
        carlo = self.carlo
        low, high = np.array(carlo.whole).T
        if kind == "uniform":  # a third beyond the ranges, below zero included
            return ControllerMatrix.of(rng.uniform(low - 0.02 * high, low + 1.05 * (high - low)))
        if kind == "corner":
            ends = carlo.whole if rng.uniform() < 0.5 else self.envelope.box(condition)
            values = [pair[rng.integers(2)] for pair in ends]
            return ControllerMatrix.of(
                [values[0], min(values[1], ki_limit(values[0])), *values[2:]]
            )
        matrix = carlo.draw(rng, carlo.whole)
        if kind == "ki_rule":
            ki = ki_limit(matrix.kp) * float(rng.choice([1.0, 1.0 + 1e-9, 1.5, 4.0]))
            return ControllerMatrix.of([matrix.kp, min(ki, high[1]), *matrix.values[2:]])
        if kind == "climbed":
            return self._climb(matrix, condition, rng)
        return matrix

    def _climb(
        self, matrix: ControllerMatrix, condition: Condition | None, rng: np.random.Generator
    ) -> ControllerMatrix:
        codec, road = self.carlo.codec, condition or "snow"
        matrix = self.judge(matrix, condition, matrix).matrix
        worst = 0.0
        for _ in range(_CLIMB_STEPS):
            shares = [codec.share(v, i) for i, v in enumerate(matrix.values)]
            moved = np.clip(np.array(shares) + rng.normal(0.0, 0.12, NUM_PARAMETERS), 0.0, 1.0)
            step = ControllerMatrix.of([codec.value(float(s), i) for i, s in enumerate(moved)])
            step = self.judge(step, condition, step).matrix
            car, seed = draw_car(rng), int(rng.integers(2**31))
            run = rollout(step, SHORT_TURN, road, vehicle=self.carlo.vehicle, spread=car, seed=seed)
            aside = float(np.nanmax(np.abs(run.trajectory["lateral_error_m"])))
            if aside > worst:
                matrix, worst = step, aside
        return matrix

    def judge(
        self, proposal: ControllerMatrix, condition: Condition | None, near: ControllerMatrix
    ) -> Verdict:
        """The verdict from a last safe matrix at the nearest point of the box."""
        return self.gate.judge(proposal, project(near, self.envelope.box(condition)), condition)

    def audit(
        self, matrix: ControllerMatrix, condition: Condition | None, rng: np.random.Generator
    ) -> str | None:
        """Drive a matrix on many cars; the first violation, or None."""
        roads: tuple[Condition, ...] = (
            (condition,) if condition else ("snow", CONDITIONS[rng.integers(len(CONDITIONS))])
        )
        other = _OTHERS[rng.integers(len(_OTHERS))]
        for road in roads:
            for scenario, count in (*_DRIVES, (other, 1)):
                for _ in range(count):
                    trial = Trial(scenario, draw_car(rng), int(rng.integers(2**31)))
                    found = self.carlo.breaks(matrix, trial, road)
                    if found is not None:
                        return f"{scenario.name}, {road}, {trial.spread}: {found}"
        return None


def prove(config: EnvelopeConfig) -> None:
    """Run the proof, write its report, print one JSON line."""
    vehicle, ranges = Vehicle.load(config.vehicle), Ranges.load(config.ranges)
    envelope = Envelope.load(config.out, vehicle=vehicle, ranges=ranges)
    carlo = MonteCarlo(vehicle, ranges, envelope.limits)
    check = _Timed(RolloutCheck(vehicle, envelope.limits))
    if not config.proof.box:
        envelope = replace(envelope, boxes=dict.fromkeys(CONDITIONS, carlo.whole_named))
    gate = SafetyGate(ranges, carlo.codec, envelope=envelope, check=check)
    check.seconds.clear()
    adversary = Adversary(carlo, gate, envelope)
    counts: Counter[str] = Counter()
    examples: list[str] = []
    proof = config.proof
    numbers = range(proof.first, proof.first + proof.proposals)
    for number in tqdm(numbers, desc="proposals", unit="matrix", disable=None):
        _one(adversary, number, config.seed, counts, examples)
    if proof.first == 0:
        _alternate(adversary, proof.step_drives, config.seed, counts, examples)
    result = _report(config, counts, examples, check.seconds)
    print(json.dumps(result))


def _one(
    adversary: Adversary, number: int, seed: int, counts: Counter[str], examples: list[str]
) -> None:
    rng = np.random.default_rng([seed, 1, number])
    kind = KINDS[number % len(KINDS)]
    drawn = int(rng.integers(len(CONDITIONS) + 1))
    condition = CONDITIONS[drawn] if drawn < len(CONDITIONS) else None
    proposal = adversary.propose(kind, condition, rng)
    near = adversary.carlo.draw(rng, adversary.envelope.box(condition))
    verdict = adversary.judge(proposal, condition, near if kind == "step" else proposal)
    asked = adversary.audit(proposal, condition, rng)
    why: str = verdict.outcome
    if why == "refused":
        why = "refused_by_check" if "simulation" in verdict.reasons[-1] else "refused_by_bounds"
    run = asked if verdict.matrix == proposal else adversary.audit(verdict.matrix, condition, rng)
    counts[f"{kind}.{why}.{_truth(asked)}.{_truth(run)}"] += 1
    if run:
        examples.append(f"{number} {kind} {condition} {verdict.matrix.values}: {run}")


def _truth(violation: str | None) -> str:
    return "breaks" if violation else "fine"


def _alternate(
    adversary: Adversary, drives: int, seed: int, counts: Counter[str], examples: list[str]
) -> None:
    """Drives whose source asks every second for another corner of the ranges."""
    carlo = adversary.carlo
    for number in range(drives):
        rng = np.random.default_rng([seed, 2, number])
        condition = CONDITIONS[number % len(CONDITIONS)]
        scenario = (LEFT_TURN, LANE_CHANGE, OPEN_ROAD)[number % 3]
        start = carlo.draw(rng, adversary.envelope.box(None))

        def source(_: Moment, rng: np.random.Generator = rng) -> Answer:
            return Answer([pair[rng.integers(2)] for pair in carlo.whole])

        drive = drive_policy(
            source,
            scenario,
            condition,
            vehicle=carlo.vehicle,
            gate=adversary.gate,
            default=start,
            spread=draw_car(rng),
            seed=number,
        )
        broken = violation(drive.rollout, scenario, condition, carlo.limits)
        counts[f"alternating.{'breaks' if broken else 'fine'}"] += 1
        if broken:
            examples.append(f"alternating {number} {scenario.name} {condition}: {broken}")


def _report(
    config: EnvelopeConfig, counts: Counter[str], examples: list[str], seconds: list[float]
) -> dict[str, Any]:
    """Add to an earlier part where there is one, and write."""
    path = config.proof.report
    if config.proof.first > 0 and path.is_file():
        earlier = json.loads(path.read_text())
        counts = counts + Counter(earlier["counts"])
        examples = [*earlier["false_acceptances"], *examples]
        seconds = [*(1e-3 * ms for ms in earlier["check_cpu_ms_all"]), *seconds]
    result = {**summarise(counts), "counts": dict(sorted(counts.items()))}
    p50, p99 = np.quantile(seconds, [0.5, 0.99])
    result["check_cpu_ms"] = {"p50": round(1e3 * p50, 2), "p99": round(1e3 * p99, 2)}
    result["false_acceptances"] = examples[:_KEPT_EXAMPLES]
    path.parent.mkdir(parents=True, exist_ok=True)
    everything = {**result, "check_cpu_ms_all": [round(1e3 * s, 2) for s in seconds]}
    path.write_text(json.dumps(everything, indent=1) + "\n")
    return result


def summarise(counts: Counter[str]) -> dict[str, Any]:
    """Both errors with their 95 % intervals.

    counts: proposals by `kind.outcome.asked.run`, where asked says whether the proposal breaks a
    limit and run whether the matrix does that the car runs after it; drives by
    `alternating.breaks` and `alternating.fine`.
    """
    proposals = [(key.split("."), n) for key, n in counts.items() if key.count(".") == 3]

    def share(events: int, trials: int) -> dict[str, Any]:
        interval = clopper_pearson(events, trials) if trials else (0.0, 1.0)
        return {"events": events, "of": trials, "interval": [round(end, 6) for end in interval]}

    everything = sum(n for _, n in proposals)
    run_breaks = sum(n for (_, _, _, run), n in proposals if run == "breaks")
    outcomes: dict[str, Counter[str]] = {"breaks": Counter(), "fine": Counter()}
    for (_, outcome, asked, _), n in proposals:
        outcomes[asked][outcome] += n
    fine = outcomes["fine"]
    swaps = counts["alternating.breaks"]
    return {
        "false_acceptance": share(run_breaks, everything),
        "needless": share(fine.total() - fine["accepted"], fine.total()),
        "asked_breaks": dict(sorted(outcomes["breaks"].items())),
        "asked_fine": dict(sorted(fine.items())),
        "alternating": share(swaps, swaps + counts["alternating.fine"]),
    }


class _Timed:
    """A check that notes the CPU time of each call [s]."""

    def __init__(self, check: RolloutCheck) -> None:
        self._check = check
        self.seconds: list[float] = []

    def __call__(self, matrix: ControllerMatrix, condition: Condition | None) -> str | None:
        start = time.process_time()
        try:
            return self._check(matrix, condition)
        finally:
            self.seconds.append(time.process_time() - start)


if __name__ == "__main__":
    sys.exit(run_stage(EnvelopeConfig, "configs/envelope.yaml", prove, __doc__))
