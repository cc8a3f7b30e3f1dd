"""How a stage ends: a whole folder or none, a manifest, an exit code and one clear sentence."""

import errno
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from ridetune.stage import (
    explain_os_error,
    hash_file,
    new_folder,
    run_stage,
    write_manifest,
)


@dataclass(frozen=True)
class Config:
    """A stage's config."""

    seed: int


def test_a_new_folder_appears_whole(tmp_path: Path) -> None:
    out = tmp_path / "deep/run"
    with new_folder(out) as folder:
        (folder / "a.txt").write_text("a")
        assert not out.exists()
    assert [p.name for p in out.iterdir()] == ["a.txt"]
    assert [p.name for p in out.parent.iterdir()] == ["run"]


def _fail(out: Path, error: BaseException) -> None:
    with new_folder(out) as folder:
        (folder / "half.txt").write_text("half")
        raise error


@pytest.mark.parametrize("error", [RuntimeError("x"), KeyboardInterrupt(), OSError(28, "full")])
def test_an_exception_leaves_nothing_and_keeps_the_older_folder(
    tmp_path: Path, error: BaseException
) -> None:
    out = tmp_path / "run"
    with pytest.raises(type(error)):
        _fail(out, error)
    assert list(tmp_path.iterdir()) == []
    with new_folder(out) as folder:
        (folder / "old.txt").write_text("old")
    with pytest.raises(type(error)):
        _fail(out, error)
    assert [p.name for p in out.iterdir()] == ["old.txt"]


def test_an_older_folder_is_replaced_and_a_killed_runs_rest_is_removed(tmp_path: Path) -> None:
    out = tmp_path / "run"
    for name in ("first", "second"):
        rest = tmp_path / ".run.partial"
        rest.mkdir()
        (rest / "rest.txt").write_text("of a killed run")
        with new_folder(out) as folder:
            (folder / name).write_text(name)
    assert [p.name for p in out.iterdir()] == ["second"]


def test_a_folder_that_holds_more_than_a_run_is_never_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside = tmp_path / "project/src"
    inside.mkdir(parents=True)
    monkeypatch.chdir(inside)
    for out in (tmp_path, inside, Path("..").resolve(), Path.home(), Path("/")):
        with pytest.raises(ValueError, match="holds more than a run"), new_folder(out):
            pass
    (tmp_path / "file").write_text("precious")
    with pytest.raises(ValueError, match="is a file"), new_folder(tmp_path / "file"):
        pass
    assert (tmp_path / "file").read_text() == "precious" and inside.is_dir()


def test_the_manifest_names_versions_memory_and_the_hash_of_every_file(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/a.txt").write_text("abc")
    write_manifest(tmp_path, seconds=1.234, facts={"samples": 3})
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["samples"] == 3 and manifest["seconds"] == 1.2
    assert manifest["peak_rss_mb"] > 1
    assert "python" in manifest["versions"] and "numpy" in manifest["versions"]
    assert manifest["files"] == {"sub/a.txt": hash_file(tmp_path / "sub/a.txt")}
    assert hash_file(tmp_path / "sub/a.txt").startswith("ba7816bf8f01cfea")


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.ENOSPC, "No space left", "runs/x"), "the disk is full at runs/x; free"),
        (OSError(errno.EACCES, "Permission denied", "/x"), "not allowed to write at /x; choose"),
        (OSError(errno.EROFS, "Read-only"), "not allowed to write; choose"),
        (OSError(errno.EIO, "Input/output error", "/x"), "Input/output error at /x"),
        (OSError("odd"), "odd"),
    ],
)
def test_an_operating_system_error_names_the_remedy(error: OSError, message: str) -> None:
    assert explain_os_error(error).startswith(message)


def _run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Exception | None, *more: str
) -> int:
    path = tmp_path / "stage.yaml"
    path.write_text("seed: 3\n")

    def work(config: Config) -> None:
        if error:
            raise error
        print(f"worked with {config.seed}")

    monkeypatch.setattr(sys, "argv", ["stage", "--config", str(path), *more])
    return run_stage(Config, "configs/none.yaml", work, "about")


def test_a_stage_that_works_exits_with_0(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, tmp_path, None, "seed=5") == 0
    assert capsys.readouterr().out == "worked with 5\n"


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ValueError("no model at x; train one"), "error: no model at x; train one\n"),
        (OSError(errno.ENOSPC, "No space left"), "error: the disk is full; free some space"),
    ],
)
def test_a_users_error_exits_with_2_and_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    error: Exception,
    message: str,
) -> None:
    assert _run(monkeypatch, tmp_path, error) == 2
    shown = capsys.readouterr().err
    assert shown.startswith(message) and shown.count("\n") == 1


def test_an_unknown_key_on_the_command_line_exits_with_2(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, tmp_path, None, "sed=5") == 2
    assert "did you mean 'seed'" in capsys.readouterr().err


def test_a_bug_is_not_hidden_as_a_users_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(KeyError):
        _run(monkeypatch, tmp_path, KeyError("bug"))
