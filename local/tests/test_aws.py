"""examples/aws: templates, policies and the cluster's file, as far as they can be checked without AWS."""

import functools
import json
import os
import re
import socket
import subprocess
import tempfile
import time
import unittest
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from labkit import awscalls, pythonenv, settings

REPOSITORY = Path(__file__).resolve().parents[2]
AWS = REPOSITORY / "examples" / "aws"
EXAMPLES = REPOSITORY / "examples"
POLICIES = AWS / "iam"
README = REPOSITORY / "charts" / "leaderboard-operator" / "README.md"
GUIDE = REPOSITORY / "docs" / "aws.md"
PLACEHOLDER = re.compile(r"<[A-Z][A-Z_]+>")
# These stay for who needs them; the guide has a row for each.
NOT_FOR_ALL = {"<OIDC>", "<KEY_ID>", "<KARPENTER_NODE_ROLE>"}
# Without a resource of their own in IAM.
FOR_EVERYTHING = {"ecr:GetAuthorizationToken", "sts:GetFederationToken"}
# Row of the chart's README -> the policy that has the same actions.
ROWS = {
    "controller": "controller",
    "bridge": "bridge",
    "Pods of submissions": "submission-worker",
    "controller, where `logs.cloudWatch.retentionDays` is set": "log-groups",
    "controller and Pods, where S3 uses a key of KMS": "kms",
}
# Keys of eksctl's schema that the file may use, so that a misspelled one is noticed.
CLUSTER = {"apiVersion", "kind", "metadata", "iam", "vpc", "addons", "managedNodeGroups", "nodeGroups"}
GROUP = {"name", "amiFamily", "ami", "instanceType", "minSize", "desiredCapacity", "maxSize", "privateNetworking"}
GROUP |= {"disablePodIMDS", "volumeSize", "volumeType", "volumeEncrypted", "labels", "taints", "tags", "iam"}
GROUP |= {"overrideBootstrapCommand"}
TEMPLATE = "k8s.io/cluster-autoscaler/node-template"


@functools.cache
def programs() -> Path:
    return pythonenv.ensure(settings.load(REPOSITORY))


