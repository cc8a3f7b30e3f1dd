"""Where each proposal of a folder lies, so that a row is read only when somebody looks at it.

In: a folder of parts. In memory: ids and row groups' places, and the row groups read last.
"""

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from data.proposals import Proposal

# A part of 50 frames has one row group of some tens of MB.
_GROUPS_KEPT = 2


@dataclass(frozen=True)
class _Place:
    part: Path
    group: int
    row: int  # within its row group


class ProposalIndex:
    """The proposals of a folder by id, in its order; ValueError if none or a part is damaged."""

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise ValueError(f"no proposals at {folder}; run `python -m data.propose` first")
        parts = sorted(folder.glob("part-*.parquet"))
        self._places: dict[str, _Place] = {}
        for part in parts:
            self._add_part(part)
        if not self._places:
            raise ValueError(f"{folder} holds no proposals; run `python -m data.propose` first")
        self._groups: OrderedDict[tuple[Path, int], Any] = OrderedDict()
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, proposal_id: str) -> bool:
        return proposal_id in self._places

    @property
    def ids(self) -> tuple[str, ...]:
        """All ids, in the order of the folder."""
        return tuple(self._places)

    def read(self, proposal_id: str) -> Proposal:
        """One proposal with its frame; ValueError if its part is damaged or not the same any more.

        proposal_id must be known.
        """
        place = self._places[proposal_id]
        (row,) = self._group(place).slice(place.row, 1).to_pylist()
        if row["proposal_id"] != proposal_id:
            raise ValueError(f"{place.part} has changed; start the review again")
        return Proposal.of_row(row)

    def _add_part(self, part: Path) -> None:
        import pyarrow as arrow
        import pyarrow.parquet as parquet

        try:
            with parquet.ParquetFile(part) as file:
                for group in range(file.num_row_groups):
                    ids = file.read_row_group(group, columns=["proposal_id"])["proposal_id"]
                    for row, proposal_id in enumerate(ids.to_pylist()):
                        self._add(proposal_id, _Place(part, group, row))
        except (OSError, KeyError, arrow.ArrowException) as error:
            raise ValueError(f"{part} is damaged ({error}); propose again") from error

    def _add(self, proposal_id: str, place: _Place) -> None:
        other = self._places.setdefault(proposal_id, place)
        if other != place:
            raise ValueError(
                f"proposal {proposal_id} stands in {other.part} and again in {place.part}; "
                "delete the folder and propose again"
            )

    def _group(self, place: _Place) -> Any:
        """The row group of a place; the last ones are kept."""
        import pyarrow as arrow
        import pyarrow.parquet as parquet

        key = place.part, place.group
        with self._lock:
            if key not in self._groups:
                try:
                    with parquet.ParquetFile(place.part) as file:
                        self._groups[key] = file.read_row_group(place.group)
                except (OSError, arrow.ArrowException) as error:
                    raise ValueError(f"{place.part} is damaged ({error}); propose again") from error
                if len(self._groups) > _GROUPS_KEPT:
                    self._groups.popitem(last=False)
            self._groups.move_to_end(key)
            return self._groups[key]
