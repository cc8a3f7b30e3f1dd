"""The sections of the page: what other commands wrote, as HTML.

Dicts as their JSON files hold them in, text out. A section whose file is missing says which
command makes it.
"""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from ridetune.sample import CONDITIONS, LEVELS

from .driving_score import Manoeuvre
from .plots import Bar, interval_bars
from .tables import Numbers, table, title

_CONTROLS = {
    "served": "served bundle",
    "text": "matrix as text",
    "constant": "constant default",
    "random": "random matrix",
    "shuffled": "shuffled words",
    "shuffled_frames": "shuffled frames",
    "shuffled_instructions": "shuffled words",
    "oracle": "labels themselves",
}
_TAKEOVER_ARMS = {
    "baseline": "baseline",
    "without_memory": "no memory",
    "with_memory": "with memory",
    "shuffled": "shuffled",
    "random": "random",
    "oracle": "oracle",
    "ideal_without_memory": "ideal, no memory",
    "ideal_with_memory": "ideal, memory",
}


def missing(what: str, command: str) -> str:
    """The sentence that stands for results that are not there."""
    return (
        f'<p class="missing">{escape(what)} not measured yet. '
        f"<code>{escape(command)}</code> writes it; then build this page again.</p>"
    )


def alignment(evaluation: Mapping[str, Any]) -> str:
    """Command alignment, style accuracy and scenario alignment beside their controls."""
    scores = {"served": evaluation["served"], **evaluation["controls"]}
    charts = (
        ("command_alignment", "Command alignment (Eq. 7)", "score, 0 to 100", 1.0),
        ("style_accuracy", "Style recognised", "share of decisions [%]", 100.0),
        ("scenario_alignment", "Scenario alignment", "share of clear/adverse pairs [%]", 100.0),
    )
    cards = []
    for key, name, unit, factor in charts:
        bars = [
            Bar(
                "ours" if arm == "served" else "default",
                _CONTROLS.get(arm, arm),
                factor * score[key],
                None,
                f"{score['decisions']} decisions",
            )
            for arm, score in scores.items()
        ]
        chart = interval_bars([("", bars)], 100.0, unit, f"{name}, served bundle and controls")
        cards.append(f"<div><h4>{name}</h4>{chart}</div>")
    served = evaluation["served"]
    shares = served["scenario_alignment_by_condition"].items()
    by_condition = ", ".join(f"{c} {100 * share:.1f} %" for c, share in shares)
    return (
        f'<div class="charts three">{"".join(cards)}</div>'
        f'<p class="note">{served["decisions"]:,} decisions on held-out sentences and unseen '
        f"synthetic frames, {served['pairs']:,} clear/adverse pairs. Scenario alignment of the "
        f"served bundle by condition: {by_condition}. A control that knows nothing sets the bar: "
        "a constant matrix aligns well above zero because the styles' ranges overlap.</p>"
    )


def loop_rows(closed_loop: Mapping[str, Any]) -> dict[Manoeuvre, dict[str, Numbers]]:
    """Rows of Table 1 of the drives with a model in the loop; empty where no metrics were kept."""
    names = {"constant": "baseline", "text": "text", "served": "ours", "oracle": "oracle"}
    rows: dict[Manoeuvre, dict[str, Numbers]] = {
        manoeuvre: {
            name: {**arms[arm]["metrics"], "driving_score": arms[arm]["score"]}
            for arm, name in names.items()
            if arms.get(arm, {}).get("metrics")
        }
        for manoeuvre, arms in closed_loop["scores"].items()
    }
    return rows if all("ours" in arms for arms in rows.values()) else {}


def text_way(evaluation: Mapping[str, Any], profile: Mapping[str, Any]) -> str:
    """What the matrix written as text costs and gives, decision by decision."""
    text, ms = evaluation["text"], profile["as_text_ms"]
    return (
        f'<p class="note">The matrix as text, the paper\'s way: over '
        f"{text['decisions']} decisions {100 * text['well_formed']:.1f} % are well formed and "
        f"align {text['command_alignment_text']:.1f}, the bins of the same decisions "
        f"{text['command_alignment_bins']:.1f}; decoding takes {ms['p50']:.1f} ms in the median, "
        f"one pass {profile['parallel_ms']['p50']:.1f} ms.</p>"
    )


def closed_loop(result: Mapping[str, Any]) -> str:
    """Driving scores with the model in the loop, beside its controls, and the targets."""
    cards = []
    for manoeuvre, arms in result["scores"].items():
        bars = [
            Bar(
                "ours" if arm == "served" else "default",
                "oracle" if arm == "oracle" else _CONTROLS.get(arm, title(arm).lower()),
                row["score"],
                None,
                f"{row['over_constant']:+.2f} over constant, standard error "
                f"{row['standard_error']:.2f}, {row['drives']} drives, {row['failed']} failed",
            )
            for arm, row in arms.items()
        ]
        name = title(manoeuvre)
        chart = interval_bars([("", bars)], 100.0, "driving score (Eq. 6), 0 to 100", name)
        served = arms["served"]
        cards.append(
            f'<div><h4>{name}</h4>{chart}<p class="note">Served over constant '
            f"{served['over_constant']:+.2f} ± {served['standard_error']:.2f} (standard error), "
            f"{served['drives']} drives, {served['failed']} failed.</p></div>"
        )
    targets = "".join(
        f'<tr><th scope="row">{escape(name)}</th>'
        f"<td>{'reached' if target['reached'] else 'NOT reached'}</td></tr>"
        for name, target in result["targets"].items()
    )
    return (
        "<h3>With the served bundle in the loop</h3>"
        f'<div class="charts three">{"".join(cards)}</div>'
        + table(
            "Targets of closed-loop driving.",
            "<tr><th>target</th><th></th></tr>",
            targets,
            words=True,
        )
    )


