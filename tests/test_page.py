"""The page: whole without a network, honest about what is missing, and drawn from the numbers."""

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from evaluate import sections
from evaluate.animation import animate
from evaluate.curves import _beside, choose, curves
from evaluate.driving_score import MANOEUVRES, METRICS, DrivingScoreConfig
from evaluate.page import PageConfig, read_result, write_page
from evaluate.plots import Bar, Line, interval_bars, line_chart, ticks
from evaluate.style_drives import (
    DEFAULT,
    FRAME_S,
    NAMES,
    StyleDrive,
    drive_styles,
    style_matrix,
    table_rows,
)
from evaluate.tables import paper_table, table_1
from ridetune.alignment import command_alignment, style_of
from ridetune.codec import MatrixCodec
from ridetune.config import load_config
from ridetune.matrix import STYLES, Ranges, ki_limit
from ridetune.sample import CONDITIONS, LEVELS
from ridetune.sim.scenarios import SCENARIOS
from ridetune.stage import run_stage
from tests.shipped_car import RANGES, VEHICLE

CODEC = MatrixCodec(RANGES)
# Tags that stand alone in HTML.
VOID = {"meta", "input", "br", "link", "img", "hr"}
SCORES = {
    "command_alignment": 86.3,
    "style_accuracy": 0.75,
    "scenario_alignment": 0.98,
    "scenario_alignment_by_condition": {"rain": 0.9, "fog": 0.91, "snow": 0.92, "night": 0.93},
    "decisions": 3600,
    "pairs": 2880,
}


@pytest.fixture(scope="module")
def drives() -> dict[Any, dict[str, StyleDrive]]:
    return drive_styles(VEHICLE, CODEC, "sunny", 0)


