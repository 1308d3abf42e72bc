"""Owns the checks of the Helm chart: text, values, what it renders, and what a real API server makes of it.

Called by `lab chart-test`. The API server is a throwaway one without nodes; it answers what the two accounts may do and what not.
"""

import json
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from . import (
    apidocs,
    apiserver,
    artifacthub,
    book,
    chartalerts,
    chartcases,
    chartdocs,
    chartnotes,
    chartrender,
    chartsets,
    doccheck,
    docruns,
    kubeversions,
    metricdocs,
    programdocs,
    release,
    schemas,
    tools,
)
from .chartcases import RELEASE, SET_IMAGE, SYSTEM, Access
from .chartrender import documents
from .console import say, seconds
from .errors import LabError
from .kube import Kube, at_once
from .settings import Settings

# The Jobs that the operator's tests hold its own against.
JOBS = "crates/pod-spec/src/job/golden"
# The kind of each object of a YAML text, or of a JSON one.
KIND = re.compile(r"""^(?:kind: |  "kind": ")(\w+)""", re.MULTILINE)
CRDS = ("leaderboards.leaderboard.carla.org", "submissions.leaderboard.carla.org")


def run(settings: Settings, update: bool) -> None:
    """All checks; raises with the first ones that fail."""
    chart = chartrender.folder(settings.repository)
    generated, copied = settings.repository / "crds", chart / "files" / "crds"
    jobs = settings.repository / JOBS
    if update:
        copy_definitions(generated, copied)
    folder = tools.ensure(settings, [*apiserver.TOOLS, chartalerts.TOOL])
    check("the chart's copy of crds/", lambda: same_definitions(generated, copied))
    check("a reason above every rule", lambda: rules_have_reasons(chart))
    check("values.yaml and the README's table", lambda: chartdocs.same_table(chart))
    check("values.yaml and its schema", lambda: chartdocs.same_schema(chart))
    check("metrics and their page", lambda: metricdocs.same(settings.repository))
    check("the API and its pages", lambda: apidocs.same(settings.repository))
    check("exit codes, status files and their page", lambda: programdocs.same(settings.repository))
    check("what Artifact Hub reads", lambda: artifacthub.check(settings.repository))
    check("one version", lambda: release.version(settings.repository))
    check("a runbook for each alert", lambda: doccheck.runbooks(settings.repository))
    check("the documents as a book", lambda: book.make(settings))
    check("when each alert fires", lambda: chartalerts.fire(settings.repository, folder))
    started = time.monotonic()
    with apiserver.running(settings, folder) as kube:
        say(f"an API server of its own is ready ({seconds(time.monotonic() - started)})")
        for name in chartcases.NAMESPACES:
            kube.run("kubectl", "create", "namespace", name)
        check("helm lint --strict", lambda: lint(kube, chart))
        check("values that must be refused", lambda: refused_values(kube, chart))
        check("what each value shows in the objects", lambda: chartrender.every_value(kube, chart))
        check("what people of other charts type", lambda: chartsets.typed(kube, chart))
        shown = chartnotes.texts(kube, chart)
        check("NOTES.txt", lambda: chartnotes.notes(shown))
        check("alerts and dashboard", lambda: chartrender.queries(kube, chart, settings.repository))
        rendered = {file.name if file else "defaults.yaml": render(kube, chart, file) for file in values_files(chart)}
        given = rendered | {file.name: file.read_text() for file in sorted(jobs.glob("*.json"))}
        check("kubeconform -strict, with that server's schemas", lambda: conform(kube, given, own_document(kube)))
        for version in kubeversions.SUMS:
            served = kubeversions.document(settings, version)
            check(f"the same for Kubernetes {version}", lambda served=served: conform(kube, given, served))
        check("server-side dry run", lambda: dry_run(kube, rendered))
        check("one file without Helm", lambda: chartrender.applied(kube, chart))
        check("install, rights in one leaderboard's namespace", lambda: installed(kube, chart))
        check("rights of people", lambda: people(kube))
        check("manifests of NOTES.txt", lambda: chartnotes.manifests(kube, chart, shown))
        check("examples of Chart.yaml", lambda: examples(kube, chart))
        check("values of examples/aws", lambda: aws_values(kube, chart, settings.repository / "examples" / "aws"))
        check("manifests of demo and quickstart", lambda: manifests(kube, settings.repository / "examples"))
        before = identities(kube)
        check("upgrade with roles, several leaderboards", lambda: upgraded(kube, chart))
        check("roll back", lambda: rolled_back(kube))
        check("uninstall keeps the definitions", lambda: uninstalled(kube))
        check("install again, and nothing is lost", lambda: installed_again(kube, chart, before))
        check("install, rights in all namespaces", lambda: all_namespaces(kube, chart))
        check("install, and no right of the cluster", lambda: namespaced(kube, chart))
        check("a release of another name takes over", lambda: taken_over(kube, chart))
    with apiserver.running(settings, folder) as kube:
        check("commands and manifests of the documents", lambda: docruns.check(settings, kube))


