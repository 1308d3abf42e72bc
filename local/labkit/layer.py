"""Owns the bytes of an image: the same content always gives the same tar, layer and image, on any day and by any user. Pure."""

import gzip
import hashlib
import io
import json
import tarfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import PurePosixPath

LAYER_TYPE = "application/vnd.oci.image.layer.v1.tar+gzip"
CONFIG_TYPE = "application/vnd.oci.image.config.v1+json"
MANIFEST_TYPE = "application/vnd.oci.image.manifest.v1+json"
INDEX_TYPE = "application/vnd.oci.image.index.v1+json"
LONG_AGO = "1970-01-01T00:00:00Z"


@dataclass(frozen=True)
class Entry:
    """One file, folder or symbolic link of a layer. `path` is absolute."""

    path: str
    mode: int
    content: bytes | None = None
    target: str | None = None
    uid: int = 0
    gid: int = 0

    @property
    def is_dir(self) -> bool:
        return self.content is None and self.target is None


@dataclass(frozen=True)
class Packed:
    """A layer as it is stored, and the digest (hex) of the tar in it."""

    blob: bytes
    content: str


@dataclass(frozen=True)
class Image:
    """A built image: its blobs by digest (hex), its manifest's digest, and what the archive formats need to know."""

    blobs: dict[str, bytes]
    manifest: str
    config: str
    layers: tuple[str, ...]

    @property
    def digest(self) -> str:
        return f"sha256:{self.manifest}"

    @property
    def layer(self) -> str:
        """The uppermost layer, which is the image's own."""
        return self.layers[-1]


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def with_parents(entries: Iterable[Entry]) -> list[Entry]:
    """The entries in order of their paths, with the folders that lead to them; of two with one path the later wins."""
    by_path = {entry.path: entry for entry in entries}
    for path in list(by_path):
        for parent in PurePosixPath(path).parents:
            if str(parent) != "/":
                by_path.setdefault(str(parent), Entry(str(parent), 0o755))
    return [by_path[path] for path in sorted(by_path)]


def tar(entries: Iterable[Entry]) -> bytes:
    """A tar of the entries, sorted, at time 0."""
    sink = io.BytesIO()
    with tarfile.open(fileobj=sink, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for entry in with_parents(entries):
            info = tarfile.TarInfo(entry.path.lstrip("/"))
            info.mode, info.uid, info.gid, info.mtime = entry.mode, entry.uid, entry.gid, 0
            if entry.is_dir:
                info.type = tarfile.DIRTYPE
                archive.addfile(info)
            elif entry.target is not None:
                info.type, info.linkname, info.mode = tarfile.SYMTYPE, entry.target, 0o777
                archive.addfile(info)
            else:
                content = entry.content or b""
                info.size = len(content)
                archive.addfile(info, io.BytesIO(content))
    return sink.getvalue()


def as_json(value: object) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


def pack(entries: Iterable[Entry]) -> Packed:
    content = tar(entries)
    # Fast: these images travel inside one machine only.
    return Packed(gzip.compress(content, compresslevel=1, mtime=0), sha256(content))


def build(entries: Iterable[Entry], config: dict[str, object], architecture: str, *below: Packed) -> Image:
    """An image of one layer, over those `below`. `config` holds Env, Entrypoint, Cmd, User, WorkingDir as the OCI format names them."""
    layers = [*below, pack(entries)]
    image_config = as_json(
        {
            "architecture": architecture,
            "os": "linux",
            "created": LONG_AGO,
            "config": config,
            "rootfs": {"type": "layers", "diff_ids": [f"sha256:{one.content}" for one in layers]},
            "history": [{"created": LONG_AGO, "created_by": "local/lab image"} for _ in layers],
        }
    )
    manifest = as_json(
        {
            "schemaVersion": 2,
            "mediaType": MANIFEST_TYPE,
            "config": descriptor(CONFIG_TYPE, image_config),
            "layers": [descriptor(LAYER_TYPE, one.blob) for one in layers],
        }
    )
    stored = [one.blob for one in layers]
    blobs = {sha256(blob): blob for blob in (*stored, image_config, manifest)}
    return Image(blobs, sha256(manifest), sha256(image_config), tuple(sha256(blob) for blob in stored))


def descriptor(media_type: str, content: bytes) -> dict[str, object]:
    return {"mediaType": media_type, "digest": f"sha256:{sha256(content)}", "size": len(content)}


def layout(image: Image, name: str) -> dict[str, bytes]:
    """The files of an OCI image layout, which also is an archive that older engines load (manifest.json)."""
    index = {
        "schemaVersion": 2,
        "mediaType": INDEX_TYPE,
        "manifests": [
            {
                **descriptor(MANIFEST_TYPE, image.blobs[image.manifest]),
                "annotations": {
                    "io.containerd.image.name": name,
                    "org.opencontainers.image.ref.name": name.rpartition(":")[2],
                },
            }
        ],
    }
    layers = [f"blobs/sha256/{digest}" for digest in image.layers]
    legacy = [{"Config": f"blobs/sha256/{image.config}", "RepoTags": [name], "Layers": layers}]
    files = {f"blobs/sha256/{digest}": blob for digest, blob in image.blobs.items()}
    return files | {
        "oci-layout": as_json({"imageLayoutVersion": "1.0.0"}),
        "index.json": as_json(index),
        "manifest.json": as_json(legacy),
    }


def archive(image: Image, name: str) -> bytes:
    """The layout as one tar: for `ctr images import`, `docker load`, `crane push`."""
    return tar(Entry(f"/{path}", 0o644, content) for path, content in layout(image, name).items())
