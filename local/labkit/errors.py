"""Owns the one error that reaches a person: a line that names what failed and what to do next."""


class LabError(Exception):
    """What failed, on what, and what to do. Shown as one line; the program exits with 2."""