def check(what: str, work: Callable[[], str]) -> None:
    """One check; its answer is a short summary. A failed one ends the test."""
    started = time.monotonic()
    try:
        summary = work()
    except LabError as error:
        raise LabError(f"chart: {what}: {error}") from error
    print(f"ok    {what:<48} {summary} ({seconds(time.monotonic() - started)})", flush=True)


def copy_definitions(generated: Path, copied: Path) -> None:
    copied.mkdir(parents=True, exist_ok=True)
    for stale in copied.glob("*.yaml"):
        stale.unlink()
    for file in generated.glob("*.yaml"):
        shutil.copyfile(file, copied / file.name)


def same_definitions(generated: Path, copied: Path) -> str:
    wanted = {file.name: file.read_text() for file in generated.glob("*.yaml")}
    found = {file.name: file.read_text() for file in copied.glob("*.yaml")}
    if not wanted:
        raise LabError(f"{generated} is empty: run `make crds`")
    if wanted != found:
        raise LabError("the copy differs from crds/: run `local/lab chart-test --update`")
    for name, text in wanted.items():
        # The template puts the annotation there by text.
        if text.count("\nmetadata:\n") != 1 or "\nmetadata:\n  annotations:" in text:
            raise LabError(f"{name} has another shape than templates/crds.yaml expects")
    return f"{len(wanted)} files"


def rules_have_reasons(chart: Path) -> str:
    """A right without a reason can't be reviewed."""
    count = 0
    for file in sorted((chart / "templates").glob("*-rbac.yaml")):
        lines = file.read_text().splitlines()
        for number, line in enumerate(lines):
            if line.strip().startswith("- apiGroups:"):
                count += 1
                if not lines[number - 1].strip().startswith("#"):
                    raise LabError(
                        f"{file.name}:{number + 1} gives a right and does not say why: write a comment above it"
                    )
    return f"{count} rules"


def values_files(chart: Path) -> list[Path | None]:
    """None is values.yaml alone."""
    return [None, *sorted((chart / "ci").glob("*.yaml"))]


def with_values(file: Path | None) -> list[str]:
    return [SET_IMAGE, *([] if file is None else [f"--values={file}"])]


def lint(kube: Kube, chart: Path) -> str:
    for file in values_files(chart):
        done = kube.attempt("helm", "lint", "--strict", str(chart), *with_values(file))
        if done.returncode != 0:
            raise LabError(f"{file or 'values.yaml'}: {done.stdout.strip()[-600:]}")
    return f"{len(values_files(chart))} sets of values"


def aws_values(kube: Kube, chart: Path, examples: Path) -> str:
    """The file is for people to copy; with their names in it the chart takes it."""
    text = (examples / "values.yaml").read_text()
    for placeholder, value in (("<ACCOUNT_ID>", "123456789012"), ("<REGION>", "us-east-1"), ("<TAG>", "1.0.0")):
        text = text.replace(placeholder, value)
    argv = ["template", RELEASE, str(chart), f"--namespace={SYSTEM}", "--values=-"]
    found = chartrender.objects(kube, kube.run("helm", *argv, given=text))
    for program in ("controller", "bridge"):
        account = found[f"ServiceAccount/{RELEASE}-{program}"]["metadata"]["annotations"]
        role = account["eks.amazonaws.com/role-arn"]
        if role != f"arn:aws:iam::123456789012:role/leaderboard-{program}":
            raise LabError(f"the account of the {program} has the role {role}")
    return f"{len({id(one) for one in found.values()})} objects"