def takeovers(closed_loop: Mapping[str, Any]) -> str:
    """Takeover rates by directness level with their intervals."""
    studies = closed_loop["takeovers"]
    arms: dict[str, Any] = dict(studies["served"]["arms"])
    arms |= {f"ideal_{arm}": c for arm, c in studies["ideal"]["arms"].items() if arm != "baseline"}
    highest = max(cell["interval"][1] for levels in arms.values() for cell in levels.values())
    limit = 10.0 * math.ceil(10.0 * highest)
    cards = []
    for level in ("all", *LEVELS):
        name = "All levels" if level == "all" else f"Level {level}"
        bars = [_takeover_bar(arm, levels[level]) for arm, levels in arms.items()]
        chart = interval_bars([("", bars)], limit, "takeovers [% of trips], 95 % interval", name)
        cards.append(f"<div><h4>{name}</h4>{chart}</div>")
    return (
        f'<div class="charts">{"".join(cards)}</div>'
        '<p class="note">Simulated passengers under stated priors; no claim about people. Level I '
        "says it explicitly, II hints strongly, III mildly. The ideal policy understands every "
        "word and complaint. Intervals are Clopper-Pearson and treat trips as independent, which "
        "trips of one passenger are not.</p>"
    )


def _takeover_bar(arm: str, cell: Mapping[str, Any]) -> Bar:
    low, high = cell["interval"]
    return Bar(
        "ours" if arm in ("without_memory", "with_memory") else "default",
        _TAKEOVER_ARMS.get(arm, title(arm)),
        100.0 * cell["rate"],
        (100.0 * low, 100.0 * high),
        f"{cell['takeovers']} of {cell['trips']} trips",
    )


def latency(profile: Mapping[str, Any]) -> str:
    """Quantiles cold and warm, stages, and the machine that they were measured on."""
    rows = (
        ("cold_ms", "cold: JPEG and words to gated matrix"),
        ("warm_ms", "warm: words to gated matrix, frame prefilled"),
        ("parallel_ms", "decoding: six bins in one pass"),
        ("as_text_ms", "decoding: matrix as text, the paper's way"),
        ("full_gate_ms", "a served car's gate: verified envelope and rollout check"),
    )
    body = "".join(
        f'<tr><th scope="row">{name}</th>'
        + "".join(f"<td>{profile[key][q]:.1f}</td>" for q in ("p50", "p90", "p99"))
        + f"<td>{profile[key]['requests']}</td></tr>"
        for key, name in rows
    )
    hardware = profile["hardware"]
    caption = (
        f"Milliseconds on {hardware['cpu']}, {hardware['threads']} thread of "
        f"{hardware['cores']} cores, {hardware['device']}."
    )
    head = "<tr><th></th><th>p50</th><th>p90</th><th>p99</th><th>requests</th></tr>"
    stages: Mapping[str, float] = profile["stages_p50_ms"]
    whole = sum(stages.values())
    parts = "".join(
        f'<span style="flex:{ms / whole:.4f}" title="{escape(name)} {ms:.2f} ms"></span>'
        for name, ms in stages.items()
    )
    words = ", ".join(f"{name} {ms:.2f}" for name, ms in stages.items())
    return (
        table(escape(caption), head, body)
        + f'<div class="stack" role="img" aria-label="Stages of a cold decision">{parts}</div>'
        + f'<p class="note">Stages of a cold decision, median milliseconds, left to right: '
        f"{escape(words)}.</p>"
    )


def sweep(result: Mapping[str, Any]) -> str:
    """Unsafe runs by scenario and condition, and by style with intervals."""
    cells: Sequence[Mapping[str, Any]] = result["cells"]
    conditions = [c for c in CONDITIONS if any(cell["condition"] == c for cell in cells)]
    head = "<tr><th></th>" + "".join(f"<th>{c}</th>" for c in conditions) + "</tr>"
    body = []
    for scenario in dict.fromkeys(c["scenario"] for c in cells):
        row = f'<tr><th scope="row">{title(scenario)}</th>'
        for condition in conditions:
            chosen = [c for c in cells if (c["scenario"], c["condition"]) == (scenario, condition)]
            unsafe, runs = (sum(c[key] for c in chosen) for key in ("unsafe", "runs"))
            share = min(math.sqrt(unsafe / runs), 0.75)
            row += f'<td class="cell" style="--share:{share:.3f}">{unsafe} / {runs}</td>'
        body.append(row + "</tr>")
    bars = [
        Bar(
            style,
            style,
            100.0 * pool["unsafe"] / pool["runs"],
            (100.0 * pool["interval"][0], 100.0 * pool["interval"][1]),
            f"{pool['unsafe']} of {pool['runs']} runs",
        )
        for style, pool in result["unsafe_by_style"].items()
    ]
    highest = 100.0 * max(p["interval"][1] for p in result["unsafe_by_style"].values())
    limit = next(x for x in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0) if highest <= x)
    chart = interval_bars([("", bars)], limit, "unsafe runs [%], 95 % interval", "Unsafe by style")
    rate = result["rate"]
    return (
        table("Unsafe runs / runs, all styles together", head, "".join(body))
        + f'<div class="chart-card">{chart}</div>'
        + f'<p class="note">{rate["runs"]:,} runs of matrices drawn from the whole ranges of the '
        "styles (no model, no gate) on cars with spread mass, tyres and delays. Unsafe: left the "
        f"lane, hit something or lost control. {rate['runs_per_s']:,} runs a second "
        f"({rate['backend']}), {rate['runs_per_cpu_s']:,} per CPU-second.</p>"
    )
