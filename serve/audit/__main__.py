"""Verify the audit log of a car: count what is in it and name the first fault.

Lines that are missing at the very end leave a log that is whole. Note the last line's number and
hash elsewhere, as this prints them, and give them as --known.

    python -m serve.audit runs/audit
"""

import argparse
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from .chain import DamageError, Line, Link, log_files, walk_all
from .events import count_as


@dataclass
class Verification:
    """What a log holds up to its first fault; counts: of events by kind and outcome."""

    num_files: int
    counts: Counter[str] = field(default_factory=Counter)
    first: Line | None = None
    last: Line | None = None
    fault: str | None = None


def verify(folder: Path, *, known: Link | None = None) -> Verification:
    """Check every byte of a log; ValueError without one.

    known: a line noted elsewhere, which must still be there; without it, lines missing at the end
    cannot be told from lines that were never written.
    """
    found = Verification(len(log_files(folder)))
    missing = known
    try:
        for line in walk_all(folder):
            found.first, found.last = found.first or line, line
            found.counts[count_as(line.event)] += 1
            missing = None if line.link == known else missing
    except DamageError as error:
        found.fault = str(error)
    if missing is not None and found.fault is None:
        where, end = log_files(folder)[-1], found.last.number if found.last else 0
        found.fault = f"{where}: the log ends with line {end} and does not hold {missing}"
    return found


def describe(found: Verification) -> list[str]:
    """What a verification found, as lines for a terminal."""
    until = "before the fault" if found.fault else "in all"
    said = [f"files {found.num_files}, lines {found.counts.total()} {until}"]
    if found.first is not None and found.last is not None:
        begin, end = (f"{line.time:%Y-%m-%d %H:%M:%S}" for line in (found.first, found.last))
        said += [f"from {begin} to {end} UTC"]
        said += [f"{count:8}  {name}" for name, count in sorted(found.counts.items())]
        said += [f"last line {found.last.link}"]
    if found.fault is not None:
        return [*said, f"NOT WHOLE: {found.fault}"]
    return [*said, "whole: every line is as it was written and follows from the one before"]


def main() -> int:
    """Verify a log: 0 if it is whole, 1 with its first fault, 2 where there is none."""
    parser = argparse.ArgumentParser(
        prog="python -m serve.audit",
        description="Verify the audit log of a car, count what is in it and name the first fault.",
        epilog="Exit code: 0 whole, 1 not whole, 2 no log there.",
    )
    parser.add_argument("folder", type=Path, help="where the server wrote audit-*.jsonl")
    parser.add_argument(
        "--known",
        metavar="NUMBER:SHA256",
        help="a line noted earlier (the last one, as this prints it) that must still be there; "
        "without it nobody can tell whether whole lines were cut off at the end",
    )
    arguments = parser.parse_args()
    try:
        known = Link.parse(arguments.known) if arguments.known else None
        found = verify(arguments.folder, known=known)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("\n".join(describe(found)))
    return 0 if found.fault is None else 1


if __name__ == "__main__":
    sys.exit(main())
