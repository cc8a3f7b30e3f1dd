"""Tables of the page as HTML: Table 1's layout for our rows and, apart, for the paper's own."""

import math
from collections.abc import Mapping
from html import escape

from .driving_score import METRICS, TABLE_1, Manoeuvre

Numbers = Mapping[str, float | None]

# Of each column of Table 1: its key, name, unit, factor, digits.
_COLUMNS = (
    ("ttc_s", "Time to collision", "s", 1.0, 2),
    ("sv_x", "SV<sub>x</sub>", "m²/s²", 1.0, 2),
    ("sv_y", "SV<sub>y</sub>", "10⁻² m²/s²", 100.0, 2),
    ("mean_ax", "|a<sub>x</sub>|", "m/s²", 1.0, 2),
    ("mean_jx", "|J<sub>x</sub>|", "m/s³", 1.0, 2),
    ("mean_ay", "|a<sub>y</sub>|", "10⁻¹ m/s²", 10.0, 2),
    ("mean_jy", "|J<sub>y</sub>|", "m/s³", 1.0, 2),
    ("felt_ay", "felt |a<sub>y</sub>|", "m/s²", 1.0, 2),
    ("latency_s", "Latency", "s", 1.0, 3),
    ("command_alignment", "Command alignment", "0 to 100", 1.0, 1),
    ("scenario_alignment", "Scenario alignment", "0 to 100", 1.0, 1),
    ("driving_score", "Driving score", "0 to 100", 1.0, 1),
)
_ARMS = {
    "baseline": "baseline (default matrix)",
    "text": "matrix as text (the paper's way)",
    "ours": "ours (served bundle)",
    "oracle": "oracle",
}


def title(name: str) -> str:
    """A name of the code as words."""
    return name.replace("_", " ").capitalize()


def table_1(rows: Mapping[Manoeuvre, Mapping[str, Numbers]], caption: str) -> str:
    """Table 1's layout; `rows` by manoeuvre and arm, in SI units, alignments in [0, 100]."""
    head = "".join(f"<th>{name}<small>{unit}</small></th>" for _, name, unit, _, _ in _COLUMNS)
    body = []
    for manoeuvre, arms in rows.items():
        span = len(_COLUMNS) + 1
        body.append(f'<tr><th scope="rowgroup" colspan="{span}">{title(manoeuvre)}</th></tr>')
        for arm, row in arms.items():
            cells = "".join(
                f"<td>{say(_waited(key, row), factor, digits)}</td>"
                for key, _, _, factor, digits in _COLUMNS
            )
            kind = ' class="ours"' if arm == "ours" else ""
            name = escape(_ARMS.get(arm, arm))
            body.append(f'<tr{kind}><th scope="row">{name}</th>{cells}</tr>')
    return table(caption, f"<tr><th></th>{head}</tr>", "".join(body))


def _waited(key: str, row: Numbers) -> float | None:
    """A row's value; who waits for no model has no latency."""
    value = row.get(key)
    return None if key == "latency_s" and value == 0.0 else value


def paper_table() -> str:
    """The paper's own Table 1, labelled as such."""
    rows: dict[Manoeuvre, dict[str, Numbers]] = {
        manoeuvre: {
            f"{model}, real car": dict(zip((*METRICS, "driving_score"), row, strict=True))
            for model, row in models.items()
        }
        for manoeuvre, models in TABLE_1.items()
    }
    caption = (
        "Printed in the on-board VLM paper, measured on a real car. No number of ours stands "
        "in this table, and none of it in ours."
    )
    return f"<details><summary>The paper's own Table 1</summary>{table_1(rows, caption)}</details>"


def say(value: float | None, factor: float = 1.0, digits: int = 2) -> str:
    """A number for a table cell; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    return f"{factor * value:.{digits}f}"


def table(caption: str, head: str, body: str, *, words: bool = False) -> str:
    """A table that scrolls by itself on a narrow screen, from HTML; `words`: long names wrap."""
    kind = ' class="words"' if words else ""
    return (
        f'<p class="note">{caption}</p><div class="scroll"><table{kind}><thead>{head}</thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
