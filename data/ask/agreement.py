"""How far the model's styles and conditions agree with those of the rules, pair by pair."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..kappa import cohens_kappa


def compare_folders(rules: Path, model: Path) -> Iterator[str]:
    """Lines on how far the styles and conditions of two folders of the same pairs agree."""
    first, second = _labels(rules), _labels(model)
    for name, place in (("style", 0), ("condition", 1)):
        pairs = [(first[pair][place], label[place]) for pair, label in second.items()]
        yield describe_agreement(name, pairs)


def _labels(folder: Path) -> dict[tuple[str, str], tuple[str, str]]:
    """Style and condition of every pair (frame, words) of a folder."""
    import pyarrow.parquet as parquet

    names = ["frame_name", "instruction", "style", "condition"]
    labels = {}
    for path in sorted(folder.glob("part-*.parquet")):
        columns = parquet.read_table(path, columns=names).to_pydict()
        for frame, words, *label in zip(*(columns[name] for name in names), strict=True):
            labels[frame, words] = (label[0], label[1])
    return labels


def describe_agreement(name: str, pairs: Sequence[tuple[str, str]]) -> str:
    """One line: how often model and rules agree, kappa, and where they differ most."""
    if not pairs:
        return f"{name}: no pair to compare"
    share = sum(rules == model for rules, model in pairs) / len(pairs)
    kappa = cohens_kappa(pairs)
    differ = Counter(f"{rules} -> {model}" for rules, model in pairs if rules != model)
    most = ", ".join(f"{change} {count}" for change, count in differ.most_common(3))
    return (
        f"{name}: model and rules agree on {share:.1%} of {len(pairs)}, Cohen's kappa "
        + ("undefined" if kappa is None else f"{kappa:.3f}")
        + (f"; rules -> model: {most}" if most else "")
    )
