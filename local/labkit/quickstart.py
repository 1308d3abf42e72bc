"""Owns the images that examples/quickstart.yaml and its first submission name, made by the lab: same names and tag as a release has.

Called by `lab test` for the cluster's tests. What a release publishes is made by local/quickstart/Dockerfile.
"""

import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from . import build, demo, image, release
from .image_spec import ImageSpec, parse
from .settings import Settings

MANIFEST, GAME = "examples/quickstart.yaml", "examples/quickstart-game.yaml"
# Where a release puts its images; the release workflow and those who have images of their own write another name there.
PUBLISHED = "ghcr.io/OWNER/"
IMAGE = re.compile(r"^ +image: (\S+)$", re.MULTILINE)


def images(settings: Settings) -> list[str]:
    """Pushes the images; returns their references with digests."""
    search = image.Search({}, image.target_folder(settings.repository, os.environ), build.PROFILE)
    return image.push_all(settings, list(specs(settings.repository)), search)


def specs(repository: Path) -> Iterator[ImageSpec]:
    """The stand-ins, the guessing game, and of CARLA's stand-in one image of each kind, under the tag of the version."""
    tag = release.version(repository)
    for file in ("challenge/images.toml", "quickstart/images.toml"):
        for spec in parse((repository / "local" / file).read_text(), file):
            if file.startswith("quickstart") or spec.name in (demo.CONTENTS, demo.SIMULATOR, demo.AGENT):
                yield replace(spec, tag=tag)


def named(repository: Path) -> list[str]:
    """The images that the manifests name."""
    return [image for file in (MANIFEST, GAME) for image in IMAGE.findall((repository / file).read_text())]
