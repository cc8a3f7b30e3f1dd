"""A decision as plain text for a terminal of 100 columns."""

import textwrap

from ridetune.matrix import PARAMETERS

from .wire import DecisionOut

WIDTH = 100
_LABEL = 14
_STAGES = ("image", "prefill", "prompt", "decide", "gate")

GUIDE = """\
The car's controllers take six values.
  speed      K_p  how firmly the car follows the wanted speed
             K_i  how it makes up for an error that lasts
             K_d  how it damps changes
  steering   W_l  how closely it keeps to the middle of the lane
             W_h  how closely it keeps to the lane's direction
             W_s  how calm it keeps the steering wheel"""


def answer_lines(question: str, answer: DecisionOut) -> list[str]:
    """The lines that show one answer; nothing in the text can move the cursor."""
    ms = answer.timings_ms
    lines = [f'  "{question}"', ""]
    lines += _matrices(answer)
    lines += ["", *wrapped(_label("gate"), answer.verdict.outcome)]
    for reason in answer.verdict.reasons:
        lines += wrapped(" " * _LABEL + "- ", reason)
    lines += wrapped(_label("scene"), answer.scene or "(the model did not say)")
    lines += wrapped(_label("because"), _reason(answer.explanation))
    stages = "   ".join(f"{name} {ms[name]:.1f}" for name in _STAGES if name in ms)
    lines += wrapped(_label("time"), f"matrix after {ms['total']:.1f} ms   ({stages})")
    if "explain" in ms:
        lines += [f"{_label('')}scene and reason {ms['explain']:.1f} ms later"]
    return lines


def wrapped(label: str, text: str) -> list[str]:
    """A label and a text that hangs beside it; control characters become spaces."""
    shown = "".join(c if c.isprintable() else " " for c in text)
    return textwrap.wrap(
        shown, WIDTH, initial_indent=label, subsequent_indent=" " * len(label)
    ) or [label]


def _matrices(answer: DecisionOut) -> list[str]:
    """The matrix with its names, beside the default."""
    lines = [f"{_label('matrix')}{'for the car':<52}default"]
    for row in range(2):
        names = PARAMETERS[3 * row : 3 * row + 3]
        car = "   ".join(
            f"{n} {_number(v)}" for n, v in zip(names, answer.matrix[row], strict=True)
        )
        default = "  ".join(_number(v) for v in answer.default[row])
        lines.append(f"{_label('')}{car:<52}{default}")
    return lines


def _number(value: float | None) -> str:
    return "      -" if value is None else f"{value:7.4f}"


def _label(name: str) -> str:
    return f"      {name:<{_LABEL - 6}}"


def _reason(explanation: str | None) -> str:
    """Without the word that the label says already."""
    return (explanation or "(the model did not say)").removeprefix("because ")