def refused_values(kube: Kube, chart: Path) -> str:
    argv = ["template", "x", str(chart), SET_IMAGE]
    answers = at_once(
        lambda case: kube.attempt("helm", *argv, *(f"--set-json={one}" for one in case[0])), chartcases.REFUSED
    )
    for (settings, word), done in zip(chartcases.REFUSED, answers, strict=True):
        if done.returncode == 0:
            raise LabError(f"{' '.join(settings)} was taken")
        if word not in done.stderr:
            raise LabError(f"{' '.join(settings)} was refused without the word {word}: {done.stderr.strip()[-300:]}")
    return f"{len(chartcases.REFUSED)} mistakes"


def render(kube: Kube, chart: Path, file: Path | None) -> str:
    return kube.run("helm", "template", RELEASE, str(chart), f"--namespace={SYSTEM}", *with_values(file))


def own_document(kube: Kube) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(kube.run("kubectl", "get", "--raw", "/openapi/v2"))
    return document


def conform(kube: Kube, given: Mapping[str, str], document: dict[str, Any]) -> str:
    """What the chart renders, and the Jobs as the controller makes them, are right by the schemas of a document."""
    kinds = [kind for text in given.values() for kind in KIND.findall(text)]
    with tempfile.TemporaryDirectory(prefix="leaderboard-schemas-") as folder:
        known, texts = Path(folder) / "schemas", Path(folder) / "given"
        known.mkdir()
        texts.mkdir()
        for name, schema in schemas.files(document, frozenset(kinds)):
            (known / name).write_text(json.dumps(schema))
        for name, text in given.items():
            (texts / name).write_text(text)
        location = f"-schema-location={known}/{schemas.TEMPLATE}"
        done = kube.attempt("kubeconform", "-strict", "-summary", "-output=json", location, str(texts))
    answer = json.loads(done.stdout or "{}")
    if done.returncode != 0:
        raise LabError(describe(answer) or done.stderr.strip()[-300:])
    valid = answer["summary"]["valid"]
    if valid != len(kinds):
        raise LabError(f"of {len(kinds)} objects it has judged {valid}")
    return f"{valid} objects"


def describe(answer: dict[str, Any]) -> str:
    bad = [one for one in answer.get("resources", []) if one["status"] != "statusValid"]
    return "; ".join(f"{Path(one['filename']).name}: {one['kind']} {one['name']}: {one['msg']}" for one in bad)[:600]


def dry_run(kube: Kube, rendered: Mapping[str, str]) -> str:
    """The server's own answer to each rendering; the Pods in it must be as confined as they claim."""
    argv = ["apply", "--server-side", "--dry-run=server", "--validate=strict", "--filename=-", "--output=json"]
    objects, judged = 0, set[str]()
    for text in rendered.values():
        # Many are the same with other values, the large definitions among them.
        new = [part for part in text.rstrip("\n").split("\n---\n") if part not in judged]
        judged.update(new)
        for item in documents(kube.run("kubectl", *argv, given="\n---\n".join(new))) if new else []:
            objects += 1
            if item["kind"] == "Deployment":
                confined(item)
    return f"{objects} objects"


def confined(deployment: dict[str, Any]) -> None:
    name, pod = deployment["metadata"]["name"], deployment["spec"]["template"]["spec"]
    rules = [pod["securityContext"].get("runAsNonRoot") is True]
    rules.append(pod["securityContext"].get("seccompProfile") == {"type": "RuntimeDefault"})
    for container in pod["containers"]:
        context = container["securityContext"]
        rules.append(context.get("readOnlyRootFilesystem") is True)
        rules.append(context.get("allowPrivilegeEscalation") is False)
        rules.append(context.get("capabilities") == {"drop": ["ALL"]})
        rules.append({"livenessProbe", "readinessProbe"} <= container.keys())
        rules.append("memory" in container["resources"].get("limits", {}))
    if not all(rules):
        raise LabError(f"Deployment {name} is less confined than the chart claims: {pod['securityContext']}")


