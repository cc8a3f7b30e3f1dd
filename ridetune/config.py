"""YAML + overrides -> a frozen dataclass; unknown keys are errors that name the nearest one."""

import difflib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, is_dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import yaml
from pydantic import Field, TypeAdapter, ValidationError

Count = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Config = TypeVar("Config")
CONFIG_FILE = "config.yaml"


def load_config(kind: type[Config], path: Path, overrides: Sequence[str] = ()) -> Config:
    """Read a YAML file into the dataclass `kind` and apply `section.key=value` overrides.

    Raises ValueError with the file, the key and the remedy.
    """
    if not path.is_file():
        raise ValueError(f"no config file at {path}; the shipped ones are in configs/")
    try:
        raw = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not valid YAML: {error}") from error
    if not isinstance(raw, dict):
        raise ValueError(f"{path} must hold a mapping of keys to values")
    for override in overrides:
        _override(raw, override)
    _check_keys(kind, raw, str(path))
    try:
        return TypeAdapter(kind).validate_python(raw)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] in ("missing", "missing_argument"):
            raise ValueError(f"{path}: the key {key!r} is missing") from error
        raise ValueError(f"{path}: {key}: {first['msg']}, got {first['input']!r}") from error


def save_config(config: Any, path: Path) -> None:
    """Write the resolved config beside the artefact it made."""
    plain = TypeAdapter(type(config)).dump_python(config, mode="json")
    path.write_text(yaml.safe_dump(plain, sort_keys=False))


def start_or_resume(config: Any, folder: Path, *, begun: bool, free: Collection[str] = ()) -> None:
    """Make a run's folder with its config.yaml, or go on in it.

    begun: whether the folder holds results already; then ValueError where a key differs that is
    not one of the `free` ones, which do not shape the results.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, partial = folder / CONFIG_FILE, folder / f".{CONFIG_FILE}"
    save_config(config, partial)
    if begun and path.exists():
        before, now = (yaml.safe_load(file.read_text()) for file in (path, partial))
        changed = [key for key in now if key not in free and before.get(key) != now[key]]
        if changed:
            partial.unlink()
            raise ValueError(
                f"{folder} holds results of another {', '.join(changed)}; "
                "delete it, or name a new `out`"
            )
    partial.rename(path)


def _override(raw: dict[str, Any], override: str) -> None:
    key, equals, value = override.partition("=")
    if not equals:
        raise ValueError(f"override {override!r} is not of the form section.key=value")
    *sections, last = key.split(".")
    for section in sections:
        inner = raw.setdefault(section, {})
        if not isinstance(inner, dict):
            raise ValueError(f"override {override!r}: {section} is a value, not a section")
        raw = inner
    try:
        raw[last] = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise ValueError(f"override {override!r}: the value is not valid YAML") from error


def _check_keys(kind: Any, value: Any, where: str) -> None:
    """Refuse unknown keys at any depth; a section may be optional, in a list or in a mapping."""
    if not is_dataclass(kind):
        many = isinstance(value, Mapping) and get_origin(kind) in (dict, Mapping)
        items = list(value.values()) if many else value if isinstance(value, list) else [value]
        for inner, item in product(get_args(kind), items):
            _check_keys(inner, item, where)
        return
    if not isinstance(value, Mapping):
        return
    known = [field.name for field in fields(kind)]
    types = get_type_hints(kind)
    for key, inner in value.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.0)
            raise ValueError(f"{where}: unknown key {key!r}; did you mean {near[0]!r}?")
        _check_keys(types[key], inner, f"{where}: {key}")
