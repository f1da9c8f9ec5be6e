"""The nearest valid word for a misspelt one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(word: str, valid: Iterable[str]) -> str | None:
    """Return the valid word most like `word`, or None if nothing is near.

    A word that begins or ends another counts as near: "las" for "readers.las".
    """
    words = list(dict.fromkeys(valid))
    folded = {known.lower(): known for known in reversed(words)}
    close = difflib.get_close_matches(word.lower(), list(folded), n=1, cutoff=0.6)
    if close:
        return folded[close[0]]
    part = [
        known
        for known in words
        if len(word) > 2 and (word.lower() in known.lower() or known.lower() in word.lower())
    ]
    return min(part, key=len) if part else None


def meant(word: str, valid: Iterable[str], *, turned: bool = False) -> str:
    """Return "; did you mean 'x'?", or a list of what is valid, or nothing if there is nothing to offer.

    Args:
        word: what was written.
        valid: what could have been.
        turned: `word` is the valid one and `valid` what was written.

    """
    words = list(dict.fromkeys(valid))
    near = nearest(word, words)
    if turned:
        return f"; did you mean {word!r} by {near!r}?" if near else ""
    if near:
        return f"; did you mean {near!r}?"
    return f" (there are: {', '.join(sorted(words))})" if 0 < len(words) <= 12 else ""
