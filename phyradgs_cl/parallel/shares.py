"""Who does what: counts divided over ranks."""


def span(count: int, parts: int, part: int) -> range:
    """The ``part``-th of ``parts`` runs of 0 … count−1, whose lengths differ by one at most."""
    return range(part * count // parts, (part + 1) * count // parts)
