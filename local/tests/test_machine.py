"""What the lab reads from the machine: mounts, address translation rules, libraries, settings, failures of registries."""

import json
import os
import struct
import subprocess
import tempfile
import unittest
from pathlib import Path

from labkit import cluster, components, console, elf, files, gpus, image, leftovers, network, pki, settings
from labkit.errors import LabError

MOUNTS = """22 1 254:0 / / rw - ext4 /dev/vda rw
90 22 0:40 / /srv/.local/run/netns/a rw - tmpfs tmpfs rw
91 22 0:41 / /srv/.local/data/with\\040blank rw - tmpfs tmpfs rw
92 91 0:42 / /srv/.local/data/with\\040blank/inner rw - tmpfs tmpfs rw
93 22 0:43 / /srv/.localother/data rw - tmpfs tmpfs rw
"""
RULES = """*nat
:POSTROUTING ACCEPT [0:0]
:CNI-aa11 - [0:0]
-A POSTROUTING -s 10.77.0.10/32 -m comment --comment "name: \\"leaderboard-local\\" id: \\"5896\\"" -j CNI-aa11
-A POSTROUTING -s 172.17.0.2/32 -m comment --comment "name: \\"other\\" id: \\"77\\"" -j CNI-bb22
-A CNI-aa11 -d 10.77.0.0/24 -m comment --comment "name: \\"leaderboard-local\\" id: \\"5896\\"" -j ACCEPT
-A CNI-bb22 -d 172.17.0.0/16 -m comment --comment "name: \\"other\\" id: \\"77\\"" -j ACCEPT
COMMIT
"""
LDD = """\tlinux-vdso.so.1 (0x00007ffe7a9f5000)
\tlibtinfo.so.6 => /lib/x86_64-linux-gnu/libtinfo.so.6 (0x00007f5be8d6c000)
\tlibc.so.6 => /lib/x86_64-linux-gnu/libc.so.6 (0x00007f5be8b8b000)
\t/lib64/ld-linux-x86-64.so.2 (0x00007f5be8f06000)
"""


def lab(**env: str) -> settings.Settings:
    return settings.load(Path("/srv/repo"), {"HOME": "/home/a", **env})


class Leftovers(unittest.TestCase):
    def test_only_our_mounts_are_found_innermost_first(self) -> None:
        found = leftovers.mounts_below(MOUNTS, "/srv/.local")
        inner = "/srv/.local/data/with blank/inner"
        self.assertEqual(found, [inner, "/srv/.local/data/with blank", "/srv/.local/run/netns/a"])

    def test_only_our_rules_are_removed(self) -> None:
        removals = network.masquerade_removals(RULES)
        jump = ["-D", "POSTROUTING", "-s", "10.77.0.10/32", "-m", "comment", "--comment"]
        jump += ['name: "leaderboard-local" id: "5896"', "-j", "CNI-aa11"]
        self.assertEqual(removals, [jump, ["-F", "CNI-aa11"], ["-X", "CNI-aa11"]])
        self.assertEqual(network.masquerade_removals(""), [])

    def test_the_links_of_a_bridge_that_is_gone_are_none(self) -> None:
        self.assertEqual(network.our_veths(""), [])
        self.assertEqual(network.our_veths("not json"), [])
        self.assertEqual(network.our_veths('[{"ifname": "veth1"}, {}]'), ["veth1"])


