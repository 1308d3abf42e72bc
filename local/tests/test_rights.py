"""Which rights are used, granted and refused, by made-up roles and lines of an audit log."""

import json
import tempfile
import unittest
from pathlib import Path
from typing import Any

from labkit import rights
from labkit.rights import RARE, Request, Right

OWN = "leaderboard.carla.org"
AT = "2026-11-23T04:00:00.123456Z"
BEFORE, AFTER = "2026-11-23T04:00:00.000000Z", "2026-11-23T04:00:01.000000Z"


def line(agent: str, verb: str, resource: str, name: str = "", namespace: str = "one", **more: Any) -> str:
    resource, _, part = resource.partition("/")
    about = {"resource": resource, "subresource": part, "apiGroup": OWN, "name": name, "namespace": namespace}
    made = {"verb": verb, "userAgent": agent, "objectRef": about, "requestReceivedTimestamp": AT}
    return json.dumps(made | more)


def used(
    program: str, verb: str, resource: str, name: str = "", namespace: str = "one", is_refused: bool = False
) -> Request:
    return Request(Right(program, verb, resource, OWN), namespace, name, is_refused)


def role(name: str, rules: list[dict[str, Any]], namespace: str | None = "one") -> list[dict[str, Any]]:
    kind = "Role" if namespace else "ClusterRole"
    metadata = {"name": name, "namespace": namespace} if namespace else {"name": name}
    subjects = [{"kind": "ServiceAccount", "name": name}]
    binding = {
        "kind": f"{kind}Binding",
        "metadata": metadata,
        "roleRef": {"kind": kind, "name": name},
        "subjects": subjects,
    }
    return [{"kind": kind, "metadata": metadata, "rules": rules}, binding]


def rule(verbs: list[str], resources: list[str], names: list[str] | None = None) -> dict[str, Any]:
    made: dict[str, Any] = {"apiGroups": [OWN], "resources": resources, "verbs": verbs}
    return made | ({"resourceNames": names} if names else {})


# Every exception is granted, as the comparison wants.
GRANTED: dict[Right, set[str] | None] = {
    **dict.fromkeys(RARE),
    Right("controller", "list", "submissions", OWN): None,
    Right("controller", "update", "leases", OWN): {"operator"},
    Right("bridge", "list", "leaderboards", OWN): None,
}
USED = [
    used("controller", "list", "submissions"),
    used("controller", "update", "leases", "operator"),
    used("bridge", "list", "leaderboards"),
]


class Rights(unittest.TestCase):
    def test_a_line_of_the_log_is_a_request_of_one_program(self) -> None:
        agent = "leaderboard-operator-controller/0.1.0"
        request = rights.request_of(line(agent, "patch", "submissions/status", "s"), BEFORE)
        self.assertEqual(request, used("controller", "patch", "submissions/status", "s"))
        forbidden = {"annotations": {"authorization.k8s.io/decision": "forbid"}}
        request = rights.request_of(line(agent, "list", "submissions", **forbidden), BEFORE)
        self.assertEqual(request, used("controller", "list", "submissions", is_refused=True))
        for other in (
            "kubectl/v1.35",
            "leaderboard-tests",
            "leaderboard-operator-other/1",
            "not-leaderboard-operator-bridge/1",
        ):
            self.assertIsNone(rights.request_of(line(other, "list", "submissions"), BEFORE), other)
        self.assertIsNone(rights.request_of(line(agent, "list", "submissions")[:-9], BEFORE))
        self.assertIsNone(rights.request_of(line(agent, "list", "submissions"), AFTER))
        self.assertIsNone(
            rights.request_of(json.dumps({"verb": "get", "userAgent": agent, "requestURI": "/version"}), "")
        )

    def test_logs_that_were_put_aside_are_read_too(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "audit.log"
            log.write_text(line("leaderboard-operator-bridge/1", "get", "submissions") + "\n")
            old = line("leaderboard-operator-controller/1", "list", "submissions")
            (Path(folder) / "audit-2026-11-23T04-00-00.000.log").write_text(old + "\nhalf a li")
            (Path(folder) / "kube-apiserver.log").write_text(old)
            found = list(rights.read(log, BEFORE))
        self.assertEqual(found, [used("controller", "list", "submissions"), used("bridge", "get", "submissions")])

    def test_roles_grant_what_their_rules_say_to_whom_they_are_bound(self) -> None:
        objects = [
            *role("operator-controller", [rule(["list", "watch"], ["submissions", "leaderboards"])]),
            *role("operator-controller", [rule(["get"], ["nodes"])], namespace=None),
            *role("operator-controller", [rule(["update"], ["leases"], ["a"])], namespace="two"),
            *role("operator-controller", [rule(["update"], ["leases"], ["b"])], namespace="three"),
            *role("operator-bridge", [rule(["list"], ["leaderboards"])]),
            {"kind": "ClusterRole", "metadata": {"name": "nobodys"}, "rules": [rule(["delete"], ["submissions"])]},
        ]
        self.assertEqual(
            rights.rights_of(objects),
            {
                Right("controller", "list", "submissions", OWN): None,
                Right("controller", "list", "leaderboards", OWN): None,
                Right("controller", "watch", "submissions", OWN): None,
                Right("controller", "watch", "leaderboards", OWN): None,
                Right("controller", "get", "nodes", OWN): None,
                Right("controller", "update", "leases", OWN): {"a", "b"},
                Right("bridge", "list", "leaderboards", OWN): None,
            },
        )

    def test_what_is_used_and_granted_is_no_difference(self) -> None:
        self.assertEqual(rights.differences(GRANTED, USED), [])

    def test_a_verb_that_is_used_and_not_granted_is_named(self) -> None:
        more = [used("bridge", "delete", "leaderboards"), used("controller", "update", "leases", "another")]
        self.assertEqual(
            rights.differences(GRANTED, [*USED, *more]),
            [
                f"used and not granted: bridge: delete leaderboards of {OWN}",
                f"used and not granted: controller: update leases of {OWN} another",
            ],
        )

    def test_a_verb_that_is_granted_and_not_used_is_named_unless_there_is_a_reason(self) -> None:
        idle = Right("bridge", "watch", "leaderboards", OWN)
        found = rights.differences({**GRANTED, idle: None}, USED)
        self.assertEqual(len(found), 1)
        self.assertIn(f"bridge: watch leaderboards of {OWN}", found[0])
        gone = next(iter(RARE))
        fewer = {right: names for right, names in GRANTED.items() if right != gone}
        self.assertIn(gone.text(), rights.differences(fewer, USED)[0])
        self.assertTrue(all(RARE.values()))

    def test_a_log_without_the_programs_is_no_success(self) -> None:
        self.assertEqual(rights.differences(GRANTED, []), ["the audit log has no request of bridge and controller"])
        self.assertEqual(rights.differences(GRANTED, USED[:2]), ["the audit log has no request of bridge"])

    def test_a_refusal_counts_only_where_the_right_was_never_there(self) -> None:
        passing = [used("bridge", "list", "leaderboards", is_refused=True)]
        self.assertEqual(rights.differences(GRANTED, [*USED, *passing]), [])
        lasting = [used("bridge", "list", "leaderboards", namespace="two", is_refused=True)]
        self.assertEqual(
            rights.differences(GRANTED, [*USED, *lasting]),
            [f"refused and never allowed: bridge: list leaderboards of {OWN} in two"],
        )


if __name__ == "__main__":
    unittest.main()