class Reader(HTMLParser):
    """Every start and end tag in balance; addresses and visible text kept."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "srcset", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        return None

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.text += data


def read(html: str) -> Reader:
    reader = Reader()
    reader.feed(html)
    reader.close()
    assert not reader.open
    return reader


def count(takeovers: int, trips: int) -> dict[str, Any]:
    rate = takeovers / trips
    return {"takeovers": takeovers, "trips": trips, "rate": rate, "interval": [rate / 2, rate * 2]}


def evaluation() -> dict[str, Any]:
    controls = ("constant", "random", "shuffled_frames", "shuffled_instructions", "oracle")
    text = {
        "decisions": 300,
        "well_formed": 1.0,
        "command_alignment_text": 85.11,
        "command_alignment_bins": 85.53,
    }
    return {"text": text, "served": SCORES, "controls": dict.fromkeys(controls, SCORES)}


def profile() -> dict[str, Any]:
    row = {"p50": 38.13, "p90": 54.16, "p99": 71.07, "max": 78.1, "requests": 300}
    return {
        **dict.fromkeys(("cold_ms", "warm_ms", "parallel_ms", "as_text_ms", "full_gate_ms"), row),
        "stages_p50_ms": {"image": 24.7, "decide": 5.2},
        "hardware": {"cpu": "Abacus <1>", "cores": 2, "threads": 1, "device": "CPU"},
    }


def closed_loop(drives: dict[Any, dict[str, StyleDrive]]) -> dict[str, Any]:
    row = {
        "score": 81.25,
        "over_constant": 3.5,
        "standard_error": 0.4,
        "drives": 45,
        "failed": 0,
    }
    levels = {level: count(3, 30) for level in ("all", *LEVELS)}
    arms = dict.fromkeys(("baseline", "without_memory", "with_memory"), levels)
    return {
        "scores": {m: {"constant": row, "served": row, "shuffled": row} for m in MANOEUVRES},
        "targets": {"the moon": {"reached": False}, "the road": {"reached": True}},
        "takeovers": {"served": {"arms": arms}, "ideal": {"arms": arms}},
        "trajectories": [
            {
                "manoeuvre": manoeuvre,
                "style": style,
                "instruction": f"<b>{style}</b> please",
                "period_s": FRAME_S,
                "signals": {
                    name: [None if math.isnan(x) else x for x in values.tolist()]
                    for name, values in drives[manoeuvre][style].signals.items()
                },
            }
            for manoeuvre in MANOEUVRES
            for style in STYLES
        ],
    }


def sweep_result() -> dict[str, Any]:
    cells = [
        {"scenario": "left_turn", "condition": c, "style": s, "runs": 40, "unsafe": c == "snow"}
        for c in CONDITIONS
        for s in STYLES
    ]
    pool = {"runs": 200, "unsafe": 1, "interval": [0.0001, 0.03]}
    rate = {"runs": 600, "runs_per_s": 500.0, "runs_per_cpu_s": 250.0, "backend": "joblib"}
    return {"cells": cells, "unsafe_by_style": dict.fromkeys(STYLES, pool), "rate": rate}


# --- what is driven for the page ---


def test_style_matrices_are_of_their_style_and_calmer_in_bad_weather(
    ranges: Ranges, codec: MatrixCodec
) -> None:
    for style in STYLES:
        clear = style_matrix(style, codec, "sunny")
        assert style_of(clear, ranges) == style
        assert command_alignment(clear, style, ranges) > 99
        assert clear.ki <= ki_limit(clear.kp)
        snow = style_matrix(style, codec, "snow")
        assert (snow.kp, -snow.ws) < (clear.kp, -clear.ws)


def test_drives_of_the_page_are_whole_and_their_styles_in_order(
    drives: dict[Any, dict[str, StyleDrive]],
) -> None:
    assert list(drives) == list(MANOEUVRES)
    assert all(
        d.status in ("finished", "stopped") for cars in drives.values() for d in cars.values()
    )
    rise = [drives["acceleration"][s].metrics.t90_s or 0.0 for s in STYLES]
    assert rise[0] > rise[1] > rise[2] > 0
    peaks = [drives["lane_change"][s].metrics.felt.peak_acceleration for s in STYLES]
    assert peaks[0] < peaks[1] < peaks[2]


def test_rows_of_table_1_count_their_drives_and_the_oracle_aligns(root: Path) -> None:
    score = load_config(DrivingScoreConfig, root / "configs/driving_score.yaml")
    table = table_rows(VEHICLE, CODEC, score, range(1))
    for rows in table.values():
        assert rows["baseline"]["driven"] == rows["oracle"]["driven"] == 15
        assert rows["baseline"]["scenario_alignment"] == 0.0
        assert rows["oracle"]["scenario_alignment"] == 100.0
        assert rows["oracle"]["command_alignment"] > rows["baseline"]["command_alignment"] + 10
        assert set(METRICS) <= set(rows["oracle"])
    assert table["acceleration"]["baseline"]["mean_ax"] == pytest.approx(0.78, rel=0.15)


# --- charts ---


def test_ticks_are_round_few_and_inside() -> None:
    for low, high in ((0.0, 18.0), (-0.031, 0.047), (12.0, 51.3), (0.0, 100.0), (-250.0, 10.0)):
        found = ticks(low, high)
        assert 3 <= len(found) <= 7
        assert low - 1e-9 <= found[0] and found[-1] <= high + 1e-9


def test_a_line_runs_through_its_points_and_breaks_where_nothing_is() -> None:
    x, y = np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.0, 10.0, np.nan, 5.0])
    chart = line_chart([Line("default", "a & b", x, y)], "time [s]", "speed <km/h>", 'a "chart"')
    svg = ElementTree.fromstring(chart)  # well formed, names escaped
    path = next(p.get("d", "") for p in svg.iter("path"))
    assert [part[0] for part in re.findall(r"[ML][^ML]+", path)] == ["M", "L", "M"]
    points = [tuple(map(float, p.split())) for p in re.findall(r"[ML]([\d. ]+)", path)]
    assert points[0][1] > points[2][1] > points[1][1]  # 10 stands highest
    assert points[0][0] < points[1][0] < points[2][0]
    assert {"time [s]", "speed <km/h>"} <= {t.text for t in svg.iter("text")}


def test_noise_does_not_fill_a_chart() -> None:
    noise = Line("moderate", "", np.arange(50.0), 50.0 + 0.01 * np.sin(np.arange(50.0)))
    heights = []
    for least in (0.0, 10.0):
        path = re.search(r' d="([^"]+)"', line_chart([noise], "x", "y", "", least=least))
        assert path is not None
        heights.append(np.ptp([float(p) for p in re.findall(r" ([\d.]+)", path[1])]))
    assert heights[0] > 100 > 1 > heights[1]


def test_distance_from_the_path_is_positive_to_its_left() -> None:
    path = SCENARIOS["left_turn"].waypoints()
    side = np.array([-0.5, 0.0, 0.5])
    straight = _beside(np.full(3, 20.03), side, path)
    np.testing.assert_allclose(straight, side, atol=1e-9)
    # After the turn the road runs along y; its left is towards smaller x.
    after = _beside(40.0 + 23.89 - side, np.full(3, 60.0), path)
    np.testing.assert_allclose(after, side, atol=0.01)
    assert np.isnan(_beside(np.array([np.nan]), np.array([np.nan]), path)).all()


def test_bars_are_as_long_as_their_values_and_whiskers_span_their_interval() -> None:
    bars = [Bar("ours", "a", 20.0, (10.0, 40.0), ""), Bar("default", "b", 40.0, None, "")]
    svg = ElementTree.fromstring(interval_bars([("", bars)], 100.0, "%", "bars"))
    short, long = (float(r.get("width", "0")) for r in svg.iter("rect"))
    assert long == pytest.approx(2 * short, abs=0.2)
    (whisker,) = (p.get("d", "") for p in svg.iter("path"))
    start, end = (float(v) for v in re.findall(r"M([\d.]+) [\d.]+H([\d.]+)", whisker)[0])
    assert end - start == pytest.approx(1.5 * short, abs=0.3)


# --- animations and curves ---


def test_the_animation_follows_the_drive(drives: dict[Any, dict[str, StyleDrive]]) -> None:
    signals = {name: drive.signals for name, drive in drives["lane_change"].items()}
    shown = animate("lane_change", signals, VEHICLE)
    assert [car["style"] for car in shown["cars"]] == list(STYLES)
    for car in shown["cars"]:
        x = [pose[0] for pose in car["poses"]]
        assert x == sorted(x)
        assert car["poses"][-1][1] == pytest.approx(3.5, abs=0.3)  # in the left lane
    (lead,) = shown["others"]
    assert len(lead["at"]) == len(shown["cars"][0]["poses"])
    trajectory = drives["lane_change"]["moderate"].trajectory
    moment = round(20 * FRAME_S / trajectory.period_s)
    assert shown["cars"][1]["poses"][20][0] == pytest.approx(trajectory["x_m"][moment], abs=0.001)


def test_served_trajectories_take_the_place_of_the_middles_with_their_words(
    drives: dict[Any, dict[str, StyleDrive]],
) -> None:
    given = closed_loop(drives)["trajectories"]
    given[0]["signals"]["y_m"] = [7.0] * len(given[0]["signals"]["x_m"])
    shown = choose(drives, given)
    assert shown.words is not None
    place = given[0]["manoeuvre"], given[0]["style"]
    assert set(shown.signals[place[0]][place[1]]["y_m"]) == {7.0}
    assert shown.signals["left_turn"][DEFAULT]["y_m"].shape == (150,)
    assert choose(drives, given[1:]).words is None  # not all nine
    given[0]["period_s"] = 0.5
    with pytest.raises(ValueError, match="closed_loop"):
        choose(drives, given)


def test_each_manoeuvre_shows_four_charts_with_every_line(
    drives: dict[Any, dict[str, StyleDrive]],
) -> None:
    html = curves(choose(drives, None))
    read(html)
    assert html.count("<svg") == 4 * len(MANOEUVRES)
    for name in NAMES:
        assert html.count(f'class="line style-{name}"') == 4 * len(MANOEUVRES)


# --- tables and sections ---


def test_the_papers_numbers_stand_in_a_table_of_their_own() -> None:
    text = read(paper_table()).text
    assert "real car" in text and "No number of ours" in text and "76.5" in text
    ours = table_1({"left_turn": {"baseline": {"ttc_s": math.inf, "mean_ay": 0.129}}}, "ours")
    assert "real car" not in ours
    cells = re.findall(r"<td>([^<]+)</td>", ours)
    assert cells[0] == "\N{EN DASH}" and cells[5] == "1.29"


def test_takeovers_show_counts_and_say_that_passengers_are_simulated(
    drives: dict[Any, dict[str, StyleDrive]],
) -> None:
    html = sections.takeovers(closed_loop(drives))
    assert "Simulated passengers" in read(html).text
    assert html.count("3 of 30 trips") == 4 * (3 + 2)  # levels, arms of both studies


def test_targets_that_are_not_reached_are_said(drives: dict[Any, dict[str, StyleDrive]]) -> None:
    text = read(sections.closed_loop(closed_loop(drives))).text
    assert "the moonNOT reached" in text and "the roadreached" in text


def test_rows_with_a_model_in_the_loop_make_table_1_where_their_metrics_are_kept(
    drives: dict[Any, dict[str, StyleDrive]],
) -> None:
    result = closed_loop(drives)
    assert sections.loop_rows(result) == {}
    for arms in result["scores"].values():
        for arm in arms:
            arms[arm] = {**arms[arm], "metrics": dict.fromkeys(METRICS, 1.0)}
    rows = sections.loop_rows(result)
    assert list(rows) == list(MANOEUVRES)
    assert set(rows["left_turn"]) == {"baseline", "ours"}
    assert rows["left_turn"]["ours"]["driving_score"] == 81.25


def test_unsafe_runs_are_pooled_over_the_styles() -> None:
    html = sections.sweep(sweep_result())
    assert re.findall(r"(\d+ / \d+)</td>", html) == ["0 / 120"] * 3 + ["3 / 120"] + ["0 / 120"]
    read(html)


# --- the whole page ---


def build(root: Path, folder: Path, files: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    for name in ("evaluation", "profile", "closed_loop", "sweep"):
        if name in files:
            (folder / f"{name}.json").write_text(json.dumps(files[name]))
    overrides = [
        f"{n}={folder / n}.json" for n in ("evaluation", "profile", "closed_loop", "sweep")
    ]
    config = load_config(
        PageConfig,
        root / "configs/page.yaml",
        [*overrides, f"out={folder / 'page/report.html'}", "table_seeds=1"],
    )
    write_page(config)
    return config.out.read_text(), json.loads(
        config.out.with_suffix(".json").read_text(), parse_constant=pytest.fail
    )


def test_a_page_without_results_names_the_command_for_each(root: Path, tmp_path: Path) -> None:
    html, result = build(root, tmp_path, {})
    page = read(html)
    for command in ("make bench", "make sweep", "evaluate.closed_loop"):
        assert command in page.text
    assert set(result["inputs"].values()) == {None}
    assert "no model takes part" in page.text


def test_a_page_with_every_result_is_whole_small_and_needs_no_network(
    root: Path, tmp_path: Path, drives: dict[Any, dict[str, StyleDrive]]
) -> None:
    files = {
        "evaluation": evaluation(),
        "profile": profile(),
        "closed_loop": closed_loop(drives),
        "sweep": sweep_result(),
    }
    html, result = build(root, tmp_path, files)
    page = read(html)
    assert not page.addresses
    assert not re.search(r"https?://|url\(|@import|fetch\(", html)
    assert len(html) < 3_000_000
    assert "not measured yet" not in page.text and "$" not in page.text
    assert "Abacus <1>" in page.text and "<b>moderate</b> please" in page.text
    assert "Simulation" in page.text
    data = re.search(r'<script type="application/json" id="drives">(.*?)</script>', html, re.S)
    assert data is not None
    assert set(json.loads(data[1])) == set(MANOEUVRES)
    assert all(result["inputs"].values())
    assert result["evaluation"] == files["evaluation"]
    assert "paper" not in json.dumps(result["table_1"])


def test_broken_results_and_a_wrong_name_are_refused(root: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.json").write_text('{"served": ')
    with pytest.raises(ValueError, match="make it again"):
        read_result(tmp_path / "broken.json")
    (tmp_path / "list.json").write_text("[1]")
    with pytest.raises(ValueError, match="one JSON object"):
        read_result(tmp_path / "list.json")
    with pytest.raises(ValueError, match=r"\.html"):
        load_config(PageConfig, root / "configs/page.yaml", ["out=page.txt"])


def test_the_command_ends_with_one_json_line(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    yaml = str(root / "configs/page.yaml")
    nothing = [f"{n}={tmp_path / n}" for n in ("evaluation", "profile", "closed_loop", "sweep")]
    out = tmp_path / "report.html"
    arguments = ["page", "--config", yaml, *nothing, f"out={out}", "table_seeds=1"]
    monkeypatch.setattr("sys.argv", arguments)
    assert run_stage(PageConfig, yaml, write_page, None) == 0
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last["page"] == str(out)
    assert last["missing"] == ["evaluation", "profile", "closed_loop", "sweep"]
