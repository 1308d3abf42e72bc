"""The build of the Dockerfile: what it is given of the machine, what its image must be, and what is said where it can't run."""

import fcntl
import gzip
import os
import re
import signal
import struct
import tempfile
import unittest
from contextlib import redirect_stderr
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from labkit import build, dockerfile, engine, enginecheck, layer, leftovers, packages, testrun
from labkit.enginecheck import Built, Member
from labkit.errors import LabError, NotRun
from labkit.image_spec import parse
from labkit.layer import Entry

REPOSITORY = Path(__file__).resolve().parents[2]
TEXT = (REPOSITORY / "Dockerfile").read_text()
SPEC = parse((REPOSITORY / "local" / "operator-image.toml").read_text(), "operator-image.toml")[0]
OPERATOR, RUNNER = "/usr/local/bin/leaderboard-operator", "/usr/local/bin/leaderboard-runner"


def program(loader: str | None) -> bytes:
    """The head of a program that asks for a loader, or for none."""
    headers = 0 if loader is None else 1
    head = b"\x7fELF\x02\x01" + bytes(26) + struct.pack("<Q", 64) + bytes(14) + struct.pack("<HH", 56, headers)
    path = (loader or "").encode() + b"\0"
    return head + bytes(6) + struct.pack("<IIQQQQQQ", 3, 4, 120, 0, 0, len(path), len(path), 1) + path


def layer_of(*entries: Entry) -> enginecheck.Layer:
    return enginecheck.read_layer(gzip.compress(layer.tar(entries)))


BASE = layer_of(Entry("/lib64/ld.so", 0o755, b"loader"), Entry("/etc/passwd", 0o644, b"root"))
PROGRAMS = (Entry(OPERATOR, 0o755, program("/lib64/ld.so")), Entry(RUNNER, 0o755, program(None)))
CONFIG = {"Entrypoint": ["leaderboard-operator"], "User": "60973:60973", "Env": ["A=b", "PATH=/bin:/usr/local/bin"]}


def faults(*entries: Entry, **config: object) -> list[str]:
    """Of an image with these programs, and these parts of its configuration in place of the right ones."""
    return enginecheck.faults(Built({**CONFIG, **config}, [BASE, layer_of(*entries)]), [BASE.digest], SPEC)


