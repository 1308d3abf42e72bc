"""Owns what has to be built before anything can run: tools by Go, the tree by cargo, Python's packages. All at the same time.

Called by `demo`. Each compiler leaves a core idle where it links or where one large package is left, and the other one takes it.
"""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing

from . import build, lanes, pythonenv, tools
from .errors import LabError
from .lanes import Job
from .settings import Settings

# Two compilers of Go and two of Rust at once take up to 5 GB.
LEAST_MEMORY_BYTES = 7 << 30


def ensure(settings: Settings, names: Sequence[str]) -> None:
    """Builds what is missing: the named tools, and what the demo runs of this repository."""
    works: Mapping[str, Callable[[], object]] = {
        "tools": lambda: tools.ensure(settings, names, tools.fitting_assets(os.environ)),
        # The small build first: at the end it would leave a core idle.
        "programs": lambda: (build.static_programs(settings), build.programs(settings)),
        "packages": lambda: pythonenv.ensure(settings),
    }
    cold = [bool(absent(settings, names)), build.cold_seconds(settings) > 0, not pythonenv.is_whole(settings)]
    if sum(cold) > 1 and memory_bytes() >= LEAST_MEMORY_BYTES:
        side_by_side(settings, works)
    else:
        # One alone has a bar on a terminal.
        for work in works.values():
            work()


def absent(settings: Settings, names: Sequence[str]) -> list[tuple[tools.ToolSet, str]]:
    """The named tools that must be built."""
    return tools.missing(settings, names, tools.fitting_assets(os.environ))


def cold_seconds(settings: Settings, names: Sequence[str]) -> int:
    """About how long the builds take on two cores that do nothing else: they share them, as each alone fills both."""
    python = 0 if pythonenv.is_whole(settings) else pythonenv.USUAL_SECONDS
    return max(tools.cold_seconds(absent(settings, names)) + build.cold_seconds(settings), python)


def memory_bytes() -> int:
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def side_by_side(settings: Settings, works: Mapping[str, Callable[[], object]]) -> None:
    """Each in a process of its own; the first that fails ends the others and raises its error."""
    jobs = [[Job(name, lambda work=work: error_of(work))] for name, work in works.items()]
    with closing(lanes.run(jobs, settings.logs, captured=False)) as ended:
        for one in ended:
            if one.value != "":
                raise LabError(one.value or f"the process that builds the {one.job.name} ended without a result")


def error_of(work: Callable[[], object]) -> str:
    """Runs it; empty if it raised nothing."""
    try:
        work()
    except LabError as error:
        return str(error)
    except KeyboardInterrupt:
        sys.exit(130)
    return ""
