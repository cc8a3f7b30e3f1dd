"""One's own commands: what a CSV file may say, and on which side of the split it stands."""

from pathlib import Path

import numpy as np
import pytest

from data.instructions import Speakers, Speech, read_own
from data.own_commands import read_own_commands
from data.phrases import Bank
from ridetune.matrix import STYLES

HEAD = "text,style,level,intent,language\n"


def written(tmp_path: Path, *rows: str, head: str = HEAD, encoding: str = "utf-8") -> Path:
    path = tmp_path / "mine.csv"
    path.write_text(head + "".join(f"{row}\n" for row in rows), encoding=encoding)
    return path


def many(count: int) -> list[str]:
    """Commands of words of their own."""
    letters = "abcdefghijklmnopqrstuvwxyz"
    words = [letters[n // 26] + letters[n % 26] for n in range(count)]
    return [f"zo{w} bu{w} fi{w},{STYLES[n % 3]},II,," for n, w in enumerate(words)]


def test_a_file_of_commands_is_read(tmp_path: Path, bank: Bank) -> None:
    path = written(
        tmp_path,
        '"Zippy, whirr me onward, chauffeur!",aggressive,I,speed,en',
        "My {minutes} gerbils wobble, Conservative ,iii,,",
        "Langsamer bitte,conservative,I,,de",
    )
    own = read_own_commands(path, bank)
    assert [(p.text, p.style, p.level, p.intent) for p in own.phrases] == [
        ("Zippy, whirr me onward, chauffeur!", "aggressive", "I", "speed"),
        ("My {minutes} gerbils wobble", "conservative", "III", "comfort"),
    ]
    assert all(p.phrase_id.startswith("own_mine/") for p in own.phrases)


def test_spreadsheets_may_use_semicolons_and_a_byte_order_mark(tmp_path: Path, bank: Bank) -> None:
    path = written(
        tmp_path, "Zippy whirr onward;moderate;II", head="Text;Style;Level\n", encoding="utf-8-sig"
    )
    assert [p.style for p in read_own_commands(path, bank).phrases] == ["moderate"]


def test_wrong_rows_are_all_named(tmp_path: Path, bank: Bank) -> None:
    path = written(
        tmp_path,
        "Fine words here,moderate,I,,",
        "Too wild,wild,I,,",
        "No level,moderate,IV,,",
        "Odd,moderate,I,gossip,",
        "Bring {nothing} here,moderate,I,,",
        ",moderate,I,,",
        "Vite,moderate,I,,fr",
    )
    with pytest.raises(ValueError, match="has wrong rows") as caught:
        read_own_commands(path, bank)
    message = str(caught.value)
    for part in (
        "line 3: style 'wild' is none of",
        "line 4: level 'IV' is none of I, II, III",
        "line 5: intent 'gossip'",
        "line 6: the text: 'Bring {nothing} here' uses the slot 'nothing'",
        "line 7: the instruction holds no words",
        "and 1 more",
    ):
        assert part in message


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "lacks the column 'text'"),
        (b"text,level\nGo,I\n", "lacks the column 'style'"),
        ("text,style,level\nGr\xfc\xdfe,moderate,I\n".encode("latin-1"), "not UTF-8"),
    ],
)
def test_a_file_that_is_none_says_what_it_lacks(
    tmp_path: Path, bank: Bank, content: bytes, message: str
) -> None:
    path = tmp_path / "mine.csv"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_own_commands(path, bank)
    with pytest.raises(ValueError, match="no file of commands"):
        read_own_commands(tmp_path / "missing.csv", bank)


def test_repeats_and_what_the_bank_holds_out_are_left_out(tmp_path: Path, bank: Bank) -> None:
    held_out = next(p for p in bank.phrases if p.held_out and "," not in p.text)
    path = written(
        tmp_path,
        f"{held_out.text},{held_out.style},II,,",
        "Zippy whirr onward,moderate,II,,",
        "zippy; WHIRR onward!,moderate,II,,",
    )
    own = read_own_commands(path, bank)
    assert [p.text for p in own.phrases] == ["Zippy whirr onward"]
    assert own.repeats == 2


def test_one_command_in_two_styles_is_an_error(tmp_path: Path, bank: Bank) -> None:
    path = written(tmp_path, "Zippy whirr,moderate,I,,", "zippy whirr!,aggressive,II,,")
    with pytest.raises(ValueError, match=r"'zippy whirr!' twice, as moderate and as aggressive"):
        read_own_commands(path, bank)


def test_commands_that_differ_by_a_number_are_two_on_one_side(tmp_path: Path, bank: Bank) -> None:
    rows = [f"Zippy whirr {n} bumpety,moderate,I,," for n in range(10, 16)]
    own = read_own_commands(written(tmp_path, *rows), bank)
    assert len(own.phrases) == 6
    assert len({p.held_out for p in own.phrases}) == len({p.phrase_id for p in own.phrases}) == 1


def test_a_part_is_held_out_whatever_else_is_in_the_file(tmp_path: Path, bank: Bank) -> None:
    some = read_own_commands(written(tmp_path, *many(100)), bank).phrases
    more = read_own_commands(written(tmp_path, *many(200)), bank).phrases
    assert 0.05 < np.mean([p.held_out for p in more]) < 0.25
    assert more[:100] == some


def test_draws_keep_to_the_share_the_style_and_the_side(tmp_path: Path) -> None:
    speech = Speech(("en",), grammar=0.0, own=written(tmp_path, *many(120)), own_share=0.25)
    speakers = Speakers(speech, read_own(speech))
    rng = np.random.default_rng(3)
    drawn = [
        (style, split, speakers.draw(speakers.bank(rng), style, split, rng)[0])
        for style in STYLES
        for split in ("train", "test")
        for _ in range(400)
    ]
    assert all(p.style == style and p.held_out == (split == "test") for style, split, p in drawn)
    own = [p.phrase_id.startswith("own_") for _, _, p in drawn]
    assert abs(np.mean(own) - 0.25) < 0.04


def test_a_file_in_other_languages_is_an_error(tmp_path: Path) -> None:
    path = written(tmp_path, "Langsamer bitte,conservative,I,,de")
    with pytest.raises(ValueError, match="holds no commands in en; name their language"):
        read_own(Speech(("en",), grammar=0.0, own=path, own_share=0.5))


def test_no_language_is_an_error() -> None:
    with pytest.raises(ValueError, match="languages is empty"):
        read_own(Speech((), grammar=0.0, own=None, own_share=0.5))