class Image(unittest.TestCase):
    def test_the_base_with_both_programs_is_right(self) -> None:
        self.assertEqual(faults(*PROGRAMS), [])

    def test_how_it_is_run_is_compared(self) -> None:
        for key, value, word in (
            ("Entrypoint", None, "Entrypoint is []"),
            ("Entrypoint", ["sh", "-c", "leaderboard-operator"], "Entrypoint is ['sh', '-c'"),
            ("Cmd", ["controller"], "Cmd is ['controller']"),
            ("User", None, "User is ''"),
            ("User", "0", "User is '0'"),
            ("Env", ["PATH=/bin"], "leaderboard-operator is in no folder of its PATH, /bin"),
            ("Env", None, "leaderboard-operator is in no folder of its PATH, which is empty"),
        ):
            with self.subTest(word):
                (found,) = faults(*PROGRAMS, **{key: value})
                self.assertIn(word, found)

    def test_each_file_that_differs_is_named(self) -> None:
        operator, runner = PROGRAMS
        for entries, expected in (
            ([operator], f"{RUNNER} is missing"),
            ([*PROGRAMS, Entry("/src/Cargo.toml", 0o644, b"")], "/src/Cargo.toml is in it"),
            ([*PROGRAMS, Entry("/etc/.wh.passwd", 0o644, b"")], "/etc/.wh.passwd is in it"),
            ([*PROGRAMS, Entry("/usr/local/bin/sh", 0o777, target="/bin/busybox")], "/usr/local/bin/sh is in it"),
            ([operator, replace(runner, mode=0o644)], f"{RUNNER} has mode 644, and 755 expected"),
            ([operator, replace(runner, content=b"#!/bin/sh\n")], f"{RUNNER} is no program"),
            (
                [operator, replace(runner, content=program("/lib64/ld.so"))],
                f"{RUNNER} needs /lib64/ld.so, and a static",
            ),
            ([replace(operator, content=program(None)), runner], f"{OPERATOR} is static"),
            ([replace(operator, content=program("/lib/musl.so")), runner], f"{OPERATOR} needs /lib/musl.so, which its"),
        ):
            with self.subTest(expected):
                self.assertTrue(any(fault.startswith(expected) for fault in faults(*entries)), faults(*entries))

    def test_another_base_is_named(self) -> None:
        other = layer_of(Entry("/etc/passwd", 0o644, b"other"))
        found = enginecheck.faults(Built(CONFIG, [other, layer_of(*PROGRAMS)]), [BASE.digest], SPEC)
        self.assertEqual(found, ["its first layers are not those of its base"])

    def test_an_engine_s_layout_is_read(self) -> None:
        made = layer.build(PROGRAMS, CONFIG, "amd64")
        with tempfile.TemporaryDirectory() as folder:
            for path, content in layer.layout(made, "a:1").items():
                (Path(folder) / path).parent.mkdir(parents=True, exist_ok=True)
                (Path(folder) / path).write_bytes(content)
            built = enginecheck.read(Path(folder))
        self.assertEqual(built.config, CONFIG)
        self.assertEqual([one.digest for one in built.layers], [layer_of(*PROGRAMS).digest])
        self.assertEqual(built.layers[0].members[RUNNER], Member(0o755, False, program(None)))
        self.assertTrue(built.layers[0].members["/usr/local/bin"].is_dir)
        self.assertEqual(built.layers[0].pushed_bytes, len(made.blobs[made.layer]))

    def test_a_release_has_a_limit_as_a_registry_keeps_it(self) -> None:
        self.assertEqual(enginecheck.too_large(Built(CONFIG, [BASE])), [])
        heavy = replace(BASE, pushed_bytes=enginecheck.MOST_PUSHED_BYTES)
        self.assertEqual(
            enginecheck.too_large(Built(CONFIG, [BASE, heavy])),
            ["it has 30.0 MiB compressed, and 30.0 MiB are the most"],
        )

    def test_its_size_is_said_for_people(self) -> None:
        text = enginecheck.sizes(Built(CONFIG, [BASE, layer_of(Entry("/a", 0o755, bytes(3 << 20)))]), 1)
        self.assertRegex(text, r"^3\.0 MiB \(0\.0 MiB compressed\): base 0\.0 MiB .* programs 3\.0 MiB .* a 3\.0 MiB$")


class Text(unittest.TestCase):
    """What the build of the tests relies on in the Dockerfile."""

    def test_it_keeps_what_the_tests_fill(self) -> None:
        (run,) = re.findall(r"^RUN (.+?) \\$", TEXT, re.MULTILINE)
        self.assertEqual(run, dockerfile.CACHES)

    def test_each_argument_that_is_given_is_one_of_its_own(self) -> None:
        declared = set(re.findall(r"^ARG (\w+)=", TEXT, re.MULTILINE))
        self.assertEqual(declared, {"BUILD_IMAGE", "BASE_IMAGE", "REVISION", *dockerfile.selection(build.PROFILE)})

    def test_a_release_is_built_unless_told_otherwise(self) -> None:
        self.assertRegex(TEXT, r"(?m)^ARG PROFILE=release$")
        self.assertRegex(TEXT, r'(?m)^ARG PACKAGES="--package leaderboard-operator"$')
        self.assertEqual(dockerfile.selection("release"), {"PROFILE": "release"})
        workflow = (REPOSITORY / ".github" / "workflows" / "release.yaml").read_text()
        for argument in dockerfile.selection(build.PROFILE):
            self.assertNotIn(f"{argument}=", workflow)


