"""Owns what stands between two marks of a document, and is made from other files. Pure."""

from .errors import LabError


def between(text: str, begin: str, end: str, inside: str, document: str) -> str:
    """The document's text with this between its marks."""
    before, has_begin, rest = text.partition(begin)
    _, has_end, after = rest.partition(end)
    if not has_begin or not has_end:
        raise LabError(f"{document} lacks the lines {begin!r} and {end!r}: put them where the table is to be")
    return f"{before}{begin}\n{inside}\n{end}{after}"
