"""What crosses the wire between the page and the review server; unknown fields are errors."""

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from ridetune.matrix import Style
from ridetune.sample import Condition, Level, Split

from .agreement import Agreement
from .preview import Drive
from .queue import Progress
from .sliders import Slider
from .store import Action, Finite, Six


def _clean(name: str) -> str:
    """One spelling for one person: single spaces, lower case."""
    cleaned = " ".join(name.split()).casefold()
    if not cleaned or not cleaned.replace(" ", "").replace("-", "").replace(".", "").isalnum():
        raise ValueError("a name has letters and digits, also dots, dashes and spaces")
    return cleaned


Annotator = Annotated[str, Field(max_length=40), AfterValidator(_clean)]
Id = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]


class _In(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ReviewIn(_In):
    """An answer. style and values only with `edit`; base: how many actions the page knew of."""

    proposal_id: Id
    annotator: Annotator
    action: Literal["accept", "edit", "reject", "skip"]
    style: Style | None = None
    values: Six | None = None
    seconds: Annotated[Finite, Field(ge=0, le=86_400)]
    base: Annotated[int, Field(ge=0)]


class UndoIn(_In):
    """Take back one's own last action; number: of that action as the page knows it."""

    annotator: Annotator
    number: Annotated[int, Field(ge=1)]


class PreviewIn(_In):
    """A matrix to drive with."""

    values: Six
    condition: Condition


class PreviewOut(BaseModel):
    """Two drives; fault: why the matrix could not be saved; ki_limit: of its K_p."""

    fault: str | None
    ki_limit: float
    drives: tuple[Drive, ...]


class WasOut(BaseModel):
    """What the annotator had answered before they took it back."""

    action: Action
    style: Style
    values: tuple[float, ...]


class ItemOut(BaseModel):
    """One pair to look at, without a word of what others said.

    starts, explanations: the matrix and the sentence for each style that it may be corrected to.
    """

    proposal_id: str
    base: int
    instruction: str
    level: Level
    style: Style
    values: tuple[float, ...]
    scene: str
    condition: Condition
    speed_mps: float | None
    split: Split
    source: str
    licence: str
    frame_name: str
    proposed_by: str
    confidence: float
    starts: dict[Style, tuple[float, ...]]
    explanations: dict[Style, str]
    preview: PreviewOut
    was: WasOut | None


class LastOut(BaseModel):
    """One's own last action that stands: what an undo would take back."""

    number: int
    action: Action


class NextOut(BaseModel):
    """What to look at next; item is None where nothing is left for this annotator."""

    annotator: str
    item: ItemOut | None
    progress: Progress
    last: LastOut | None


class SlidersOut(BaseModel):
    """The six sliders of the vehicle."""

    vehicle: str
    sliders: tuple[Slider, ...]


class AgreementOut(BaseModel):
    """How first and second opinions agree, and where they do not."""

    agreement: Agreement
    disputes: tuple[str, ...]


class ErrorOut(BaseModel):
    """What is wrong with a request, in one sentence."""

    error: str