def helm(kube: Kube, chart: Path, *more: str) -> None:
    kube.run("helm", "upgrade", "--install", RELEASE, str(chart), f"--namespace={SYSTEM}", SET_IMAGE, *more)


def installed(kube: Kube, chart: Path) -> str:
    helm(kube, chart, '--set-json=namespaces=["leaderboard"]', '--set-json=allow.secrets=["evalai"]')
    return rights(kube, chartcases.DEFAULT)


def people(kube: Kube) -> str:
    """Binds the cluster's own roles, and the chart's for hosts. No controller manager runs here that aggregates: it is done by hand."""
    roles = kube.json("kubectl", "get", "clusterroles")["items"]
    lists = [aggregated("view", "view", roles), aggregated("edit", "view edit", roles)]
    lists += [aggregated("admin", "view edit admin", roles)]
    bindings = [bound("view", "view"), bound("edit", "edit"), bound("admin", "admin"), bound("host", f"{RELEASE}-host")]
    made = {"apiVersion": "v1", "kind": "List", "items": [*lists, *bindings]}
    kube.run("kubectl", "apply", "--server-side", "--force-conflicts", "--filename=-", given=json.dumps(made))
    return rights(kube, tuple(chartcases.people("leaderboard")))


def aggregated(name: str, labels: str, roles: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A role with all rules that the labels add to it, as the controller manager would make it."""
    marks = {f"rbac.authorization.k8s.io/aggregate-to-{label}" for label in labels.split()}
    parts = [role for role in roles if marks & (role["metadata"].get("labels") or {}).keys()]
    rules = [rule for role in parts for rule in role.get("rules") or []]
    return {
        "apiVersion": "rbac.authorization.k8s.io/v1",
        "kind": "ClusterRole",
        "metadata": {"name": f"test-{name}"},
        "rules": rules,
    }


def bound(account: str, role: str) -> dict[str, Any]:
    return {
        "apiVersion": "rbac.authorization.k8s.io/v1",
        "kind": "RoleBinding",
        "metadata": {"name": f"test-{account}", "namespace": "leaderboard"},
        "roleRef": {
            "apiGroup": "rbac.authorization.k8s.io",
            "kind": "ClusterRole",
            "name": role if role.startswith(RELEASE) else f"test-{role}",
        },
        "subjects": [{"kind": "ServiceAccount", "name": account, "namespace": SYSTEM}],
    }


def examples(kube: Kube, chart: Path) -> str:
    """Artifact Hub shows them: the server must take them, and their kinds must be the definitions'. They stay for what follows."""
    text = (chart / "Chart.yaml").read_text()
    for name in CRDS:
        if f"name: {name}\n" not in artifacthub.block(text, "crds"):
            raise LabError(f"artifacthub.io/crds of Chart.yaml lacks {name}")
    indented = "".join(f"  {line}\n" for line in artifacthub.block(text, "crdsExamples").splitlines())
    argv = ["apply", "--server-side", "--validate=strict", "--namespace=leaderboard", "--filename=-"]
    taken = kube.run("kubectl", *argv, "--output=name", given=f"apiVersion: v1\nkind: List\nitems:\n{indented}")
    return f"{len(taken.splitlines())} objects"


def manifests(kube: Kube, examples: Path) -> str:
    """They are applied on clusters alone, which few have; the server must take them, without a word."""
    demo = [file for file in sorted((examples / "demo").glob("*.yaml")) if file.name != "values.yaml"]
    files = [*demo, examples / "quickstart.yaml"]
    for file in files:
        # Each submission of the demo gets a name of its own, which an apply can't give.
        verb = ["create"] if "generateName:" in file.read_text() else ["apply", "--server-side"]
        done = kube.attempt("kubectl", *verb, "--dry-run=server", "--validate=strict", f"--filename={file}")
        if done.returncode != 0 or done.stderr:
            raise LabError(f"{file.name}: {done.stderr.strip()[-400:]}")
    return f"{len(files)} files"


def upgraded(kube: Kube, chart: Path) -> str:
    helm(kube, chart, f"--values={chart / 'ci' / 'roles.yaml'}")
    return rights(kube, chartcases.WITH_ROLES)


def rolled_back(kube: Kube) -> str:
    """To the first installation, with its rights."""
    kube.run("helm", "rollback", RELEASE, "1", f"--namespace={SYSTEM}")
    return rights(kube, chartcases.DEFAULT)


def identities(kube: Kube) -> dict[str, str]:
    """What must outlive the release: its objects by their uid, which one that is made anew would not have."""
    items = kube.json("kubectl", "get", "leaderboards,submissions", "--all-namespaces")["items"]
    return {f"{item['kind']} {item['metadata']['name']}": item["metadata"]["uid"] for item in items}


def installed_again(kube: Kube, chart: Path, before: dict[str, str]) -> str:
    helm(kube, chart)
    after = identities(kube)
    kube.run("helm", "uninstall", RELEASE, f"--namespace={SYSTEM}")
    if not before or after != before:
        raise LabError(f"there were {before} and are {after}")
    return f"{len(after)} objects of hosts and participants"


def uninstalled(kube: Kube) -> str:
    kube.run("helm", "uninstall", RELEASE, f"--namespace={SYSTEM}")
    kube.run("kubectl", "get", "crd", *CRDS)
    left = kube.json(
        "kubectl", "get", "clusterroles,clusterrolebindings", "--selector=app.kubernetes.io/part-of=" + RELEASE
    )
    if left["items"]:
        raise LabError(f"{len(left['items'])} cluster roles or bindings are left behind")
    return "and nothing else"


def all_namespaces(kube: Kube, chart: Path) -> str:
    helm(kube, chart, f"--values={chart / 'ci' / 'all-namespaces.yaml'}")
    summary = rights(kube, chartcases.CLUSTER_WIDE)
    kube.run("helm", "uninstall", RELEASE, f"--namespace={SYSTEM}")
    return summary


def namespaced(kube: Kube, chart: Path) -> str:
    helm(kube, chart, f"--values={chart / 'ci' / 'namespaced.yaml'}")
    summary = rights(kube, chartcases.NAMESPACED)
    kube.run("helm", "uninstall", RELEASE, f"--namespace={SYSTEM}")
    # crds.keep=false: the definitions don't outlive the release.
    chartrender.definitions_removed(kube)
    return summary


def taken_over(kube: Kube, chart: Path) -> str:
    """The definitions that an uninstalled release leaves are still marked as its own."""
    helm(kube, chart)
    kube.run("helm", "uninstall", RELEASE, f"--namespace={SYSTEM}")
    install = ("helm", "install", "other", str(chart), f"--namespace={SYSTEM}", SET_IMAGE)
    try:
        kube.run(*install)
    except LabError:
        kube.run(*install, "--take-ownership", "--force-conflicts")
        kube.run("helm", "uninstall", "other", f"--namespace={SYSTEM}")
        return "only with --take-ownership"
    raise LabError("helm takes the definitions over by itself: the README need not ask for --take-ownership")


def rights(kube: Kube, cases: tuple[Access, ...]) -> str:
    """Asks the server's authorizer each question, in one request after the other of one kubectl."""
    reviews = "\n---\n".join(json.dumps(review(case)) for case in cases)
    answers = documents(kube.run("kubectl", "create", "--filename=-", "--output=json", given=reviews))
    wrong = [
        f"{case.account} may {'not ' if case.allowed else ''}{case.verb} {case.resource} in {case.namespace or 'the cluster'}"
        for case, answer in zip(cases, answers, strict=True)
        if answer["status"].get("allowed", False) != case.allowed
    ]
    if wrong:
        raise LabError("; ".join(wrong))
    return f"{len(cases)} questions to the authorizer"


def review(case: Access) -> dict[str, Any]:
    group, _, rest = case.resource.rpartition("/") if case.resource.count("/") else ("", "", case.resource)
    resource, _, subresource = rest.partition(":")
    attributes = {
        "namespace": case.namespace,
        "verb": case.verb,
        "group": group,
        "resource": resource,
        "subresource": subresource,
        "name": case.name,
    }
    user = f"system:serviceaccount:{SYSTEM}:{case.account}"
    groups = ["system:serviceaccounts", "system:authenticated"]
    return {
        "apiVersion": "authorization.k8s.io/v1",
        "kind": "SubjectAccessReview",
        "spec": {"user": user, "groups": groups, "resourceAttributes": attributes},
    }
