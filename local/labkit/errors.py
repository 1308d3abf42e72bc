"""Owns the one error that reaches a person: a line that names what failed and what to do next."""


class LabError(Exception):
    """What failed, on what, and what to do. Shown as one line; the program exits with 2."""


class NotRun(LabError):
    """This machine lacks what a check needs: the run of all tests names it and goes on, a command of its own fails with it."""
