"""The keys of the tool cache, the order of building, and whose binaries win."""

import os
import re
import tempfile
import unittest
from pathlib import Path
from unittest import mock

from labkit import build, console, demo, pythonenv, settings, tools
from labkit.errors import LabError
from labkit.toolsets import SETS, build_flags, cache_key, in_build_order, kubernetes_ldflags, set_of

REPOSITORY = Path(__file__).resolve().parents[2]


def modules(file: Path) -> dict[str, str]:
    """What a go.mod requires: module -> version."""
    return dict(re.findall(r"^\s+(\S+\.\S+) (v\S+)", file.read_text(), re.MULTILINE))


class Keys(unittest.TestCase):
    def test_the_key_follows_from_everything_that_decides_the_build(self) -> None:
        with tempfile.TemporaryDirectory() as name:
            module = Path(name)
            keys = set()
            for file, text in (("go.mod", "a"), ("go.mod", "b"), ("go.sum", "x"), ("main.go", "package main")):
                (module / file).write_text(text)
                keys.add(cache_key(module, ["-trimpath"], "linux/x86_64"))
            keys.add(cache_key(module, ["-trimpath", "-race"], "linux/x86_64"))
            last = cache_key(module, ["-trimpath"], "linux/aarch64")
            self.assertEqual(len(keys | {last}), 6)
            (module / "notes.txt").write_text("does not matter")
            self.assertEqual(cache_key(module, ["-trimpath"], "linux/aarch64"), last)
            self.assertRegex(last, r"^[0-9a-f]{16}$")

    def test_content_can_not_wander_from_one_file_to_the_next(self) -> None:
        with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as two:
            for folder, mod, total in ((one, "ab", "c"), (two, "a", "bc")):
                (Path(folder) / "go.mod").write_text(mod)
                (Path(folder) / "go.sum").write_text(total)
            self.assertNotEqual(cache_key(Path(one), [], ""), cache_key(Path(two), [], ""))


class Sets(unittest.TestCase):
    def test_every_set_has_its_module_and_names_every_tool_in_it(self) -> None:
        for tool_set in SETS.values():
            module = REPOSITORY / "local" / "tools" / tool_set.name / "go.mod"
            lines = module.read_text().split()
            for tool in tool_set.tools.values():
                self.assertTrue(tool.package == "." or tool.package in lines, tool.package)
            self.assertIn("-trimpath", build_flags(tool_set))

    def test_the_order_is_the_order_of_the_sets_without_repeats(self) -> None:
        order = [name for _, name in in_build_order(["crane", "kubectl", "etcd", "crane", "kube-apiserver"])]
        self.assertEqual(order, ["etcd", "kube-apiserver", "kubectl", "crane"])

    def test_what_is_made_of_kubernetes_packages_is_in_its_module(self) -> None:
        self.assertEqual({set_of(name).name for name in ("etcd", "helm", "kubectl")}, {"kubernetes"})

    def test_the_gpus_have_the_modules_of_kubernetes(self) -> None:
        """Of another version Go would compile each package once more."""
        wanted, found = (modules(REPOSITORY / "local" / "tools" / name / "go.mod") for name in ("kubernetes", "gpu"))
        self.assertGreater(len(found), 40)
        self.assertEqual({name: version for name, version in found.items() if wanted.get(name, version) != version}, {})

    def test_an_unknown_tool_is_refused_with_those_there_are(self) -> None:
        with self.assertRaisesRegex(LabError, "no tool is called kubeadm: choose from .*kubectl"):
            in_build_order(["kubeadm"])

    def test_the_version_is_linked_into_both_packages(self) -> None:
        flags = kubernetes_ldflags("v1.35.4")
        self.assertEqual(flags.count("gitVersion=v1.35.4"), 2)
        self.assertEqual(flags.count("gitMinor=35"), 2)


class Envtest(unittest.TestCase):
    def test_its_binaries_win_for_the_three_that_it_has(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            binary = Path(folder) / "etcd"
            binary.write_text("#!/bin/sh\n")
            binary.chmod(0o755)
            self.assertEqual(tools.from_assets(folder, "etcd"), binary)
            self.assertIsNone(tools.from_assets(folder, "kubelet"))
            self.assertIsNone(tools.from_assets(None, "etcd"))
            with self.assertRaisesRegex(LabError, "has no executable kubectl"):
                tools.from_assets(folder, "kubectl")

    def test_the_folder_that_is_returned_links_to_them(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            for name in ("etcd", "kubectl"):
                (Path(folder) / name).write_text("#!/bin/sh\n")
                (Path(folder) / name).chmod(0o755)
            lab = settings.load(REPOSITORY, {"LEADERBOARD_TOOLS": f"{folder}/cache"})
            place = tools.ensure(lab, ["etcd", "kubectl"], folder)
            self.assertEqual(os.readlink(place / "etcd"), f"{folder}/etcd")
            self.assertEqual(tools.ensure(lab, ["etcd", "kubectl"], folder), place)

    def test_the_cluster_takes_them_only_if_the_node_fits_the_server(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            for says, taken in (("Kubernetes v1.35.9", True), ("Kubernetes v1.36.1", False), ("", False)):
                with self.subTest(says):
                    server = Path(folder) / "kube-apiserver"
                    server.write_text(f"#!/bin/sh\necho {says}\n")
                    server.chmod(0o755)
                    found = tools.fitting_assets({"KUBEBUILDER_ASSETS": folder})
                    self.assertEqual(found, folder if taken else None)
            self.assertIsNone(tools.fitting_assets({}))


class Forecast(unittest.TestCase):
    def test_it_names_what_must_be_built_and_nothing_else(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            lab = settings.load(REPOSITORY, {"LEADERBOARD_TOOLS": f"{folder}/cache"})
            with mock.patch.dict(os.environ, {"CARGO_TARGET_DIR": f"{folder}/target"}):
                cold = demo.forecast(lab)
                for tool_set, name in tools.missing(lab, demo.TOOLS):
                    place = tools.home(lab, tool_set) / name
                    place.parent.mkdir(parents=True, exist_ok=True)
                    place.touch()
                pythonenv.home(lab).mkdir()
                pythonenv.mark(lab).touch()
                (Path(folder) / "target" / build.PROFILE).mkdir(parents=True)
                warm = demo.forecast(lab)
        self.assertRegex(
            cold,
            r"about 1\d min .* on two cores that do nothing else: \S+ min \S+ s for 10 tools from source \(kube-apiserver takes "
            r"longest\), the operator and the stand-ins in Rust, the AWS stand-in's packages, and 90 s for .*; what is built is kept",
        )
        self.assertEqual(
            warm, "this takes about 90 s on two cores: 90 s for the cluster, the images and one submission"
        )


class Bar(unittest.TestCase):
    def test_it_grows_and_never_claims_to_be_done(self) -> None:
        for spent, usual, shown in (
            (0, 100, "  it [........................]   0%  0.0 s of about 100 s"),
            (50, 100, "  it [############............]  50%  50 s of about 100 s"),
            (300, 100, "  it [#######################.]  99%  5 min 0 s where 100 s are usual"),
        ):
            with self.subTest(spent):
                self.assertEqual(console.bar("it", spent, usual), shown)


if __name__ == "__main__":
    unittest.main()