def in_environment(arguments: Sequence[str], **environment: str) -> Any:
    """What a part of labkit says that needs the lab's virtual environment."""
    env = {"PYTHONPATH": str(REPOSITORY / "local"), "PYTHONDONTWRITEBYTECODE": "1", **environment}
    argv = [str(programs() / "python"), "-m", "labkit.aws_examples", *arguments]
    done = subprocess.run(argv, env={**os.environ, **env}, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise AssertionError(done.stderr[-2000:])
    return json.loads(done.stdout)


@functools.cache
def parsed(name: str) -> list[Any]:
    file = str(AWS / name)
    return in_environment(["yaml", file])[file]


def text_as_yaml(text: str) -> Any:
    """A file within a file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "text.yaml"
        file.write_text(text)
        ((found,),) = in_environment(["yaml", str(file)]).values()
    return found


def gpus_of(file: Path) -> int:
    """GPUs that a Pod of a Leaderboard requests. `PerContainer`: one for each simulator and each agent."""
    ((leaderboard,),) = in_environment(["yaml", str(file)]).values()
    gpu, pairs = leaderboard["spec"]["gpu"], leaderboard["spec"]["evaluation"]["carla"].get("pairs", 4)
    assert gpu == {"resourceName": "nvidia.com/gpu"}, gpu
    return 2 * pairs


@functools.cache
def source() -> awscalls.Source:
    found = in_environment(["operations", *awscalls.SERVICES])
    return awscalls.Source(REPOSITORY, frozenset(name for names in found.values() for name in names))


@contextmanager
def stand_in() -> Iterator[dict[str, str]]:
    """A stand-in for AWS, as environment for its clients."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "log").open("w") as log:
        env = {**os.environ, "BIND_HOST": "127.0.0.1", "GATEWAY_PORT": str(port)}
        process = subprocess.Popen([str(programs() / "ministack")], env=env, stdout=log, stderr=log)
        try:
            await_health(f"http://127.0.0.1:{port}/_ministack/health")
            keys = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test"}
            region = {"AWS_REGION": "us-east-1", "AWS_DEFAULT_REGION": "us-east-1", "AWS_EC2_METADATA_DISABLED": "true"}
            yield {**keys, **region, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}
        finally:
            process.kill()
            process.wait()


def await_health(url: str) -> None:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        try:
            with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(url, timeout=5):
                return
        except OSError:
            time.sleep(0.1)
    raise AssertionError(f"{url} does not answer")


class Templates(unittest.TestCase):
    def test_cfn_lint_finds_nothing(self) -> None:
        files = sorted(str(file) for file in (AWS / "cloudformation").glob("*.yaml"))
        self.assertEqual(len(files), 4)
        argv = [str(programs() / "cfn-lint"), "--regions", "us-east-1", "us-west-2", "--", *files]
        done = subprocess.run(argv, capture_output=True, text=True, check=False)
        self.assertEqual((done.returncode, done.stdout), (0, ""), done.stderr)

    def test_they_make_what_the_operator_needs(self) -> None:
        with stand_in() as environment:
            found = in_environment(["deploy", str(AWS / "cloudformation")], **environment)
        queue, dead = found["queues"]["challenge-1-production"], found["queues"]["leaderboard-submissions-dead"]
        for attributes in (queue, dead):
            self.assertEqual(attributes["MessageRetentionPeriod"], "1209600")
            # It would put messages away without a reason.
            self.assertNotIn("RedrivePolicy", attributes)
        keys = [(key["AttributeName"], key["KeyType"]) for key in found["keys"]]
        self.assertEqual(keys, [("team-id", "HASH"), ("submission-id", "RANGE")])
        groups = [(group["logGroupName"], group["retentionInDays"]) for group in found["groups"]]
        self.assertEqual(groups, [("leaderboard-20", 30)])
        rule = found["encryption"]["Rules"][0]["ApplyServerSideEncryptionByDefault"]
        self.assertEqual(rule["SSEAlgorithm"], "AES256")
        wanted = ["leaderboard/contents", "leaderboard/operator", "leaderboard/simulator"]
        self.assertEqual(sorted(found["repositories"]), wanted)


class Policies(unittest.TestCase):
    def test_each_program_may_do_what_it_calls_and_nothing_else(self) -> None:
        self.assertEqual(list(awscalls.faults(source(), POLICIES)), [])

    def test_the_calls_of_each_program_are_found(self) -> None:
        # Some that are certain, so that a scan that finds nothing is no success.
        for program, calls in (
            ("controller", {"get_object", "put_object", "list_objects_v2", "upload_part", "update_item"}),
            ("bridge", {"receive_message", "send_message"}),
            ("submission-worker", {"upload_part_copy", "delete_object", "put_log_events"}),
        ):
            self.assertLessEqual(calls, source().of_program(program), program)
        self.assertNotIn("delete_object", source().of_program("controller"))
        self.assertNotIn("put_object", source().of_program("bridge"))

    def test_every_reason_of_an_indirect_action_is_used(self) -> None:
        allowed = {(file.stem, action) for file in POLICIES.glob("*.json") for action, _ in awscalls.actions(file)}
        self.assertEqual(awscalls.INDIRECT.keys() - allowed, set())
        self.assertTrue(all(awscalls.INDIRECT.values()))
        kms = {action for policy, action in awscalls.INDIRECT if policy == "kms"}
        self.assertEqual({action for action, _ in awscalls.actions(POLICIES / "kms.json")}, kms)

    def test_nothing_is_for_every_resource_that_has_resources(self) -> None:
        for file in sorted(POLICIES.glob("*.json")):
            for action, resources in awscalls.actions(file):
                if file.name.startswith("trust-") or action in FOR_EVERYTHING:
                    continue
                for resource in resources:
                    self.assertRegex(resource, r"^arn:aws:[a-z0-9]+:.*[a-z0-9>]", f"{file.name}: {action}")
            self.assertNotIn('"*"', [a for a, _ in awscalls.actions(file)])

    def test_the_controller_writes_two_objects_of_a_run_and_its_submitted_file(self) -> None:
        files = ("crates/contract/src/report.rs", "crates/contract/src/keys.rs", "crates/api/src/names.rs")
        keys = "".join((REPOSITORY / name).read_text() for name in files)
        own = set(re.findall(r'(?:OWNER_KEY|FAILURE_LOG_KEY): &str = "(.+)"', keys))
        submitted = set(re.findall(r'INPUT: &str = "(.+)"', keys))
        self.assertEqual((len(own), submitted), (2, {"input/"}))
        allowed: dict[str, set[str]] = {}
        for action, resources in awscalls.actions(POLICIES / "controller.json"):
            allowed.setdefault(action, set()).update(resource.partition("/*/")[2] for resource in resources)
        parts = {f"{folder}*" for folder in submitted}
        self.assertEqual(allowed["s3:PutObject"], own | parts)
        self.assertEqual(allowed["s3:AbortMultipartUpload"], parts)

    def test_a_session_of_a_pod_has_the_rights_of_its_role(self) -> None:
        code = awscalls.TESTS.sub("", (REPOSITORY / "crates/pod/src/identity.rs").read_text())
        names = ("submission-worker", "kms")
        role = {action for name in names for action, _ in awscalls.actions(POLICIES / f"{name}.json")}
        # The last one is a condition.
        self.assertEqual(set(awscalls.ACTION.findall(code)) - {"kms:ViaService"}, role)

    def test_pod_identity_is_let_through_where_the_operator_is_confined(self) -> None:
        self.assertIs(parsed("values.yaml")[0]["networkPolicy"]["enabled"], True)
        after = GUIDE.read_text().split("create-pod-identity-association")[1]
        rule = text_as_yaml(after.split("```yaml\n")[1].split("```")[0])["networkPolicy"]["egress"]["extra"][0]
        self.assertEqual((rule["to"][0]["ipBlock"]["cidr"], rule["ports"][0]["port"]), ("169.254.170.23/32", 80))

    def test_the_charts_readme_has_the_same_actions(self) -> None:
        text = README.read_text()
        for row, policy in ROWS.items():
            line = next((line for line in text.splitlines() if line.startswith(f"| {row} | ")), "")
            actions = {action for action, _ in awscalls.actions(POLICIES / f"{policy}.json")}
            self.assertEqual(set(awscalls.ACTION.findall(line)), actions, row)

    def test_what_is_missing_unused_or_unknown_is_named(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            for name, actions in (
                ("controller", ["s3:GetObject", "s3:DeleteObject"]),
                ("log-groups", []),
                ("bridge", ["sqs:ReceiveMessage"]),
                ("submission-worker", ["s3:PutObject"]),
            ):
                statement = {"Effect": "Allow", "Action": actions, "Resource": "arn:aws:s3:::b/*"}
                (Path(folder) / f"{name}.json").write_text(json.dumps({"Statement": [statement]}))
            operations = frozenset({"get_object", "list_buckets", "receive_message", "put_object"})
            small = awscalls.Source(Path(folder), operations)
            small.texts = {
                "crates/aws/src/archive.rs": "pub async fn get(&self) { x.get_object() }\nfn put(&self) { x.put_object() }",
                "src/submissions/a.rs": "archive.get(key); client.list_buckets()",
                "src/bridge/a.rs": "client.receive_message()",
                "crates/pod/a.rs": "use aws_sigv4::sign;",
            }
            found = "\n".join(awscalls.faults(small, Path(folder)))
        for part in (
            "list_buckets: no action in awscalls.py",
            "put_object: no program that awscalls.py knows calls it",
            "controller is allowed s3:DeleteObject and never calls it",
            "submission-worker is allowed s3:PutObject and never calls it",
            "crates/pod/a.rs signs requests",
        ):
            self.assertIn(part, found)


class Cluster(unittest.TestCase):
    def setUp(self) -> None:
        (self.cluster,) = parsed("cluster.yaml")

    def test_only_keys_of_eksctl_are_used(self) -> None:
        self.assertEqual(self.cluster.keys() - CLUSTER, set())
        for group in [*self.cluster["managedNodeGroups"], *self.cluster["nodeGroups"]]:
            self.assertEqual(group.keys() - GROUP, set(), group["name"])

    def test_an_autoscaler_can_start_the_first_gpu_node(self) -> None:
        (gpu,) = self.cluster["nodeGroups"]
        tags, name = gpu["tags"], self.cluster["metadata"]["name"]
        self.assertEqual((gpu["minSize"], gpu["desiredCapacity"]), (0, 0))
        self.assertEqual(tags[f"k8s.io/cluster-autoscaler/{name}"], "owned")
        self.assertIn(f"{TEMPLATE}/resources/ephemeral-storage", tags)
        for key, value in gpu["labels"].items():
            self.assertEqual(tags[f"{TEMPLATE}/label/{key}"], value)
        for taint in gpu["taints"]:
            self.assertEqual(tags[f"{TEMPLATE}/taint/{taint['key']}"], f"{taint['value']}:{taint['effect']}")
        (values,) = parsed("cluster-autoscaler-values.yaml")
        self.assertEqual(values["autoDiscovery"]["clusterName"], name)

    def test_a_node_has_the_gpus_that_one_submission_requests(self) -> None:
        (gpu,) = self.cluster["nodeGroups"]
        _, pool, overlay = parsed("karpenter.yaml")
        (plugin,) = parsed("device-plugin-values.yaml")
        (test,) = parsed("gpu-test.yaml")
        requested = {gpus_of(EXAMPLES / name) for name in ("leaderboard-10.yaml", "leaderboard-20.yaml")}
        (shared,) = text_as_yaml(plugin["config"]["map"]["default"])["sharing"]["timeSlicing"]["resources"]
        # A g5.12xlarge has four.
        shown = {4 * shared["replicas"]}
        self.assertEqual(shared["name"], "nvidia.com/gpu")
        self.assertEqual(requested, shown)
        self.assertEqual({int(gpu["tags"][f"{TEMPLATE}/resources/nvidia.com/gpu"])}, shown)
        self.assertEqual({int(overlay["spec"]["capacity"]["nvidia.com/gpu"])}, shown)
        self.assertEqual({int(test["spec"]["containers"][0]["resources"]["limits"]["nvidia.com/gpu"])}, shown)
        self.assertEqual(int(pool["spec"]["limits"]["nvidia.com/gpu"]), gpu["maxSize"] * shown.pop())
        # Where the plugin runs.
        self.assertTrue(any(f'"{key}"' in json.dumps(plugin["affinity"]) for key in gpu["labels"]))

    def test_the_first_pod_says_what_the_driver_lacks_to_draw(self) -> None:
        (test,) = parsed("gpu-test.yaml")
        (container,) = test["spec"]["containers"]
        vulkan, opengl = "usr/share/vulkan/icd.d/nvidia_icd.x86_64.json", "usr/lib64/libGLX_nvidia.so.0"
        for files, missing in [
            ([vulkan, opengl], []),
            ([vulkan], ["MISSING libGLX_nvidia.so.0"]),
            ([opengl], ["MISSING nvidia_icd*.json"]),
            ([], ["MISSING nvidia_icd*.json", "MISSING libGLX_nvidia.so.0"]),
        ]:
            with tempfile.TemporaryDirectory() as root:
                for name in ["dev/nvidia0", "etc/hosts", "lib/x", "usr/x", *files]:
                    path = Path(root) / name
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.touch()
                ran = subprocess.run(
                    container["command"], env={**os.environ, "ROOT": root}, capture_output=True, text=True
                )
            self.assertEqual(ran.returncode, 0, ran.stderr)
            found = [line for line in ran.stdout.splitlines() if line.startswith("MISSING")]
            self.assertEqual(found, missing)
        with tempfile.TemporaryDirectory() as root:
            ran = subprocess.run(container["command"], env={**os.environ, "ROOT": root}, capture_output=True, text=True)
        self.assertEqual(ran.returncode, 1, "a Pod without a GPU does not succeed")

    def test_no_pod_gets_the_nodes_role_and_policies_are_enforced(self) -> None:
        groups = [*self.cluster["managedNodeGroups"], *self.cluster["nodeGroups"]]
        self.assertTrue(all(group["disablePodIMDS"] and group["privateNetworking"] for group in groups))
        cni = next(addon for addon in self.cluster["addons"] if addon["name"] == "vpc-cni")
        self.assertEqual(json.loads(cni["configurationValues"])["enableNetworkPolicy"], "true")

    def test_roles_fit_policies_service_accounts_and_trust(self) -> None:
        self.assertTrue(self.cluster["iam"]["withOIDC"])
        accounts = {one["roleName"]: one for one in self.cluster["iam"]["serviceAccounts"] if "roleName" in one}
        for program in awscalls.PROGRAMS:
            account = accounts.pop(f"leaderboard-{program}")
            self.assertTrue(account["roleOnly"], "with an account of eksctl's its annotation would come along")
            policies = [arn.rpartition("/")[2] for arn in account["attachPolicyARNs"]]
            self.assertEqual(policies, [f"leaderboard-{program}"])
            trust = json.loads((POLICIES / f"trust-{program}.json").read_text())["Statement"][0]
            subject = f"system:serviceaccount:{account['metadata']['namespace']}:{account['metadata']['name']}"
            self.assertEqual(trust["Condition"]["StringEquals"]["<OIDC>:sub"], subject)
        self.assertEqual(accounts, {})

    def test_nodes_are_set_up_alike_by_eksctl_and_karpenter(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            by_eksctl = Path(folder) / "eksctl.yaml"
            by_eksctl.write_text(self.cluster["nodeGroups"][0]["overrideBootstrapCommand"])
            node_class, pool, _ = parsed("karpenter.yaml")
            by_karpenter = Path(folder) / "karpenter.yaml"
            by_karpenter.write_text(node_class["spec"]["userData"])
            files = [str(by_eksctl), str(by_karpenter)]
            (one,), (other,) = in_environment(["yaml", *files]).values()
        self.assertEqual(one["spec"]["instance"]["localStorage"]["strategy"], node_class["spec"]["instanceStorePolicy"])
        self.assertEqual(one["spec"]["kubelet"], other["spec"]["kubelet"])
        self.assertEqual(pool["spec"]["template"]["spec"]["taints"], self.cluster["nodeGroups"][0]["taints"])


class Guide(unittest.TestCase):
    def test_every_placeholder_is_explained_and_replaced(self) -> None:
        text = GUIDE.read_text()
        command = next(line for line in text.splitlines() if line.startswith("sed -i "))
        used = set()
        for file in [*AWS.glob("*.yaml"), *POLICIES.glob("*.json")]:
            used |= set(PLACEHOLDER.findall(file.read_text()))
        self.assertEqual(used, set(PLACEHOLDER.findall(command)) | NOT_FOR_ALL)
        rows = {name for line in text.splitlines() if line.startswith("| `<") for name in PLACEHOLDER.findall(line)}
        self.assertEqual(rows, used)

    def test_every_file_is_in_the_guide(self) -> None:
        text = GUIDE.read_text() + (AWS / "README.md").read_text()
        for file in AWS.rglob("*.*"):
            name = str(file.relative_to(AWS))
            shown = "iam/trust-*.json" if name.startswith("iam/trust-") and name not in text else name
            self.assertIn(shown, text, f"{name} is in no guide")


if __name__ == "__main__":
    unittest.main()
