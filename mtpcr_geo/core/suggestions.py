"""The nearest valid name for a misspelt one: of an option, a stage, a tag, a method, a command.

The command, pipelines and the Python API all ask here, so a misspelling gets one answer everywhere.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "algorithm": ("matcher", "method"),
    "batch": ("pipeline",),
    "cellsize": ("cell",),
    "clobber": ("overwrite",),
    "convert": ("apply",),
    "coregister": ("register",),
    "crs": ("source-crs", "target-crs", "a-srs", "override-srs"),
    "datum": ("vertical",),
    "debug": ("verbose",),
    "destination": ("out", "filename"),
    "detector": ("matcher", "method"),
    "dof": ("motion",),
    "dryrun": ("validate", "dump-pipeline"),
    "epsg": ("source-crs", "target-crs", "a-srs", "override-srs"),
    "file": ("filename",),
    "fixed": ("target",),
    "geoid": ("vertical",),
    "georeference": ("prior",),
    "grid": ("cell",),
    "gridsize": ("cell",),
    "gsd": ("cell",),
    "guess": ("prior",),
    "icp": ("register", "refine"),
    "info": ("check",),
    "initial": ("prior",),
    "inspect": ("check",),
    "invert": ("inverse",),
    "leveling": ("level",),
    "levelling": ("level",),
    "matching": ("matcher",),
    "method": ("matcher",),
    "modeldir": ("models",),
    "modelfolder": ("models",),
    "moving": ("source",),
    "out": ("filename",),
    "outdir": ("out", "filename"),
    "outfile": ("out", "filename"),
    "outfolder": ("out", "filename"),
    "output": ("out", "filename"),
    "outputcrs": ("out-crs",),
    "outputdir": ("out", "filename"),
    "outputfile": ("out", "filename"),
    "pixel": ("cell",),
    "pixelsize": ("cell",),
    "preset": ("profile",),
    "projection": ("source-crs", "target-crs", "a-srs", "override-srs"),
    "randomseed": ("seed",),
    "randomstate": ("seed",),
    "reference": ("target",),
    "replace": ("overwrite",),
    "resolution": ("cell",),
    "resultcrs": ("out-crs",),
    "run": ("register", "pipeline"),
    "silent": ("quiet",),
    "skiprecording": ("no-recording",),
    "srs": ("source-crs", "target-crs", "a-srs", "override-srs"),
    "transform": ("apply", "motion"),
    "verticalcrs": ("vertical",),
    "voxel": ("cell",),
    "voxelsize": ("cell",),
    "warp": ("apply",),
    "weights": ("models",),
}
"""Names that users of other tools write, by what they may mean here; the first that is valid counts, with
those that share its last part (so ``crs`` means both ``source-crs`` and ``target-crs``)."""

_LONGEST = 100  # letters; what is longer is no name written wrongly, and takes long to compare
_LEAST = 0.55
_LISTED = 12


def suggestions(word: str, valid: Iterable[str]) -> list[str]:
    """Return the valid names that `word` may stand for, the likeliest first; empty if none is near.

    More than one comes back only for a word that means several: ``crs`` for source and target.

    Args:
        word: what was written; dashes before it, case, ``_`` for ``-`` do not matter.
        valid: what could have been written; returned as spelt there.

    """
    names = list(dict.fromkeys(valid))
    parts = _parts(word)
    if not parts or len(word) > _LONGEST:
        return []
    by_form = {_form(name): name for name in reversed(names)}
    same = by_form.get("-".join(parts))
    if same is not None:
        return [same]
    meant_by_it = [by_form[known] for known in SYNONYMS.get("".join(parts), ()) if known in by_form]
    if meant_by_it:
        last = _parts(meant_by_it[0])[-1]
        return [name for name in meant_by_it if len(_parts(name)) > 1 and _parts(name)[-1] == last] or [
            meant_by_it[0]
        ]
    likeness = {name: _likeness(word, name) for name in names}
    best = max(names, key=lambda name: (likeness[name], -len(name)), default=None)
    return [best] if best is not None and likeness[best] >= _LEAST else []


def nearest(word: str, valid: Iterable[str]) -> str | None:
    """Return the valid name likest to `word`, or None if none is near; see `suggestions`."""
    return next(iter(suggestions(word, valid)), None)


def meant(word: str, valid: Iterable[str], *, turned: bool = False) -> str:
    """Return "; did you mean 'x'?", or a list of what is valid, or nothing if there is nothing to offer.

    Args:
        word: what was written.
        valid: what could have been.
        turned: `word` is the valid one and `valid` what was written.

    """
    names = list(dict.fromkeys(valid))
    near = suggestions(word, names)
    if turned:
        return f"; did you mean {word!r} by {near[0]!r}?" if near else ""
    if near:
        return f"; did you mean {' or '.join(map(repr, near))}?"
    return f" (there are: {', '.join(sorted(names))})" if 0 < len(names) <= _LISTED else ""


def edit_distance(a: str, b: str) -> int:
    """Return how many letters to insert, drop, change or swap with their neighbour to turn `a` into `b`.

    This is the optimal string alignment distance (Damerau 1964): no letter is edited twice.
    """
    before: list[int] = []
    last = list(range(len(b) + 1))
    for i, x in enumerate(a, 1):
        row = [i]
        for j, y in enumerate(b, 1):
            cost = min(last[j] + 1, row[j - 1] + 1, last[j - 1] + (x != y))
            if i > 1 and j > 1 and x == b[j - 2] and a[i - 2] == y:
                cost = min(cost, before[j - 2] + 1)
            row.append(cost)
        before, last = last, row
    return last[-1]


def _parts(name: str) -> list[str]:
    """Split a name into its words: ``--no-prior_sigma`` is no, prior, sigma."""
    return [part for part in re.split(r"[-_.\s]+", name.lower()) if part]


def _form(name: str) -> str:
    return "-".join(_parts(name))


def _likeness(word: str, name: str) -> float:
    """Return how like two names are, 0 to 1: the best of spelling, shared parts, and beginning."""
    family, _, rest = word.lower().partition(".")
    if rest and name.lower().startswith(f"{family}."):
        # that both are filters says nothing about which
        word, name = rest, name[len(family) + 1 :]
    parts, known = _parts(word), _parts(name)
    a, b = "-".join(parts), "-".join(known)
    return max(_by_spelling(a, b), _by_beginning(a, b), _by_parts(parts, known))


def _by_spelling(a: str, b: str) -> float:
    """Compare letter by letter: one slip in three letters of the longer name at most."""
    longest = max(len(a), len(b))
    slips = edit_distance(a, b)
    return 1.0 - slips / longest if slips <= max(1, longest // 3) and slips < longest else 0.0


def _by_parts(word: list[str], name: list[str]) -> float:
    """Compare part by part, in any order: the share of the letters that are in parts alike."""
    left = list(name)
    alike = 0.0
    for part in word:
        shares = {other: max(_by_spelling(part, other), _by_beginning(part, other)) for other in left}
        found = max(left, key=shares.__getitem__, default="")
        if found and shares[found] > 0.0:
            left.remove(found)
            alike += shares[found] * (len(part) + len(found))
    letters = sum(map(len, word)) + sum(map(len, name))
    # a whole part written alone names what it is a part of: "las" is "readers.las"
    whole = len(word) < len(name) and all(part in name for part in word)
    return max(alike / letters, _LEAST if whole and letters > 2 else 0.0)


def _by_beginning(a: str, b: str) -> float:
    """Compare names of which one begins the other; two letters say too little."""
    short, long = sorted((a, b), key=len)
    if len(short) < 3 or not long.startswith(short):
        return 0.0
    return _LEAST + (1.0 - _LEAST) * len(short) / len(long) / 2
