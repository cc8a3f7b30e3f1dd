"""Proposals from frames: what is drawn for a picture, what is left out, and how a run goes on."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from data import proposals
from data import propose as stage
from data.annotate import draw_matrix, shift_for_care
from data.instructions import Speech
from data.proposals import Proposal, read_proposals
from data.propose import propose
from data.proposer import ProposeConfig, split_of
from data.sources.seen import Facts
from ridetune.camera.render import render
from ridetune.camera.scene import Scene
from ridetune.codec import MatrixCodec
from ridetune.config import load_config
from ridetune.matrix import STYLES, Ranges, ki_limit
from ridetune.sample import CONDITIONS, Condition
from ridetune.workers import Backend

RANGES = Ranges.load(Path("configs/ranges.yaml"))


def config_of(tmp_path: Path, **changes: object) -> ProposeConfig:
    config = load_config(ProposeConfig, Path("configs/propose.yaml"))
    return replace(config, out=tmp_path / "out", root=tmp_path / "frames", **changes)  # type: ignore[arg-type]


def photograph(path: Path, condition: Condition, seed: int) -> None:
    """A picture that no other one looks like."""
    scene = Scene(condition, "straight", "near", "light", "city", seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), cv2.cvtColor(render(scene, 320, 180), cv2.COLOR_RGB2BGR))


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    folder = tmp_path / "frames"
    for number in range(4):
        photograph(folder / "sunny" / f"{number}.png", "sunny", 10 + number)
    photograph(folder / "rain" / "wet.png", "rain", 3)
    return folder


def parts_of(config: ProposeConfig) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(config.out.glob("part-*"))}


def proposals_of(config: ProposeConfig) -> list[Proposal]:
    propose(config)
    return list(read_proposals(config.out))


@pytest.mark.usefixtures("frames")
def test_every_picture_gets_one_proposal_of_each_style(tmp_path: Path) -> None:
    made = proposals_of(config_of(tmp_path, test_share=0.0))
    by_picture: dict[str, list[str]] = {}
    for proposal in made:
        by_picture.setdefault(proposal.frame_name, []).append(proposal.sample.style)
    assert all(sorted(styles) == sorted(STYLES) for styles in by_picture.values())
    # A clear picture has one variant, the wet one none.
    assert len(by_picture) == 4 * 2 + 1
    assert len({proposal.proposal_id for proposal in made}) == len(made)


@pytest.mark.usefixtures("frames")
def test_a_clear_test_scene_is_asked_the_same_in_every_condition(tmp_path: Path) -> None:
    made = proposals_of(config_of(tmp_path, test_share=1.0, calibration_share=0.0))
    scene = [p.sample for p in made if p.sample.scene_id == "images/sunny/0.png"]
    assert {s.condition for s in scene} == set(CONDITIONS)
    said = {c: {s.instruction for s in scene if s.condition == c} for c in CONDITIONS}
    assert all(words == said["sunny"] for words in said.values())
    assert {s.split for s in scene} == {"test"}


@pytest.mark.usefixtures("frames")
def test_the_same_config_proposes_the_same(tmp_path: Path) -> None:
    first = proposals_of(config_of(tmp_path))
    again = proposals_of(replace(config_of(tmp_path), out=tmp_path / "again"))
    assert first == again


def test_no_frame_is_lost_between_the_parts(tmp_path: Path) -> None:
    made = proposals_of(
        config_of(tmp_path, source="synthetic", limit=7, frames_per_part=2, near_bits=0)
    )
    assert len({p.sample.scene_id for p in made}) == 7
    assert len(list((tmp_path / "out").glob("part-*.parquet"))) == 4


@pytest.mark.usefixtures("frames")
def test_a_stopped_run_goes_on_and_makes_no_part_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = proposals_of(replace(config_of(tmp_path, frames_per_part=2), out=tmp_path / "whole"))
    config = config_of(tmp_path, frames_per_part=2)
    write = proposals.write_whole
    written: list[int] = []

    def stop_after_one(content: bytes, path: Path) -> None:
        if written:
            raise KeyboardInterrupt
        write(content, path)
        written.append(path.stat().st_mtime_ns)

    monkeypatch.setattr(stage, "write_whole", stop_after_one)
    with pytest.raises(KeyboardInterrupt):
        propose(config)
    monkeypatch.setattr(stage, "write_whole", write)
    assert proposals_of(config) == whole
    assert (config.out / "part-00000.parquet").stat().st_mtime_ns == written[0]


@pytest.mark.usefixtures("frames")
@pytest.mark.parametrize("backend", ["joblib", "ray"])
def test_parts_are_the_same_wherever_they_are_made(tmp_path: Path, backend: Backend) -> None:
    if backend == "ray":
        pytest.importorskip("ray", reason="the extra `scale` is not installed")
    here = config_of(tmp_path, frames_per_part=2)
    there = replace(here, out=tmp_path / backend, backend=backend, workers=2)
    propose(here)
    propose(there)
    assert len(parts_of(here)) == 3
    assert parts_of(there) == parts_of(here)


@pytest.mark.usefixtures("frames")
def test_a_run_may_go_on_elsewhere(tmp_path: Path) -> None:
    config = config_of(tmp_path, frames_per_part=2)
    propose(config)
    whole = parts_of(config)
    (config.out / "part-00001.parquet").unlink()
    propose(replace(config, backend="joblib", workers=2))
    assert parts_of(config) == whole


@pytest.mark.usefixtures("frames")
def test_every_language_is_asked_for(tmp_path: Path) -> None:
    speech = Speech(("de", "zh"), grammar=0.2, own=None, own_share=0.0)
    made = proposals_of(config_of(tmp_path, speech=speech, test_share=0.0))
    assert {p.sample.language for p in made} == {"de", "zh"}
    assert all(p.sample.explanation.startswith("because ") for p in made)


@pytest.mark.usefixtures("frames")
def test_own_commands_are_drawn_beside_the_bank(tmp_path: Path) -> None:
    csv_file = tmp_path / "mine.csv"
    rows = [f"Zo{w}a bu{w}e {style[:4]}{w},{style},II" for w in "bcdfghjkl" for style in STYLES]
    csv_file.write_text("text,style,level\n" + "\n".join(rows) + "\n")
    speech = Speech(("en",), grammar=0.0, own=csv_file, own_share=1.0)
    made = proposals_of(config_of(tmp_path, speech=speech, test_share=0.0))
    assert {p.sample.phrase_id.split("/")[0] for p in made} == {"own_mine"}


@pytest.mark.usefixtures("frames")
def test_a_folder_of_another_config_is_refused(tmp_path: Path) -> None:
    propose(config_of(tmp_path))
    with pytest.raises(ValueError, match="holds results of another seed"):
        propose(config_of(tmp_path, seed=8))


def test_what_is_left_out_is_listed_with_its_reason(tmp_path: Path, frames: Path) -> None:
    (frames / "sunny" / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no picture")
    picture = cv2.imread(str(frames / "sunny" / "0.png"))
    assert picture is not None
    cv2.imwrite(str(frames / "sunny" / "0-again.jpg"), picture)
    photograph(frames / "somewhere" / "nice.png", "fog", 77)
    propose(config_of(tmp_path))
    with (tmp_path / "out" / "skipped.csv").open() as file:
        reasons = {row["frame"]: row["reason"] for row in csv.DictReader(file)}
    assert "damaged" in reasons["sunny/broken.jpg"] or "readable" in reasons["sunny/broken.jpg"]
    assert "looks like" in reasons["sunny/0.png"]
    assert "condition is not known" in reasons["somewhere/nice.png"]
    assert len(reasons) == 3


def test_a_source_without_a_usable_frame_says_why(tmp_path: Path) -> None:
    photograph(tmp_path / "frames" / "nice.png", "fog", 1)
    with pytest.raises(ValueError, match="condition is not known"):
        propose(config_of(tmp_path))


def test_a_source_needs_its_root_and_the_synthetic_camera_its_limit(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="root="):
        propose(replace(config_of(tmp_path), root=None))
    with pytest.raises(ValueError, match="limit="):
        propose(config_of(tmp_path / "b", source="synthetic"))


def test_a_video_needs_to_be_told_the_weather(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="condition="):
        propose(config_of(tmp_path, source="video"))


def test_a_run_that_made_nothing_may_be_corrected(tmp_path: Path) -> None:
    photograph(tmp_path / "frames" / "nice.png", "fog", 1)
    with pytest.raises(ValueError, match="not known"):
        propose(config_of(tmp_path))
    photograph(tmp_path / "frames" / "fog" / "nice.png", "fog", 2)
    propose(config_of(tmp_path, seed=9))


def test_the_synthetic_camera_knows_everything_of_its_scenes(tmp_path: Path) -> None:
    made = proposals_of(config_of(tmp_path, source="synthetic", limit=4, variants_per_frame=0))
    assert {p.confidence for p in made} == {1.0}


def test_no_scene_stands_on_two_sides() -> None:
    splits = [split_of(f"scene-{n}", 0.2, 0.1) for n in range(2000)]
    assert 0.16 < splits.count("test") / 2000 < 0.24
    assert 0.07 < splits.count("calibration") / 2000 < 0.13
    assert split_of("scene-7", 0.2, 0.1) == split_of("scene-7", 0.2, 0.1)


def test_what_asks_for_care_makes_the_label_more_conservative() -> None:
    calm = Facts(condition="rain", dark=True, lead="near", traffic="dense")
    plain = Facts(condition="rain", dark=False, lead="none", traffic="light")
    assert shift_for_care(plain, 10.0) == 0.0
    assert shift_for_care(calm, 10.0) < shift_for_care(Facts(condition="rain"), 30.0) < 0.0
    # Dark is no more than what night itself says.
    assert shift_for_care(Facts(condition="night", dark=True), None) == 0.0
    codec = MatrixCodec(RANGES)
    for style in STYLES:
        drawn = [
            draw_matrix(style, "rain", None, codec, np.random.default_rng(1), care=care)
            for care in (0.0, -0.2)
        ]
        assert drawn[1].kp <= drawn[0].kp
        assert all(m.ki <= ki_limit(m.kp) + 1e-12 for m in drawn)