class Machine(unittest.TestCase):
    """What of the machine stands in for the image of the compiler."""

    def test_folders_are_mounted_and_links_stay_links(self) -> None:
        with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, {"CARGO_HOME": "/nowhere"}):
            root = Path(folder)
            for place in ("usr/bin", "usr/lib", "usr/local/bin", "usr/share", "sbin", "etc/alternatives", "home"):
                (root / place).mkdir(parents=True)
            (root / "bin").symlink_to("usr/bin")
            self.assertEqual(dockerfile.system(root, links=True), ["bin"])
            mounts = dockerfile.machine_mounts(root)
        expected = ["/sbin", "/usr/bin", "/usr/lib", "/etc/alternatives"]
        self.assertEqual(list(mounts.values()), expected)
        self.assertEqual([str(place) for place in mounts], [f"{folder}{place}" for place in expected])

    def test_cargo_s_home_is_named_as_on_the_machine_and_leads_to_the_cache(self) -> None:
        for home, target in ((Path("/home/a/.cargo"), dockerfile.REGISTRY), (Path("/usr/local/cargo"), None)):
            with tempfile.TemporaryDirectory() as folder:
                made = dockerfile.build_image(Path(folder), home)
            content = gzip.decompress(made.blobs[made.layer])
            members = enginecheck.read_layer(content).members
            self.assertEqual(members[dockerfile.REGISTRY].is_dir, True)
            self.assertEqual(members[str(home / "registry")].is_dir, target is None)
            self.assertIn(f"CARGO_HOME={home}".encode(), made.blobs[made.config])

    def test_its_caches_get_libraries_and_no_programs(self) -> None:
        text = "\n".join(dockerfile.seed(["local"]))
        self.assertIn("cp -a .fingerprint build /src/target/local/", text)
        self.assertIn(r"find deps -maxdepth 1 \( -name 'lib*' -o -name '*.d' \)", text)
        self.assertEqual(len(dockerfile.folders("release")), len(set(dockerfile.folders("release"))))

    def test_what_is_mounted_can_t_be_written(self) -> None:
        self.assertEqual(engine.volumes({Path("/usr/lib"): "/usr/lib"}), ["--volume", "/usr/lib:/usr/lib:ro"])


