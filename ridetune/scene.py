"""What a scene description says: the questions that it answers, and how to read the answers."""

# A keyword of each answer stands in the text of a description that gives it.
SCENE_QUESTIONS: dict[str, tuple[tuple[str, ...], ...]] = {
    "condition": (("sunny",), ("rainy",), ("foggy",), ("snowy",), ("night",)),
    "road": (("straight",), ("left",), ("right",), ("intersection",)),
    "lead": (
        ("no vehicle", "free lane"),
        ("close ahead", "near vehicle"),
        ("far ahead", "distant"),
    ),
    "surroundings": (("city",), ("highway",), ("country",)),
    "traffic": (("light",), ("dense",)),
}


def scene_answers(scene: str) -> tuple[int, ...]:
    """The number of the answer to each of SCENE_QUESTIONS; -1 where the text gives none."""
    found = []
    for answers in SCENE_QUESTIONS.values():
        said = [i for i, words in enumerate(answers) if any(word in scene for word in words)]
        found.append(said[0] if said else -1)
    return tuple(found)
