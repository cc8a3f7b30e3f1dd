"""How an answer looks on a terminal."""

from serve.layout import WIDTH, answer_lines
from serve.wire import DecisionOut, VerdictOut

ROWS = [[0.35, 0.005, 0.08], [0.16, 1.0, 0.35]]


def test_lines_keep_to_the_width_when_everything_is_slow() -> None:
    slow = dict.fromkeys(("image", "prefill", "prompt", "decide", "gate", "explain"), 12345.6)
    answer = DecisionOut.model_construct(
        matrix=ROWS,
        default=ROWS,
        verdict=VerdictOut(outcome="accepted", reasons=["word " * 60]),
        scene="word " * 60,
        explanation="." * 300,
        timings_ms={**slow, "total": 123456.7},
    )
    lines = answer_lines("Keep it like this.", answer)
    assert max(len(line) for line in lines) <= WIDTH
    assert any("gate 12345.6" in line for line in lines)
