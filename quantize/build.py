"""Merged model -> 4-bit AWQ checkpoint, checked by reading it back.

    python -m quantize --config configs/quantize.yaml model=runs/tiny/merged

In: a merged model folder and the dataset's calibration split. Out: a folder with the packed
layers of the language model, everything else in float16, and report.json: what each search found,
and the KL to the unquantized model beside that of rounding to nearest.
"""

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ridetune.awq_checkpoint import load_quantized
from ridetune.config import save_config
from ridetune.qwen import core, load_model
from ridetune.stage import Stopwatch, new_folder, peak_rss_mb, write_manifest

from .awq import JOBS, LINEARS, check_layer, round_groups
from .calibration import (
    CalibrationPrompt,
    Reader,
    hold_apart,
    read_calibration,
    record_activations,
    write_prompt,
)
from .checkpoint import REPORT_FILE, check_source, quantized_tensors, write_checkpoint
from .divergence import Answer, Divergence, answer, answers, divergence, is_above

LOG = logging.getLogger(__name__)
_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class QuantizeConfig:
    """model, data and out are folders; the rest is explained in configs/quantize.yaml."""

    model: Path
    data: Path
    out: Path
    check_scenes: int
    group_size: int
    num_exponents: int
    tokens: int
    clip: bool
    seed: int
    dtype: Literal["float32", "bfloat16"]
    device: str
    threads: int


def quantize(config: QuantizeConfig) -> None:
    """Quantize a merged model, measure what it lost and write both; ValueError names the remedy."""
    clock = Stopwatch()
    check_source(config.model)
    if config.out.resolve() == config.model.resolve():
        raise ValueError(f"out and model are both {config.out}; choose another `out` folder")
    torch.set_num_threads(config.threads)
    reader = Reader.load(config.model)
    to_fit, to_check = hold_apart(read_calibration(config.data), config.check_scenes)
    check_prompts = [write_prompt(sample, reader) for sample in to_check]

    model = _load_source(config)
    for layer in core(model).language_model.layers:
        check_layer(layer, config.group_size)
    truth = answers(model, check_prompts, reader, name="unquantized")
    if not all(one.is_finite() for one in truth):
        raise ValueError(f"{config.model} gives values that are not finite; train or merge again")
    seen = record_activations(
        model,
        [write_prompt(sample, reader) for sample in to_fit],
        reader,
        tokens=config.tokens,
        seed=config.seed,
    )
    tensors, jobs = quantized_tensors(
        model,
        seen,
        group_size=config.group_size,
        num_exponents=config.num_exponents,
        clip=config.clip,
    )
    _log_jobs(jobs)
    del model, seen

    with new_folder(config.out) as folder:
        write_checkpoint(tensors, config.model, folder, group_size=config.group_size)
        del tensors
        rounded = _measure_rounding(truth, check_prompts, reader, config)
        report = {
            "samples": {"calibration": len(to_fit), "check": len(to_check)},
            **_check(folder, truth, rounded, check_prompts, reader, config),
            "jobs": jobs,
            "peak_rss_mb": round(peak_rss_mb()),
            "peak_gpu_mb": round(_peak_gpu_mb()),
        }
        (folder / REPORT_FILE).write_text(json.dumps(report, indent=2) + "\n")
        save_config(config, folder / "config.yaml")
        write_manifest(folder, seconds=clock.seconds, facts={"stage": "quantize"})
    print(
        f"quantized: {config.out}, KL of the actions {report['kl']['awq']['actions_nats']:.2e}, "
        f"rounding to nearest {report['kl']['round_to_nearest']['actions_nats']:.2e}, "
        f"{clock.seconds:.0f} s"
    )


def round_to_nearest(model: Any, group_size: int) -> None:
    """Round a model in place without looking at activations, the rest to float16: the control."""
    for parameter in model.parameters():
        parameter.data = parameter.data.to(torch.float16).to(parameter.dtype)
    for layer in core(model).language_model.layers:
        for name in LINEARS:
            weight = layer.get_submodule(name).weight
            weight.data = round_groups(weight.data, group_size).dequantize().to(weight.dtype)


def _load_source(config: QuantizeConfig) -> Any:
    model: Any = load_model(config.model, dtype=_DTYPES[config.dtype])
    return model.to(config.device)


def _measure_rounding(
    truth: list[Answer], prompts: list[CalibrationPrompt], reader: Reader, config: QuantizeConfig
) -> Divergence:
    """The loss of rounding to nearest, on a freshly loaded model so that one is held at a time."""
    model = _load_source(config)
    round_to_nearest(model, config.group_size)
    return divergence(truth, answers(model, prompts, reader, name="round to nearest"))


def _check(
    folder: Path,
    truth: list[Answer],
    rounded: Divergence,
    prompts: list[CalibrationPrompt],
    reader: Reader,
    config: QuantizeConfig,
) -> dict[str, Any]:
    """Read the checkpoint back and compare; what went wrong is logged and stays in the report."""
    model: Any = load_quantized(folder, dtype=_DTYPES[config.dtype])
    model = model.to(config.device)
    found = answers(model, prompts, reader, name="quantized")
    if not all(one.is_finite() for one in found):
        raise ValueError(
            f"the quantized model gives values that are not finite in {config.dtype}; "
            "try clip=false or a smaller group_size"
        )
    lost = divergence(truth, found)
    worse = {
        "actions": is_above(lost.actions, rounded.actions),
        "next_token": is_above(lost.next_token, rounded.next_token),
    }
    for name in (name for name, is_worse in worse.items() if is_worse):
        LOG.warning("event=awq_worse_than_rounding_to_nearest distribution=%s", name)
    finite_in_half = answer(model.half(), prompts[0], reader).is_finite()
    if not finite_in_half:
        LOG.warning("event=overflow_in_float16 remedy='run this checkpoint in bfloat16'")
    return {
        "kl": {"awq": lost.as_dict(), "round_to_nearest": rounded.as_dict()},
        "awq_worse_than_rounding_beyond_noise": worse,
        "finite": {config.dtype: True, "float16": finite_in_half},
    }


def _log_jobs(rows: list[dict[str, Any]]) -> None:
    """One line per kind of job; the single layers are in the report."""
    for job in JOBS:
        mine = [row for row in rows if row["job"] == job.name]
        before, after = (
            float(np.mean([row[key] for row in mine])) for key in ("error_rounded", "error_scaled")
        )
        LOG.info(
            "event=scaled job=%r layers=%d error_rounded=%.2e error_scaled=%.2e reduction=%.0f%%",
            job.name,
            len(mine),
            before,
            after,
            100 * (1 - after / before),
        )


def _peak_gpu_mb() -> float:
    return torch.cuda.max_memory_allocated() / 2**20 if torch.cuda.is_available() else 0.0
