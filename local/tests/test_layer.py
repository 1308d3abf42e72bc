"""The bytes of an image: the same from the same content, and whole for the engines that read them."""

import gzip
import io
import json
import tarfile
import unittest

from labkit import layer
from labkit.layer import Entry

ENTRIES = [
    Entry("/usr/bin/tool", 0o755, b"program"),
    Entry("/etc/motd", 0o644, b"hello", uid=1000, gid=1000),
    Entry("/bin/sh", 0o777, target="/usr/bin/tool"),
    Entry("/tmp", 0o1777),
]


class Determinism(unittest.TestCase):
    def test_the_order_of_the_entries_changes_nothing(self) -> None:
        config: dict[str, object] = {"Env": ["A=1"], "Cmd": ["/bin/sh"]}
        first = layer.build(ENTRIES, config, "amd64")
        again = layer.build(reversed(ENTRIES), dict(reversed(config.items())), "amd64")
        self.assertEqual(first, again)
        self.assertEqual(layer.archive(first, "a:1"), layer.archive(again, "a:1"))

    def test_content_mode_and_configuration_change_the_digest(self) -> None:
        built = [
            layer.build([Entry("/a", 0o644, b"1")], {}, "amd64"),
            layer.build([Entry("/a", 0o644, b"2")], {}, "amd64"),
            layer.build([Entry("/a", 0o755, b"1")], {}, "amd64"),
            layer.build([Entry("/a", 0o644, b"1")], {"User": "1"}, "amd64"),
        ]
        self.assertEqual(len({image.digest for image in built}), len(built))


class Content(unittest.TestCase):
    def test_the_tar_holds_each_entry_and_the_folders_that_lead_to_it(self) -> None:
        with tarfile.open(fileobj=io.BytesIO(layer.tar(ENTRIES))) as archive:
            members = {member.name: member for member in archive.getmembers()}
            self.assertEqual(
                list(members), ["bin", "bin/sh", "etc", "etc/motd", "tmp", "usr", "usr/bin", "usr/bin/tool"]
            )
            tool = archive.extractfile("usr/bin/tool")
            assert tool is not None
            self.assertEqual(tool.read(), b"program")
        self.assertEqual((members["usr/bin/tool"].mode, members["usr/bin/tool"].mtime), (0o755, 0))
        self.assertEqual((members["etc/motd"].uid, members["etc/motd"].gid), (1000, 1000))
        self.assertEqual((members["bin/sh"].issym(), members["bin/sh"].linkname), (True, "/usr/bin/tool"))
        self.assertEqual((members["tmp"].isdir(), members["tmp"].mode), (True, 0o1777))
        self.assertEqual((members["usr"].isdir(), members["usr"].mode), (True, 0o755))

    def test_of_two_entries_with_one_path_the_later_wins(self) -> None:
        content = layer.tar([Entry("/a", 0o644, b"old"), Entry("/a", 0o600, b"new")])
        with tarfile.open(fileobj=io.BytesIO(content)) as archive:
            self.assertEqual([(member.name, member.mode) for member in archive.getmembers()], [("a", 0o600)])

    def test_an_empty_file_is_a_file(self) -> None:
        with tarfile.open(fileobj=io.BytesIO(layer.tar([Entry("/empty", 0o644, b"")]))) as archive:
            self.assertTrue(archive.getmember("empty").isreg())

    def test_the_manifest_leads_to_every_blob(self) -> None:
        image = layer.build(ENTRIES, {"Cmd": ["x"]}, "arm64")
        manifest = json.loads(image.blobs[image.manifest])
        self.assertEqual(manifest["config"]["digest"], f"sha256:{image.config}")
        self.assertEqual(manifest["layers"][0]["digest"], f"sha256:{image.layer}")
        config = json.loads(image.blobs[image.config])
        self.assertEqual((config["architecture"], config["config"]), ("arm64", {"Cmd": ["x"]}))
        plain = gzip.decompress(image.blobs[image.layer])
        self.assertEqual(config["rootfs"]["diff_ids"], [f"sha256:{layer.sha256(plain)}"])
        for digest, blob in image.blobs.items():
            self.assertEqual(layer.sha256(blob), digest)

    def test_images_over_one_layer_share_its_blob(self) -> None:
        below = layer.pack(ENTRIES)
        one, other = (layer.build([Entry("/a", 0o644, text)], {}, "amd64", below) for text in (b"1", b"2"))
        self.assertEqual(one.layers[0], other.layers[0])
        self.assertEqual(one.blobs[one.layers[0]], below.blob)
        config = json.loads(one.blobs[one.config])
        plain = [layer.sha256(gzip.decompress(one.blobs[digest])) for digest in one.layers]
        self.assertEqual(config["rootfs"]["diff_ids"], [f"sha256:{digest}" for digest in plain])
        manifest = json.loads(one.blobs[one.manifest])
        self.assertEqual([each["digest"] for each in manifest["layers"]], [f"sha256:{digest}" for digest in one.layers])
        self.assertEqual(len(config["history"]), len(one.layers))
        files = layer.layout(one, "a:1")
        self.assertEqual(len(json.loads(files["manifest.json"])[0]["Layers"]), 2)


if __name__ == "__main__":
    unittest.main()
