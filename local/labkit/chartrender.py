"""Owns what the chart renders for given values: the objects, the text after an installation, and one file to install without Helm.

Called by `charttest` and by `lab install-yaml`. Rendering asks no cluster; kubectl only turns YAML into JSON.
"""

import json
import re
import tempfile
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from . import chartdocs, chartmetrics, chartshows
from .chartcases import IMAGE, RELEASE, SET_IMAGE, SYSTEM
from .chartshown import ABSENT, MONITORING, Case, Shown
from .errors import LabError
from .kube import Kube, at_once

SOURCE = re.compile(r"^# Source: leaderboard-operator/(templates/\S+)$", re.MULTILINE)
MONITORING_KINDS = ("PodMonitor", "ServiceMonitor", "PrometheusRule")
# Three minutes for the removal of the definitions, which the API server is reminded of every 5 s.
REMOVAL_LOOKS, REMOVAL_PAUSE = 36, 5
# Stands before each of several texts that one kubectl reads.
MARK = "Text"
DEFINITION = "CustomResourceDefinition/"
# The definitions are most of what the chart renders, and the same for all values but those that are about them.
LEAN: Mapping[str, Any] = {"crds.enabled": False}


def folder(repository: Path) -> Path:
    return repository / "charts" / RELEASE


def template(kube: Kube, chart: Path, values: Mapping[str, Any], kinds: Sequence[str] = ()) -> str:
    """The objects of some values, as YAML. `kinds` are those that the cluster is to have, as group/version/kind."""
    argv = ["template", RELEASE, str(chart), f"--namespace={SYSTEM}", "--values=-"]
    argv += (f"--api-versions={kind}" for kind in kinds)
    return kube.run("helm", *argv, given=json.dumps(nested({**IMAGE, **values})))


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """`{"a.b": 1}` as `{"a": {"b": 1}}`; keys of the values themselves stay as they are."""
    result: dict[str, Any] = {}
    for path, value in values.items():
        *groups, name = path.split(".")
        place = result
        for group in groups:
            place = place.setdefault(group, {})
        place[name] = {**place.get(name, {}), **value} if isinstance(value, dict) else value
    return result


def objects(kube: Kube, manifests: str) -> dict[str, dict[str, Any]]:
    """The objects of a YAML text by kind/namespace/name, and by kind/name, which is the first of that name.

    An empty patch that kubectl makes here gives them back as JSON.
    """
    return by_name(as_json(kube, manifests))


def objects_of_each(kube: Kube, texts: Sequence[str]) -> list[dict[str, dict[str, Any]]]:
    """The same for each of many texts, by one kubectl."""
    mark = f"---\napiVersion: v1\nkind: {MARK}\nmetadata: {{name: mark}}\n---\n"
    found: list[list[dict[str, Any]]] = []
    for item in as_json(kube, "".join(f"{mark}{text}\n" for text in texts)):
        if item["kind"] == MARK:
            found.append([])
        else:
            found[-1].append(item)
    if len(found) != len(texts):
        raise LabError(f"kubectl has given back {len(found)} texts of {len(texts)}")
    return [by_name(items) for items in found]


def as_json(kube: Kube, manifests: str) -> list[dict[str, Any]]:
    argv = ["patch", "--local", "--filename=-", "--type=merge", "--patch={}", "--output=json"]
    return documents(kube.run("kubectl", *argv, given=manifests))


