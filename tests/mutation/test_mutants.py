"""Mutants: every kind of change, at its place, and none in texts and annotations."""


from mutation.mutants import mutants

SOURCE = b'''"""A text with 1 + 1."""
LIMIT: Literal[3] = 40


def f(x: int = -1, *, whole: bool = True) -> int | None:
    """Another, 2 < 3."""
    if x < LIMIT and not whole:
        return f"{x + 1} \xe2\x82\xac"
    x += 2.5; y = x @ x
    return x * 3 if x is None else None
'''
FOUND = [
    "2: 40 → 80", "5: -1 → (1)", "5: 1 → 2", "5: True → False",
    "7: x < LIMIT and not whole → (x < LIMIT or not whole)", "7: x < LIMIT → (x <= LIMIT)",
    "7: not whole → (whole)", '8: return f"{x + 1} €" → return None', "9: x += 2.5 → x -= 2.5",
    "9: 2.5 → 5.0", "10: return x * 3 if x is None else None → return None",
    "10: x * 3 if x is None else None → (None if x is None else x * 3)", "10: x * 3 → (x / 3)", "10: 3 → 4",
    "10: x is None → (x is not None)",
]


def test_every_kind_of_change_is_found_in_its_place() -> None:
    assert sorted(map(str, mutants(SOURCE))) == sorted(FOUND)