class Caches(unittest.TestCase):
    """What a build keeps for the next one. The engine is a stand-in that fails as long as `broken` is among it."""

    def warm(self, own: SimpleNamespace) -> list[str]:
        """The Dockerfiles that were built."""
        built: list[str] = []

        def build(file: Path, *_: object) -> None:
            built.append(file.read_text())
            if (own.caches / "broken").exists():
                raise LabError("rm: cannot remove")

        own.build = build
        work = own.caches.parent / "work"
        work.mkdir(exist_ok=True)
        settings = SimpleNamespace(repository=REPOSITORY, logs=work)
        with (
            patch.object(dockerfile, "cache_key", return_value="key"),
            patch.object(dockerfile.build, "released_runner", side_effect=lambda _: built.append("released runner")),
            patch.dict(os.environ, {"CARGO_TARGET_DIR": str(own.caches.parent / "target")}),
            redirect_stderr(StringIO()),
        ):
            dockerfile.warm(settings, own, "local", {}, work)
        return built

    def test_caches_that_fail_are_thrown_away_and_filled_anew(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "target" / "local" / "deps").mkdir(parents=True)
            own = SimpleNamespace(caches=Path(folder) / "caches")
            own.caches.mkdir()
            filled = self.warm(own)
            self.assertEqual((len(filled), filled[0]), (2, "released runner"))
            self.assertIn("cp -a .fingerprint", filled[1])
            kept = self.warm(own)
            self.assertEqual(len(kept), 1)
            self.assertNotIn("cp -a", kept[0])
            (own.caches / "broken").touch()
            again = self.warm(own)
            self.assertEqual(again, [*kept, *filled])
            self.assertEqual((own.caches / "key").read_text(), "key")

    def test_caches_that_can_not_be_filled_are_no_warm_ones(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            own = SimpleNamespace(caches=Path(folder) / "caches")
            own.caches.mkdir()
            with patch.object(engine, "forget"), self.assertRaises(LabError):
                (own.caches / "broken").touch()
                self.warm(own)
            self.assertFalse((own.caches / "key").exists())


class Engines(unittest.TestCase):
    settings = SimpleNamespace(logs=Path("/nowhere"))

    def ensure(self, user: int, programs: set[str]) -> tuple[str, list[str]]:
        """What is found where `programs` are, and which packages were installed."""
        installed: list[str] = []

        def install(_: object, names: list[str]) -> None:
            installed.extend(names)
            programs.update(names)

        with (
            patch.object(engine.os, "geteuid", return_value=user),
            patch.object(engine.shutil, "which", side_effect=lambda name: f"/bin/{name}" if name in programs else None),
            patch.object(packages, "install", side_effect=install),
        ):
            return engine.ensure(self.settings), installed

    def test_it_is_installed_where_the_machine_has_none(self) -> None:
        self.assertEqual(self.ensure(0, {"buildah", "apt-get"}), ("/bin/buildah", []))
        self.assertEqual(self.ensure(0, {"apt-get"}), ("/bin/buildah", ["buildah"]))

    def test_what_a_machine_lacks_is_said(self) -> None:
        for user, programs, word in ((1000, {"buildah"}, "only root"), (0, {"docker"}, "no buildah and no apt-get")):
            with self.assertRaisesRegex(NotRun, word):
                self.ensure(user, programs)

    def test_nothing_is_removed_through_a_mount(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            own = engine.Engine("buildah", Path(folder) / "storage", Path(folder) / "caches")
            (own.storage / "root").mkdir(parents=True)
            with (
                patch.object(leftovers, "mounts_below", return_value=["/x/usr/lib"]),
                self.assertRaisesRegex(LabError, "/x/usr/lib is still mounted"),
            ):
                engine.clear(own)
            self.assertTrue(own.storage.is_dir())
            engine.clear(own)
            self.assertFalse(own.storage.exists())

    def test_one_that_outlives_its_run_keeps_the_next_one_out(self) -> None:
        """As a run that is killed leaves it behind, at work on the caches."""
        with tempfile.TemporaryDirectory() as folder:
            said, may_end = Path(folder) / "said", Path(folder) / "may-end"
            os.mkfifo(said)
            os.mkfifo(may_end)
            program = Path(folder) / "buildah"
            program.write_text(f"#!/bin/sh\necho runs >{said}\nread line <{may_end}\n")
            program.chmod(0o755)
            run = os.fork()
            if run == 0:
                with (
                    patch.object(engine, "ensure", return_value=str(program)),
                    engine.opened(SimpleNamespace(cache=Path(folder))) as own,
                ):
                    own.run("images", "--all")
                os._exit(1)
            self.assertEqual(said.read_text(), "runs\n")
            os.kill(run, signal.SIGKILL)
            os.waitpid(run, 0)
            with (Path(folder) / "dockerfile.lock").open("w") as lock:
                with self.assertRaises(BlockingIOError):
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                may_end.write_text("\n")
                # Waits for its end.
                fcntl.flock(lock, fcntl.LOCK_EX)


class NotRunLayers(unittest.TestCase):
    def test_a_layer_that_can_t_run_here_is_named_and_fails_nothing(self) -> None:
        def work(_: testrun.Plan) -> None:
            raise NotRun("no engine")

        with redirect_stderr(StringIO()):
            result = testrun.run_layer(
                testrun.Plan(SimpleNamespace(), ""), testrun.Layer("image", "it", work, testrun.COMPUTES), []
            )
        self.assertEqual((result.failure, result.lacks), ("", "no engine"))
        lines = testrun.table([testrun.Result("lab", 1.0, ""), result], 1.0, 0.0).splitlines()
        self.assertTrue(lines[3].endswith("   not run: no engine"))
        self.assertTrue(lines[4].endswith("   passed; not run: image"))


if __name__ == "__main__":
    unittest.main()