class Holders(unittest.TestCase):
    def test_a_process_of_another_cluster_is_ended_by_its_own_down(self) -> None:
        def ending(**env: str) -> str:
            argv = ["sh", "-c", "echo; read _"]
            with subprocess.Popen(argv, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
                process.stdout.readline()
                found = cluster.ending(process.pid)
                process.stdin.close()
            return found

        self.assertEqual(
            ending(LEADERBOARD_LAB_OWNER="/srv/b/.local:etcd"),
            "run `LEADERBOARD_LAB_STATE=/srv/b/.local local/lab down`",
        )
        self.assertEqual(ending(PATH=os.environ["PATH"]), "end that")
        self.assertEqual(cluster.ending(None), "end that")


class Libraries(unittest.TestCase):
    def test_the_loader_is_one_of_them_and_the_kernel_s_is_not(self) -> None:
        expected = [
            "/lib/x86_64-linux-gnu/libc.so.6",
            "/lib/x86_64-linux-gnu/libtinfo.so.6",
            "/lib64/ld-linux-x86-64.so.2",
        ]
        self.assertEqual(elf.parse_ldd(LDD, "bash"), expected)

    def test_a_missing_one_is_named(self) -> None:
        with self.assertRaisesRegex(LabError, r"tool needs libx\.so\.1, which this machine lacks"):
            elf.parse_ldd("\tlibx.so.1 => not found\n", "tool")

    def test_the_loader_is_read_from_the_program_s_headers(self) -> None:
        head = b"\x7fELF\x02\x01" + bytes(26) + struct.pack("<Q", 64) + bytes(14) + struct.pack("<HH", 56, 1) + bytes(6)
        header = struct.pack("<IIQQQQQQ", 3, 4, 120, 0, 0, 7, 7, 1)
        self.assertEqual(elf.interpreter(head + header + b"/lib/x\0"), "/lib/x")
        self.assertIsNone(elf.interpreter(head.replace(struct.pack("<HH", 56, 1), struct.pack("<HH", 56, 0)) + header))
        for content in (b"", b"#!/bin/sh\n", head, b"\x7fELF\x02\x01"):
            self.assertIsNone(elf.interpreter(content))


class Binaries(unittest.TestCase):
    def test_cargo_s_folders_are_searched_for_the_profile(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder)
            self.assertEqual(image.Search({}, target, "local").candidates("tool"), [])
            for profile in ("local", "debug"):
                (target / profile).mkdir()
                (target / profile / "tool").write_text(profile)
            self.assertEqual(image.Search({}, target, "local").candidates("tool"), [target / "local" / "tool"])
            self.assertEqual(image.Search({}, target, "dev").candidates("tool"), [target / "debug" / "tool"])

    def test_a_binary_given_by_hand_must_exist(self) -> None:
        self.assertEqual(image.given_binaries([f"me={__file__}"]), {"me": Path(__file__).absolute()})
        for pair in ("me", "me=/nonexistent"):
            with self.assertRaises(LabError):
                image.given_binaries([pair])


class Places(unittest.TestCase):
    def test_the_defaults(self) -> None:
        self.assertEqual(lab().state, Path("/srv/repo/.local"))
        self.assertEqual(lab().cache, Path("/home/a/.cache/leaderboard-operator/tools"))
        self.assertEqual(lab().api_endpoint, "https://10.77.0.1:16443")
        self.assertEqual(lab().registry, "10.77.0.1:4566")

    def test_what_the_environment_overrides(self) -> None:
        self.assertEqual(lab(XDG_CACHE_HOME="/c").cache, Path("/c/leaderboard-operator/tools"))
        self.assertEqual(lab(LEADERBOARD_TOOLS="/t", XDG_CACHE_HOME="/c").cache, Path("/t"))
        self.assertEqual(lab(LEADERBOARD_LAB_STATE="/s").state, Path("/s"))
        self.assertEqual(lab(LEADERBOARD_LAB_PORT_AWS="4567").aws_endpoint, "http://10.77.0.1:4567")

    def test_a_port_must_be_one(self) -> None:
        for text in ("0", "65536", "x", "-1", "1.5"):
            with self.assertRaisesRegex(LabError, "LEADERBOARD_LAB_PORT_AWS"):
                lab(LEADERBOARD_LAB_PORT_AWS=text)


class Configuration(unittest.TestCase):
    def parts(self, **env: str) -> dict[str, components.Component]:
        made = components.all_components(
            lab(**env), Path("/tools"), Path("/venv/python"), "/usr/bin/containerd", "/usr/lib/cni"
        )
        return {part.name: part for part in made}

    def test_nothing_listens_beyond_the_machine(self) -> None:
        for part in self.parts().values():
            for address, _ in part.listens:
                self.assertIn(address, ("127.0.0.1", settings.HOST_ADDRESS), part.name)
            self.assertFalse([word for word in part.argv if "0.0.0.0" in word], part.name)

    def test_no_two_parts_share_a_port(self) -> None:
        listens = [pair for part in self.parts().values() for pair in part.listens]
        self.assertEqual(len(listens), len(set(listens)))

    def test_a_changed_port_changes_the_digests_of_those_that_use_it(self) -> None:
        before, after = self.parts(), self.parts(LEADERBOARD_LAB_PORT_AWS="4567")
        changed = {name for name in before if before[name].digest() != after[name].digest()}
        self.assertEqual(changed, {"aws", "containerd"})

    def test_pods_reach_the_internet_only_on_request(self) -> None:
        self.assertFalse(json.loads(files.cni(lab()))["plugins"][0]["ipMasq"])
        self.assertTrue(json.loads(files.cni(lab(LEADERBOARD_LAB_INTERNET="1")))["plugins"][0]["ipMasq"])

    def test_a_built_containerd_takes_the_place_of_the_systems_with_its_own_shim(self) -> None:
        with_system, with_built = lab(), lab(LEADERBOARD_LAB_CONTAINERD="built")
        self.assertNotIn("containerd", cluster.tools_of(with_system))
        for tool in ("containerd", "containerd-shim-runc-v2"):
            self.assertIn(tool, cluster.tools_of(with_built))
        made = components.containerd(with_built, "/tools/containerd")
        self.assertEqual(made.env["PATH"].split(":")[0], "/tools")

    def test_the_stand_in_of_gpus_has_the_rights_of_the_node(self) -> None:
        made = gpus.component(lab(), Path("/tools"))
        self.assertIn("-kubeconfig=/srv/repo/.local/pki/node.kubeconfig", made.argv)
        self.assertIn("gpus", cluster.GUESTS)

    def test_the_stand_in_serves_nothing_that_runs_code(self) -> None:
        served = self.parts()["aws"].env["SERVICES"].split(",")
        self.assertEqual(set(served) & {"lambda", "ecs", "ec2", "codebuild", "states", "batch"}, set())
        self.assertLessEqual({"sqs", "s3", "dynamodb", "secretsmanager", "logs", "ecr", "sts"}, set(served))

    def test_only_the_admins_reads_are_audited(self) -> None:
        rules = json.loads(files.audit_policy())["rules"]
        reads = ["get", "list", "watch"]
        of_admin = {"level": "Metadata", "verbs": reads, "users": ["admin"], "omitStages": ["ResponseStarted"]}
        self.assertEqual(rules[:2], [of_admin, {"level": "None", "verbs": reads}])
        self.assertEqual(rules[-1], {"level": "Metadata"})

    def test_the_server_s_certificate_names_every_address_it_is_reached_at(self) -> None:
        (server,) = [one for one in pki.CERTIFICATES if one.name == "apiserver"]
        for address in (settings.HOST_ADDRESS, settings.API_SERVICE_ADDRESS):
            self.assertIn(f"IP:{address}", server.addresses.split(","))


class Words(unittest.TestCase):
    def test_a_network_failure_differs_from_others(self) -> None:
        output = 'go: x@v1: Get "http://p/x": dial tcp: lookup p: no such host\nexit status 1\n'
        self.assertIn("no such host", console.network_failure(output) or "")
        self.assertIsNone(console.network_failure("main.go:1: syntax error\n"))

    def test_durations(self) -> None:
        self.assertEqual([console.seconds(value) for value in (0.24, 37.4, 387)], ["0.2 s", "37 s", "6 min 27 s"])


if __name__ == "__main__":
    unittest.main()