def by_name(items: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for item in items:
        kind, metadata = item["kind"], item["metadata"]
        name = f"{kind}/{metadata.get('namespace', '')}/{metadata['name']}"
        if name in found:
            raise LabError(f"{name} is rendered twice")
        found[name] = item
        found.setdefault(f"{kind}/{metadata['name']}", item)
    return found


def documents(text: str) -> list[dict[str, Any]]:
    """JSON objects one after the other, or one List of them."""
    found, decoder, place = [], json.JSONDecoder(), 0
    text = text.strip()
    while place < len(text):
        value, place = decoder.raw_decode(text, place)
        found += value["items"] if value.get("kind") == "List" else [value]
        while place < len(text) and text[place].isspace():
            place += 1
    return found


def at(value: Any, path: str) -> Any:
    """What is at a path, whose parts are keys or places in a list; ABSENT where there is nothing."""
    for part in filter(None, path.split(".")):
        if isinstance(value, list) and part.isdecimal() and int(part) < len(value):
            value = value[int(part)]
        elif isinstance(value, dict) and part in value:
            value = value[part]
        else:
            return ABSENT
    return value


def holds(found: Any, wanted: Any) -> bool:
    """True if all that is wanted is there: maps may have more keys and lists more members."""
    if isinstance(wanted, dict) and isinstance(found, dict):
        return all(key in found and holds(found[key], value) for key, value in wanted.items())
    if isinstance(wanted, list) and isinstance(found, list):
        return all(any(holds(one, value) for one in found) for value in wanted)
    return bool(found == wanted) and type(found) is type(wanted)


def fault(rendered: Mapping[str, Any], shown: Shown) -> str | None:
    value = rendered.get(shown.object, ABSENT)
    found = at(value, shown.path) if value != ABSENT else ABSENT
    if value == ABSENT and shown.path:
        return f"there is no {shown.object}"
    if holds(found, shown.holds):
        return None
    return f"{shown.object}: {shown.path or 'the object'} is {json.dumps(found)[:300]}, not {json.dumps(shown.holds)}"


def every_value(kube: Kube, chart: Path) -> str:
    """Renders each case; then no value and no template may be without one."""
    texts = at_once(lambda case: template(kube, chart, lean(case), case.kinds), chartshows.CASES)
    sources = set(SOURCE.findall("\n".join(texts)))
    for case, rendered in zip(chartshows.CASES, objects_of_each(kube, texts), strict=True):
        faults = [text for shown in case.shown if (text := fault(rendered, shown))]
        if faults:
            raise LabError(f"with {json.dumps(case.values)}: {'; '.join(faults)}")
    untested = without_case(chart, chartshows.CASES)
    idle = sorted({f"templates/{file.name}" for file in (chart / "templates").glob("*.yaml")} - sources)
    if untested or idle:
        raise LabError(f"chartshows.py has no case for the values {untested} and none that renders {idle}: add them")
    return f"{len(chartshows.CASES)} cases, {sum(len(case.shown) for case in chartshows.CASES)} assertions"


def lean(case: Case) -> Mapping[str, Any]:
    """The values of a case, without the definitions where it is about other objects."""
    is_about_them = any(shown.object.startswith(DEFINITION) for shown in case.shown)
    return case.values if is_about_them else {**LEAN, **case.values}


def without_case(chart: Path, cases: Sequence[Case]) -> list[str]:
    """Values that no case sets."""
    given = {path for case in cases for path in paths(case.values)}
    return [path for path in chartdocs.leaves((chart / "values.yaml").read_text()) if path not in given]


def paths(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """The paths of values, those of groups among them."""
    for name, value in values.items():
        yield prefix + name
        if isinstance(value, dict):
            yield from paths(value, f"{prefix}{name}.")


def queries(kube: Kube, chart: Path, repository: Path) -> str:
    """Every metric, label and value that an alert or the dashboard asks for must be one that the operator exports."""
    values = {"prometheusRule.enabled": True, "grafanaDashboard.enabled": True}
    kinds = [f"{MONITORING}/{kind}" for kind in MONITORING_KINDS]
    rendered = objects(kube, template(kube, chart, values, kinds))
    rules = rendered[f"PrometheusRule/{RELEASE}"]["spec"]
    dashboard = json.loads(rendered[f"ConfigMap/{RELEASE}-dashboard"]["data"]["leaderboard-operator.json"])
    as_they_are(kube, chart / "files", rules, dashboard)
    asked = [*of_alerts(rules["groups"]), *of_dashboard(dashboard)]
    metrics, literals = chartmetrics.of_repository(repository)
    wrong = [f"{name}: {one}" for name, query in asked for one in chartmetrics.faults(query, metrics, literals)]
    if wrong:
        raise LabError("; ".join(wrong))
    return f"{len(asked)} queries, {len(metrics)} metrics"


def as_they_are(kube: Kube, files: Path, rules: Mapping[str, Any], dashboard: Mapping[str, Any]) -> None:
    """A real Prometheus reads the files (`tests/api/prometheus.rs`), so the objects must hold the same."""
    written = textwrap.indent((files / "alerts.yaml").read_text(), "  ")
    head = "apiVersion: v1\nkind: Written\nmetadata: {name: alerts}\nspec:\n"
    wanted = objects(kube, head + written)["Written/alerts"]["spec"]
    if rules != wanted:
        raise LabError("the PrometheusRule differs from files/alerts.yaml")
    if dashboard != json.loads((files / "dashboard.json").read_text()):
        raise LabError("the ConfigMap of the dashboard differs from files/dashboard.json")


def of_alerts(groups: Sequence[dict[str, Any]]) -> Iterator[tuple[str, str]]:
    """The name and the query of each alert, which must have what people need to act."""
    for rule in (rule for group in groups for rule in group["rules"]):
        missing = {"summary", "description"} - rule["annotations"].keys()
        if missing or rule["labels"].get("severity") not in ("critical", "warning"):
            raise LabError(f"{rule['alert']} has no {', '.join(missing) or 'severity of critical or warning'}")
        yield rule["alert"], rule["expr"]


def of_dashboard(dashboard: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for panel in dashboard["panels"]:
        for target in panel.get("targets", []):
            yield panel["title"], target["expr"]
    for variable in dashboard["templating"]["list"]:
        if variable["type"] == "query":
            yield variable["name"], variable["query"]["query"]


def one_file(kube: Kube, chart: Path, more: Sequence[str] = ()) -> str:
    """All that is to be applied where there is no Helm: the namespace, the definitions and the operator. `more` is for `helm template`."""
    namespace = f"apiVersion: v1\nkind: Namespace\nmetadata:\n  name: {SYSTEM}\n"
    argv = ["template", RELEASE, str(chart), f"--namespace={SYSTEM}", "--no-hooks", *more]
    return f"# kubectl apply --server-side --filename=FILE\n{namespace}{kube.run('helm', *argv)}"


def applied(kube: Kube, chart: Path) -> str:
    """The one file goes in, and out again."""
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", prefix="leaderboard-") as file:
        file.write(one_file(kube, chart, [SET_IMAGE, '--set-json=namespaces=[{"name":"other","secrets":["evalai"]}]']))
        file.flush()
        argv = [f"--filename={file.name}", "--output=name"]
        made = kube.run("kubectl", "apply", "--server-side", "--validate=strict", *argv).splitlines()
        # Nothing here would empty a namespace that is deleted.
        selector = f"--selector=app.kubernetes.io/part-of={RELEASE}"
        kinds = "deployments,services,poddisruptionbudgets,serviceaccounts,roles,rolebindings,clusterroles,clusterrolebindings"
        gone = kube.run("kubectl", "delete", kinds, selector, "--all-namespaces", "--output=name").splitlines()
        kube.run("kubectl", "delete", "crd", "--all", "--wait=false")
        definitions_removed(kube)
    if len(made) != len(gone) + len(("namespace", "leaderboards", "submissions")):
        raise LabError(
            f"{len(made)} objects were applied, and {len(gone)} could be deleted by their label: {made} {gone}"
        )
    return f"{len(made)} objects"


def definitions_removed(kube: Kube) -> None:
    """Waits until every definition is gone. The API server's finalizer pauses longer after each failure, so a change of each one makes
    it look again."""
    left: list[str] = []
    for number in range(REMOVAL_LOOKS):
        left = kube.run("kubectl", "get", "crd", "--output=name").split()
        if not left:
            return
        for name in left:
            # It may be gone by now.
            kube.attempt("kubectl", "annotate", name, f"reminder={number}", "--overwrite")
        kube.attempt("kubectl", "wait", "--for=delete", f"--timeout={REMOVAL_PAUSE}s", *left)
    raise LabError(f"after {REMOVAL_LOOKS * REMOVAL_PAUSE} s there still are {', '.join(left)}")
