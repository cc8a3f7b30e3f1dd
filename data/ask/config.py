"""Whom `python -m data.ask` asks, how patiently and for how much; its address and its key."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import httpx
from pydantic import Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Price = Annotated[float, Field(ge=0, allow_inf_nan=False)]
AtLeastOne = Annotated[int, Field(ge=1)]


@dataclass(frozen=True)
class AskConfig:
    """Whom to ask, how patiently and for how much. Prices and max_cost in one currency."""

    proposals: Path
    out: Path
    base_url: str  # without /chat/completions
    model: str
    api_key_file: Path | None  # a file, so that no key stands in a config or log
    prompt: str
    options: dict[str, Any]  # everything else that the endpoint wants in a request
    timeout_s: Positive  # without a byte of an answer
    attempts: AtLeastOne  # at a request
    backoff_s: Positive  # after the first failed attempt, then twice as long each time
    max_concurrent: AtLeastOne
    give_up_after: AtLeastOne  # pairs in a row that got no usable answer
    input_price: Price  # per million tokens
    output_price: Price
    max_cost: Price | None  # of a run
    cache: Path
    ranges: Path
    seed: int  # of the matrices


def completions_url(config: AskConfig) -> str:
    """Where to post; ValueError where base_url or the options cannot be meant."""
    try:
        url = httpx.URL(config.base_url)
    except httpx.InvalidURL as error:
        raise ValueError(f"base_url={config.base_url!r} is no URL: {error}") from error
    if url.userinfo or url.query:
        raise ValueError("base_url may hold no password or query; put the key into api_key_file")
    if url.scheme not in ("http", "https") or not url.host:
        raise ValueError(f"base_url={config.base_url!r} must start with http:// or https://")
    if taken := {"model", "messages", "stream"} & config.options.keys():
        raise ValueError(f"options may not set {', '.join(sorted(taken))}")
    return f"{config.base_url.rstrip('/')}/chat/completions"


def read_key(path: Path | None) -> str | None:
    """The key in a file; ValueError, without quoting it, where it is none."""
    if path is None:
        return None
    if not path.is_file():
        raise ValueError(f"no key at api_key_file={path}; write it there, or set null for none")
    key = path.read_text(errors="replace").strip()
    if not re.fullmatch(r"[!-~]+", key):
        raise ValueError(f"api_key_file={path} must hold the key alone, one word of ASCII")
    return key
